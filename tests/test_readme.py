"""The README's code does what its comments say, and its commands exist."""

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def test_the_ten_lines(capsys):
    code = re.search(r"```python\n(.*?)```", README, re.S)[1]
    assert sum(bool(line.strip()) for line in code.splitlines()) <= 12
    exec(compile(code, "README.md", "exec"), {})
    printed = capsys.readouterr().out.splitlines()
    promised = re.findall(r"print\(.*\)\s+# ([\['].*)$", code, re.M)
    assert len(promised) == 2
    assert printed[0] == promised[0]
    assert [float(x) for x in printed[1].strip("[]").split()] == [0.3, 2.2]
    assert any(line.startswith("FiveBar(half_base=1.0, proximal=1.0, distal=2.1006") for line in printed)
    assert "('v = 0',)" in printed[-1]


def test_every_target_that_is_named_exists():
    makefile = (ROOT / "Makefile").read_text()
    contributing = (ROOT / "CONTRIBUTING.md").read_text()
    named = set(re.findall(r"(?:^    |`)make (\w+)", README + contributing, re.M))
    assert {"reproduce", "test", "bench", "lint"} <= named
    assert named <= set(re.findall(r"^(\w+):", makefile, re.M))


def test_linked_files_exist():
    for link in re.findall(r"\]\(([^)#:]+)\)|`([\w./]+\.(?:md|py|ipynb))`", README):
        assert (ROOT / "".join(link)).exists(), link
