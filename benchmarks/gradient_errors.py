"""Compare gradients of plans with differences of plans that are made anew.

    python -m benchmarks.gradient_errors [--task hit] [--num 100] [--float64] [--out DIR]

`pj.gradient` differentiates the time of the last contact, or the cost, by several parts of the
case. The reference moves all these parts along one random direction, forwards and backwards, by two
step lengths, and minimises again in float64, with the same decisions, and from the same plan if the
task's planner searches for a path. The error is relative, by the nearer of the two differences. The
table has the number of solved cases, and how many of these have a gradient.
"""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.run import argument_parser, at_least, begin
from planner_jax.optimise.sensitivity import part_of, replace_part
from planner_jax.planning.gradient import with_type
from planner_jax.task.block.problem.smooth import SmoothBlock

_STEPS = (1e-3, 1e-4)  # in the units of the parts
_TASKS = {  # the number of a plan, and the parts of a case
    "hit": ("stroke.time", ("ball.vel", "limits.body_rate", "head_state")),
    "catch": (lambda plan: jnp.max(plan.times), ("net.height", "limits.speed", "head_state")),
    "rally": (lambda plan: plan.strokes.time[-1], ("ball.vel", "limits.body_rate", "places")),
    "intercept": ("cost", ("limits.acceleration", "target.vel", "movers.centre", "speed")),
    "block": ("contact_time", ("ball.pos",)),
    "reach": ("cost", ("angles", "limits.acceleration")),
    "group": (
        "cost",
        ("shared.limits.acceleration", "shared.target.vel", "shared.movers.centre", "shared.speed"),
    ),
    "team": (
        lambda plan: jnp.max(plan.robots.times),
        ("shared.limits.body_rate", "shared.net.height", "head_states"),
    ),
}
# Settings of Newton's method with which a search continues as far as float64 permits.
_EXACT = pj.NewtonConfig(max_steps=20, damping=1e-6, tighten=30.0, tolerance=1e-12, patience=8)
_LONG = {"max_steps": 2000, "settled": 20}  # least squares that end at the minimum


def differences(
    planner: Any, cases: Any, plans: Any, of: str | Callable, away: dict[str, np.ndarray]
) -> list[np.ndarray]:
    """Return for each of `_STEPS` the derivatives (B,) of a plan's number along a direction.

    `away` has the direction's part (...) for each name of a part of the cases.
    """
    with jax.enable_x64(True):
        cases, plans = with_type(cases, np.float64), with_type(plans, np.float64)
        smooth, started = planner.settle(cases, lambda *_: plans)
        started = with_type(started, np.float64)
        problem = smooth.problem
        if isinstance(problem, SmoothBlock):  # its least squares end early
            solver = dataclasses.replace(problem.solver, **_LONG)
            smooth = pj.SearchPlanner(dataclasses.replace(problem, solver=solver))
        else:
            smooth = smooth.with_polish(dataclasses.replace(_EXACT, subspace=problem.subspace))

        def number(step: float) -> np.ndarray:
            moved = started
            for name, direction in away.items():
                moved = replace_part(moved, name, part_of(started, name) + step * direction)
            found = pj.plan(smooth, jax.tree.map(np.asarray, moved))
            value = part_of(found, of) if isinstance(of, str) else jax.vmap(of)(found)
            return np.where(pj.are_solved(found), value, np.nan)

        return [(number(step) - number(-step)) / (2.0 * step) for step in _STEPS]


def errors_of(
    planner: Any, cases: Any, of: str | Callable, by: Sequence[str], seed: int
) -> tuple[Any, np.ndarray]:
    """Return the gradients of B cases, and their relative errors (B,) along a random direction."""
    rng = np.random.default_rng(seed)
    found = pj.gradient(planner, cases, of=of, by=by)
    away = {name: rng.normal(size=found.by[name].shape[1:]) for name in by}
    slope: Any = sum(
        np.sum(
            np.asarray(found.by[k], np.float64) * each[None], axis=tuple(range(1, each.ndim + 1))
        )
        for k, each in away.items()
    )
    errors, solved = np.full(slope.shape, np.nan), np.flatnonzero(pj.are_solved(found.plans))
    some, plans = jax.tree.map(lambda leaf: np.asarray(leaf)[solved], (cases, found.plans))
    expected = differences(planner, some, plans, of, away) if solved.size else [errors[solved]]
    errors[solved] = np.min([abs(slope[solved] - each) / abs(each) for each in expected], axis=0)
    return found, errors


def main() -> None:
    parser = argument_parser("gradient_errors", __doc__, num=100, seed=31)
    parser.add_argument("--task", choices=_TASKS, default="hit", help="default: hit")
    parser.add_argument("--suite", help="default: the first suite of the task")
    parser.add_argument("--float64", action="store_true", help="differentiate in float64 too")
    parser.add_argument("--chunk", type=at_least(1), default=10, help="cases at once; default: 10")
    options = parser.parse_args()
    of, by = _TASKS[options.task]
    task = pj.task_named(options.task)
    precise = jax.enable_x64 if options.float64 else contextlib.nullcontext
    with begin(parser, options) as bench, precise(True):
        planner, errors, solved, began = task.planner(), [], 0, time.process_time()
        for first in range(0, options.num, options.chunk):
            num = min(options.chunk, options.num - first)
            named = {"suite": options.suite} if options.suite else {}
            cases = task.draw(num, seed=options.seed, first=first, **named)
            cases = with_type(cases, np.float64 if options.float64 else np.float32)
            found, error = errors_of(planner, cases, of, by, options.seed)
            is_solved = pj.are_solved(found.plans)
            solved += int(is_solved.sum())
            errors += error[is_solved & np.isfinite(error)].tolist()
            bench.say(f"{first + num} cases: {solved} solved, {len(errors)} compared")
        quantiles = np.quantile(errors, (0.5, 0.9, 1.0))
        bench.say(
            f"{options.task}: relative error: median {quantiles[0]:.1e}, 90 % {quantiles[1]:.1e}, "
            f"greatest {quantiles[2]:.1e}; at most 5e-3 in {np.sum(np.array(errors) <= 5e-3)} of "
            f"{len(errors)} cases; {time.process_time() - began:.0f} CPU s",
        )
        bench.note(errors=errors)


if __name__ == "__main__":
    main()
