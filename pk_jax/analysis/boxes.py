"""Boxes of poses and free joints, bisected until each is settled."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.analysis.slices import coordinate_names, coordinates_of
from pk_jax.geometry import rotations
from pk_jax.geometry.axis_pose import AxisPose
from pk_jax.geometry.poses import retract, tangent_size
from pk_jax.geometry.se3 import SE3
from pk_jax.kinematics.batching import home_shapes
from pk_jax.kinematics.entrywise import UnknownPrimitive
from pk_jax.kinematics.intervals import Interval, enclosure, minus, thin
from pk_jax.mechanisms.base import Mechanism

MOST = 1_000_000  # boxes
AT_A_TIME = 2048

Report = Callable[..., None]


class Certificate(NamedTuple):
    """What was proved. Names and order of the coordinates are in `names`."""

    is_proved: bool
    bound: float  # what the proof leaves to spare, see the function; NaN where it is none
    boxes: int  # examined
    names: tuple[str, ...]
    lower: np.ndarray  # (d,) of the whole box
    upper: np.ndarray
    unsettled: tuple[np.ndarray, np.ndarray]  # lower and upper (k, d) of boxes that are left


class Box:
    """The box that a user names, and functions of its coordinates (pose, then free joints)."""

    def __init__(self, mech: Mechanism, ranges: Mapping[str, Sequence[float]]) -> None:
        self.mech = mech
        pose, joints = self._at_home = mech.home()
        self.names = (*coordinate_names(mech), *free_names(mech))
        self.n = tangent_size(pose)
        self.equations = jax.eval_shape(mech.residual, pose, joints).shape[0]
        at = coordinates_of(jax.tree.map(lambda leaf: leaf[None], pose))[0]
        self.home = np.append(at, np.asarray(joints)[len(joints) - mech.free_joints :])
        lower, upper = self.home.copy(), self.home.copy()
        for name, given in checks.is_dict("ranges", ranges).items():
            if name not in self.names:
                raise ValueError(f"ranges must name some of {', '.join(self.names)}, got {name!r}")
            ends = checks.real_numpy(f"ranges[{name!r}]", given).astype(float)
            if ends.shape != (2,) or not np.all(np.isfinite(ends)) or not ends[0] <= ends[1]:
                got = " ".join(str(given).split())
                raise ValueError(f"ranges[{name!r}] must be (lower, upper), lower <= upper, got {got}")
            place = self.names.index(name)
            lower[place], upper[place] = ends
        self.whole = lower, upper

    def at_home(self, boxes: int | None = None) -> tuple[Any, Any]:
        """The home pose, and joints of which nothing is known, so that none can have a say unnoticed."""
        pose, joints = self._at_home
        if boxes is None:
            return pose, jnp.full_like(joints, jnp.nan)
        nothing = np.full((boxes, len(joints)), np.nan)
        return pose, Interval(nothing, nothing)

    def enclosed(self, function: Callable, lower: np.ndarray, upper: np.ndarray) -> Any:
        """Bounds of `function(mech, home, coordinates)` over boxes (k, d); NaN where it may jump."""
        box = Interval(lower, upper)
        try:
            return enclosure(function, self.mech, self.at_home(len(lower)), box, is_sure=True)
        except UnknownPrimitive as error:
            what = f"{type(self.mech).__name__}: there are no bounds of the primitive {error}"
            raise ValueError(f"no certificate for {what}") from None


def free_names(mech: Mechanism) -> tuple[str, ...]:
    """Names of the kinematically redundant joints."""
    m = home_shapes(mech)[1].shape[0]
    names = mech.joint_names or tuple(f"q{i}" for i in range(1, m + 1))
    return names[m - mech.free_joints :]


def check_chart(box: Box) -> None:
    """ValueError where angles of the box are not those of one pose each."""
    limits = {"pitch": np.pi / 2, "roll": np.pi, "yaw": np.pi, "phi": np.pi}
    for name, low, high in zip(box.names, *box.whole, strict=True):
        if max(abs(low), abs(high)) >= limits.get(name, np.inf):
            raise ValueError(f"ranges[{name!r}] must be inside +-{limits[name]:.6g} rad, got ({low}, {high})")


def pose_at(home: Any, values: jax.Array) -> Any:
    """The pose of coordinates; `rotations.from_rotation_vector` has two formulas, intervals want one."""
    if isinstance(home, AxisPose):
        return AxisPose(values[0], rotations.from_angles(values[1:4]))
    if isinstance(home, SE3):
        start = SE3(jnp.zeros_like(home.translation), home.rotation)
        return retract(start, values[:6])
    return values[: home.shape[0]]


# --- bisection


class Settled(NamedTuple):
    """What is known of boxes (k,)."""

    bound: np.ndarray  # proved; NaN: nothing is
    is_done: np.ndarray
    spread: np.ndarray  # (k, d) how much each coordinate contributes to what is not known
    is_lost: bool  # at some point the contrary holds


def bisected(
    box: Box,
    settle: Callable[[np.ndarray, np.ndarray], Settled],
    starts: Sequence[tuple[np.ndarray, np.ndarray]],
    most: int,
    report: Report | None,
    what: str,
) -> Certificate:
    """Settle the boxes, those that are not in two halves, until none is left."""
    say = report or (lambda *_: None)
    most = checks.is_count("most", most, most=10**9)
    lower, upper = (np.stack(ends) for ends in zip(*starts, strict=True))
    bound, examined, is_lost = np.inf, 0, False
    while len(lower) and examined < most and not is_lost:
        count = min(AT_A_TIME, most - examined, len(lower))
        here = slice(len(lower) - count, len(lower))  # the last ones: depth first, few are kept
        low, high = lower[here], upper[here]
        with np.errstate(all="ignore"):  # NaN is what is not known
            found = settle(low, high)
        examined += len(low)
        is_lost = found.is_lost
        bound = min(bound, np.min(found.bound[found.is_done], initial=np.inf))
        open_low, open_high = low[~found.is_done], high[~found.is_done]
        spread = np.where(open_high > open_low, found.spread[~found.is_done], -1.0)
        spread = np.where(np.isnan(spread), np.inf, spread)
        rows, axis = np.arange(len(open_low)), np.argmax(spread, axis=1)
        cut = halved(open_low, open_high)[0][rows, axis]
        can_be_cut = (open_low[rows, axis] < cut) & (cut < open_high[rows, axis])
        is_lost |= not np.all(can_be_cut)
        below, above = open_high.copy(), open_low.copy()
        below[rows, axis] = above[rows, axis] = cut
        lower = np.concatenate([lower[: here.start], open_low, above])
        upper = np.concatenate([upper[: here.start], below, open_high])
        say(f"{what}: boxes", examined, examined + len(lower))
    is_proved = not len(lower)
    return Certificate(
        is_proved, float(bound) if is_proved else np.nan, examined, box.names, *box.whole, (lower, upper)
    )


def halved(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A point of each box near its middle, and how far from it the box reaches at most."""
    middle = Interval(lower, upper).middle
    ends = [minus(thin(upper), thin(middle)).upper, minus(thin(middle), thin(lower)).upper]
    return middle, np.where(upper > lower, np.maximum(*ends), 0.0)
