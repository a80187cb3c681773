"""A row that cannot be answered changes no bit of another one, whatever is in it and wherever it stands."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from outsiders import delta

import pk_jax as pk
from pk_jax import Status
from pk_jax.kinematics.compiled import FULL
from pk_jax.kinematics.in_blocks import BLOCK

POISONS = (np.nan, np.inf, -np.inf, 1e300, -1e300, 5e-324, 0.0)
RPR, ARMS = pk.catalogued("nam-2-rpr"), pk.catalogued("nam-2-rrr")
WHOLE = BLOCK + 5  # rows that two threads share, and the last chunk of lanes is not full
SHARE = -(-WHOLE // 2)
EDGES = (0, FULL.lanes - 1, FULL.lanes, SHARE - 1, SHARE, WHOLE - 1)
FEW = 19


class Case(NamedTuple):
    """A public function of rows, and rows of it."""

    call: Callable[[Any], Any]
    rows: Any  # a tree of arrays, batch first; the first number of a row is what is spoiled
    edges: tuple[int, ...] = (0, 7, 8, FEW - 1)


def points(count, seed=0):
    """Mostly reachable by both of the paper's mechanisms."""
    return np.random.default_rng(seed).uniform([-1.5, 0.8], [1.5, 3.2], (count, 2))


def lengths(count):
    """Of the 2-RPR; every 300th row is out of reach, sixteen of them in a large batch."""
    found = np.array(pk.inverse_kinematics(RPR, points(count)).joints)
    found[150::300][:16] = 9.0, 0.1
    return found


def angles(count):
    return np.asarray(pk.inverse_kinematics(ARMS, points(count, 1)).joints)


def casing(count):
    rng = np.random.default_rng(2)
    return pk.AxisPose.from_angles(rng.uniform(0.44, 0.52, count), *rng.uniform(-0.05, 0.05, (3, count)))


def nine_lengths():
    mech = pk.catalogued("nine-lengths")
    off = 1e-3 * np.random.default_rng(3).uniform(-1, 1, (WHOLE, 9))
    return Case(partial(pk.nine_length_pose, mech), np.asarray(mech.home()[1]) * (1 + off), EDGES)


def configurations(mech, count):
    pose = points(count)
    joints = pk.inverse_kinematics(mech, pose).joints
    return np.asarray(joints), pose


def designs():
    poses = pk.rectangle([-0.3, 1.0], [0.3, 1.5], (3, 3))
    problem = pk.DesignProblem(
        lambda values: pk.FiveBar(half_base=0.3, **values),
        {"proximal": (0.6, 2.0), "distal": (0.6, 2.5)},
        pk.least_over(poses, "isotropy"),
    )
    vectors = np.random.default_rng(4).uniform(problem.lower, problem.upper, (FEW, 2))
    return Case(partial(pk.evaluate_designs, problem), vectors)


def paths():
    """Of which each is followed by itself."""
    along = 0.3 * np.linspace(0, 1, 4)[:, None] + np.linspace(0, 0.3, FEW)[:, None, None] * [1, 0.5]
    joints = np.asarray(pk.inverse_kinematics(RPR, (along + [0.0, 2.0]).reshape(-1, 2)).joints)
    return Case(jax.jit(jax.vmap(partial(pk.track, RPR))), joints.reshape(FEW, 4, 2))


CASES = {
    "forward": lambda: Case(partial(pk.forward_kinematics, RPR), lengths(WHOLE), (*EDGES, 150, 450)),
    "forward of angles": lambda: Case(partial(pk.forward_kinematics, ARMS), angles(WHOLE), EDGES),
    "forward of guesses": lambda: Case(
        lambda rows: pk.forward_kinematics(RPR, rows[1], rows[0]), (points(WHOLE, 5), lengths(WHOLE)), EDGES
    ),
    "forward, traced lanes": lambda: Case(
        jax.jit(partial(pk.forward_kinematics, RPR)), lengths(4100), (0, 63, 64, 150, 450, 4099)
    ),
    "forward, traced": lambda: Case(jax.jit(partial(pk.forward_kinematics, RPR)), lengths(FEW)),
    "inverse": lambda: Case(partial(pk.inverse_kinematics, ARMS), points(FEW)),
    "inverse by Newton": lambda: Case(
        partial(pk.inverse_kinematics, delta()),
        np.random.default_rng(6).uniform([-0.1, -0.1, -0.8], [0.1, 0.1, -0.5], (FEW, 3)),
    ),
    "indices": lambda: Case(partial(pk.local_indices, ARMS), points(FEW)),
    "velocities": lambda: Case(
        lambda rows: jax.vmap(lambda q, x: pk.velocity_jacobian(RPR, x, q))(*rows), configurations(RPR, FEW)
    ),
    "singularities": lambda: Case(
        lambda rows: pk.classify_singularity(RPR, rows[1], rows[0]), configurations(RPR, WHOLE), EDGES
    ),
    "singularities, vmapped": lambda: Case(
        lambda rows: jax.vmap(lambda q, x: pk.classify_singularity(RPR, x, q))(*rows),
        configurations(RPR, FEW),
    ),
    "modes": lambda: Case(partial(pk.assembly_modes, ARMS), angles(5), (0, 2, 4)),
    "travels": lambda: Case(lambda at: pk.travel(RPR, "x", at=at), points(FEW)),
    "redundancy": lambda: Case(partial(pk.resolve_redundancy, pk.CasingOscillator()), casing(FEW)),
    "nine lengths": nine_lengths,
    "designs": designs,
    "paths": paths,
}
QUICK = ("forward", "inverse", "velocities", "singularities")  # the others in make soak


def spoiled(rows, at, poison):
    """The rows with one number of one of them replaced."""
    leaves, tree = jax.tree.flatten(jax.tree.map(np.array, rows))
    leaves[0].reshape(len(leaves[0]), -1)[at, 0] = poison
    return jax.tree.unflatten(tree, leaves)


def bits(tree):
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree)]


def others(tree, at):
    """All rows but one."""
    return [np.delete(np.asarray(leaf), at, axis=0) for leaf in jax.tree.leaves(tree) if np.ndim(leaf)]


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.soak] * (n not in QUICK)) for n in CASES]
)
def test_no_other_row_changes(name):
    case = CASES[name]()
    clean = case.call(case.rows)
    for at in case.edges:
        expected = bits(others(clean, at))
        for poison in POISONS:
            found = case.call(spoiled(case.rows, at, poison))
            is_same = bits(others(found, at)) == expected
            assert is_same, (at, poison)
            if not np.isfinite(poison) and hasattr(found, "status"):
                assert np.ravel(np.asarray(found.status)[at])[0] == Status.BAD_INPUT, (at, poison)


# ---------------------------------------------------------------- derivatives in the geometry


def of_forward(mech, rows):
    return pk.forward_kinematics(mech, rows).pose


def of_inverse(mech, rows):
    return pk.inverse_kinematics(mech, rows).joints


def of_indices(mech, rows):
    return jnp.stack(pk.local_indices(mech, rows)[:2], axis=1)


GRADIENTS = {
    "forward": (of_forward, RPR, lambda: lengths(FEW)),
    "forward on lanes": (of_forward, RPR, lambda: lengths(4100)),
    "forward of angles": (of_forward, ARMS, lambda: angles(FEW)),
    "inverse": (of_inverse, ARMS, lambda: points(FEW)),
    "indices": (of_indices, ARMS, lambda: points(FEW)),
}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.soak] * (n != "forward")) for n in GRADIENTS]
)
def test_slopes_of_the_good_rows_in_the_geometry_stay(name):
    """Of a sum over the others, as a user would write it."""
    function, mech, rows = GRADIENTS[name]
    rows = rows()

    @jax.jit
    @jax.grad
    def slope(mech, rows, is_counted):
        return jnp.nansum(jnp.where(is_counted[:, None], jnp.sin(function(mech, rows)), 0))

    for at in (0, len(rows) // 2, len(rows) - 1):
        is_counted = np.arange(len(rows)) != at
        clean = slope(mech, rows, is_counted)
        assert all(np.isfinite(leaf) for leaf in jax.tree.leaves(clean)) and clean.half_base != 0
        for poison in POISONS:
            is_same = bits(slope(mech, spoiled(rows, at, poison), is_counted)) == bits(clean)
            assert is_same, (at, poison)
