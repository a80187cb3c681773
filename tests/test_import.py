"""Importing the library does nothing but import it."""

import ast
import inspect
import json
import subprocess
import sys

import pytest

import pk_jax as pk

WATCH = """
import json, sys
import pk_jax
loaded = sorted({name.partition(".")[0] for name in sys.modules})
import jax
before = dict(jax.config.values)
for name in pk_jax.__all__:  # every module that a public name lives in
    getattr(pk_jax, name)
after = dict(jax.config.values)
from jax._src import xla_bridge
print(json.dumps({
    "changed": sorted(k for k in after.keys() | before.keys() if after.get(k) != before.get(k)),
    "backends": xla_bridge.backends_are_initialized(),
    "loaded": loaded,
}))
jax.numpy.zeros(())
print(xla_bridge.backends_are_initialized())  # the question above can be answered with yes
"""


@pytest.fixture(scope="module")
def watched():
    ran = subprocess.run(
        [sys.executable, "-W", "error", "-c", WATCH], capture_output=True, text=True, timeout=120
    )
    assert ran.returncode == 0, ran.stderr
    first, control = ran.stdout.splitlines()
    return json.loads(first) | {"control": control}


def test_import_starts_no_backend(watched):
    assert watched["control"] == "True"
    assert watched["backends"] is False


def test_import_changes_no_setting(watched):
    assert watched["changed"] == []


@pytest.mark.parametrize("heavy", ["matplotlib", "optax", "jax", "numpy"])
def test_import_leaves_out(watched, heavy):
    assert "pk_jax" in watched["loaded"]
    assert heavy not in watched["loaded"]


PUBLIC = pk.__all__


def test_the_names_for_type_checkers_are_the_names_that_exist():
    imports = [
        node for node in ast.walk(ast.parse(inspect.getsource(pk))) if isinstance(node, ast.ImportFrom)
    ]
    stated = {(f"{node.module}", alias.asname) for node in imports for alias in node.names}
    assert {(module, name) for module, name in stated if module != "typing"} == {
        (module, name) for module, names in pk._NAMES.items() for name in names
    }


def test_a_name_that_does_not_exist():
    with pytest.raises(AttributeError, match="module 'pk_jax' has no attribute 'five_bar'"):
        _ = pk.five_bar


@pytest.mark.parametrize("name", PUBLIC)
def test_every_public_name_is_documented(name):
    value = getattr(pk, name)
    doc = inspect.getdoc(value) if callable(value) or inspect.isclass(value) else None
    assert doc, f"pk_jax.{name} has no docstring"
    assert not doc.startswith(f"{name}("), f"pk_jax.{name} has only the docstring Python made up"
    own = vars(value).get("__doc__") if inspect.isclass(value) else doc
    assert own, f"pk_jax.{name} inherits its docstring"


def test_public_names_come_from_the_library():
    assert {"FiveBar", "TwoRPR", "check_mechanism", "inverse_kinematics"} <= set(PUBLIC)
    assert not [n for n in PUBLIC if not f"{getattr(pk, n).__module__}.".startswith("pk_jax.")]
