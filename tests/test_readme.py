"""What the README names exists; tests/test_reproduce.py runs its code."""

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def test_every_target_that_is_named_exists():
    makefile = (ROOT / "Makefile").read_text()
    contributing = (ROOT / "CONTRIBUTING.md").read_text()
    named = set(re.findall(r"(?:^    |`)make (\w+)", README + contributing, re.M))
    assert {"reproduce", "test", "bench", "lint"} <= named
    assert named <= set(re.findall(r"^(\w+):", makefile, re.M))


def test_linked_files_exist():
    for link in re.findall(r"\]\(([^)#:]+)\)|`([\w./]+\.(?:md|py|ipynb))`", README):
        assert (ROOT / "".join(link)).exists(), link
