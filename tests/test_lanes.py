"""Entry by entry is the plain function; elimination on lanes is numpy.linalg."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from outsiders import delta, three_legs, three_rpr

import pk_jax as pk
from pk_jax.geometry.poses import retract, tangent_zero
from pk_jax.kinematics import elimination
from pk_jax.kinematics.closure import closure
from pk_jax.kinematics.entrywise import entrywise, unknown_primitives
from pk_jax.kinematics.lanes import Entries, is_known, split, stack

X = np.random.default_rng(0).uniform(0.1, 0.9, (3, 4))  # what every elementary function is defined on
M = np.random.default_rng(1).uniform(-1, 1, (4, 4))
PICKED, PLACES = np.array([2, 0, 2]), np.array([1, 3])

STRUCTURE = {
    "slice": lambda x: x[1:, ::-2],
    "one row": lambda x: x[-1],
    "one entry": lambda x: x[1, 2],
    "strided slice": lambda x: lax.slice(x, (0, 1), (3, 4), (2, 2)),
    "stack": lambda x: jnp.stack([x[0], x[2]], axis=1),
    "concatenate": lambda x: jnp.concatenate([x, 2 * x[:1], jnp.ones((1, 4), x.dtype)], axis=0),
    "split": lambda x: jnp.split(x, (1, 3), axis=1)[1] + x[:, :1],
    "unstacked": lambda x: sum((k + 1) * row for k, row in enumerate(x)),
    "gather": lambda x: x[PICKED],
    "gather of pairs": lambda x: x[PICKED, PLACES[[0, 1, 1]]],
    "take along the last axis": lambda x: jnp.take(x, PLACES, axis=1),
    "take, clipped": lambda x: jnp.take(x, np.array([0, 7]), axis=1, mode="clip"),
    "take, filled with zeros": lambda x: x.at[:, np.array([0, 7])].get(mode="fill", fill_value=0),
    "set a constant": lambda x: x.at[0, PLACES].set(7.0),
    "set a row": lambda x: x.at[1].set(x[0]),
    "set in place": lambda x: x.at[1:, 2].set(jnp.array([5.0, 6.0], x.dtype)),
    "add in place": lambda x: x.at[1].add(3.0),
    "dynamic slice": lambda x: lax.dynamic_slice(x, (1, 2), (2, 2)),
    "dynamic update": lambda x: lax.dynamic_update_slice(x, x[:2, :2], (1, 1)),
    "transpose": lambda x: x.T,
    "swap axes": lambda x: jnp.swapaxes(jnp.reshape(x, (3, 2, 2)), 0, 2),
    "cycled axes": lambda x: jnp.transpose(jnp.reshape(x, (3, 2, 2)), (1, 2, 0)),
    "roll": lambda x: jnp.roll(x, (1, -1), axis=(0, 1)),
    "flip": lambda x: jnp.flip(x, axis=0),
    "pad": lambda x: jnp.pad(x, ((1, 0), (0, 2)), constant_values=3.0),
    "diagonal": lambda x: jnp.diagonal(x) + jnp.trace(x),
    "repeat": lambda x: jnp.repeat(x, 2, axis=0)[:, None],
    "tile": lambda x: jnp.tile(x, (2, 1)),
    "broadcast": lambda x: x[:, None, :] * x[None, :, :],
    "squeeze": lambda x: jnp.squeeze(x[:1], axis=0),
    "triangle": lambda x: jnp.tril(x),
    "meshes": lambda x: jnp.arange(4) * x + jnp.arange(3.0)[:, None] * jnp.eye(3, 4),
    "whole numbers": lambda x: x * ((jnp.arange(4) + 1) // 2) + x * (jnp.arange(4) % 3),
    "shifted whole numbers": lambda x: x * lax.div(jnp.arange(-3, 1), jnp.asarray(2)),
    "a sum of nothing": lambda x: x + jnp.sum(x[:0]) + jnp.sum(jnp.zeros(0)),
}
PRODUCTS = {
    "matrix product": lambda x: x @ M,
    "with a vector": lambda x: x @ jnp.arange(4.0) + M[0] @ x[1],
    "einsum": lambda x: jnp.einsum("ij,jk,lk->il", x, M, x),
    "einsum of a batch": lambda x: jnp.einsum("ij,ik->ijk", x, x[:, ::-1]),
    "batched product": lambda x: jnp.einsum("bij,bjk->bik", x.reshape(3, 2, 2), x.reshape(3, 2, 2)),
    "cross": lambda x: jnp.cross(x[:2, :3], x[1:, 1:]),
    "norm": lambda x: jnp.linalg.norm(x, axis=1),
    "norm of all": lambda x: jnp.linalg.norm(x),
    "sums": lambda x: jnp.sum(x, axis=0) + jnp.mean(x) + jnp.prod(x, axis=0),
    "extremes": lambda x: jnp.max(x, axis=1) - jnp.min(x),
    "all and any": lambda x: jnp.where(jnp.all(x > 0.2, axis=1) | jnp.any(x > 0.8, axis=1), 1.0, x[:, 0]),
    "det and inverse of pairs": lambda x: jnp.linalg.det(x[:2, :2]) * x,
}
ELEMENTS = {
    "abs": lambda x: jnp.abs(x - 0.5),
    "powers": lambda x: x**3 + x**-2 + x**2.5 + 2.0**x + x**0,
    "roots": lambda x: jnp.sqrt(x) + jnp.cbrt(x) + lax.rsqrt(x),
    "arcs": lambda x: jnp.arccos(x) + jnp.arcsin(x) + jnp.arctan(x) + jnp.arctan2(x, x - 0.5),
    "circle": lambda x: jnp.sin(x) + jnp.cos(x) * jnp.tan(x),
    "hyperbola": lambda x: jnp.sinh(x) + jnp.cosh(x) + jnp.tanh(x),
    "areas": lambda x: jnp.arccosh(1 + x) + jnp.arcsinh(x) + jnp.arctanh(x),
    "exponentials": lambda x: jnp.exp(x) + jnp.exp2(x) + jnp.expm1(x) + jax.nn.sigmoid(x),
    "logarithms": lambda x: jnp.log(x) + jnp.log1p(x) + jnp.log2(x),
    "erf": lambda x: jax.scipy.special.erf(x),
    "sinc": lambda x: jnp.sinc(x - x[0]),
    "rounding": lambda x: jnp.floor(9 * x) + jnp.ceil(7 * x) + jnp.round(5 * x) + jnp.trunc(3 * x),
    "remainders": lambda x: jnp.mod(x, 0.3) + jnp.fmod(-x, 0.2) + x // 0.3,
    "where": lambda x: jnp.where(x > 0.5, x, -x) + jnp.where(x[0] != x[0, 0], 1.0, 2.0),
    "where of constants": lambda x: jnp.where(jnp.arange(4) < 2, x, 0.0),
    "select": lambda x: jnp.select([x < 0.3, x < 0.6], [1.0, x], 3.0),
    "clip": lambda x: jnp.clip(x, 0.3, x[0, 0]) + jnp.maximum(x, 0.5) * jnp.minimum(x, x[1]),
    "signs": lambda x: jnp.sign(x - 0.5) * (-x),
    "logic": lambda x: jnp.where(((x > 0.3) & ~(x >= 0.7)) ^ (x <= 0.2) | (x == x[0, 0]), x, 1.0),
    "finite": lambda x: jnp.where(jnp.isfinite(x) & ~jnp.isnan(x), x, 0.0),
    "division": lambda x: x / 3 + 2 / x + x / x[0] + 0 / x,
    "casts": lambda x: x.astype(jnp.float32) + (x > 0.5) + (9 * x).astype(int),
    "divided whole numbers": lambda x: lax.div((9 * x).astype(int), 2) * x,
    "known on known": lambda x: x * jnp.sin(jnp.arange(4.0)) * jnp.hypot(3.0, 4.0),
    "derivative": lambda x: jax.grad(lambda y: jnp.sum(y**3 * M[0]))(x[0]),
    "a jitted function": lambda x: jax.jit(lambda y: y * 2 + jnp.ones(4))(x),
    "remat": lambda x: jax.checkpoint(jnp.sin)(x),
}
FALLING_BACK = {
    "while loop": lambda x: lax.while_loop(lambda y: jnp.sum(y) < 9, lambda y: 2 * y, x),
    "fori loop": lambda x: lax.fori_loop(0, 3, lambda k, y: y + k, x),
    "scan": lambda x: lax.scan(lambda c, row: (c + row, c * row), x[0], x)[1],
    "branches": lambda x: lax.cond(x[0, 0] > 0.4, jnp.sin, jnp.cos, x),
    "solve": lambda x: jnp.linalg.solve(x[:, :3] + 3 * jnp.eye(3), x[:, 3]),
    "sort": lambda x: jnp.sort(x, axis=1),
    "cumsum": lambda x: jnp.cumsum(x, axis=0),
    "argmax": lambda x: x[jnp.argmax(x[:, 0])],
    "index that is computed": lambda x: x[(3 * x[0, 0]).astype(int)],
}
KNOWN = STRUCTURE | PRODUCTS | ELEMENTS
MAY_FALL_BACK = {"add in place", "take, filled with zeros", "tile", "select"}


CASES = ((jnp.float64, ()), (jnp.float64, (2, 2)), (jnp.float32, (3,)))


def on_lanes(x, dtype, lanes):
    """An array of lanes, the lanes last."""
    spread = np.random.default_rng(2).permutation(np.linspace(0.8, 1.1, int(np.prod(lanes)))).reshape(lanes)
    return jnp.asarray(x[(..., *[None] * len(lanes))] * spread, dtype)


def both(function, array, lanes):
    """`function` entry by entry, and as it is."""
    shape = array.shape[: array.ndim - len(lanes)]
    found = stack(entrywise(function, Entries(shape, [array[i] for i in np.ndindex(shape)])))
    plain = function
    for _ in lanes:
        plain = jax.vmap(plain, in_axes=-1, out_axes=-1)
    plain = plain(array)
    return found, jnp.broadcast_to(plain, found.shape)  # what is known has no lanes


@pytest.mark.parametrize("name", KNOWN | FALLING_BACK)
def test_entry_by_entry_is_the_plain_function(name):
    """Also in float32, and the precision is kept."""
    function = (KNOWN | FALLING_BACK)[name]
    arrays = [on_lanes(X, *case) for case in CASES]
    evaluate = lambda *arrays: [both(function, a, lanes) for a, (_, lanes) in zip(arrays, CASES, strict=True)]
    evaluate = jax.jit(evaluate, compiler_options={"xla_backend_optimization_level": 0})  # compiles faster
    for (found, plain), (dtype, _) in zip(evaluate(*arrays), CASES, strict=True):
        assert found.dtype == plain.dtype or plain.dtype != dtype  # float64 constants may widen float32
        tolerance = 1e-14 if dtype == jnp.float64 else 4e-6
        np.testing.assert_allclose(found, plain, rtol=tolerance, atol=tolerance / 10)


@pytest.mark.parametrize("name", [name for name in KNOWN if name not in MAY_FALL_BACK])
def test_what_is_known_does_not_fall_back(name):
    assert unknown_primitives(KNOWN[name], X) == []


@pytest.mark.parametrize("name", ["while loop", "solve", "sort", "scan", "branches"])
def test_what_is_unknown_is_named(name):
    assert set(unknown_primitives(FALLING_BACK[name], X)) & {"while", "sort", "scan", "cond", "lu"}


def test_several_arguments_and_answers():
    function = lambda pair, z: {"sum": pair[0] + pair[1], "product": (pair[0] @ z, z[0])}
    x, y, z = np.random.default_rng(3).uniform(-1, 1, (3, 2, 2))
    found = entrywise(function, (split(jnp.asarray(x)), split(jnp.asarray(y))), split(jnp.asarray(z)))
    expected = function((x, y), z)
    assert found.keys() == expected.keys()
    np.testing.assert_allclose(stack(found["sum"]), expected["sum"], rtol=1e-15)
    np.testing.assert_allclose(stack(found["product"][0]), expected["product"][0], rtol=1e-14)


# ---------------------------------------------------------------- what is known vanishes


def operations(function, entries=4):
    """Arithmetic left in the jaxpr of `function` of a vector, entry by entry."""

    def evaluate(x):
        return [item for item in entrywise(function, split(x)).items if not is_known(item)]

    jaxpr = jax.make_jaxpr(evaluate)(jnp.ones(entries))
    names = (equation.primitive.name for equation in jaxpr.jaxpr.eqns)
    return sorted(name for name in names if name in {"mul", "add", "sub", "neg", "div"})


def test_products_with_known_zeros_and_ones_vanish():
    assert operations(lambda x: np.zeros((4, 4)) @ x) == []
    assert operations(lambda x: np.eye(4)[[2, 0, 3, 1]] @ x) == []
    assert operations(lambda x: -np.eye(4) @ x) == ["neg"] * 4
    assert operations(lambda x: np.diag([2.0, 0.0, 1.0, 3.0]) @ x) == ["mul"] * 2
    sparse = np.array([[2.0, 0, 3.0, 0], [0, 0, 0, 1.0], [0, 0, 0, 0], [1.0, 1.0, 0, 0]])
    assert operations(lambda x: sparse @ x) == ["add", "add", "mul", "mul"]
    assert operations(lambda x: x + jnp.zeros(4)) == operations(lambda x: x * jnp.ones(4)) == []
    assert operations(lambda x: jnp.zeros(4) - x) == ["neg"] * 4
    assert operations(lambda x: jnp.sum(x * jnp.array([0, 0, 1.0, 0]))) == []
    found = entrywise(lambda x: np.zeros((2, 4)) @ x, split(jnp.ones(4)))
    assert all(is_known(item) and item == 0 for item in found.items)


# ---------------------------------------------------------------- mechanisms are made of known primitives

HOUSE = {
    "2-RPR": lambda: pk.TwoRPR(half_base=1.0, l_min=1.0, l_max=3.0),
    "2-RRR": lambda: pk.FiveBar(half_base=1.0, proximal=1.0, distal=2.15),
    "Stewart": lambda: pk.catalogued("semi-regular-stewart"),
    "Delta": delta,
    "3-RPR": three_rpr,
    "three legs": three_legs,
}


@pytest.mark.parametrize("name", HOUSE)
def test_mechanisms_are_evaluated_entry_by_entry(name):
    mech = HOUSE[name]()
    pose, joints = mech.home()
    assert unknown_primitives(lambda m, x, q: m.linearize(x, q), mech, pose, joints) == []
    assert unknown_primitives(lambda m, x, q: m.residual(x, q), mech, pose, joints) == []
    assert unknown_primitives(closure, mech, pose, joints) == []
    assert unknown_primitives(retract, pose, tangent_zero(pose)) == []


# ---------------------------------------------------------------- elimination


def swapped(matrix):
    """Complete pivoting as the textbook has it, by exchanging rows and columns. -> order of both"""
    a, n = np.array(matrix), len(matrix)
    rows, columns = list(range(n)), list(range(n))
    for k in range(n):
        i, j = np.unravel_index(np.argmax(np.abs(a[k:, k:])), (n - k, n - k))
        a[[k, k + i]] = a[[k + i, k]]
        a[:, [k, k + j]] = a[:, [k + j, k]]
        rows[k], rows[k + i] = rows[k + i], rows[k]
        columns[k], columns[k + j] = columns[k + j], columns[k]
        a[k + 1 :] -= np.outer(a[k + 1 :, k] / a[k, k], a[k])
    return tuple(rows), tuple(columns)


RANDOM = np.random.default_rng(4)


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_the_order_is_that_of_complete_pivoting(n):
    for _ in range(30):
        matrix = RANDOM.normal(size=(n, n))
        order = elimination.pivot_order(matrix)
        assert tuple(order) == swapped(matrix)
        sign = np.linalg.det(np.eye(n)[list(order.rows)]) * np.linalg.det(np.eye(n)[list(order.columns)])
        np.testing.assert_allclose(order.parity(), sign, rtol=1e-12)


def test_roundoff_does_not_change_the_order():
    """Pivots of equal size occur in every symmetrical mechanism."""
    matrix = np.kron(np.array([[1.0, 0.5], [-0.5, 1.0]]), np.eye(3)) + 0.01
    order = elimination.pivot_order(matrix)
    for _ in range(20):
        assert elimination.pivot_order(matrix * (1 + RANDOM.uniform(-1e-12, 1e-12, matrix.shape))) == order


def lanes_of(matrices):
    _, rows, columns = matrices.shape
    return [[jnp.asarray(matrices[:, i, j]) for j in range(columns)] for i in range(rows)]


@jax.jit
def _solved_by_inverse(matrices, right, inverse, sign):
    by = elimination.Reference([list(row) for row in inverse], sign)
    return _solved(matrices, right, by)


def _solved(matrices, right, by):
    factors = elimination.factor([[matrices[:, i, j] for j in range(6)] for i in range(6)], by)
    x = elimination.solve(factors, [right[:, i] for i in range(6)])
    inverse = jnp.stack([jnp.stack(row, axis=1) for row in elimination.inverse(factors)], axis=1)
    return jnp.stack(x, axis=1), inverse, factors.sign()


def near(matrix, spread, count=7):
    return matrix * (1 + RANDOM.uniform(-spread, spread, (count, *matrix.shape)))


@pytest.mark.parametrize("kind", ["order", "inverse"])
def test_solving_is_that_of_numpy(kind):
    solve = jax.jit(_solved, static_argnums=2)
    for matrix in RANDOM.normal(size=(2 if kind == "order" else 8, 6, 6)):
        matrices, right = near(matrix, 0.02), RANDOM.normal(size=(7, 6))
        if kind == "order":
            found, inverse, sign = solve(matrices, right, elimination.pivot_order(matrix))
        else:
            sign = np.sign(np.linalg.det(matrix))
            found, inverse, sign = _solved_by_inverse(matrices, right, np.linalg.inv(matrix), sign)
        size = np.linalg.cond(matrices)[:, None]
        expected = np.linalg.solve(matrices, right[..., None])[..., 0]
        scale = np.max(np.abs(expected), axis=1, keepdims=True)
        np.testing.assert_allclose((found - expected) / size / scale, 0, atol=1e-14)
        expected = np.linalg.inv(matrices)
        scale = np.max(np.abs(expected), axis=(1, 2), keepdims=True)
        np.testing.assert_allclose((inverse - expected) / size[..., None] / scale, 0, atol=1e-14)
        np.testing.assert_array_equal(sign, np.sign(np.linalg.det(matrices)))


def test_the_sign_follows_the_order_of_rows_and_columns():
    matrix = RANDOM.normal(size=(3, 3))
    for rows, columns in itertools.product(itertools.permutations(range(3)), repeat=2):
        moved = matrix[np.ix_(rows, columns)]
        by = elimination.pivot_order(moved)
        factors = elimination.factor(lanes_of(moved[None]), by)
        np.testing.assert_array_equal(factors.sign(), np.sign(np.linalg.det(moved)))
        x = elimination.solve(factors, [jnp.asarray([v]) for v in (1.0, 2.0, 3.0)])
        np.testing.assert_allclose(np.ravel(x), np.linalg.solve(moved, [1, 2, 3]), rtol=1e-12)


def test_an_order_from_one_matrix_serves_another():
    """Any order is right where no pivot vanishes."""
    matrices, right = RANDOM.normal(size=(7, 6, 6)) + 4 * np.eye(6), RANDOM.normal(size=(7, 6))
    by = elimination.pivot_order(np.eye(6)[::-1] + 0.1 * RANDOM.normal(size=(6, 6)))
    found, _, sign = jax.jit(_solved, static_argnums=2)(matrices[:, ::-1], right[:, ::-1], by)
    expected = np.linalg.solve(matrices, right[..., None])[..., 0]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11)
    np.testing.assert_array_equal(sign, np.sign(np.linalg.det(matrices[:, ::-1])))


@jax.jit
def _least_squares(matrices, right):
    rows = [[matrices[:, i, j] for j in range(matrices.shape[2])] for i in range(matrices.shape[1])]
    upper, projected = elimination.orthogonalize(rows, [right[:, i] for i in range(right.shape[1])])
    x = jnp.stack(elimination.back_substitute(upper, projected), axis=1)
    return x, jnp.stack([jnp.stack([v + 0 * right[:, 0] for v in row], 1) for row in upper], 1)


@pytest.mark.parametrize("shape", [(3, 3), (9, 6), (3, 2), (5, 1)])
def test_least_squares_are_those_of_numpy(shape):
    matrices, right = RANDOM.normal(size=(7, *shape)), RANDOM.normal(size=(7, shape[0]))
    found, upper = _least_squares(matrices, right)
    expected = [np.linalg.lstsq(a, b)[0] for a, b in zip(matrices, right, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(upper, np.triu(upper))
    gram = np.swapaxes(matrices, 1, 2) @ matrices
    np.testing.assert_allclose(np.swapaxes(upper, 1, 2) @ upper, gram, rtol=0, atol=1e-13)


def test_least_squares_of_nearly_dependent_columns():
    """The right side goes along as a column: gram-schmidt without it loses the square of the condition."""
    column = np.linspace(1.0, 2.0, 6)
    matrix = np.stack([column, column + 1e-6 * np.sin(9 * column), np.ones(6)], axis=1)
    x = np.array([1.0, -2.0, 0.5])
    found, _ = _least_squares(matrix[None], (matrix @ x)[None])
    np.testing.assert_allclose(found[0], x, rtol=0, atol=64 * np.finfo(float).eps * np.linalg.cond(matrix))


@jax.jit
def _normal_equations(matrices, right):
    rows = [[matrices[:, i, j] for j in range(matrices.shape[2])] for i in range(matrices.shape[1])]
    gram = elimination.normal(rows)
    factors = elimination.factor_symmetric(gram)
    onto = lambda matrix: jnp.stack([jnp.stack(row, axis=1) for row in matrix], axis=1)
    x = elimination.solve_symmetric(factors, [right[:, i] for i in range(right.shape[1])])
    return onto(gram), jnp.stack(x, axis=1), onto(elimination.inverse_symmetric(factors))


@pytest.mark.parametrize("shape", [(3, 3), (9, 6), (3, 2), (5, 1)])
def test_normal_equations_are_those_of_numpy(shape):
    matrices, right = RANDOM.normal(size=(7, *shape)), RANDOM.normal(size=(7, shape[1]))
    gram, x, inverse = _normal_equations(matrices, right)
    expected = np.swapaxes(matrices, 1, 2) @ matrices
    worst = np.linalg.cond(expected).max()
    np.testing.assert_allclose(gram, expected, rtol=0, atol=1e-13)
    np.testing.assert_allclose(x, np.linalg.solve(expected, right[..., None])[..., 0], rtol=1e-13 * worst)
    np.testing.assert_allclose(inverse @ expected, np.tile(np.eye(shape[1]), (7, 1, 1)), atol=1e-14 * worst)
    np.testing.assert_array_equal(inverse, np.swapaxes(inverse, 1, 2))
