"""Measure the scales of the exact planners' decision variables beside the shipped ones.

    python -m benchmarks.measure_scales [--write]

Hits: serves of the generator (seed 7), 100 of each hard kind, so that limits are active.
Catches: throws of the suite `hard`, at limits x 1 and 0.8; one segment serves for all.
Prints the largest ratio to the shipped scale; --write makes the shipped files anew.
"""

import argparse
import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax.task
from planner_jax.optimise.scaling import measure_scale
from planner_jax.task.catch.decide import decided, greedy
from planner_jax.task.catch.exact import ExactCatch
from planner_jax.task.catch.scenario import CatchScenario
from planner_jax.task.catch.suites import make_suite
from planner_jax.task.hit.exact import ExactHit
from planner_jax.task.hit.scenario import HitScenario
from planner_jax.task.hit.serves import generate_serves, to_scenarios

HIT_PIECES, CATCH_PIECES = (6, 12), (6,)

# Sensible sizes to begin with: metres, log seconds, log m/s^2, m/s, m/s^3.
_FIRST_HIT = (0.05, 0.1, 0.2, 0.6, 0.8, 30.0, 30.0, 30.0)
# Log seconds, place in the net, m/s, m/s^2, m/s^3.
_FIRST_CATCH = (0.03, 0.5, 0.5, 0.6, 0.6, 0.6, 2.0, 2.0, 2.0, 40.0, 40.0, 30.0)
# Curvature taken as none: easy throws hardly feel the place in the net and the last jerk.
_CATCH_FLOOR = 0.1


def hard_scenarios(num: int, seed: int) -> HitScenario:
    """`num` serves of each of five kinds: late, very late, weak, very weak, any start."""
    kinds = (
        {"delay": 0.5},
        {"delay": 0.6},
        {"limit_scale": 0.5},
        {"limit_scale": 0.35},
        {"start": "uniform"},
    )
    serves = generate_serves(num * len(kinds), seed)
    batches = [
        to_scenarios(serves[i * num : (i + 1) * num], **kind) for i, kind in enumerate(kinds)
    ]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *batches)


def weak_throws(num: int, seed: int) -> CatchScenario:
    """`num` hard throws at each of two limits on speed and body rate."""
    scenarios = make_suite("hard", num, seed)
    scenarios = decided(scenarios, jax.jit(jax.vmap(greedy))(scenarios))

    def weaker(factor: float) -> CatchScenario:
        limits = scenarios.limits
        limits = dataclasses.replace(
            limits, speed=limits.speed * factor, body_rate=limits.body_rate * factor
        )
        return dataclasses.replace(scenarios, limits=limits)

    batches = [weaker(factor) for factor in (1.0, 0.8)]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *batches)


def measure_hits(num: int, seed: int) -> dict[str, np.ndarray]:
    """Scale of `ExactHit` by name."""
    scenarios, found = hard_scenarios(num, seed), {}
    for pieces in HIT_PIECES:
        first = (0.2,) * (3 * (pieces - 1)) + _FIRST_HIT
        proportions = (0.2, 0.5) + (1.0,) * (pieces - 2)
        planner = ExactHit(proportions=proportions, scale=first)
        found[f"exact-{pieces}"] = measure_scale(planner, scenarios)
    return found


def measure_catches(num: int, seed: int) -> dict[str, np.ndarray]:
    """Scale of one segment of `ExactCatch` by name."""
    scenarios, found = weak_throws(num, seed), {}
    for pieces in CATCH_PIECES:
        first = (0.3,) * (3 * (pieces - 1)) + _FIRST_CATCH
        planner = ExactCatch(proportions=(0.3,) + (1.0,) * (pieces - 1), scale=first)
        found[f"exact-{pieces}"] = measure_scale(planner, scenarios, floor=_CATCH_FLOOR)
    return found


TASKS = {"hit": measure_hits, "catch": measure_catches}


def main() -> None:
    """Measure, and write or compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", action="store_true", help="replace the shipped files")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--num", type=int, default=100, help="scenarios of each kind")
    parser.add_argument("--seed", type=int, default=7)
    args = parser.parse_args()
    for task in args.tasks:
        path = Path(planner_jax.task.__path__[0]) / task / "measured_scales.json"
        shipped = json.loads(path.read_text("utf-8"))
        found = TASKS[task](args.num, args.seed)
        for name, scale in found.items():
            print(task, name, np.array2string(scale, precision=3, max_line_width=100))
            if name in shipped:
                ratio = np.exp(np.abs(np.log(scale / np.asarray(shipped[name]))).max())
                print(f"  largest ratio to the shipped scale: {ratio:.2f}")
        if args.write:
            rounded = {
                name: [float(f"{value:.3g}") for value in scale] for name, scale in found.items()
            }
            path.write_text(json.dumps(rounded, indent=1) + "\n", "utf-8")
            print(f"wrote {path.name} of {task}")


if __name__ == "__main__":
    main()
