"""Settings of longer searches of planners that minimise, which lower the cost of their plans."""

import dataclasses

from planner_jax.optimise.planner import Problem
from planner_jax.optimise.settings import LbfgsConfig, NewtonConfig, Round, Stage

# Settings with which Newton's method continues the first round (attempt) to the optimum.
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
# Value of `effort` -> settings of Newton's method, which continues the first round (attempt).
_BY_EFFORT = {
    "good": NewtonConfig(max_steps=1, damping=1e-6, tolerance=2e-2, stragglers=(0.125, 2, 60)),
    "best": NewtonConfig(
        max_steps=8, damping=1e-6, tolerance=1e-7, patience=8, stragglers=(0.125, 8, 32)
    ),
}


def polish_rounds(
    problem: Problem, rounds: tuple[Round, ...], solver: NewtonConfig | str | None
) -> tuple[Round, ...]:
    """Return attempts (rounds) whose first search is followed by Newton's method.

    `solver` has the settings of the method. An effort, "good" or "best", or None, which continues
    to a local optimum, stand for settings with the problem's number of subspace vectors. If the
    problem's guesses are minima, the rounds are unchanged.
    """
    if problem.guesses_minima:
        return rounds
    first, *others = rounds
    stages = (*first.stages, Stage(first.solver, first.settings))
    if not isinstance(solver, NewtonConfig):
        usual = _POLISH if solver is None else _BY_EFFORT[solver]
        solver = dataclasses.replace(usual, subspace=problem.subspace)
    return (dataclasses.replace(first, solver=solver, stages=stages), *others)
