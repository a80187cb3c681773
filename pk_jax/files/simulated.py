"""The control loop, as the command line says and shows it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from pk_jax import checks
from pk_jax.control.loop import FEEDBACKS, Simulation, simulate_control
from pk_jax.control.plant import Gains, Plant, check_gains, check_plant
from pk_jax.control.reference import Reference, circle_reference, step_reference
from pk_jax.files.named import Named
from pk_jax.files.rows_file import format_rows
from pk_jax.kinematics.nine_lengths import require_nine_rows
from pk_jax.mechanisms.stewart import LEGS
from pk_jax.status import Status

_NO_LENGTHS = ("period", "delay", "lag")  # of a plant


def set_by(texts: Sequence[str], option: str, default: Any, metres: float) -> Any:
    """Fields of a plant or of gains that NAME=VALUE set, lengths in the unit of the user."""
    found = default
    for text in texts:
        name, _, value = text.partition("=")
        if name not in default._fields:
            raise ValueError(f"{option} must name one of {', '.join(default._fields)}, got {name!r}")
        try:
            number = float(value)
        except ValueError:
            raise ValueError(f"{option} must be NAME=VALUE, a number, got {text!r}") from None
        if isinstance(default, Plant) and name not in _NO_LENGTHS:
            number *= metres
        is_whole = name == "delay" and number.is_integer()
        found = found._replace(**{name: int(number) if is_whole else number})
    return found


class Experiment(NamedTuple):
    """What is simulated: a platform, what it should do, and how well it is made."""

    named: Named
    reference: Reference
    plant: Plant
    gains: Gains


def experiment_of(
    named: Named,
    kind: str,
    plant: Sequence[str],
    gains: Sequence[str],
    *,
    radius: float | None = None,
    frequency: float = 0.5,
    twist: str | None = None,
    duration: float | None = None,
) -> Experiment:
    """What the options say; lengths of defaults are in proportion to the platform."""
    mech, metres = named.mechanism, named.metres
    require_nine_rows("simulate", mech)
    given = set_by(plant, "--plant", Plant(), metres), set_by(gains, "--gain", Gains(), 1.0)
    check_plant(given[0])
    check_gains(given[1])
    size = float(mech.length())
    options = {} if duration is None else {"duration": duration}
    if kind == "circle":
        radius = 0.2 * size if radius is None else radius * metres
        reference = circle_reference(mech, radius=radius, frequency=frequency, **options)
    else:
        reference = step_reference(mech, _twist(twist, size, metres), **options)
    return Experiment(named, reference, *given)


def _twist(text: str | None, size: float, metres: float) -> np.ndarray:
    if text is None:
        return np.array([0.06 * size, -0.04 * size, 0.04 * size, 0.05, 0.0, 0.05])
    try:
        numbers = [float(field) for field in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 6:
        raise ValueError(f"--twist must be six numbers, X,Y,Z,RX,RY,RZ, got {text!r}")
    return np.array(numbers) * np.repeat([metres, 1.0], 3)


def runs_of(
    one: Experiment, feedbacks: Sequence[str], seeds: int, seed: int, note: Callable[[str], None]
) -> dict[str, Simulation]:
    """Every feedback on the same machines."""
    seeds = checks.is_count("seeds", seeds, most=100_000)
    seed = checks.is_count("seed", seed, least=0, most=2**32 - 1)
    found = {}
    for feedback in feedbacks:
        note(f"simulating feedback {feedback}")
        found[feedback] = simulate_control(
            one.named.mechanism,
            one.reference,
            feedback,
            key=jax.random.key(seed),
            plant=one.plant,
            gains=one.gains,
            seeds=seeds,
        )
    return found


def feedbacks_of(chosen: Sequence[str]) -> tuple[str, ...]:
    """Those asked for, or all."""
    for name in chosen:
        if name not in FEEDBACKS:
            raise ValueError(f"--feedback must be one of {', '.join(FEEDBACKS)}, got {name!r}")
    return tuple(dict.fromkeys(chosen)) or FEEDBACKS


def table_of(one: Experiment, runs: dict[str, Simulation]) -> dict[str, Any]:
    """RMS over time and seeds, in the unit of the user and rad."""
    root = lambda values: float(np.sqrt(np.mean(np.asarray(values) ** 2)))
    rows = {}
    for name, run in runs.items():
        rows[name] = {
            "rms_position": root(run.rms_position) / one.named.metres,
            "rms_rotation": root(run.rms_rotation),
            "settling_time": float(np.max(np.asarray(run.settling_time))),
            "not_ok": int(np.sum(np.asarray(run.status) != Status.OK)),
        }
    return {"reference": one.reference.name, "unit": one.named.unit, "feedback": rows}


def table_text(one: Experiment, runs: dict[str, Simulation]) -> str:
    table, unit = table_of(one, runs), "" if one.named.unit == "1" else f" ({one.named.unit})"
    seeds = len(next(iter(runs.values())).status)
    is_step = one.reference.settled_after == 0
    lines = [f"{one.named.name}: {one.reference.name}, {one.reference.duration:g} s, {seeds} seeds"]
    titles = [f"RMS position{unit}", "RMS rotation (rad)", *(["settles in (s)"] if is_step else []), "not OK"]
    lines.append(f"{'feedback':10}" + "".join(f"{title:>20}" for title in titles))
    for name, row in table["feedback"].items():
        numbers = [row["rms_position"], row["rms_rotation"], *([row["settling_time"]] if is_step else [])]
        lines.append(f"{name:10}" + "".join(f"{n:20.6g}" for n in numbers) + f"{row['not_ok']:20}")
    return "\n".join(lines)


def samples_csv(one: Experiment, runs: dict[str, Simulation]) -> str:
    """Every sample: time, errors and legs, seed by seed."""
    legs = [f"l{i}" for i in range(1, LEGS + 1)]
    text = ",".join(["feedback", "seed", "time", "position_error", "rotation_error", *legs]) + "\n"
    for name, run in runs.items():
        time, position, rotation, leg = map(
            np.asarray, (run.time, run.position_error, run.rotation_error, run.legs)
        )
        seeds, samples = position.shape
        lengths = [position.ravel(), *leg.reshape(-1, LEGS).T]
        position, *leg = (each / one.named.metres for each in lengths)
        columns = [
            np.repeat(np.arange(seeds), samples),
            np.tile(time, seeds),
            position,
            rotation.ravel(),
            *leg,
        ]
        text += format_rows([[name] * (seeds * samples), *columns])
    return text
