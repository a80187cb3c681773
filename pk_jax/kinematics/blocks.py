"""Which closure equations see which joints: known from the mechanism's code, whatever its values are."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import jax

from pk_jax.kinematics.entrywise import entrywise
from pk_jax.kinematics.jacobian import joint_jacobian
from pk_jax.kinematics.lanes import is_known, split
from pk_jax.mechanisms.base import Mechanism


class Block(NamedTuple):
    """Equations and joints that only see one another, a leg with all its motors, say."""

    equations: tuple[int, ...]
    joints: tuple[int, ...]


def joint_blocks(
    mech: Mechanism, pose: Any, joints: jax.Array, count: int | None = None
) -> tuple[Block, ...]:
    """The blocks of B, or of its first `count` columns, in the order of their first equation."""
    leaves, tree = jax.tree.flatten((mech, pose, joints))
    return _blocks(tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves), count)


def has_one_joint_an_equation(blocks: tuple[Block, ...]) -> bool:
    """Whether B is diagonal."""
    return all(block.equations == block.joints and len(block.joints) == 1 for block in blocks)


@lru_cache(maxsize=256)
def _blocks(tree: Any, leaves: tuple, count: int | None) -> tuple[Block, ...]:
    answer = []

    def look(*leaves):
        jacobian = entrywise(joint_jacobian, *jax.tree.unflatten(tree, list(map(split, leaves))))
        answer.extend([not (is_known(item) and item == 0) for item in row[:count]] for row in jacobian.rows())

    jax.eval_shape(look, *(jax.ShapeDtypeStruct(*leaf) for leaf in leaves))
    blocks = []
    open_rows = list(range(len(answer)))
    while open_rows:
        rows, seen = [open_rows[0]], set()
        for row in rows:  # grows while it is walked
            seen |= {j for j, is_seen in enumerate(answer[row]) if is_seen}
            rows += [
                i for i in open_rows if i not in rows and seen & {j for j, s in enumerate(answer[i]) if s}
            ]
        open_rows = [i for i in open_rows if i not in rows]
        blocks.append(Block(tuple(sorted(rows)), tuple(sorted(seen))))
    return tuple(blocks)
