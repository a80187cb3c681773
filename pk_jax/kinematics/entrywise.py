"""One-configuration code, evaluated entry by entry on lanes.

A batched Newton step is a few hundred multiplications on small matrices. Written as batched matrix
operations it is slow: every one goes through memory and, worse, through LAPACK. Here the plain code
of ONE configuration is traced, and its jaxpr evaluated with each array replaced by its scalar
entries, each entry being a lane: an array over many configurations. What remains is straight
elementwise arithmetic that the compiler keeps in registers, and entries that are known to be zero or
one vanish. Mechanism code stays as plain as `sum((points - base)**2) - l**2`.

A function with a primitive that is not known here (a loop, a factorization) falls back to `vmap`.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from pk_jax.kinematics.lanes import (
    Entries,
    Lane,
    is_entries,
    is_known,
    items_of,
    minus,
    over,
    plus,
    stack,
    times,
)


class UnknownPrimitive(Exception):
    """A primitive that cannot be evaluated entry by entry."""


class Invariants:
    """Values that stay the same while others change: computed by a first call, found again by the later ones.

    A loop that calls `entrywise` with one of these in its body finds there what was computed, from
    the `fixed` arguments alone, by a call before the loop (cosines of the joints, for example).
    """

    def __init__(self, *fixed: Any) -> None:
        self.fixed = {id(item) for item in items_of(fixed)}
        self.found: dict[tuple[int, ...], list[Entries]] = {}
        self.is_complete = False

    def holds(self, inputs: Sequence[Entries]) -> bool:
        return all(is_known(item) or id(item) in self.fixed for entries in inputs for item in entries.items)

    def keep(self, path: tuple[int, ...], outputs: list[Entries]) -> None:
        self.found[path] = outputs
        self.fixed |= {id(item) for entries in outputs for item in entries.items}


class Rules(NamedTuple):
    """Arithmetic of entries: of lanes here, of other numbers elsewhere."""

    plus: Callable
    minus: Callable
    times: Callable
    over: Callable
    negative: Callable
    square: Callable
    power: Callable  # (item, whole number)
    greater: Callable
    lesser: Callable
    elementwise: Callable  # (equation, *items), any other primitive
    can_fall_back: bool  # to `vmap`


def entrywise(
    function: Callable, *arguments: Any, invariants: Invariants | None = None, rules: Rules | None = None
) -> Any:
    """`function(*arguments)`, where the leaves of the arguments and of the answer are `Entries`."""
    rules = rules or LANES
    leaves, tree = jax.tree.flatten(arguments, is_leaf=is_entries)
    dtype = next(item.dtype for leaf in leaves for item in leaf.items if not is_known(item))
    traced = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(leaf.shape, dtype) for leaf in leaves])
    jaxpr, answer = jax.make_jaxpr(function, return_shape=True)(*traced)
    try:
        found = _evaluate(jaxpr.jaxpr, jaxpr.consts, leaves, rules, invariants)
    except UnknownPrimitive:
        if not rules.can_fall_back:
            raise
        found = _vmapped(function, tree, leaves, dtype)
    if invariants is not None:
        invariants.is_complete = True
    return jax.tree.unflatten(jax.tree.structure(answer), found)


def unknown_primitives(function: Callable, *arguments: Any) -> list[str]:
    """What keeps `function` of these (abstract) arguments from being evaluated entry by entry."""
    jaxpr = jax.make_jaxpr(function)(*arguments)
    return sorted(set(_unknown(jaxpr.jaxpr)))


# --- the evaluator


def _evaluate(
    jaxpr: Jaxpr,
    constants: Sequence[Any],
    arguments: Sequence[Entries],
    rules: Rules,
    invariants: Invariants | None = None,
    path: tuple[int, ...] = (),
) -> list[Entries]:
    values: dict[Any, Entries] = {}

    def read(atom) -> Entries:
        return _known(atom.val) if isinstance(atom, Literal) else values[atom]

    values.update(zip(jaxpr.constvars, map(_known, constants), strict=True))
    values.update(zip(jaxpr.invars, arguments, strict=True))
    for place, equation in enumerate(jaxpr.eqns):
        here = (*path, place)
        if invariants is not None and here in invariants.found:
            outputs = invariants.found[here]
        else:
            inputs = [read(atom) for atom in equation.invars]
            outputs = _apply(equation, inputs, rules, invariants, here)
            if invariants is not None and not invariants.is_complete and invariants.holds(inputs):
                invariants.keep(here, outputs)
        values.update(zip(equation.outvars, outputs, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _known(value: Any) -> Entries:
    array = np.asarray(value)
    return Entries(array.shape, array.ravel().tolist())


def _apply(
    equation, inputs: list[Entries], rules: Rules, invariants: Invariants | None, path: tuple[int, ...]
) -> list[Entries]:
    name, params = equation.primitive.name, equation.params
    if (inner := _called(params)) is not None:
        return _evaluate(inner.jaxpr, inner.consts, inputs, rules, invariants, path)
    if name in _STRUCTURAL:
        return _STRUCTURAL[name](inputs, params)
    if name in _REDUCTIONS:
        return [_reduce(_REDUCTIONS[name](rules), inputs[0], params["axes"])]
    if name == "dot_general":
        return [_dot_general(*inputs, params["dimension_numbers"], rules)]
    if name == "iota":
        return [_iota(params["shape"], params["dimension"])]
    is_float = jnp.issubdtype(equation.outvars[0].aval.dtype, jnp.floating)
    if name in _ARITHMETIC and is_float:
        function = _ARITHMETIC[name](rules)
    elif name == "integer_pow" and is_float:
        function = functools.partial(rules.power, y=params["y"])
    elif name in _ELEMENTWISE or name in _ARITHMETIC:  # whole numbers divide and overflow as JAX says
        function = functools.partial(rules.elementwise, equation)
    else:
        raise UnknownPrimitive(name)
    shape = equation.outvars[0].aval.shape
    spread = [entries.at(np.broadcast_to(entries.indices(), shape)).items for entries in inputs]
    return [Entries(shape, [function(*row) for row in zip(*spread, strict=True)])]


def _called(params: dict[str, Any]) -> ClosedJaxpr | None:
    """The body of a call (jit, custom_jvp_call, remat, ...)."""
    for key in ("jaxpr", "call_jaxpr", "fun_jaxpr"):
        if (inner := params.get(key)) is not None and not {"length", "cond_jaxpr", "branches"} & set(params):
            return inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
    return None


def picked(equation, *items: Any) -> Any:
    """What a choice or a conversion that is known gives of its items; None for anything else."""
    if equation.primitive.name == "select_n" and is_known(items[0]):
        return items[1 + int(items[0])]
    if equation.primitive.name == "convert_element_type" and is_known(items[0]):
        return np.asarray(items[0]).astype(equation.outvars[0].aval.dtype).item()
    return None


def _bind(equation, *items: Lane) -> Lane:
    """An elementwise primitive on one entry of each operand."""
    if (item := picked(equation, *items)) is not None:
        return item
    if all(map(is_known, items)):
        return of_known(equation, *items)
    shape = jnp.broadcast_shapes(*(jnp.shape(item) for item in items))
    arrays = [
        jnp.broadcast_to(jnp.asarray(x, atom.aval.dtype), shape)
        for x, atom in zip(items, equation.invars, strict=True)
    ]
    return equation.primitive.bind(*arrays, **equation.params)


def of_known(equation, *items: Any) -> Any:
    """An elementwise primitive on known numbers, as JAX computes it."""
    with jax.ensure_compile_time_eval():
        arrays = [jnp.asarray(x, atom.aval.dtype) for x, atom in zip(items, equation.invars, strict=True)]
        return np.asarray(equation.primitive.bind(*arrays, **equation.params)).item()


def _integer_power(base: Lane, y: int) -> Lane:
    return functools.reduce(times, [base] * y, 1.0) if y >= 0 else over(1.0, _integer_power(base, -y))


LANES = Rules(
    plus,
    minus,
    times,
    over,
    lambda a: -a,
    lambda a: times(a, a),
    _integer_power,
    lambda a, b: jnp.maximum(a, b),
    lambda a, b: jnp.minimum(a, b),
    _bind,
    can_fall_back=True,
)
_ARITHMETIC: dict[str, Callable[[Rules], Callable]] = {
    "add": lambda rules: rules.plus,
    "add_any": lambda rules: rules.plus,
    "sub": lambda rules: rules.minus,
    "mul": lambda rules: rules.times,
    "div": lambda rules: rules.over,
    "neg": lambda rules: rules.negative,
    "square": lambda rules: rules.square,
    "copy": lambda rules: lambda a: a,
    "copy_p": lambda rules: lambda a: a,
}
# fmt: off
_ELEMENTWISE = frozenset((
    "abs", "acos", "acosh", "and", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil", "clamp",
    "convert_element_type", "cos", "cosh", "eq", "erf", "exp", "exp2", "expm1", "floor", "ge", "gt",
    "is_finite", "le", "log", "log1p", "logistic", "lt", "max", "min", "ne", "not", "or", "pow", "rem",
    "round", "rsqrt",
    "select_n", "sign", "sin", "sinh", "sqrt", "stop_gradient", "tan", "tanh", "xor",
))
# fmt: on
_REDUCTIONS: dict[str, Callable[[Rules], Callable]] = {
    "reduce_sum": lambda rules: rules.plus,
    "reduce_prod": lambda rules: rules.times,
    "reduce_max": lambda rules: rules.greater,
    "reduce_min": lambda rules: rules.lesser,
    "reduce_and": lambda rules: rules.lesser,
    "reduce_or": lambda rules: rules.greater,
}


def _reduce(function: Callable, entries: Entries, axes: Sequence[int]) -> Entries:
    if not entries.items:
        raise UnknownPrimitive("a reduction of nothing")
    kept = [axis for axis in range(len(entries.shape)) if axis not in axes]
    groups = entries.indices().transpose(*kept, *axes).reshape(*(entries.shape[axis] for axis in kept), -1)
    shape = groups.shape[:-1]
    rows = groups.reshape(-1, groups.shape[-1])
    return Entries(shape, [functools.reduce(function, [entries.items[i] for i in row]) for row in rows])


def _dot_general(left: Entries, right: Entries, dimension_numbers, rules: Rules) -> Entries:
    (left_sum, right_sum), (left_batch, right_batch) = dimension_numbers
    if not (left.items and right.items):
        raise UnknownPrimitive("a product of nothing")

    def arranged(entries: Entries, summed, batch):
        free = [axis for axis in range(len(entries.shape)) if axis not in (*summed, *batch)]
        indices = entries.indices().transpose(*batch, *free, *summed)
        sizes = [entries.shape[axis] for axis in (*batch, *free)]
        return indices.reshape(int(np.prod(sizes[: len(batch)])), -1, _size(entries, summed)), sizes

    rows, left_sizes = arranged(left, left_sum, left_batch)
    columns, right_sizes = arranged(right, right_sum, right_batch)
    items = [
        functools.reduce(
            rules.plus,
            [rules.times(left.items[i], right.items[j]) for i, j in zip(row, column, strict=True)],
            0.0,
        )
        for batch in range(len(rows))
        for row, column in itertools.product(rows[batch], columns[batch])
    ]
    return Entries((*left_sizes, *right_sizes[len(left_batch) :]), items)


def _size(entries: Entries, axes: Sequence[int]) -> int:
    return int(np.prod([entries.shape[axis] for axis in axes]))


def _iota(shape: tuple[int, ...], dimension: int) -> Entries:
    return _known(
        np.broadcast_to(
            np.arange(shape[dimension]).reshape(
                [-1 if axis == dimension else 1 for axis in range(len(shape))]
            ),
            shape,
        )
    )


# --- structure: what moves entries about acts on their indices


def _moved(move: Callable[[np.ndarray, dict], np.ndarray]) -> Callable:
    return lambda inputs, params: [inputs[0].at(move(inputs[0].indices(), params))]


def _broadcast(indices: np.ndarray, params: dict) -> np.ndarray:
    shape = [1] * len(params["shape"])
    for size, axis in zip(indices.shape, params["broadcast_dimensions"], strict=True):
        shape[axis] = size
    return np.broadcast_to(indices.reshape(shape), params["shape"])


def _sliced(indices: np.ndarray, params: dict) -> np.ndarray:
    strides = params["strides"] or (1,) * indices.ndim
    bounds = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return indices[tuple(slice(*each) for each in bounds)]


def _concatenated(inputs: list[Entries], params: dict) -> list[Entries]:
    items = [item for entries in inputs for item in entries.items]
    starts = np.cumsum([0] + [len(entries.items) for entries in inputs])
    indices = [entries.indices() + start for entries, start in zip(inputs, starts[:-1], strict=True)]
    return [Entries((), items).at(np.concatenate(indices, axis=params["dimension"]))]


def _stacked(inputs: list[Entries], params: dict) -> list[Entries]:
    axis = params["axis"]
    return _concatenated([e.at(np.expand_dims(e.indices(), axis)) for e in inputs], {"dimension": axis})


def _unstacked(inputs: list[Entries], params: dict) -> list[Entries]:
    indices = np.moveaxis(inputs[0].indices(), params["axis"], 0)
    return [inputs[0].at(part) for part in indices]


def _split_up(inputs: list[Entries], params: dict) -> list[Entries]:
    (entries,) = inputs
    cuts = np.cumsum(params["sizes"])[:-1]
    return [entries.at(part) for part in np.split(entries.indices(), cuts, axis=params["axis"])]


def _by_jax(primitive) -> Callable:
    """Any other primitive that moves entries to places known beforehand: JAX moves their indices."""

    def moved(inputs: list[Entries], params: dict) -> list[Entries]:
        movable = _MOVABLE[primitive.name]
        items = [item for k in movable for item in inputs[k].items]
        start, arrays = 0, []
        for k, entries in enumerate(inputs):
            if k in movable:
                arrays.append(np.arange(start, start + len(entries.items)).reshape(entries.shape))
                start += len(entries.items)
            elif all(map(is_known, entries.items)):
                arrays.append(np.asarray(entries.items).reshape(entries.shape).astype(np.int32))
            else:
                raise UnknownPrimitive(f"{primitive.name} at an index that is computed")
        if "fill_value" in params:  # whatever it is, -1 marks where it goes
            params = params | {"fill_value": -1}
        with jax.ensure_compile_time_eval():
            indices = np.asarray(primitive.bind(*map(jnp.asarray, arrays), **params))
        if np.any((indices < 0) | (indices >= len(items))):  # filled in from out of bounds
            raise UnknownPrimitive(f"{primitive.name} out of bounds")
        return [Entries((), items).at(indices)]

    return moved


_MOVABLE = {  # operands whose entries move; the others are known indices
    "dynamic_slice": (0,),
    "dynamic_update_slice": (0, 1),
    "gather": (0,),
    "pad": (0, 1),
    "scatter": (0, 2),
}
_STRUCTURAL: dict[str, Callable] = {
    "broadcast_in_dim": _moved(_broadcast),
    "reshape": _moved(lambda indices, params: indices.reshape(params["new_sizes"])),
    "squeeze": _moved(lambda indices, params: indices.squeeze(params["dimensions"])),
    "expand_dims": _moved(lambda indices, params: np.expand_dims(indices, params["dimensions"])),
    "transpose": _moved(lambda indices, params: indices.transpose(params["permutation"])),
    "rev": _moved(lambda indices, params: np.flip(indices, params["dimensions"])),
    "slice": _moved(_sliced),
    "concatenate": _concatenated,
    "split": _split_up,
    "stack": _stacked,
    "unstack": _unstacked,
    "dynamic_slice": _by_jax(lax.dynamic_slice_p),
    "dynamic_update_slice": _by_jax(lax.dynamic_update_slice_p),
    "gather": _by_jax(lax.gather_p),
    "pad": _by_jax(lax.pad_p),
    "scatter": _by_jax(lax.scatter_p),
}


def _unknown(jaxpr: Jaxpr):
    known = {*_STRUCTURAL, *_REDUCTIONS, *_ARITHMETIC, *_ELEMENTWISE, "dot_general", "integer_pow", "iota"}
    for equation in jaxpr.eqns:
        if (inner := _called(equation.params)) is not None:
            yield from _unknown(inner.jaxpr)
        elif equation.primitive.name not in known:
            yield equation.primitive.name


def _vmapped(function: Callable, tree, leaves: Sequence[Entries], dtype) -> list[Entries]:
    """The fallback: lanes as the last axis of ordinary arrays."""
    lanes = jnp.broadcast_shapes(*(jnp.shape(item) for leaf in leaves for item in leaf.items))
    alike = [jnp.broadcast_to(jnp.zeros((), dtype), lanes)]  # makes every leaf one of lanes
    arrays = [stack(Entries((len(leaf.items) + 1,), leaf.items + alike))[:-1] for leaf in leaves]
    arrays = [a.reshape(*leaf.shape, *lanes).astype(dtype) for a, leaf in zip(arrays, leaves, strict=True)]
    for _ in lanes:
        function = jax.vmap(function, in_axes=-1, out_axes=-1)
    found = jax.tree.leaves(function(*jax.tree.unflatten(tree, arrays)))
    shapes = [leaf.shape[: leaf.ndim - len(lanes)] for leaf in found]
    return [
        Entries(shape, [leaf[i] for i in np.ndindex(shape)])
        for leaf, shape in zip(found, shapes, strict=True)
    ]
