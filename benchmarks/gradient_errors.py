"""Compare gradients of plans of groups, teams and blocks with differences of new plans.

    python -m benchmarks.gradient_errors [--task group] [--num 100] [--chunk 10] [--out DIR]

`pj.gradient` differentiates the time of the last meeting, of the last catch, or of a block, by
parts of the case. The reference moves all these parts along one random direction, forwards and
backwards, by two step lengths, and minimises again in float64, from the same plan and with the same
decisions. The error is relative, by the nearer of the two differences. The table has the number of
solved cases, and how many of these have a gradient.
"""

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

_STEPS = (1e-4, 1e-5)  # in the units of the parts


def _last_catch(plan: Any) -> jax.Array:
    return jnp.max(plan.robots.times)


_TASKS = {  # the number of a plan, the parts of a case, and the suite; None: the usual one
    "group": (
        "cost",
        ("shared.limits.acceleration", "shared.target.vel", "shared.movers.centre", "shared.speed"),
        None,
    ),
    "team": (_last_catch, ("shared.limits.body_rate", "shared.net.height", "head_states"), None),
    "block": ("contact_time", ("ball.pos",), "pole"),
}


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

        def number(step: float) -> np.ndarray:
            moved = started
            for name, direction in away.items():
                moved = replace_part(moved, name, part_of(started, name) + step * direction)
            found = pj.plan(smooth, jax.tree.map(np.asarray, moved))
            value = getattr(found, of) if isinstance(of, str) else jax.vmap(of)(found)
            return np.where(pj.are_solved(found), value, np.nan)

        return [(number(step) - number(-step)) / (2.0 * step) for step in _STEPS]


def errors_of(
    planner: Any, cases: Any, of: str | Callable, by: Sequence[str], seed: int
) -> tuple[Any, np.ndarray]:
    """Return the gradients of B cases, and their relative errors (B,) along a random direction."""
    rng = np.random.default_rng(seed)
    found = pj.gradient(planner, cases, of=of, by=by)
    away = {name: rng.normal(size=found.by[name].shape[1:]) for name in by}
    slope = sum(
        np.sum(
            np.asarray(found.by[k], np.float64) * each[None], axis=tuple(range(1, each.ndim + 1))
        )
        for k, each in away.items()
    )
    expected = differences(planner, cases, found.plans, of, away)
    return found, np.min([np.abs(slope - each) / np.abs(each) for each in expected], axis=0)


def main() -> None:
    parser = argument_parser("gradient_errors", __doc__, num=100, seed=31)
    parser.add_argument("--task", choices=_TASKS, default="group", help="default: group")
    parser.add_argument("--chunk", type=at_least(1), default=10, help="cases at once; default: 10")
    options = parser.parse_args()
    of, by, suite = _TASKS[options.task]
    task = pj.task_named(options.task)
    with begin(parser, options) as bench:
        planner, errors, solved, began = task.planner(), [], 0, time.process_time()
        for first in range(0, options.num, options.chunk):
            num = min(options.chunk, options.num - first)
            cases = jax.tree.map(np.asarray, task.draw(num, suite, options.seed, first=first))
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
