"""What a class must say to be a mechanism, and what a newcomer is told where it does not."""

from __future__ import annotations

import difflib
import functools
import inspect
from typing import Any

_CONTRACT = {  # method: what it takes, what it gives
    "residual": ("pose, joints", "the closure equations"),
    "home": ("", "a regular reference configuration"),
    "length": ("", "a characteristic length"),
    "margins": ("pose, joints", "named distances to the limits"),
    "skeleton": ("pose, joints", "what to draw"),
    "attachments": ("", "where the legs meet the platform"),
    "legs": ("points, joints", "the closure of every leg"),
    "free_range": ("", "bounds of the free joints"),
    "default_branch": ("", "signs of the working mode"),
    "inverse": ("pose, branch=None, *, free=None", "the joints"),
    "forward": ("joints", "every assembly mode"),
}
_SEE = "see CONTRIBUTING, A mechanism of your own"


def _is_units(value: Any) -> bool:
    return value is None or (isinstance(value, tuple) and all(type(v) is int and v in (0, 1) for v in value))


_SETTINGS = {  # attribute of the class: what it must be, and whether it is
    "joint_units": ("a tuple of 1 = length and 0 = angle, one a joint", _is_units),
    "pose_units": ("a tuple of 1 = length and 0 = angle, one a coordinate", _is_units),
    "angles_come_round": ("True or False", lambda value: isinstance(value, bool)),
    "joints_are_distances": ("True or False", lambda value: isinstance(value, bool)),
    "actuated_rows": ("a positive integer or None", lambda value: value is None or _is_count(value, 1)),
    "free_joints": ("an integer >= 0", lambda value: _is_count(value, 0)),
    "joint_names": (
        "a tuple of strings or None",
        lambda value: value is None or (isinstance(value, tuple) and all(isinstance(v, str) for v in value)),
    ),
}


def _is_count(value: Any, least: int) -> bool:
    return type(value) is int and value >= least


def check_attributes(cls: type) -> None:
    """TypeError where a class attribute is a misspelt or wrong setting, or a field without annotation."""
    annotated = inspect.get_annotations(cls)
    for name, value in vars(cls).items():
        if name in _SETTINGS:
            wanted, is_right = _SETTINGS[name]
            if not (isinstance(value, property) or is_right(value)):
                raise TypeError(f"{cls.__name__}.{name} must be {wanted}, got {value!r}")
        elif (
            name in _CONTRACT
            or name.startswith("_")
            or name.isupper()
            or callable(value)
            or hasattr(type(value), "__get__")
        ):
            continue  # of the contract (see below), private, a constant, a method, a property
        elif close := difflib.get_close_matches(name, _SETTINGS, n=1, cutoff=0.8):
            raise TypeError(f"{cls.__name__}.{name} is no setting of a mechanism; did you mean {close[0]}?")
        elif name not in annotated:
            raise TypeError(
                f"{cls.__name__}.{name} has no annotation: write `{name}: jax.Array = {value!r}` for a "
                "field, or its name in capitals for a constant"
            )


def check_fields(cls: type, names: tuple[str, ...]) -> None:
    for name in names:
        if name in _SETTINGS:
            raise TypeError(f"{cls.__name__}.{name} is a setting: write it without an annotation")
        if name in _CONTRACT:
            raise TypeError(f"{cls.__name__}.{name} cannot be a field: {name}() is a method of a mechanism")


@functools.cache
def require_complete(cls: type) -> None:
    """TypeError, one line that names every method that is missing or takes something else."""
    missing = [name for name in _CONTRACT if name in cls.__abstractmethods__]
    missing += sorted(cls.__abstractmethods__.difference(_CONTRACT))
    if cls.free_joints and cls.free_range.__qualname__ == "Mechanism.free_range":
        missing.append("free_range")
    if missing:
        each = ("{}({}): {}".format(name, *_CONTRACT.get(name, ("...", "abstract"))) for name in missing)
        raise TypeError(f"{cls.__name__} is missing {'; '.join(each)}; {_SEE}")
    for name, (taken, _) in _CONTRACT.items():
        if (method := getattr(cls, name, None)) is not None and not _takes(method, taken):
            found = inspect.signature(method) if callable(method) else f" = {method!r}"
            raise TypeError(
                f"{cls.__name__}.{name} must be {name}(self{taken and ', '}{taken}), got {name}{found}"
            )


def _takes(method: Any, taken: str) -> bool:
    """Whether a method can be called as the contract says."""
    positional, _, named = taken.partition("*, ")
    count = len([part for part in positional.split(", ") if part.strip(", ")])
    try:
        found = inspect.signature(method)
        found.bind(*range(1 + count), **dict.fromkeys(["free"] if named else []))
        found.bind(*range(1 + count - positional.count("=")))
    except TypeError:
        return False
    return True
