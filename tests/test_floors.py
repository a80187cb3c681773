"""The house has floors, and imports point only down."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

import pk_jax

HOUSE = Path(pk_jax.__file__).parent

GROUND = ("status", "checks", "precision")
FLOORS = ("geometry", "mechanisms", "kinematics", "analysis", "design", "control", "files", "viz")
TOP = ("papers", "cli")
RANK = {name: 0 for name in GROUND} | {name: i + 1 for i, name in enumerate((*FLOORS, *TOP))}
RANK["pk_jax"] = RANK["viz"]  # `import pk_jax as pk` sees every public name: for papers/ and cli only
RANK["__main__"] = RANK["cli"]

EVERYWHERE = None
WHERE = {  # who may import what from outside
    "jax": EVERYWHERE,
    "jaxlib": {"kinematics"},
    "numpy": EVERYWHERE,
    "optax": {"design"},
    "matplotlib": {"viz"},
    "mpl_toolkits": {"viz"},
}


def floor_of(path: Path, house: Path) -> str:
    """The folder or file of the house's top level that `path` lies in."""
    first = path.relative_to(house).parts[0].removesuffix(".py")
    return "pk_jax" if first == "__init__" else first


def imports_of(path: Path, house: Path):
    """Every module that the file imports, with its line and whether that waits for a call."""
    parts = ("pk_jax", *path.relative_to(house).with_suffix("").parts)
    package = parts[:-1]
    tree = ast.parse(path.read_text())
    functions = [
        n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
    ]
    deferred = {id(inner) for function in functions for inner in ast.walk(function)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            near = package[: len(package) - node.level + 1] if node.level else ()
            stem = ".".join((*near, *(node.module or "").split("."))).strip(".")
            names = [f"{stem}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            called = getattr(node.func, "attr", getattr(node.func, "id", ""))
            names = [node.args[0].value] if called in ("import_module", "__import__") else []
        else:
            continue
        for name in names:
            yield name, node.lineno, id(node) in deferred


def complaint(path: Path, house: Path, name: str, line: int, is_deferred: bool) -> str | None:
    """What is wrong with one import, as a sentence; None where nothing is."""
    floor = floor_of(path, house)
    said = f"{path.relative_to(house.parent)}:{line} imports {name}"
    head, *rest = name.split(".")
    if floor == "cli" and is_deferred:
        return None
    if head != "pk_jax":
        if head in sys.stdlib_module_names:
            return None
        if head not in WHERE:
            return f"{said}, which is not a dependency of the library"
        if WHERE[head] is not EVERYWHERE and floor not in WHERE[head]:
            return f"{said}, which only {', '.join(sorted(WHERE[head]))}/ may"
        return None
    if floor == "pk_jax":  # the front door may show every floor
        return None if rest and rest[0] in RANK else f"{said}, which is no floor of the house"
    target = rest[0] if rest and rest[0] in RANK else "pk_jax"
    if RANK[target] > RANK[floor] or (target == "pk_jax" and floor not in TOP):
        return f"{said}, but {floor} stands below {target}: imports point only down"
    return None


def complaints(house: Path) -> list[str]:
    found = []
    for path in sorted(house.rglob("*.py")):
        if (floor := floor_of(path, house)) not in RANK:
            found.append(f"{path.relative_to(house.parent)} is on no known floor: {floor} is unknown")
            continue
        wrong = (complaint(path, house, *each) for each in imports_of(path, house))
        found += [sentence for sentence in wrong if sentence]
    folders = [p for p in house.iterdir() if p.is_dir() and p.name != "__pycache__"]
    found += [f"pk_jax/{p.name} is an unknown floor" for p in folders if p.name not in RANK]
    return found


def test_imports_point_only_down():
    assert not complaints(HOUSE), "\n".join(complaints(HOUSE))


PLANTED = [
    ("geometry/a.py", "from pk_jax.mechanisms.base import Mechanism", "stands below mechanisms"),
    ("checks.py", "import pk_jax.geometry.safe", "stands below geometry"),
    ("kinematics/a.py", "from pk_jax import analysis", "stands below analysis"),
    ("kinematics/a.py", "from ..analysis.indices import local_indices", "stands below analysis"),
    ("kinematics/a.py", "from .. import design", "stands below design"),
    ("mechanisms/a.py", "def late():\n    from pk_jax.files import toml", "stands below files"),
    ("files/a.py", "import pk_jax.viz.draw", "stands below viz"),
    ("papers/a.py", "from pk_jax.cli import main", "stands below cli"),
    ("analysis/a.py", "import pk_jax as pk", "stands below pk_jax"),
    ("design/a.py", "from pk_jax import FiveBar", "stands below pk_jax"),
    ("control/a.py", "import importlib\nimportlib.import_module('pk_jax.cli')", "stands below cli"),
    ("design/a.py", "import matplotlib.pyplot as plt", "only viz/ may"),
    ("papers/a.py", "def draw():\n    import matplotlib", "only viz/ may"),
    ("analysis/a.py", "from optax import adam", "only design/ may"),
    ("cli.py", "import optax", "only design/ may"),
    ("viz/a.py", "def far():\n    from scipy import optimize", "not a dependency"),
    ("__init__.py", "from pk_jax.attic import thing", "no floor of the house"),
    ("attic/a.py", "x = 1", "attic is unknown"),
    ("attic.py", "x = 1", "attic is unknown"),
    ("attic/data.csv", "x = 1", "unknown floor"),
]


@pytest.mark.parametrize(("file", "text", "expected"), PLANTED)
def test_a_planted_fault_is_named(tmp_path, file, text, expected):
    house = tmp_path / "pk_jax"
    (house / file).parent.mkdir(parents=True)
    (house / file).write_text(text + "\n")
    said = complaints(house)
    assert said and expected in said[0]
    assert file.split(".")[0].split("/")[0] in said[0]


GOOD = [
    ("geometry/a.py", "from pk_jax import checks\nimport numpy as np\nimport math"),
    ("kinematics/a.py", "from .newton import solve\nfrom pk_jax.kinematics.jacobian import units"),
    ("viz/a.py", "import matplotlib.pyplot as plt\nfrom pk_jax.files import toml"),
    ("design/a.py", "def go():\n    import optax"),
    ("papers/a.py", "import pk_jax as pk\nfrom pk_jax import FiveBar, viz"),
    ("cli.py", "def run():\n    import matplotlib, optax\n    from pk_jax import papers"),
    ("__init__.py", "from pk_jax.viz.draw import draw as draw"),
]


@pytest.mark.parametrize(("file", "text"), GOOD)
def test_good_imports_pass(tmp_path, file, text):
    house = tmp_path / "pk_jax"
    (house / file).parent.mkdir(parents=True)
    (house / file).write_text(text + "\n")
    assert complaints(house) == []
