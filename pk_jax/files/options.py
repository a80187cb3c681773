"""What options of the command line mean for a mechanism."""

from __future__ import annotations

from collections.abc import Sequence

from pk_jax.analysis.slices import coordinate_names
from pk_jax.files.named import Named
from pk_jax.files.stream import free_columns
from pk_jax.geometry.poses import pose_units
from pk_jax.kinematics.batching import home_shapes


def signs_of(mode: str | None) -> list[float] | None:
    """A working mode from its signs."""
    if mode is None:
        return None
    if not mode or set(mode) - set("+-"):
        raise ValueError(f"--mode must be signs, like +-+, got {mode!r}")
    return [1.0 if sign == "+" else -1.0 for sign in mode]


def ranges_of(
    named: Named, texts: Sequence[str], *, with_free: bool = False
) -> dict[str, tuple[float, float]]:
    """NAME=LOWER:UPPER of coordinates of the pose, and of free joints where they are meant, in m and rad."""
    units = units_of(named)
    names = [name for name in units if with_free or name in coordinate_names(named.mechanism)]
    found = {}
    for text in texts:
        name, _, span = text.partition("=")
        low, _, high = span.partition(":")
        try:
            ends = float(low), float(high)
        except ValueError:
            raise ValueError(f"--range must be NAME=LOWER:UPPER, got {text!r}") from None
        if name not in names:
            raise ValueError(f"--range must name one of {', '.join(names)}, got {name!r}")
        found[name] = (ends[0] * units[name], ends[1] * units[name])
    return found


def units_of(named: Named) -> dict[str, float]:
    """Metres in the unit of each coordinate of the pose and of each free joint; 1 for angles."""
    return {name: named.metres if is_length else 1.0 for name, is_length in _lengths(named).items()}


def unit_name(named: Named, name: str) -> str:
    """The unit of a coordinate or free joint, after a space."""
    if not _lengths(named)[name]:
        return " rad"
    return "" if named.unit == "1" else f" {named.unit}"


def _lengths(named: Named) -> dict[str, bool]:
    mech = named.mechanism
    units = pose_units(home_shapes(mech)[0], mech.pose_units)
    found = dict(zip(coordinate_names(mech), map(bool, units), strict=True))
    return found | {column.name: column.kind == "length" for column in free_columns(named)}
