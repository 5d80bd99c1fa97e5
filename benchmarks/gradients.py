"""Measure time and accuracy of the gradient of a plan with respect to the numbers of its case.

    python -m benchmarks.gradients [--task hit] [--num 4096] [--steps N] [--accuracy 64] [--out DIR]

A case contains the numbers of a planning problem. The gradient of a plan's quantity, here of the
contact time of a hit or of the time of the last catch, is defined at the optimum of the planner's
objective. Three calls are timed in turns: planning with the planner's default search, planning to
the optimum, and planning to the optimum with the gradient. Times are for whole calls without
compilation, from arrays on the device to arrays on the device: the fastest and the median of
--repeat calls. The first calls, which compile, are listed separately.

The accuracy is the relative difference from a reference gradient, over all arrays of the case with
respect to which the plan is differentiated. The reference gradient is computed in float64 at optima
in float64, with the whole Hessian. Cases that are not solved in float64 are left out.
"""

import argparse
import os
import statistics
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.cost_gap import cost_gaps
from planner_jax.benchmarks.run import Bench, argument_parser, at_least, begin
from planner_jax.core.tasks import task_named
from planner_jax.optimise.settings import NewtonConfig
from planner_jax.planning.decided import first_choice

_LONG = NewtonConfig(max_steps=100, tolerance=1e-12, patience=10)
_BY = {
    "hit": ("racket_height", "drag", "target", "limits"),
    "catch": ("net", "limits", "head_state"),
}
_SEED = 5


def _last_catch(plan: Any) -> jax.Array:
    return plan.times[-1]


def _case(task: str, num: int) -> tuple[Any, Any, Any]:
    if task == "hit":
        found = pj.hit.planner("exact"), pj.hit.draw(num, seed=_SEED), "stroke.time"
    else:
        throws = first_choice(pj.catch.Greedy(), pj.catch.draw(num, seed=_SEED))
        found = pj.catch.CatchProblem.planner(), throws, _last_catch
    return found[0], jax.tree.map(np.asarray, found[1]), found[2]


def _time_calls(calls: dict[str, Any], repeat: int) -> dict[str, tuple[float, float, float]]:
    """Call the functions in turns; return for each of them three durations [s].

    These are the durations of the first call and of the fastest later call, and the median of all
    later calls.
    """
    first, later = {}, {name: [] for name in calls}
    for turn in range(1 + repeat):
        for name, call in calls.items():
            began = time.perf_counter()
            jax.block_until_ready(call())
            spent = time.perf_counter() - began
            if turn == 0:
                first[name] = spent
            else:
                later[name].append(spent)
    return {
        name: (first[name], min(times), statistics.median(times)) for name, times in later.items()
    }


def _flat(gradient: Any, num: int) -> np.ndarray:
    leaves = [np.asarray(leaf, float).reshape(num, -1) for leaf in jax.tree.leaves(gradient.by)]
    return np.concatenate(leaves, axis=1)


def _double(tree: Any) -> Any:
    def leaf(x: np.ndarray) -> np.ndarray:
        return x.astype(np.float64) if np.issubdtype(x.dtype, np.floating) else x

    return jax.tree.map(leaf, tree)


def _errors(found: np.ndarray, best: np.ndarray, lanes: np.ndarray) -> str:
    has_none = ~np.isfinite(found[lanes]).all(axis=1)
    none, lanes = has_none.mean(), lanes[~has_none]
    unit = np.median(np.abs(best[lanes]), axis=0)
    weight = np.where(unit > 1e-9 * unit.max(), 1.0 / np.maximum(unit, 1e-12), 0.0)
    size = np.linalg.norm(best[lanes] * weight, axis=1)
    error = np.linalg.norm((found[lanes] - best[lanes]) * weight, axis=1) / size
    text = ", ".join(f"{100.0 * each:.2f} %" for each in np.quantile(error, (0.5, 0.9, 0.99)))
    return f"{text}; {100 * none:.1f} % of the cases have no gradient"


def main() -> None:
    parser = argument_parser("gradients", __doc__, num=4096, repeat=10)
    parser.add_argument("--task", choices=_BY, default="hit", help="default: hit")
    parser.add_argument("--steps", type=at_least(0), help="steps of the adjoint solver")
    parser.add_argument(
        "--accuracy",
        type=at_least(0),
        default=64,
        help="number of gradients to compare; 0 for none",
    )
    options = parser.parse_args()
    planner, cases, quantity = _case(options.task, options.num)
    with begin(parser, options) as bench:
        _measure(bench, options, planner, cases, quantity)


def _measure(
    bench: Bench, options: argparse.Namespace, planner: Any, cases: Any, quantity: Any
) -> None:
    def differentiate(where: Any, **more: Any) -> Any:
        return pj.gradient(planner, where, of=quantity, by=_BY[options.task], **more)

    resident, optimal = jax.device_put(jax.tree.map(jnp.asarray, cases)), planner.with_polish()
    seconds = _time_calls(
        {
            "plan": lambda: pj.plan(planner, resident),
            "plan to the optimum": lambda: pj.plan(optimal, resident),
            "gradient": lambda: differentiate(resident, steps=options.steps),
        },
        options.repeat,
    )
    bench.say(
        f"{options.task}, {options.num} plans, {jax.devices()[0].device_kind}, load average "
        f"{os.getloadavg()[0]:.1f}",
        "| call | first [s] | fastest [ms] | median [ms] |",
        "|---|---|---|---|",
    )
    for name, (first, fastest, median) in seconds.items():
        bench.say(f"| {name} | {first:.1f} | {1e3 * fastest:.2f} | {1e3 * median:.2f} |")
        bench.row(call=name, first_seconds=first, fastest_seconds=fastest, median_seconds=median)
    _, (_, *plain), (_, *both) = seconds.values()
    ratio = [100.0 * (b / a - 1.0) for a, b in zip(plain, both, strict=True)]
    bench.say(
        f"gradient: {ratio[0]:.0f} % more than plans at the optimum (fastest), {ratio[1]:.0f} % "
        "(median)"
    )
    plans = jax.device_get(pj.plan(optimal, resident))
    success = task_named(options.task).judge(cases, plans).success
    bench.count(success, cost_gaps(planner, cases, plans))
    if options.accuracy:
        _compare(bench, options, differentiate, pj.take(cases, slice(options.accuracy)))


def _compare(bench: Bench, options: argparse.Namespace, differentiate: Any, few: Any) -> None:
    found = differentiate(few, steps=options.steps)
    with jax.enable_x64(True):
        best = differentiate(_double(few), curvature="whole", solver=_LONG)
    num, lanes = len(found.value), np.flatnonzero(pj.are_solved(best.plans))
    gradient = [_flat(each, num) for each in (found, best)]
    residual = np.nanquantile(np.asarray(found.residual)[lanes], (0.5, 0.9))
    late = np.abs(np.asarray(found.value) - np.asarray(best.value))[lanes]
    bench.say(
        f"{lanes.size} of {num} cases compared",
        f"- error of the gradient (median, p90, p99): {_errors(gradient[0], gradient[1], lanes)}",
        f"- residual of the adjoint (median, p90): {residual[0]:.2g}, {residual[1]:.2g}",
        f"- error of the quantity (median, p90): {np.median(late):.3f}, "
        f"{np.quantile(late, 0.9):.3f}",
    )


if __name__ == "__main__":
    main()
