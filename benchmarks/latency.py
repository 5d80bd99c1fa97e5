"""Time of one hit plan, batch 1, warm, with its success and cost beside it.

    python -m benchmarks.latency [--num 2000]

Every plan is a different generated serve, from the scenario's arrays to the plan's: ball
table, guess, solve and the check of the limits included. Compile time is printed apart. Run
it on an idle machine; the load average is printed.
"""

import argparse
import os
import time

import jax
import numpy as np

from planner_jax.referee.hit import referee_hits
from planner_jax.task.hit.exact import ExactHit
from planner_jax.task.hit.serves import generate_serves, to_scenarios
from planner_jax.task.solve import plan


def main() -> None:
    """Time `plan` serve by serve."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num", type=int, default=2000)
    args = parser.parse_args()
    planner = ExactHit()
    batch = jax.tree.map(np.asarray, to_scenarios(generate_serves(args.num, 1)))
    lanes = [jax.tree.map(lambda leaf, k=k: leaf[k], batch) for k in range(args.num)]
    began = time.perf_counter()
    plan(planner, lanes[0])
    compile_seconds = time.perf_counter() - began
    seconds, plans = [], []
    for scenario in lanes:
        began = time.perf_counter()
        plans.append(plan(planner, scenario))
        seconds.append(time.perf_counter() - began)
    together = jax.tree.map(lambda *leaves: np.stack(leaves), *plans)
    verdict = referee_hits(batch, together)
    p50, p90, p99 = 1e3 * np.percentile(seconds, [50, 90, 99])
    print(
        f"{args.num} serves, {jax.devices()[0].platform}, jax {jax.__version__}, "
        f"load average {os.getloadavg()[0]:.1f}"
    )
    print(
        f"p50 {p50:.3f} ms, p90 {p90:.3f} ms, p99 {p99:.3f} ms; "
        f"first call with compilation {compile_seconds:.1f} s"
    )
    print(
        f"refereed success {100 * verdict.success.mean():.2f} %, "
        f"median cost {np.median(together.cost):.3g}"
    )


if __name__ == "__main__":
    main()
