"""Many known rows: blocks of lanes, on all cores, without tracing anything anew for another batch size."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax import checks
from pk_jax.kinematics.batching import home_shapes
from pk_jax.kinematics.compiled import FULL, Options, compiled
from pk_jax.kinematics.elimination import Order
from pk_jax.kinematics.in_blocks import aligned, block_size, in_blocks, padded, size_of
from pk_jax.kinematics.lane_newton import Attempt, Home, at_home, attempt, home_from, order_of
from pk_jax.kinematics.lanes import items_of, rebuilt, split, split_rows
from pk_jax.mechanisms.base import Mechanism

ORDERS = 4  # orders of pivots that a family of mechanisms is compiled for


class Prepared(NamedTuple):
    """What solving needs of a known mechanism, computed once."""

    home: Home
    order: Order | None
    shapes: tuple[Any, jax.ShapeDtypeStruct]  # of a pose and of the joints
    leaves: list[jax.Array]  # of the mechanism and its home
    tree: Any


class Rows(NamedTuple):
    """NumPy arrays, one entry a row."""

    pose: Any
    status: np.ndarray
    residual: np.ndarray
    steps: np.ndarray
    sigma_min: np.ndarray
    det_sign: np.ndarray


_prepared: WeakKeyDictionary[Mechanism, Prepared] = WeakKeyDictionary()


def prepared(mech: Mechanism) -> Prepared:
    """Home, its inverse and its order of pivots, kept as long as the mechanism lives."""
    found = _prepared.get(mech)
    if found is None:
        with checks.known_values():
            pose, joints, jacobian = jax.tree.map(np.asarray, _at_home(mech))
            order = order_of(jacobian, mech.actuated_rows)
            home = home_from(pose, joints, jacobian, mech.actuated_rows)
            leaves, tree = jax.tree.flatten((mech, home))
            leaves = [jnp.asarray(leaf) for leaf in leaves]
            order = _order_in_use(tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves), order)
        mech_leaves = len(jax.tree.leaves(mech))
        home = jax.tree.unflatten(jax.tree.structure(home), leaves[mech_leaves:])
        found = _prepared[mech] = Prepared(home, order, home_shapes(mech), leaves, tree)
    return found


_at_home = jax.jit(at_home)


def solve(
    mech: Mechanism,
    joints: np.ndarray,
    guess: Any,
    *,
    one_guess: bool,
    options: Options = FULL,
    workers: int | None = None,
) -> Rows:
    """The first attempt at every row. joints (batch, m); guess: None, one pose, or one a row.

    workers: threads; default: one a core
    """
    ready = prepared(mech)
    count, dtype = joints.shape[0], joints.dtype
    start = "home" if guess is None else "one" if one_guess else "rows"
    block = block_size()
    shapes = tuple((leaf.shape, leaf.dtype) for leaf in ready.leaves)
    run_block = program(ready.tree, shapes, ready.order, start, block, joints.shape[1], dtype, options)
    pose_leaves, pose_tree = jax.tree.flatten(ready.shapes[0])
    poses = [aligned((count, *leaf.shape), dtype) for leaf in pose_leaves]
    numbers = [
        aligned((count,), np.int32 if name in ("status", "steps") else dtype) for name in Rows._fields[1:]
    ]
    cuts = np.cumsum([leaf.size for leaf in pose_leaves])
    if guess is not None:
        flat = [
            np.asarray(leaf, dtype).reshape(1 if one_guess else count, -1) for leaf in jax.tree.leaves(guess)
        ]
        guess = np.concatenate(flat, axis=1)

    def run(first: int, last: int) -> None:
        rows, size = slice(first, last), last - first
        given = [jnp.asarray(padded(joints[rows], block)), size_of(size)]
        if guess is not None:
            given.append(jnp.asarray(guess[0] if one_guess else padded(guess[rows], block)))
        out = np.asarray(run_block([*ready.leaves, *given])[0])  # (chunks, values, lanes)
        out = out[: -(-size // out.shape[2])]
        for pose, begin, end in zip(poses, (0, *cuts), cuts, strict=False):
            part = out[:, begin:end].transpose(0, 2, 1)
            pose[rows] = part.reshape(-1, *pose.shape[1:])[:size]
        for column, number in enumerate(numbers, cuts[-1]):
            number[rows] = out[:, column].reshape(-1)[:size]

    in_blocks(run, count, block, workers)
    return Rows(jax.tree.unflatten(pose_tree, poses), *numbers)


def _order_in_use(tree: Any, shapes: tuple, order: Order | None) -> Order | None:
    """The order of pivots, for the first few geometries of a family that need another one.

    Every order is another program. From then on one program serves all geometries: without an
    order, by the inverse at home; slower, but nothing more to compile.
    """
    seen = _orders_seen.setdefault((tree, shapes), [])
    if order not in seen and len(seen) < ORDERS:
        seen.append(order)
    return order if order in seen else None


_orders_seen: dict[tuple, list[Order | None]] = {}


@lru_cache(maxsize=64)
def program(
    tree: Any,
    shapes: tuple,
    order: Order | None,
    start: str,
    block: int,
    joints: int,
    dtype: Any,
    options: Options,
) -> Callable:
    """The compiled block: mechanism, home, joints, number of rows, guess -> (chunks, values, lanes)."""
    mech, home = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(*shape) for shape in shapes])
    lanes = options.lanes if jax.default_backend() == "cpu" else block
    size = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(home.pose))
    given = [jax.ShapeDtypeStruct((block, joints), dtype), jax.ShapeDtypeStruct((), jnp.int32)]
    if start != "home":
        given.append(jax.ShapeDtypeStruct((size,) if start == "one" else (block, size), dtype))
    kind = type(mech)

    def solve_block(mech, home, joints, count, guess=None):
        entries, home = jax.tree.map(split, (mech, home))

        def chunk(k, out):
            at = lambda rows: split_rows(lax.dynamic_slice_in_dim(rows, k * lanes, lanes))
            begin = home.pose
            if start != "home":
                begin = rebuilt((split(guess) if start == "one" else at(guess)).items, home.pose)
            found = attempt(entries, at(joints), begin, home, order, kind=kind, is_home=start == "home")
            return lax.dynamic_update_slice_in_dim(out, values_of(found, dtype)[None], k, 0)

        chunks = block // lanes
        out = jnp.zeros((chunks, size + len(Rows._fields) - 1, lanes), dtype)
        return lax.fori_loop(0, jnp.minimum((count + lanes - 1) // lanes, chunks), chunk, out)

    return compiled(solve_block, (mech, home, *given), options)


def values_of(found: Attempt, dtype: Any) -> jax.Array:
    """Everything that an attempt says, as one array of lanes. -> (values, lanes)"""
    return jnp.stack([item.astype(dtype) for item in (*items_of(found.pose), *found[1:])])
