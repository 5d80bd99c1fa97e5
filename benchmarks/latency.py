"""Time of one hit plan, batch 1, warm, with its success and cost beside it.

    python -m benchmarks.latency [--num 2000] [--out DIR]

Every plan is a different generated serve, from the case's arrays to the plan's: ball table,
guess, solve and the check of the limits included. Compile time is printed apart. Run it on an
idle machine; the load average is printed.
"""

import os
import time

import jax
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.cost_gap import cost_gaps
from planner_jax.benchmarks.run import argument_parser, begin


def main() -> None:
    """Time `plan` serve by serve."""
    parser = argument_parser("latency", __doc__, num=2000)
    options = parser.parse_args()
    num, planner = options.num, pj.hit.planner("exact")
    with begin(parser, options) as bench:
        batch = jax.tree.map(np.asarray, pj.hit.draw(num, seed=1))
        lanes = [pj.lane(batch, k) for k in range(num)]
        began = time.perf_counter()
        pj.plan(planner, lanes[0])
        compile_seconds = time.perf_counter() - began
        seconds, plans = [], []
        for case in lanes:
            began = time.perf_counter()
            plans.append(pj.plan(planner, case))
            seconds.append(time.perf_counter() - began)
        together = jax.tree.map(lambda *leaves: np.stack(leaves), *plans)
        success = pj.hit.judge(batch, together).success
        p50, p90, p99 = 1e3 * np.percentile(seconds, [50, 90, 99])
        bench.say(
            f"{num} serves, {jax.devices()[0].platform}, jax {jax.__version__}, "
            f"load average {os.getloadavg()[0]:.1f}",
            f"p50 {p50:.3f} ms, p90 {p90:.3f} ms, p99 {p99:.3f} ms; "
            f"first call with compilation {compile_seconds:.1f} s",
            f"refereed success {100 * success.mean():.2f} %, "
            f"median cost {np.median(together.cost):.3g}",
        )
        bench.count(success, cost_gaps(planner, batch, together))
        bench.note(
            p50_ms=p50,
            p90_ms=p90,
            p99_ms=p99,
            first_seconds=compile_seconds,
            median_cost=np.median(together.cost),
        )


if __name__ == "__main__":
    main()
