"""Which assembly modes a machine can be in: roads through pose space that meet no type II singularity."""

from __future__ import annotations

import enum
import heapq
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.geometry import rotations
from pk_jax.geometry.poses import Turning, features, like, pose_units, position, retract, tangent_size
from pk_jax.geometry.spread import evenly, quaternions
from pk_jax.kinematics.batching import equations, home_shapes, rows_of
from pk_jax.kinematics.inverse import working_modes
from pk_jax.kinematics.jacobian import SINGULAR_BELOW, scaled_jacobians
from pk_jax.kinematics.modes.assembly import AssemblyModes
from pk_jax.kinematics.track import CLOSEST
from pk_jax.mechanisms.base import Mechanism, require_mechanism

NODES = 512  # poses tried for the first roadmap
ROUNDS = 2  # roadmaps, each with four times the poses of the one before
NEIGHBOURS = 8  # that a pose is joined to
GLANCES = 7  # poses looked at on a way before it is taken for a road
SAMPLES = 32  # parts that a road is cut into before its parts are halved
HALVED = 14  # times, at most
REGULAR_ABOVE = 3 * CLOSEST  # sigma_min; `track`, whose own is up to sqrt(n) less, follows what is above
SAME_TO = 1e-6  # of joints: radians, or lengths over length()
ROUNDOFF = 1e-9  # of a margin
BLOCK = 2048  # poses of one call


class Link(enum.IntEnum):
    """How an assembly mode is connected to home."""

    PATH = 1  # by a way that was found and checked
    NOT_FOUND = 0  # no way was found, which proves nothing
    IMPOSSIBLE = -1  # not at all: det A has the other sign, and every way meets det A = 0


class Connections(NamedTuple):
    """Over the slots of the assembly modes."""

    to_home: np.ndarray  # (slots,) int8 Link
    group: np.ndarray  # (slots,) modes with a way between them share a number, home's is 0; -1: not real
    paths: dict[int, Any]  # slot: poses from home to the mode, of those with Link.PATH
    clearance: np.ndarray  # (slots,) least sigma_min along the path, NaN where there is none


def connect_modes(
    mech: Mechanism,
    joints: Any,
    modes: AssemblyModes,
    *,
    within_limits: bool = False,
    nodes: int = NODES,
    report: Callable[..., None] | None = None,
) -> Connections:
    """Which assembly modes the machine reaches from home, and from each other, free of type II singularities.

    joints, modes:  (m,) and `assembly_modes(mech, joints)`
    within_limits:  whether all `mech.margins` must be >= 0 on the way, too
    nodes:          poses tried for the first roadmap; a second one has four times as many more
    report:         called with (what, done, total)

    IMPOSSIBLE is a proof: det A is continuous along every motion, so that modes with unlike signs are parted
    by det A = 0, whatever the way (signs of modes with sigma_min < 1e-6 are not trusted). PATH is checked,
    though not proved: from one pose of the path to the next, A, without units (`scaled_jacobians`), changes
    by less than half its least singular value, so that no matrix on the straight line between the two is
    singular (Weyl's inequality), det A keeps its sign, and sigma_min stays above 3e-4. NOT_FOUND proves
    nothing; a mode that is itself nearer to a singularity is never found. Mechanisms with redundant actuation
    have no sign, and are never IMPOSSIBLE.

    A path stays in home's working mode: a mode that is in another one is NOT_FOUND, or IMPOSSIBLE by its
    sign, since a type I singularity lies between; two modes in the same one can share a group. Kinematically
    redundant joints first slide to their values, the platform at home, and stay there. Angles of a path
    continue past a full turn: its last pose may differ from the mode by whole turns.

    Straight ways are tried first, then a probabilistic roadmap (Kavraki, Svestka, Latombe and Overmars 1996,
    IEEE Trans. Robotics and Automation 12(4)) whose poses are spread evenly, the same every time.

    Needs float64, known values and a closed form `inverse`. ValueError for others, and for many rows.
    """
    checks.is_function("report", report)
    within_limits = checks.is_flag("within_limits", within_limits)
    checks.is_count("nodes", nodes, most=10**9)
    checks.fits(f"nodes = {nodes}", 8 * 3 * (5 * nodes) ** 2, "take fewer")
    joints = _checked(mech, joints, modes)
    home, home_joints = jax.device_get(mech.home())
    ends = _joined(_lone(home), jax.device_get(modes.poses))  # row 0 is home, row k + 1 slot k
    slots = len(modes.is_real)
    every = np.concatenate([home_joints[None], np.broadcast_to(joints, (slots, len(joints)))])
    is_real = np.append(True, modes.is_real)
    mode_of = np.where(is_real, _working_mode_of(mech, ends, every), -1)
    free = every[:, len(joints) - mech.free_joints :]

    root = np.arange(slots + 1)  # of the same group: the first row of it
    paths, clearance = {}, np.full(slots, np.nan)
    sides = [
        _Side(mech, branch, free[-1], sign, within_limits)
        for branch in _branches(mech)
        for sign in ((1.0, -1.0) if _has_sign(mech) else (0.0,))
    ]
    for done, side in enumerate(sides):
        is_here = mode_of == done // (len(sides) // len(_branches(mech)))
        is_here &= side.seen(ends, ends, np.zeros(slots + 1)).sigma > 0
        is_here[0] &= side.slides(_lone(home), free[0])
        rows = np.flatnonzero(is_here)
        if len(rows) > 1:
            found = _roads(side, _rows(ends, rows), nodes)
            root[rows] = rows[found.root]
            for row, way in found.ways.items():
                if row and root[rows[row]] == 0:
                    paths[int(rows[row]) - 1], clearance[rows[row] - 1] = _path(mech, way)
        if report is not None:
            report("roads between modes: sides", done + 1, len(sides))
    return Connections(_links(modes, paths), _numbered(root, modes.is_real), paths, clearance)


def _checked(mech: Mechanism, joints: Any, modes: AssemblyModes) -> np.ndarray:
    require_mechanism("connect_modes", mech)
    if not isinstance(modes, AssemblyModes):
        raise ValueError(f"modes must come from assembly_modes, got {type(modes).__name__}")
    if not checks.is_concrete((mech, joints, modes.poses)) or checks.is_staged():
        raise ValueError("connect_modes needs known values: call it outside of jit, grad and vmap")
    pose_like, joints_like = home_shapes(mech)
    if joints_like.dtype != jnp.float64:
        raise ValueError("connect_modes needs float64: call pk_jax.enable_x64() first")
    if not hasattr(mech, "inverse"):
        raise ValueError(f"connect_modes needs a closed form inverse, and {type(mech).__name__} has none")
    joints, is_many = rows_of("joints", joints, joints_like, numpy=True)
    if is_many or np.ndim(modes.is_real) != 1:
        raise ValueError("connect_modes takes one row of joints and its assembly modes, got a batch")
    rows_of("modes.poses", modes.poses, pose_like)
    return joints


def _has_sign(mech: Mechanism) -> bool:
    """Whether A, of the rows that carry force, is square."""
    count = equations(mech)
    return tangent_size(home_shapes(mech)[0]) == min(count, mech.actuated_rows or count)


def _links(modes: AssemblyModes, paths: dict[int, Any]) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        is_parted = modes.is_real & (modes.det_sign < 0) & (modes.sigma_min >= SINGULAR_BELOW)
    links = np.where(is_parted, Link.IMPOSSIBLE, Link.NOT_FOUND).astype(np.int8)
    links[list(paths)] = Link.PATH
    return links


def _numbered(root: np.ndarray, is_real: np.ndarray) -> np.ndarray:
    """Groups by number, in the order of their first slots; home's is 0. -> (slots,)"""
    numbers = {0: 0}
    each = zip(root[1:].tolist(), is_real, strict=True)
    return np.array([numbers.setdefault(first, len(numbers)) if real else -1 for first, real in each])


# --- working modes


def _branches(mech: Mechanism) -> list[np.ndarray | None]:
    return [branch if len(branch) else None for branch in working_modes(mech)]


def _working_mode_of(mech: Mechanism, poses: Any, joints: np.ndarray) -> np.ndarray:
    """Which of the working modes holds each pose by the joints (k, m) given, -1 for none. -> (k,)"""
    unit = np.asarray(mech.joint_units or (1,) * joints.shape[1])
    found = np.full(len(joints), -1)
    for number, branch in reversed(list(enumerate(_branches(mech)))):
        off = np.asarray(_joints_at(mech, branch, poses, joints)) - joints
        off = np.where(unit > 0, off / float(mech.length()), np.arctan2(np.sin(off), np.cos(off)))
        found[np.abs(off).max(axis=1) < SAME_TO] = number
    return found


@jax.jit
def _joints_at(mech: Mechanism, branch: Any, poses: Any, joints: jax.Array) -> jax.Array:
    free = joints[:, joints.shape[1] - mech.free_joints :]
    return jax.vmap(lambda pose, free: _inverse(mech, branch, pose, free))(poses, free)


def _inverse(mech: Mechanism, branch: Any, pose: Any, free: jax.Array) -> jax.Array:
    return mech.inverse(pose, branch, free=free if mech.free_joints else None)


# --- what a pose is like


class _Seen(NamedTuple):
    poses: Any  # (k,)
    matrices: np.ndarray  # (k, c, n) A without units
    sigma: np.ndarray  # (k,) least singular value; 0 where no road may be


class _Side(NamedTuple):
    """Where roads may run: in one working mode, on one side of the singularities."""

    mech: Mechanism
    branch: Any
    free: np.ndarray  # (f,) values of the kinematically redundant joints
    sign: float  # of det A; 0: actuation is redundant
    within_limits: bool

    def seen(self, first: Any, second: Any, along: np.ndarray, twist: Any = None, free: Any = None) -> _Seen:
        """The poses `along` (k,) of the way from `first` to `second`, moved by `twist` (k, n)."""
        count, n = len(along), tangent_size(home_shapes(self.mech)[0])
        twist = np.zeros((count, n)) if twist is None else twist
        free = np.broadcast_to(self.free, (count, len(self.free))) if free is None else free
        given = (first, second, along, twist, free)
        parts = []
        for begin in range(0, count, BLOCK):
            rows = np.minimum(np.arange(begin, begin + BLOCK), count - 1)
            part = jax.device_get(_look(self.mech, self.branch, *_rows(given, rows)))
            parts.append(_rows(part, slice(count - begin)))
        poses, matrices, margins = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
        matrices = np.where(np.isfinite(matrices).all(axis=(1, 2), keepdims=True), matrices, 0)
        sigma = np.linalg.svd(matrices, compute_uv=False)[:, -1]
        is_open = sigma > REGULAR_ABOVE
        if self.sign:
            is_open &= np.sign(np.linalg.det(matrices)) == self.sign
        if self.within_limits:
            is_open &= margins >= -ROUNDOFF
        return _Seen(poses, matrices, np.where(is_open, sigma, 0))

    def slides(self, pose: Any, free: np.ndarray) -> bool:
        """Whether the redundant joints may slide from `free` (f,) to their values, the platform at `pose`."""
        along = np.linspace(0, 1, 8 * SAMPLES + 1)
        free = free + along[:, None] * (self.free - free)
        poses = _rows(pose, np.zeros(len(along), int))
        return not _gaps(self.seen(poses, poses, along, free=free)).any()


@jax.jit
def _look(mech, branch, first, second, along, twist, free):
    """The poses, A of their actuated rows, and the least of their margins."""

    def one(first, second, along, twist, free):
        pose = retract(_between(mech, first, second, along), twist)
        joints = _inverse(mech, branch, pose, free)
        margins = jax.tree.leaves(mech.margins(pose, joints))
        least = jnp.min(jnp.concatenate([jnp.ravel(m) for m in margins])) if margins else jnp.inf
        return pose, scaled_jacobians(mech, pose, joints).pose[: mech.actuated_rows], jnp.asarray(least)

    return jax.vmap(one)(first, second, along, twist, free)


def _between(mech: Mechanism, pose: Any, other: Any, along: jax.Array) -> Any:
    """The pose that share of the way: straight, turning about one axis, the shorter way round."""
    if isinstance(pose, Turning):
        turn = rotations.to_rotation_vector(other.rotation @ pose.rotation.T)
        shift, end = jax.tree.leaves(pose)[0], jax.tree.leaves(other)[0]
        turned = rotations.from_rotation_vector(along * turn) @ pose.rotation
        return like(pose, shift + along * (end - shift), turned)
    step = other - pose
    return pose + along * jnp.where(_is_straight(mech, pose), step, jnp.arctan2(jnp.sin(step), jnp.cos(step)))


def _is_straight(mech: Mechanism, pose: Any) -> np.ndarray:
    """Which coordinates of an array pose do not come round after a full turn. -> (n,)"""
    return (np.asarray(pose_units(pose, mech.pose_units)) > 0) | (not mech.angles_come_round)


def _gaps(seen: _Seen) -> np.ndarray:
    """Whether there might be a singularity between a pose and the next one. -> (k - 1,)"""
    change = np.linalg.norm(np.diff(seen.matrices, axis=0), axis=(1, 2))
    return ~(change < np.minimum(seen.sigma[1:], seen.sigma[:-1]) / 2)


# --- roads


class _Roads(NamedTuple):
    root: np.ndarray  # (ends,) the first end that there is a way to
    ways: dict[int, list[_Seen]]  # of each end: the way from its root to it, road by road


def _roads(side: _Side, ends: Any, nodes: int) -> _Roads:
    """Checked ways between poses, all of them on this side."""
    count = len(jax.tree.leaves(ends)[0])
    points, tried, checked = ends, 0, {}
    weights = _weights(side, points, np.array(np.triu_indices(count, 1)).T)
    found = _forest(side, points, count, weights, checked)
    for grown in range(ROUNDS):
        if not found.root.any():
            break
        more = nodes * 4**grown
        points, tried = _joined(points, *_spread(side, ends, tried, tried + more)), tried + more
        weights |= _weights(side, points, _neighbours(side.mech, points, count))
        found = _forest(side, points, count, weights, checked)
    return found


def _spread(side: _Side, ends: Any, skipped: int, count: int) -> list[Any]:
    """Poses on this side: anywhere in a box around the ends, and around the straight ways between them."""
    one = _rows(ends, 0)
    unit, length = np.asarray(pose_units(one, side.mech.pose_units)), float(side.mech.length())
    n, many = len(unit), len(jax.tree.leaves(ends)[0])
    anywhere = _anywhere(ends, unit, length, evenly(count, n)[skipped:])
    near = evenly(count, n + 3)[skipped:]
    first, second = (_rows(ends, (many * near[:, i]).astype(int)) for i in range(2))
    twist = (2 * near[:, 3:] - 1) * np.where(unit > 0, length, 1)
    seen = (
        side.seen(anywhere, anywhere, np.zeros(count - skipped)),
        side.seen(first, second, near[:, 2], twist),
    )
    return [_rows(each.poses, each.sigma > 0) for each in seen]


def _anywhere(ends: Any, unit: np.ndarray, length: float, spread: np.ndarray) -> Any:
    """Poses of every orientation, in the box that holds the ends and half a length more. spread: (k, n)"""
    at = np.asarray(jax.vmap(position)(ends))
    least, most = at.min(axis=0) - length / 2, at.max(axis=0) + length / 2
    d = at.shape[1]
    moved = least + spread[:, :d] * (most - least)
    if not isinstance(ends, Turning):
        return np.where(unit > 0, moved, 2 * np.pi * spread - np.pi)
    turned = _rotations(quaternions(spread[:, d:]))
    return like(ends, moved.reshape(-1, *jax.tree.leaves(ends)[0].shape[1:]), np.asarray(turned))


_rotations = jax.jit(jax.vmap(rotations.from_quaternion))


def _neighbours(mech: Mechanism, points: Any, ends: int) -> np.ndarray:
    """Pairs of points that lie near each other, of the ends four times as many. -> (pairs, 2)"""
    apart = _apart(_features(mech, points))
    np.fill_diagonal(apart, np.inf)
    nearest = np.argsort(apart, axis=1, kind="stable")[:, : 4 * NEIGHBOURS]
    pairs = [(i, j) for i, near in enumerate(nearest) for j in (near if i < ends else near[:NEIGHBOURS])]
    return np.unique(np.sort(pairs, axis=1), axis=0)


def _features(mech: Mechanism, poses: Any) -> np.ndarray:
    return features(poses, mech.pose_units, float(mech.length()), come_round=mech.angles_come_round)


def _apart(points: np.ndarray) -> np.ndarray:
    squared = np.sum(points**2, axis=1)
    return np.sqrt(np.maximum(squared[:, None] + squared - 2 * points @ points.T, 0))


def _weights(side: _Side, points: Any, pairs: np.ndarray) -> dict[tuple[int, int], float]:
    """What roads cost, of the pairs (k, 2) whose straight way looks clear: its length over its clearance."""
    if not len(pairs):
        return {}
    count = len(pairs)
    along = np.tile(np.arange(1, GLANCES + 1) / (GLANCES + 1), count)
    first, second = (_rows(points, np.repeat(pairs[:, i], GLANCES)) for i in range(2))
    clear = side.seen(first, second, along).sigma.reshape(count, GLANCES).min(axis=1)
    features = _features(side.mech, points)
    length = np.linalg.norm(features[pairs[:, 0]] - features[pairs[:, 1]], axis=1)
    return {tuple(pairs[k].tolist()): float(length[k] / clear[k]) for k in np.flatnonzero(clear)}


def _forest(side: _Side, points: Any, ends: int, weights: dict, checked: dict) -> _Roads:
    """The cheapest ways between the ends, all their roads checked; roads that fail leave `weights`."""
    while True:
        root, before = _cheapest(len(jax.tree.leaves(points)[0]), ends, weights)
        ways = {end: _way(before, end) for end in range(ends)}
        new = sorted({road for way in ways.values() for road in map(_sorted, way)} - checked.keys())
        if not new:
            return _Roads(root, {end: [_run(checked, road) for road in way] for end, way in ways.items()})
        first, second = (_rows(points, list(column)) for column in zip(*new, strict=True))
        for road, seen in zip(new, _driven(side, first, second), strict=True):
            checked[road] = seen
            if seen is None:
                del weights[road]


def _cheapest(count: int, ends: int, weights: dict) -> tuple[np.ndarray, dict[int, int]]:
    """Dijkstra's trees from ends that no earlier tree holds. -> roots (ends,), the point before each"""
    near = [[] for _ in range(count)]
    for (i, j), weight in weights.items():
        near[i].append((j, weight))
        near[j].append((i, weight))
    root, before, cost = np.full(count, -1), {}, np.full(count, np.inf)
    for end in range(ends):
        heap = [(0.0, end, end)] if root[end] < 0 else []
        while heap:
            so_far, point, by = heapq.heappop(heap)
            if root[point] >= 0:
                continue
            root[point], before[point] = end, by
            for other, weight in near[point]:
                if so_far + weight < cost[other]:
                    cost[other] = so_far + weight
                    heapq.heappush(heap, (cost[other], other, point))
    return root[:ends], before


def _way(before: dict[int, int], end: int) -> list[tuple[int, int]]:
    """Roads, (from, to), from the root of a tree to the end."""
    way = []
    while before[end] != end:
        way.append((before[end], end))
        end = before[end]
    return way[::-1]


def _sorted(road: tuple[int, int]) -> tuple[int, int]:
    return min(road), max(road)


def _run(checked: dict, road: tuple[int, int]) -> _Seen:
    """The samples of a road in the direction of travel."""
    seen = checked[_sorted(road)]
    return seen if road[0] < road[1] else _rows(seen, slice(None, None, -1))


def _driven(side: _Side, first: Any, second: Any) -> list[_Seen | None]:
    """The poses of each road, so near each other that nothing hides between them; None: it is not clear."""
    count = len(jax.tree.leaves(first)[0])
    road, along = np.repeat(np.arange(count), SAMPLES + 1), np.tile(np.linspace(0, 1, SAMPLES + 1), count)
    seen = side.seen(_rows(first, road), _rows(second, road), along)
    is_clear = np.ones(count, bool)
    for halved in range(HALVED + 1):
        is_clear[road[seen.sigma == 0]] = False
        wide = _gaps(seen) & (road[1:] == road[:-1]) & is_clear[road[1:]]
        if not wide.any():
            break
        if halved == HALVED:
            is_clear[road[1:][wide]] = False
            break
        roads, middle = road[1:][wide], (along[1:] + along[:-1])[wide] / 2
        seen = _joined(seen, side.seen(_rows(first, roads), _rows(second, roads), middle))
        road, along = np.concatenate([road, roads]), np.concatenate([along, middle])
        order = np.lexsort((along, road))
        seen, road, along = _rows((seen, road, along), order)
    return [_rows(seen, road == k) if is_clear[k] else None for k in range(count)]


def _path(mech: Mechanism, way: list[_Seen]) -> tuple[Any, float]:
    """The poses of a way one after the other, and the least sigma among them."""
    whole = _joined(way[0], *(_rows(seen, slice(1, None)) for seen in way[1:]))
    poses = whole.poses
    if not isinstance(poses, Turning):
        poses = np.where(_is_straight(mech, poses[0]), poses, np.unwrap(poses, axis=0))
    return jax.tree.map(jnp.asarray, poses), float(whole.sigma.min())


def _rows(tree: Any, rows: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[rows], tree)


def _joined(*trees: Any) -> Any:
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *trees)


def _lone(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[None], tree)
