"""Settings of longer searches of planners that minimise, which lower the cost of their plans."""

import dataclasses
from typing import TypeVar

from planner_jax.optimise.planner import SearchPlanner
from planner_jax.optimise.settings import Attempt, LbfgsConfig, NewtonConfig, Stage

Searching = TypeVar("Searching", bound=SearchPlanner)
# Settings with which Newton's method continues the first attempt to the optimum.
_POLISH = NewtonConfig(
    max_steps=8,
    damping=1e-6,
    tighten=30.0,
    tolerance=1e-7,
    trusted=1e-6,
    patience=8,
    slack=256.0,
    stragglers=(0.125, 10, 10),
)
LONG = LbfgsConfig(max_steps=300, tolerance=1e-7, patience=6)
# The only attempt of problems whose `guesses` already are minima.
NO_SEARCH = (Attempt(solver=LbfgsConfig(max_steps=0)),)
# Value of `effort` -> settings of Newton's method, which continues the first attempt.
_BY_EFFORT = {
    "good": NewtonConfig(max_steps=1, damping=1e-6, tolerance=2e-2, stragglers=(0.125, 2, 60)),
    "best": NewtonConfig(
        max_steps=8, damping=1e-6, tolerance=1e-7, patience=8, stragglers=(0.125, 8, 32)
    ),
}


def polish(planner: Searching, solver: NewtonConfig | str | None) -> Searching:
    """Return a planner whose first attempt continues by Newton's method.

    `solver` has the settings of the method. An effort, "good" or "best", or None, which continues
    to a local optimum, stand for settings with the problem's number of subspace vectors. If the
    problem's guesses are minima, the planner is unchanged.
    """
    problem, (first, *others) = planner.problem, planner.attempts
    if problem.guesses_minima:
        return planner
    stages = (*first.stages, Stage(first.solver, first.settings))
    if not isinstance(solver, NewtonConfig):
        usual = _POLISH if solver is None else _BY_EFFORT[solver]
        solver = dataclasses.replace(usual, subspace=problem.subspace)
    attempts = (dataclasses.replace(first, solver=solver, stages=stages), *others)
    return dataclasses.replace(planner, attempts=attempts)
