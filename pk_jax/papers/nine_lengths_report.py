"""The nine-length platform as a folder of tables and figures."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pk_jax.control.loop import FEEDBACKS
from pk_jax.files.run_folder import run_folder
from pk_jax.kinematics.linear_stage import SINGULAR_BELOW
from pk_jax.mechanisms.catalogue import catalogued
from pk_jax.mechanisms.stewart import LEGS
from pk_jax.papers.nine_lengths import (
    EMBODIMENTS,
    circle_runs,
    exact_lengths,
    gains_of,
    noisy_lengths,
    rms,
    singular_layouts,
    singular_values,
    step_runs,
)
from pk_jax.viz import nine_lengths as viz

GEOMETRIES = 1000
LAYOUTS, SEEDS = 40, 200  # of every cell of noise
MICRO = 1e-6


def report_into(
    path: str | os.PathLike,
    *,
    report: Callable[..., None] | None = None,
    say: Callable[[str], None] = lambda _: None,
    show: Callable[[str], Any] = print,
    geometries: int = GEOMETRIES,
    layouts: int = LAYOUTS,
    seeds: int = 20,
) -> bool:
    """Write tables and figures; whether every pose is right and every singular layout has its rank."""
    tell = report or (lambda *_: None)
    with run_folder(path) as folder:
        exact = [exact_lengths(embodiment, geometries, 5, tell) for embodiment in EMBODIMENTS]
        show("exact lengths, random layouts, no guess (right: within 1e-9)")
        show(_table(("poses", "right", "worst", "closed form"), [each[2:] for each in exact]))
        folder.write_json("exact.json", [each._asdict() for each in exact])

        noisy = [row for embodiment in EMBODIMENTS for row in noisy_lengths(embodiment, layouts, SEEDS, tell)]
        show("\nnoise: wrong roots after the estimate, and median |dt| / noise")
        titles = ("noise", "rows", "not OK", "gross", "estimate", "closed form", "six legs")
        show(_table(titles, [each[1:] for each in noisy], layouts_of=[each.embodiment for each in noisy]))
        folder.write_json("noise.json", [each._asdict() for each in noisy])
        folder.write_figure("fig_noise.png", viz.draw_noise(noisy).figure)

        say("noise gains")
        gains = [gains_of(embodiment) for embodiment in EMBODIMENTS]
        show("\nRMS position error over RMS noise, to first order, median of layouts and poses")
        show(_table(("estimate", "closed form", "six legs"), [each[1:] for each in gains]))
        folder.write_json("gains.json", [each._asdict() for each in gains])

        show("\nsingular layouts, in every pose")
        ranks_hold = True
        for name, (expected, base, platform) in singular_layouts().items():
            values = singular_values(base, platform)
            rank = int(np.sum(values > SINGULAR_BELOW * values[0]))
            ranks_hold &= rank == expected
            show(f"  rank {rank} of {LEGS}: {name}")

        circles = circle_runs(seeds, tell)
        show(f"\ncircle of radius 0.1 m at 0.5 Hz, {seeds} seeds: RMS position error, um")
        show(f"{'':28}" + "".join(f"{name:>9}" for name in FEEDBACKS))
        for name, runs in circles.items():
            show(f"{name:28}" + "".join(f"{rms(run.rms_position) / MICRO:9.1f}" for run in runs.values()))
        both = lambda run: [rms(run.rms_position), rms(run.rms_rotation)]
        table = {name: {each: both(run) for each, run in runs.items()} for name, runs in circles.items()}
        folder.write_json("circle.json", table)
        settled = {name: float(np.max(run.settling_time)) for name, run in step_runs(seeds).items()}
        show(f"{'step settles (2 %) in, ms':28}" + "".join(f"{1e3 * time:9.0f}" for time in settled.values()))
        folder.write_json("step.json", settled)

        say("figures")
        for number, name in ((1, "nine-lengths-general"), (3, "nine-lengths")):
            mech = catalogued(name)
            folder.write_figure(f"fig{number}_platform.png", viz.draw_platform(mech, *mech.home()).figure)
        folder.write_figure("fig2_plan.png", viz.platform_plan(mech).figure)
        folder.write_figure("fig4_loop.png", viz.control_diagram().figure)
        folder.write_figure("fig_circle.png", viz.tracking_figure(circles))
        show(f"\ntables and figures: {folder.path}")
    is_right = all(each.right == each.poses for each in exact)
    return is_right and ranks_hold and not any(row.gross for row in noisy)


def _table(titles: Sequence[str], rows: Sequence[tuple], layouts_of: Sequence[int] = EMBODIMENTS) -> str:
    """Numbers under their titles, a line an embodiment."""
    as_text = lambda value: str(value) if isinstance(value, int) else f"{value:.3g}"
    lines = [f"{'':14}" + "".join(f"{title:>12}" for title in titles)]
    for embodiment, row in zip(layouts_of, rows, strict=True):
        lines.append(f"embodiment {embodiment:<3}" + "".join(f"{as_text(value):>12}" for value in row))
    return "\n".join(lines)
