"""The ground floor: safe functions, plane vectors, poses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pk_jax.geometry import planar, poses, safe

INSIDE = st.floats(-0.99, 0.99)
NAN, INF = np.nan, np.inf


def slope(function, x):
    """The derivative in forward and in reverse mode, which must agree."""
    x = jnp.asarray(x, float)
    forward, reverse = jax.jacfwd(function)(x), jax.jacrev(function)(x)
    np.testing.assert_array_equal(forward, reverse)
    return np.asarray(forward)


@pytest.mark.parametrize(
    ("function", "plain", "x"),
    [
        (safe.sqrt, lambda x: 0.5 / np.sqrt(x), 2.0),
        (safe.sqrt, lambda x: 0.5 / np.sqrt(x), 1e-300),
        (safe.arcsin, lambda x: 1 / np.sqrt(1 - x * x), -0.6),
        (safe.arccos, lambda x: -1 / np.sqrt(1 - x * x), 0.6),
        (lambda x: safe.divide(x, 2 * x * x), lambda x: -0.5 / x**2, 3.0),
    ],
)
def test_inside_the_derivative_is_the_plain_one(function, plain, x):
    np.testing.assert_allclose(slope(function, x), plain(x), rtol=1e-14)


@given(INSIDE)
def test_inside_the_value_is_the_plain_one(x):
    np.testing.assert_allclose(safe.arcsin(x), np.arcsin(x), rtol=1e-14, atol=1e-300)
    np.testing.assert_allclose(safe.arccos(x), np.arccos(x), rtol=1e-13)
    np.testing.assert_allclose(safe.sqrt(x + 1), np.sqrt(x + 1), rtol=1e-15)


@pytest.mark.parametrize(
    ("function", "x", "value"),
    [
        (safe.sqrt, 0.0, 0.0),
        (safe.sqrt, -1.0, 0.0),
        (safe.arcsin, 1.0, np.pi / 2),
        (safe.arcsin, -1.0, -np.pi / 2),
        (safe.arcsin, 1.5, np.pi / 2),
        (safe.arccos, 1.0, 0.0),
        (safe.arccos, -1.0, np.pi),
        (safe.arccos, -7.0, np.pi),
        (lambda x: safe.divide(1.0, x), 0.0, 0.0),
        (lambda x: safe.divide(x, x), 0.0, 0.0),
        (lambda x: safe.norm(jnp.stack([x, 0 * x])), 0.0, 0.0),
    ],
)
def test_at_the_ends_the_derivative_is_zero(function, x, value):
    np.testing.assert_allclose(function(jnp.asarray(x)), value, rtol=0, atol=1e-16)
    assert slope(function, x) == 0


@pytest.mark.parametrize(
    "function",
    [
        safe.sqrt,
        safe.arcsin,
        safe.arccos,
        lambda x: safe.divide(1.0, x),
        lambda x: safe.norm(jnp.stack([x, x])),
    ],
    ids=["sqrt", "arcsin", "arccos", "divide", "norm"],
)
def test_nan_stays_nan(function):
    """Safe from infinite derivatives, not from bad numbers: a masked NaN is a silent wrong answer."""
    assert np.isnan(function(jnp.asarray(NAN)))


def test_infinity_stays_infinite():
    assert safe.sqrt(jnp.asarray(INF)) == INF
    assert safe.norm(jnp.array([INF, 1.0])) == INF


def test_safe_functions_keep_float32():
    x = jnp.float32(0.5)
    for function in (safe.sqrt, safe.arcsin, safe.arccos, lambda x: safe.divide(x, x)):
        assert function(x).dtype == jnp.float32


def test_norm_is_along_the_last_axis():
    np.testing.assert_array_equal(safe.norm(jnp.array([[3.0, 4.0], [0.0, 0.0]])), [5, 0])
    np.testing.assert_allclose(jax.jacrev(safe.norm)(jnp.array([3.0, 4.0])), [0.6, 0.8], rtol=1e-15)


# ---------------------------------------------------------------- plane vectors


def test_turns_and_products_in_the_plane():
    x, y = jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])
    assert planar.cross(x, y) == 1 and planar.cross(y, x) == -1
    np.testing.assert_array_equal(planar.quarter_turn(y), x)  # to the right
    np.testing.assert_allclose(planar.rotation(jnp.pi / 2) @ x, y, atol=1e-16)
    np.testing.assert_allclose(planar.direction(jnp.array([0.0, jnp.pi / 2])), [x, y], atol=1e-16)


@given(st.floats(-4, 4), st.floats(-4, 4))
def test_rotations_add(a, b):
    both = planar.rotation(a) @ planar.rotation(b)
    np.testing.assert_allclose(both, planar.rotation(a + b), atol=1e-14)
    np.testing.assert_allclose(planar.rotation(a)[:, 0], planar.direction(a), atol=1e-16)


# ---------------------------------------------------------------- poses

POINTS = np.array([[0.3, -0.1], [0.2, 0.5]])
each_pose = pytest.mark.parametrize(
    ("pose", "points"),
    [
        (np.array([1.0, 2.0]), POINTS),
        (np.array([1.0, 2.0, 0.7]), POINTS),
        (np.array([1.0, 2.0, 3.0]), np.array([[0.1, 0.2, 0.3]])),
    ],
    ids=["point", "planar", "spatial"],
)


def test_a_planar_pose_turns_its_points_and_then_moves_them():
    found = poses.place(jnp.array([1.0, 2.0, 0.7]), jnp.asarray(POINTS))
    z = 1 + 2j + (POINTS[:, 0] + 1j * POINTS[:, 1]) * np.exp(0.7j)
    np.testing.assert_allclose(found, np.stack([z.real, z.imag], axis=1), rtol=1e-15)


@each_pose
def test_place_jacobian_is_the_rigid_body_map(pose, points):
    """v + w x p, p from the platform's origin, in base axes."""
    found = poses.place_jacobian(jnp.asarray(pose), jnp.asarray(points))
    arms = np.asarray(poses.place(jnp.asarray(pose), jnp.asarray(points))) - pose[: points.shape[1]]
    expected = np.broadcast_to(np.eye(points.shape[1]), (len(points), *[points.shape[1]] * 2))
    if pose.size != points.shape[1]:
        expected = np.concatenate([expected, np.stack([-arms[:, 1], arms[:, 0]], axis=1)[..., None]], axis=2)
    np.testing.assert_allclose(found, expected, atol=1e-15)


@each_pose
def test_the_zero_tangent_goes_nowhere(pose, points):
    zero = poses.tangent_zero(jnp.asarray(pose))
    assert zero.shape == pose.shape and not np.any(zero)
    np.testing.assert_array_equal(poses.retract(jnp.asarray(pose), zero), pose)


@pytest.mark.parametrize(("pose", "points"), [((4,), (2, 2)), ((2,), (1, 3)), ((1,), (2, 2))])
def test_a_pose_that_cannot_carry_its_points_is_told(pose, points):
    with pytest.raises(ValueError, match=r"^a pose of shape .* cannot carry points of shape .*$"):
        poses.place(jnp.zeros(pose), jnp.zeros(points))
