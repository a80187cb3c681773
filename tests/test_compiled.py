"""Programs of lanes: the options reach XLA, whatever fails falls back, and kept programs are checked."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import pk_jax as pk
from pk_jax.kinematics import compiled, rows
from pk_jax.kinematics.entrywise import Invariants, entrywise
from pk_jax.kinematics.lanes import Entries, split

ARMS = pk.FiveBar(half_base=1.0, proximal=1.0, distal=2.15)
JOINTS = np.asarray(ARMS.home()[1]) + np.linspace(-0.3, 0.3, 130)[:, None] * [1.0, -0.7]


@pytest.fixture
def kept(tmp_path):
    """JAX's folder for compiled programs."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


def doubled(options=compiled.FULL):
    program = compiled.compiled(lambda x: jnp.sin(x) * 2, (jnp.ones(5),), options)
    return np.asarray(program([jnp.arange(5.0)])[0])


EXPECTED = 2 * np.sin(np.arange(5.0))


def test_the_extra_options_reach_this_jaxlib():
    lowered = jax.jit(jnp.sin).lower(jnp.ones(5))
    assert compiled.with_extra_options(lowered, compiled.FULL) is not None
    unknown = compiled.FULL._replace(width="wide")
    assert compiled.with_extra_options(lowered, unknown) is None


@pytest.mark.parametrize("options", [compiled.PLAIN, compiled.WIDE, compiled.FULL])
def test_every_way_of_compiling_computes_the_same(options):
    np.testing.assert_allclose(doubled(options), EXPECTED, rtol=1e-15)
    poses = [
        rows.solve(ARMS, JOINTS, None, one_guess=True, options=each).pose
        for each in (options, compiled.PLAIN)
    ]
    np.testing.assert_allclose(*poses, rtol=0, atol=1e-14)


def test_without_the_client_it_compiles_the_ordinary_way(monkeypatch):
    monkeypatch.setattr(compiled.backend, "get_compile_options", None)
    np.testing.assert_allclose(doubled(), EXPECTED, rtol=1e-15)


def test_programs_are_kept_where_jax_keeps_its_own(kept, monkeypatch):
    first = doubled()
    (file,) = kept.glob("pk_jax-*")
    assert file.stat().st_mode & 0o077 == 0  # machine code: for the user's eyes only
    monkeypatch.setattr(compiled, "_write", lambda *_: pytest.fail("compiled again"))
    np.testing.assert_array_equal(doubled(), first)


@pytest.mark.parametrize("damage", [b"", b"short", None])
def test_a_damaged_program_is_compiled_again(kept, damage):
    first = doubled()
    (file,) = kept.glob("pk_jax-*")
    whole = file.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    file.write_bytes(bytes(flipped) if damage is None else damage)
    np.testing.assert_array_equal(doubled(), first)
    assert file.read_bytes()[:32] == whole[:32] or len(file.read_bytes()) > 32


def test_another_program_and_other_options_have_other_files(kept):
    doubled()
    doubled(compiled.FULL._replace(width=256))
    compiled.compiled(lambda x: jnp.cos(x), (jnp.ones(5),))
    assert len(list(kept.glob("pk_jax-*"))) == 3


def test_a_folder_that_cannot_be_written_is_no_cache(kept):
    jax.config.update("jax_compilation_cache_dir", str(kept / "missing"))
    np.testing.assert_allclose(doubled(), EXPECTED, rtol=1e-15)


def test_what_the_joints_alone_determine_is_computed_before_the_loop():
    """No cosine is left in the body; the values are those of the plain loop."""

    def linearize(mech, pose, joints):
        return mech.linearize(pose, joints)[1]

    def both(joints, pose):
        mech, q = jax.tree.map(split, ARMS), split(joints)
        invariants = Invariants(mech, q)
        entrywise(linearize, mech, split(pose), q, invariants=invariants)

        def body(_, items):
            found = entrywise(linearize, mech, Entries((2,), list(items)), q, invariants=invariants).items
            return items[0] + 0.1 * found[0], items[1] + 0.1 * found[3]

        return lax.fori_loop(0, 3, body, tuple(pose))

    pose, joints = ARMS.home()
    loop = next(e for e in jax.make_jaxpr(both)(joints, pose).eqns if e.primitive.name in ("scan", "while"))
    inside = {e.primitive.name for e in jax.tree.leaves(loop.params, is_leaf=_is_jaxpr)[0].eqns}
    assert "cos" not in inside and "add" in inside

    expected = np.asarray(pose)
    for _ in range(3):
        a = np.asarray(ARMS.linearize(jnp.asarray(expected), joints)[1])
        expected = expected + 0.1 * np.diagonal(a)
    np.testing.assert_allclose(both(joints, pose), expected, rtol=1e-14)


def _is_jaxpr(leaf):
    return hasattr(leaf, "eqns")
