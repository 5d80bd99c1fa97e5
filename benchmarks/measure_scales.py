"""Measure the scales of the hit planners' decision variables beside the shipped ones.

    python -m benchmarks.measure_scales [--write]

Scenarios are drawn by the serve generator (seed 7), 100 of each hard kind, so that limits are
active. Prints the largest ratio to the shipped scale; --write makes the shipped file anew.
"""

import argparse
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax.task.hit
from planner_jax.optimise.scaling import measure_scale
from planner_jax.task.hit.exact import ExactHit
from planner_jax.task.hit.scenario import HitScenario
from planner_jax.task.hit.serves import generate_serves, to_scenarios

SHIPPED = Path(planner_jax.task.hit.__file__).with_name("measured_scales.json")

PROPORTIONS = tuple((0.2, 0.5) + (1.0,) * (num - 2) for num in (6, 12))

# Sensible sizes to begin with: metres, log seconds, log m/s^2, m/s, m/s^3.
_FIRST = (0.05, 0.1, 0.2, 0.6, 0.8, 30.0, 30.0, 30.0)


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


def measure_exact(proportions: tuple[float, ...], scenarios: HitScenario) -> np.ndarray:
    """Scale of `ExactHit` with pieces of the given relative durations, (n,)."""
    first = (0.2,) * (3 * (len(proportions) - 1)) + _FIRST
    return measure_scale(ExactHit(proportions=proportions, scale=first), scenarios)


def main() -> None:
    """Measure, and write or compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", action="store_true", help="replace the shipped file")
    parser.add_argument("--num", type=int, default=100, help="serves of each kind")
    parser.add_argument("--seed", type=int, default=7)
    args = parser.parse_args()
    scenarios = hard_scenarios(args.num, args.seed)
    shipped = json.loads(SHIPPED.read_text("utf-8"))
    for proportions in PROPORTIONS:
        name = f"exact-{len(proportions)}"
        scale = measure_exact(proportions, scenarios)
        print(name, np.array2string(scale, precision=3, max_line_width=100))
        if name in shipped:
            ratio = np.exp(np.abs(np.log(scale / np.asarray(shipped[name]))).max())
            print(f"  largest ratio to the shipped scale: {ratio:.2f}")
        shipped[name] = [float(f"{value:.3g}") for value in scale]
    if args.write:
        SHIPPED.write_text(json.dumps(shipped, indent=1) + "\n", "utf-8")
        print(f"wrote {SHIPPED.name}")


if __name__ == "__main__":
    main()
