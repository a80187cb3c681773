"""The design problem that the settings of a run file mean."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax.design.families import design_family
from pk_jax.design.objectives import least_over, margins_over, over_workspace, rectangle
from pk_jax.design.problem import DesignProblem
from pk_jax.mechanisms.base import Mechanism

WORDS = ("rule", "rays", "nodes", "replicates", "cells", "seed", "within", "clearance", "length")


def problem_of(settings: dict[str, Any]) -> DesignProblem:
    """ValueError where the settings do not fit the family."""
    family, fixed = design_family(settings["mechanism"]), settings["fixed"]
    is_boxed = settings["objective"]["over"] == "rectangle"
    objective, constraints = (_over_rectangle if is_boxed else _over_workspace)(settings)
    return DesignProblem(
        lambda values: family.mechanism({**fixed, **values}),
        {name: tuple(bounds) for name, bounds in settings["variables"].items()},
        objective,
        constraints,
        name=settings["mechanism"],
    )


def branch_of(settings: dict[str, Any]) -> jax.Array | None:
    """The working mode that the settings name; None: the mechanism's own. -> (legs,)"""
    mode = settings["objective"]["mode"]
    return None if mode is None else jnp.array([1.0 if sign == "+" else -1.0 for sign in mode])


def _over_rectangle(settings: dict[str, Any]) -> tuple[Callable, Callable | None]:
    goal, wanted, branch = settings["objective"], settings["constraints"], branch_of(settings)
    poses = rectangle(goal["lower"], goal["upper"], goal["nodes"])
    middle = int(np.prod(goal["nodes"])) // 2
    measured = lambda name: _on_a_side(
        name, least_over(poses, name, branch, length=goal.get("length")), middle
    )
    objective = measured(goal["index"])
    if goal["measure"] == "mean":
        objective = _mean_of(objective)
    least = {name: value for name, value in wanted.items() if name != "margins"}
    if not least and not wanted["margins"]:
        return objective, None
    margins = margins_over(poses, branch) if wanted["margins"] else lambda mech: {}
    measures = {name: measured(name) for name in least}
    return objective, lambda mech: {
        **margins(mech),
        **{name: f(mech) - least[name] for name, f in measures.items()},
    }


def _over_workspace(settings: dict[str, Any]) -> tuple[Callable, Callable | None]:
    goal, branch = settings["objective"], branch_of(settings)
    words = {name: goal[name] for name in WORDS if name in goal} | (
        {} if branch is None else {"branch": branch}
    )
    objective = over_workspace(goal["index"], measure=goal["measure"], **words)
    if "volume" not in settings["constraints"]:
        return objective, None
    least, volume = settings["constraints"]["volume"], over_workspace(measure="volume", **words)
    return objective, lambda mech: {"volume": volume(mech) / least - 1}


def _on_a_side(name: str, entries: Callable, middle: int) -> Callable[[Mechanism], jax.Array]:
    """The clearance has the sign of det A: it counts on the side where the middle pose is."""
    if name != "clearance":
        return entries

    def sided(mech):
        found = entries(mech)
        return found * jax.lax.stop_gradient(jnp.where(found[middle] < 0, -1, 1))

    return sided


def _mean_of(entries: Callable[[Mechanism], jax.Array]) -> Callable[[Mechanism], jax.Array]:
    return lambda mech: jnp.mean(entries(mech))
