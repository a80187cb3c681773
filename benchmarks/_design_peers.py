"""Ways to optimize a design within a wall time, for the benchmark: gradients of pk_jax, and what users take.

    method(program, seconds, seed) -> Found

`program` is a `Program`: the problem in the unit box, compiled beforehand, so that compile time is apart. All
methods start anew until the time is over; what is found later does not count. Feasible is what violates no
constraint by more than FEASIBLE_WITHIN, for all alike.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.optimize import Bounds, differential_evolution, minimize

from pk_jax.design.problem import DesignProblem
from pk_jax.design.search import advance, begin, start_boxes

FEASIBLE_WITHIN = 1e-8  # the default tolerance of pk_jax
NO_VALUE = 1e3  # merit of a design without a value
STARTS = 16  # of the gradients, a batch
MOST_STEPS = 200  # that each of them may take, the default of pk_jax
INERTIA, PULL = 0.7298, 1.49618  # of the particle swarm: Clerc and Kennedy's constriction


class Found(NamedTuple):
    """What a method found within its time."""

    value: float  # least objective of the best feasible design; NaN where there is none
    box: np.ndarray | None
    evaluations: int  # of the objective; with `is_gradient` each with its derivatives
    is_gradient: bool
    seconds: float  # wall time, the last evaluation included
    reached: float  # seconds after which the value was within 1e-6 of the last


class Program(NamedTuple):
    """A problem whose programs are compiled."""

    problem: DesignProblem
    one: Callable  # box (n,) -> objective (k,), slacks (p,)
    many: Callable  # boxes (population, n) -> objectives, slacks
    population: int  # a multiple of n
    chunk: int  # steps of the gradients between two looks at the clock
    compile_seconds: dict[str, float]


def prepare(problem: DesignProblem, *, population: int, chunk: int) -> Program:
    """Compile everything that the methods need, and run it once."""
    n = len(problem.entries)
    measure = lambda box: problem.measure(problem.vector(box))
    seconds = {}

    def compiled(name, function, *arguments):
        began = time.perf_counter()
        call = jax.jit(function).lower(*arguments).compile()
        jax.block_until_ready(call(*arguments))
        seconds[name] = time.perf_counter() - began
        return call

    boxes = start_boxes(problem, population)
    one = compiled("one design", measure, boxes[0])
    many = compiled("population", jax.vmap(measure), boxes)
    began = time.perf_counter()
    advance(problem, begin(problem, start_boxes(problem, STARTS)), 1)
    seconds["gradients"] = time.perf_counter() - began
    return Program(problem, one, many, max(1, population // n) * n, chunk, seconds)


# --- the clock


class TimeOver(Exception):
    """The wall time is spent."""


class Budget:
    """Counts evaluations and keeps the best feasible one until the time is over, then raises TimeOver."""

    def __init__(self, program: Program, seconds: float) -> None:
        self.program, self.allowed = program, seconds
        self.began = time.perf_counter()
        self.evaluations, self.seconds = 0, 0.0
        self.trail: list[tuple[float, float]] = []
        self.value, self.box = np.nan, None

    def one(self, box: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Objective (k,) and slacks (p,) of one design."""
        found = jax.device_get(self.program.one(np.clip(box, 0, 1)))
        self.keep(np.atleast_2d(box), *(part[None] for part in found))
        return found

    def merits(self, boxes: np.ndarray) -> np.ndarray:
        """What populations minimize, by Deb's rules: -least objective, or the violation. (s, n) -> (s,)"""
        objectives, slacks = jax.device_get(self.program.many(boxes))
        return self.keep(boxes, objectives, slacks)

    def keep(self, boxes: np.ndarray, objectives: np.ndarray, slacks: np.ndarray) -> np.ndarray:
        """Take notice of evaluations. -> merits (s,)"""
        violation = np.max(-slacks, axis=1, initial=0)
        least = objectives.min(axis=1)
        merit = np.where(violation > FEASIBLE_WITHIN, violation, -least)
        merit = np.where(np.isfinite(least) & np.isfinite(violation), merit, NO_VALUE)
        fits = (violation <= FEASIBLE_WITHIN) & np.isfinite(least)
        values = np.where(fits, least, -np.inf)
        best = int(np.argmax(values))
        self.record(values[best], boxes[best], len(boxes))
        return merit

    def record(self, value: float, box: np.ndarray, evaluations: int) -> None:
        """Count evaluations, of which this was the best; too late, it is not kept."""
        self.seconds = time.perf_counter() - self.began
        self.evaluations += evaluations
        if self.seconds > self.allowed:
            raise TimeOver
        if value > (-np.inf if np.isnan(self.value) else self.value):
            self.value, self.box = float(value), np.array(box)
            self.trail.append((self.seconds, self.value))

    def found(self, *, is_gradient: bool = False) -> Found:
        late = [at for at, value in self.trail if value >= self.value - 1e-6]
        reached = late[0] if late else np.nan
        return Found(self.value, self.box, self.evaluations, is_gradient, self.seconds, reached)


def until_over(attempt: Callable[[Budget, int], Any]) -> Callable[[Program, float, int], Found]:
    """A method that begins attempt(budget, seed) again, with another seed, until the time is over."""

    def method(program: Program, seconds: float, seed: int) -> Found:
        budget = Budget(program, seconds)
        try:
            for again in range(1_000_000):
                attempt(budget, seed + 1000 * again)
        except TimeOver:
            pass
        return budget.found(is_gradient=attempt is _gradients)

    return method


# --- the methods


def _gradients(budget: Budget, seed: int) -> None:
    """pk_jax: projected quasi-Newton steps on augmented Lagrangians, a batch of starts at once."""
    problem, chunk = budget.program.problem, budget.program.chunk
    search = begin(problem, start_boxes(problem, STARTS, seed=seed))
    for _ in range(0, MOST_STEPS, chunk):
        before = search.evaluations.sum()
        search = advance(problem, search, chunk)
        values = np.where(search.violation <= FEASIBLE_WITHIN, search.value, -np.inf)
        values = np.where(np.isfinite(values), values, -np.inf)
        best = int(np.argmax(values))
        budget.record(values[best], search.box[best], int(search.evaluations.sum() - before))
        if search.is_done.all():
            break


def _evolution(budget: Budget, seed: int) -> None:
    """scipy's differential evolution as it comes, except that a population is evaluated at once."""
    n = len(budget.program.problem.entries)
    differential_evolution(
        lambda boxes: budget.merits(boxes.T),
        [(0, 1)] * n,
        seed=seed,
        popsize=budget.program.population // n,
        vectorized=True,
        updating="deferred",
        polish=False,
        maxiter=100_000,
    )


def _swarm(budget: Budget, seed: int) -> None:
    """A particle swarm with one leader; walls absorb. Until the particles have met."""
    random = np.random.default_rng(seed)
    shape = budget.program.population, len(budget.program.problem.entries)
    at, speed = random.uniform(size=shape), np.zeros(shape)
    own, own_merit = at.copy(), budget.merits(at)
    while np.ptp(own, axis=0).max() > 1e-9:
        leader = own[np.argmin(own_merit)]
        toward_own, toward_leader = random.uniform(size=(2, *shape))
        speed = INERTIA * speed + PULL * (toward_own * (own - at) + toward_leader * (leader - at))
        moved = np.clip(at + speed, 0, 1)
        speed = np.where(moved == at + speed, speed, 0)
        at, merit = moved, budget.merits(moved)
        is_better = merit < own_merit
        own = np.where(is_better[:, None], at, own)
        own_merit = np.where(is_better, merit, own_merit)


def _simplex(budget: Budget, seed: int) -> None:
    """scipy's Nelder-Mead from a random design, by Deb's rules."""
    start = np.random.default_rng(seed).uniform(size=len(budget.program.problem.entries))

    def merit(box):
        objective, slacks = budget.one(box)
        violation, least = np.max(-slacks, initial=0), objective.min()
        if not (np.isfinite(violation) and np.isfinite(least)):
            return NO_VALUE
        return violation if violation > FEASIBLE_WITHIN else -least

    options = {"xatol": 1e-8, "fatol": 1e-10, "maxiter": 2000}
    minimize(merit, start, method="Nelder-Mead", bounds=Bounds(0, 1), options=options)


def _slsqp(budget: Budget, seed: int) -> None:
    """scipy's SLSQP with its finite differences: maximize t, every objective >= t, from a random design."""
    start = np.random.default_rng(seed).uniform(size=len(budget.program.problem.entries))
    last: dict[str, Any] = {}

    def measured(box):
        if last.get("box") != box.tobytes():
            objective, slacks = (np.nan_to_num(part, nan=0.0) for part in budget.one(box))
            last.update(box=box.tobytes(), found=(objective, slacks))
        return last["found"]

    objective, slacks = measured(start)
    options = {"maxiter": 200, "ftol": 1e-10}
    if len(objective) == 1 and not len(slacks):
        minimize(
            lambda box: -measured(box)[0][0], start, method="SLSQP", bounds=Bounds(0, 1), options=options
        )
        return
    n = len(start)
    minimize(
        lambda both: -both[-1],
        np.append(start, objective.min()),
        method="SLSQP",
        bounds=Bounds(np.append(np.zeros(n), -np.inf), np.append(np.ones(n), np.inf)),
        constraints={"type": "ineq", "fun": lambda both: _slacks(*measured(both[:-1]), both[-1])},
        options=options,
    )


def _slacks(objective: np.ndarray, slacks: np.ndarray, least: float) -> np.ndarray:
    return np.concatenate([objective - least, slacks])


GRADIENTS = "gradients, multi-start"
GLOBAL_PEERS = ("differential evolution", "particle swarm")
METHODS = {
    GRADIENTS: until_over(_gradients),
    GLOBAL_PEERS[0]: until_over(_evolution),
    GLOBAL_PEERS[1]: until_over(_swarm),
    "Nelder-Mead, restarted": until_over(_simplex),
    "SLSQP, restarted": until_over(_slsqp),
}
