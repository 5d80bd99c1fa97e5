"""What the gradient of a plan costs beside the plan, and how good it is.

    python -m benchmarks.gradients [--task hit] [--num 4096] [--iterations 7] [--steps 1]
        [--accuracy 64]

Times are of whole calls from arrays on the device to arrays on the device, warm, the fastest
and the median of `--repeat`; plain and differentiated calls take turns. The first calls, which
compile, stand apart. `--iterations` makes the solve one search of that many; without it the
planner's own rounds run. Accuracy: the relative difference, over all leaves that are
differentiated by, from the gradient with the whole Hessian in float64 after a long search from
the same guess, on lanes that this search solves. It holds what the early end of the solver
does and what the truncated adjoint does, which the same Hessian at the same point tells apart.
"""

import argparse
import dataclasses
import os
import statistics
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.optimise.lbfgs import LbfgsConfig
from planner_jax.optimise.problem import Round
from planner_jax.protocol import is_solved
from planner_jax.task.catch.decide import plan_catches
from planner_jax.task.catch.exact import ExactCatch
from planner_jax.task.catch.suites import make_suite
from planner_jax.task.gradients import plan_with_gradients
from planner_jax.task.hit.exact import ExactHit
from planner_jax.task.hit.serves import generate_serves, to_scenarios
from planner_jax.task.solve import plan

_LONG = LbfgsConfig(max_steps=600, memory=12, tolerance=1e-9, patience=10)
_WRT = {
    "hit": ("racket_height", "drag", "target", "limits"),
    "catch": ("net", "limits", "head_state"),
}
_SEED = 5


def _last_catch(plan: Any) -> jax.Array:
    return plan.times[-1]


def _case(task: str, num: int) -> tuple[Any, Any, Any]:
    """Planner, scenarios with NumPy leaves, quantity."""
    if task == "hit":
        found = ExactHit(), to_scenarios(generate_serves(num, _SEED)), "stroke.time"
    else:
        planner = ExactCatch()
        throws, _ = plan_catches(planner, make_suite("throws", num, _SEED), "greedy")
        found = planner, throws, _last_catch
    return found[0], jax.tree.map(np.asarray, found[1]), found[2]


def _timed(calls: dict[str, Any], repeat: int) -> dict[str, tuple[float, float, float]]:
    """First call, fastest and median of the others [s], by name."""
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
    """Median and p90 of the relative difference, every column in units of its median size."""
    has_none = ~np.isfinite(found[lanes]).all(axis=1)
    none, lanes = has_none.mean(), lanes[~has_none]
    unit = np.median(np.abs(best[lanes]), axis=0)
    weight = np.where(unit > 1e-9 * unit.max(), 1.0 / np.maximum(unit, 1e-12), 0.0)
    size = np.linalg.norm(best[lanes] * weight, axis=1)
    error = np.linalg.norm((found[lanes] - best[lanes]) * weight, axis=1) / size
    return (
        f"{100 * np.median(error):.1f} %, {100 * np.quantile(error, 0.9):.1f} %, "
        f"beside {100 * none:.0f} % of the lanes without one"
    )


def main() -> None:
    """Print the times, then the accuracy."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", choices=_WRT, default="hit")
    parser.add_argument("--num", type=int, default=4096)
    parser.add_argument("--iterations", type=int, help="one search of as many")
    parser.add_argument("--steps", type=int, default=1)
    parser.add_argument("--repeat", type=int, default=10)
    parser.add_argument("--accuracy", type=int, default=64, help="lanes compared; 0 for none")
    args = parser.parse_args()
    planner, scenarios, quantity = _case(args.task, args.num)
    solver = None
    if args.iterations is not None:
        solver = LbfgsConfig(max_steps=args.iterations)
        planner = dataclasses.replace(planner, rounds=(Round(starts=1, solver=solver),))
    wrt = _WRT[args.task]

    def differentiated(where: Any, planner: Any = planner, **options: Any) -> Any:
        return plan_with_gradients(planner, where, quantity, wrt, **options)

    resident = jax.device_put(jax.tree.map(jnp.asarray, scenarios))
    seconds = _timed(
        {
            "plan": lambda: plan(planner, resident),
            "plan_with_gradients": lambda: differentiated(resident, steps=args.steps),
        },
        args.repeat,
    )
    print(
        f"{args.task}, {args.num} plans, {jax.devices()[0].device_kind}, load average "
        f"{os.getloadavg()[0]:.1f}; first round of {planner.rounds[0].solver.max_steps} "
        f"iterations, {args.steps} adjoint steps"
    )
    print("| call | first [s] | fastest [ms] | median [ms] |\n|---|---|---|---|")
    for name, (first, fastest, median) in seconds.items():
        print(f"| {name} | {first:.1f} | {1e3 * fastest:.2f} | {1e3 * median:.2f} |")
    (_, *plain), (_, *both) = seconds.values()
    ratio = [100.0 * (b / a - 1.0) for a, b in zip(plain, both, strict=True)]
    print(f"gradient: {ratio[0]:.0f} % of the solve's time (fastest), {ratio[1]:.0f} % (median)")
    if args.accuracy:
        few = jax.tree.map(lambda leaf: leaf[: args.accuracy], scenarios)
        _, found = differentiated(few, steps=args.steps)
        _, whole = differentiated(few, curvature="whole")
        with jax.enable_x64(True):
            plans, best = differentiated(_double(few), curvature="whole", solver=_LONG)
        lanes = np.flatnonzero(is_solved(np.asarray(plans.status)))
        num = args.accuracy
        gradient = [_flat(each, num) for each in (found, whole, best)]
        residual = np.nanquantile(np.asarray(found.residual)[lanes], (0.5, 0.9))
        print(f"{lanes.size} of {num} lanes compared; difference (median, p90)")
        print(f"- from the optimum's: {_errors(gradient[0], gradient[2], lanes)}")
        print(
            f"- of the whole Hessian's from the optimum's: "
            f"{_errors(gradient[1], gradient[2], lanes)}"
        )
        print(f"- residual of the adjoint: {residual[0]:.2g}, {residual[1]:.2g}")
        late = np.abs(np.asarray(found.value) - np.asarray(best.value))[lanes]
        print(f"- of the quantity itself: {np.median(late):.3f}, {np.quantile(late, 0.9):.3f}")


if __name__ == "__main__":
    main()
