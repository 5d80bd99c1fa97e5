"""Measure the scales of the exact planners' decision variables beside the shipped ones.

    python -m benchmarks.measure_scales [--write] [--out DIR]

Hits: serves of the generator (seed 7), 100 of each hard kind, so that limits are active.
Catches: throws of the suite `hard`, at limits x 1 and 0.8; one segment serves for all.
Prints the largest ratio to the shipped scale, and of how many cases the referee accepts the plan
that is made with the measured one; --write makes the shipped files anew.
"""

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax as pj
import planner_jax.task
from planner_jax.benchmarks.run import Bench, argument_parser, begin
from planner_jax.core.registry import task_named
from planner_jax.optimise.scaling import measure_scale
from planner_jax.planning.decided import first_choice

HIT_PIECES, CATCH_PIECES = (6, 12), (6,)

# Sensible sizes to begin with: metres, log seconds, log m/s^2, m/s, m/s^3.
_FIRST_HIT = (0.05, 0.1, 0.2, 0.6, 0.8, 30.0, 30.0, 30.0)
# Log seconds, place in the net, m/s, m/s^2, m/s^3.
_FIRST_CATCH = (0.03, 0.5, 0.5, 0.6, 0.6, 0.6, 2.0, 2.0, 2.0, 40.0, 40.0, 30.0)
# Curvature taken as none: easy throws hardly feel the place in the net and the last jerk.
_CATCH_FLOOR = 0.1


def hard_serves(num: int, seed: int) -> pj.hit.HitCase:
    """`num` serves of each of five kinds: late, very late, weak, very weak, any start."""
    kinds = (
        functools.partial(pj.hit.to_cases, delay=0.5),
        functools.partial(pj.hit.to_cases, delay=0.6),
        functools.partial(pj.hit.to_cases, limit_scale=0.5),
        functools.partial(pj.hit.to_cases, limit_scale=0.35),
        functools.partial(pj.hit.to_cases, start="uniform"),
    )
    serves = pj.hit.generate_serves(num * len(kinds), seed)
    batches = [kind(serves[i * num : (i + 1) * num]) for i, kind in enumerate(kinds)]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *batches)


def weak_throws(num: int, seed: int) -> pj.catch.CatchCase:
    """`num` hard throws at each of two limits on speed and body rate."""
    cases = first_choice(pj.catch.Greedy(), pj.catch.draw(num, "hard", seed))

    def weaker(factor: float) -> pj.catch.CatchCase:
        limits = cases.limits
        limits = dataclasses.replace(
            limits, speed=limits.speed * factor, body_rate=limits.body_rate * factor
        )
        return dataclasses.replace(cases, limits=limits)

    batches = [weaker(factor) for factor in (1.0, 0.8)]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *batches)


def hit_planners() -> dict[str, Any]:
    """`ExactHit` with a first guess of its scale, by the scale's name."""
    found = {}
    for pieces in HIT_PIECES:
        first = (0.2,) * (3 * (pieces - 1)) + _FIRST_HIT
        proportions = (0.2, 0.5) + (1.0,) * (pieces - 2)
        found[f"exact-{pieces}"] = pj.hit.ExactHit(proportions=proportions, scale=first)
    return found


def catch_planners() -> dict[str, Any]:
    """`ExactCatch` with a first guess of the scale of one segment, by the scale's name."""
    found = {}
    for pieces in CATCH_PIECES:
        first = (0.3,) * (3 * (pieces - 1)) + _FIRST_CATCH
        proportions = (0.3,) + (1.0,) * (pieces - 1)
        found[f"exact-{pieces}"] = pj.catch.ExactCatch(proportions=proportions, scale=first)
    return found


# Task -> cases, planners, options of `measure_scale`.
TASKS = {
    "hit": (hard_serves, hit_planners, {}),
    "catch": (weak_throws, catch_planners, {"floor": _CATCH_FLOOR}),
}


def measure(bench: Bench, task: str, num: int, seed: int) -> dict[str, np.ndarray]:
    """The scales of a task by name, compared with the shipped ones."""
    draw, planners, options = TASKS[task]
    cases, found = draw(num, seed), {}
    shipped = json.loads(shipped_file(task).read_text("utf-8"))
    for name, planner in planners().items():
        scale = found[name] = measure_scale(planner, cases, **options)
        bench.say(f"{task} {name} {np.array2string(scale, precision=3, max_line_width=100)}")
        ratio = None
        if name in shipped:
            ratio = np.exp(np.abs(np.log(scale / np.asarray(shipped[name]))).max())
            bench.say(f"  largest ratio to the shipped scale: {ratio:.2f}")
        plans = pj.plan(dataclasses.replace(planner, scale=tuple(scale.tolist())), cases)
        success = task_named(task).judge(cases, plans).success
        bench.count(success)
        bench.say(f"  refereed success with the measured scale: {100 * success.mean():.2f} %")
        bench.row(task=task, name=name, scale=scale, ratio=ratio, success=success.mean())
    return found


def shipped_file(task: str) -> Path:
    """Where the scales of a task are kept."""
    return Path(planner_jax.task.__path__[0]) / task / "measured_scales.json"


def main() -> None:
    """Measure, and write or compare."""
    parser = argument_parser("measure_scales", __doc__, num=100, seed=7)
    parser.add_argument("--write", action="store_true", help="replace the shipped files")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    options = parser.parse_args()
    with begin(parser, options) as bench:
        for task in options.tasks:
            found = measure(bench, task, options.num, options.seed)
            if options.write:
                rounded = {
                    name: [float(f"{value:.3g}") for value in scale]
                    for name, scale in found.items()
                }
                path = shipped_file(task)
                path.write_text(json.dumps(rounded, indent=1) + "\n", "utf-8")
                bench.say(f"wrote {path.name} of {task}")


if __name__ == "__main__":
    main()
