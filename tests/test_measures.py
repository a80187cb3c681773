"""Local indices by name: plain NumPy formulas on every family, invariances, derivatives, refusals."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import said_by

import pk_jax as pk
from pk_jax.analysis.measures import (
    INDICES,
    length_of,
    maps_of,
    measure_of,
    names_of,
    small_det,
    small_inverse,
)
from pk_jax.geometry.poses import retract, tangent_zero
from pk_jax.kinematics.jacobian import joint_jacobian, pose_jacobian
from pk_jax.mechanisms.catalogue import catalogued

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

ROWS = 4
RING = np.deg2rad([90, 210, 330])
FAMILIES = {
    "2-RPR": lambda: catalogued("nam-2-rpr"),
    "five-bar": lambda: catalogued("nam-2-rrr-isotropic"),
    "3-RPR": lambda: pk.PlanarRPR(
        base=np.stack([np.cos(RING), np.sin(RING)], 1), platform=[[0.1, 0.4], [-0.3, -0.2], [0.35, -0.1]]
    ),
    "3-RRR": lambda: catalogued("3-rrr"),
    "4-RRR": lambda: catalogued("4-rrr"),
    "6-link": lambda: catalogued("6-link"),
    "casing": lambda: catalogued("casing-oscillator"),
    "nine lengths": lambda: catalogued("nine-lengths-general"),
}
FREQUENT = ("4-RRR", "casing")  # the others wait for soak
CASES = [name if name in FREQUENT else pytest.param(name, marks=pytest.mark.soak) for name in FAMILIES]


@cache
def family(name):
    return FAMILIES[name]()


def twists_of(mech, seed):
    """Small moves away from home, each coordinate by up to a tenth of the length or 0.1 rad. -> (ROWS, n)"""
    n = tangent_zero(mech.home()[0]).shape[0]
    return np.random.default_rng(seed).uniform(-0.1, 0.1, (ROWS, n)) * float(mech.length())


def tilted(mech, seed):
    """A direction in the space of designs: every number by up to one per cent of the length."""
    rng, size = np.random.default_rng(seed), 0.01 * float(mech.length())
    return jax.tree.map(lambda leaf: jnp.asarray(rng.uniform(-size, size, leaf.shape)), mech)


def at(mech, home, twist, length):
    """Every index (7,), A and B, at the pose a twist away from `home`."""
    pose = retract(home, twist)
    joints = mech.inverse(pose)
    indices = jnp.stack([index(mech, pose, joints, length) for index in INDICES.values()])
    return indices, pose_jacobian(mech, pose, joints), joint_jacobian(mech, pose, joints)


looked_at = jax.jit(jax.vmap(at, in_axes=(None, None, 0, None)))


@jax.jit
def rates_at(mech, move, home, twists, speed, length):
    """Indices and their rates along (move, speed). -> (ROWS, 7) twice"""
    of = lambda mech, twist: at(mech, home, twist, length)[0]
    return jax.vmap(lambda twist: jax.jvp(of, (mech, twist), (move, speed)))(twists)


def look(mech, twists, home=None, length=None):
    """Of `at`, one row a twist."""
    home = mech.home()[0] if home is None else home
    length = float(mech.length()) if length is None else length
    return jax.tree.map(np.asarray, looked_at(mech, home, twists, length))


def by_numpy(mech, a, b, length):
    """All indices, in the order of INDICES, from A and B by singular values and pseudo-inverses."""
    n = a.shape[1]
    turns = {2: (1, 1), 3: (1, 1, 0), 4: (1, 0, 0, 0), 6: (1, 1, 1, 0, 0, 0)}[n]
    a = a * length ** np.array(turns)
    b = b * length ** np.array(mech.joint_units or (1,) * b.shape[1])
    rows = mech.actuated_rows or len(a)
    a, b = a[:rows], b[:rows, : rows + mech.free_joints]
    j = -np.linalg.solve(a, b) if rows == n else np.linalg.pinv(-np.linalg.solve(b, a))
    sigma = np.linalg.svd(j, compute_uv=False)
    unit = a / np.linalg.norm(a, axis=1, keepdims=True)
    sign = np.sign(np.linalg.det(unit)) if rows == n else 1
    both = np.concatenate([a, b], axis=1)
    q = np.linalg.qr(both.T)[0]  # columns span the rows of [A B]
    distances = [np.linalg.svd(part, compute_uv=False)[-1] for part in (q[:n], q[n:])]
    return {
        "frobenius_isotropy": n / np.sqrt(np.sum(sigma**2) * np.sum(sigma**-2.0)),
        "isotropy": sigma[-1] / sigma[0],
        "resistivity": 1 / np.prod(sigma),
        "manipulability": np.prod(sigma),
        "stiffness": n / np.sum(sigma**2),
        "clearance": sign / np.linalg.norm(np.linalg.pinv(unit)),
        "singularity_distance": min(distances),
    }


@pytest.mark.parametrize("name", CASES)
def test_every_index_is_that_of_numpy(name):
    mech = family(name)
    values, a, b = look(mech, twists_of(mech, 1))
    expected = [by_numpy(mech, *row, float(mech.length())) for row in zip(a, b, strict=True)]
    assert list(expected[0]) == list(INDICES)
    np.testing.assert_allclose(values, [list(row.values()) for row in expected], rtol=1e-9)
    assert np.all(np.ptp(values, axis=0) > 1e-4 * np.abs(values[0]))  # no index is a constant


@pytest.mark.parametrize(
    "name", [name if name == "4-RRR" else pytest.param(name, marks=pytest.mark.soak) for name in FAMILIES]
)
def test_rates_are_those_of_central_differences(name):
    """In the geometry and in the pose at once."""
    mech = family(name)
    twists, move, step = twists_of(mech, 2), tilted(mech, 3), 1e-4
    speed = twists_of(mech, 4)[0] / 5
    home, length = mech.home()[0], float(mech.length())

    def ahead(h):
        there = jax.tree.map(lambda x, dx: x + h * dx, mech, move)
        return rates_at(there, move, home, twists + h * speed, speed, length)

    values, rates = map(np.asarray, ahead(0.0))
    np.testing.assert_allclose(values, look(mech, twists)[0], rtol=1e-12)
    scale = np.max(np.abs(rates), axis=0)
    assert np.all(scale > 0)
    slopes = (np.asarray(ahead(step)[0]) - np.asarray(ahead(-step)[0])) / (2 * step)
    assert np.max(np.abs(slopes - rates) / scale) < 1e-5


@pytest.mark.soak
def test_indices_do_not_see_where_the_base_stands():
    """4-RRR turned and shifted with its base; in space the nine-length platform."""
    turn, shift = pk.geometry.planar.rotation(0.7), np.array([3.0, -2.0])
    mech = family("4-RRR")
    twists = twists_of(mech, 5)
    moved = pk.PlanarRRR(
        base=mech.base @ turn.T + shift,
        platform=mech.platform,
        proximal=mech.proximal,
        distal=mech.distal,
    )
    home = mech.home()[0]
    there = jnp.append(turn @ home[:2] + shift, home[2] + 0.7)
    turned = np.concatenate([twists[:, :2] @ np.asarray(turn).T, twists[:, 2:]], axis=1)
    np.testing.assert_allclose(look(moved, turned, home=there)[0], look(mech, twists)[0], rtol=1e-11)

    mech = family("nine lengths")
    twists = twists_of(mech, 6)
    turn = pk.geometry.rotations.from_rotation_vector(jnp.array([0.3, -0.4, 0.5]))
    shift = np.array([1.0, 2.0, -3.0])
    home = mech.home()[0]
    moved = pk.Stewart(base=mech.base @ turn.T + shift, platform=mech.platform)
    there = pk.SE3(turn @ home.translation + shift, turn @ home.rotation)
    turned = (twists.reshape(ROWS, 2, 3) @ np.asarray(turn).T).reshape(ROWS, 6)
    np.testing.assert_allclose(look(moved, turned, home=there)[0], look(mech, twists)[0], rtol=1e-9)


@pytest.mark.parametrize("name", ["4-RRR", "nine lengths"])
def test_indices_do_not_see_the_unit_of_length(name):
    """All lengths in thousandths, the stated length too."""
    mech, s = family(name), 1000.0
    twists, home = twists_of(mech, 7), mech.home()[0]
    n = twists.shape[1]
    powers = {3: (1, 1, 0), 6: (1, 1, 1, 0, 0, 0)}[n]
    stretch = s ** np.array(powers)
    large = jax.tree.map(lambda leaf: s * leaf, mech)
    there = home * stretch if n < 6 else pk.SE3(s * home.translation, home.rotation)
    stated = 0.37 * float(mech.length())
    one = look(mech, twists, length=stated)[0]
    np.testing.assert_allclose(
        look(large, twists * stretch, home=there, length=s * stated)[0], one, rtol=1e-10
    )
    assert np.all(np.abs(look(mech, twists)[0] / one - 1) > 1e-3)  # the stated length is used


def test_clearance_bounds_the_least_singular_value_and_changes_its_side():
    """Legs of a 2-RPR on one line are singular; above it det A < 0, below it > 0."""
    mech = family("2-RPR")
    for height in (0.8, 1e-3, -1e-3, -0.8):
        pose = jnp.array([0.3, height])
        joints = mech.inverse(pose)
        rows = np.asarray(maps_of(mech, pose, joints).rows)
        value = float(INDICES["clearance"](mech, pose, joints))
        np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, rtol=1e-14)
        least = np.linalg.svd(rows, compute_uv=False)[-1]
        assert least / np.sqrt(2) <= abs(value) <= least
        assert np.sign(value) == np.sign(np.linalg.det(rows))
        np.testing.assert_allclose(
            value, -float(INDICES["clearance"](mech, pose * np.array([1, -1]), joints)), rtol=1e-12
        )


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 6])
def test_small_inverse_and_determinant_are_those_of_numpy(n):
    matrices = (
        np.random.default_rng(n).standard_normal((20, n, n)) * 10.0 ** np.arange(-10, 10)[:, None, None]
    )
    kappa = np.linalg.cond(matrices)
    inverses = np.asarray(jax.vmap(small_inverse)(jnp.asarray(matrices)))
    expected = np.linalg.inv(matrices)
    off = np.max(np.abs(inverses - expected), axis=(1, 2)) / np.max(np.abs(expected), axis=(1, 2))
    assert np.all(off < 1e-14 * kappa)
    found = jax.vmap(small_det)(jnp.asarray(matrices))
    np.testing.assert_allclose(found, np.linalg.det(matrices), rtol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_a_singular_matrix_has_no_finite_inverse(n):
    singular = jnp.asarray(np.diag(np.arange(n, dtype=float)))
    assert not np.all(np.isfinite(small_inverse(singular)))


def test_names_functions_and_lengths_are_checked():
    def own(mech, pose, joints):
        return pose[0]

    assert measure_of(own) is own and measure_of("isotropy") is INDICES["isotropy"]
    assert names_of("isotropy") == ("isotropy",) and names_of(["isotropy", own]) == ("isotropy", own)
    assert names_of(()) == () and length_of(None) is None and length_of(2) == 2.0
    for bad in ("isotropie", 3, None):
        assert said_by(measure_of, bad).startswith("index must be a function or one of frobenius_isotropy, ")
        assert repr(bad) in said_by(names_of, ["isotropy", bad])
    for bad in (0, -1.0, np.nan, np.inf, True, "1", [1.0]):
        assert said_by(length_of, bad) == f"length must be a positive number, got {bad!r}"
