"""Measure the time from process start to the first plans, with and without cached programs.

    python -m benchmarks.cold_start [--num 1024] [--out DIR]

Two new processes, one after the other, plan one batch of hits each. The first process finds an
empty compile cache on the disk. The second process loads the programs that the first one compiled.
"""

import os
import subprocess
import sys
import tempfile
import time

import planner_jax as pj
from planner_jax.benchmarks.cost_gap import cost_gaps
from planner_jax.benchmarks.run import argument_parser, begin

FIRST_PLANS = """
import planner_jax as pj
pj.keep_compiled_programs()
plans = pj.plan(pj.hit.planner("exact"), pj.hit.draw({num}))
print(int(pj.are_solved(plans).sum()), "of {num} solved")
plans.save({path!r})
"""


def first_plans(num: int, path: str, caches: str) -> tuple[float, str]:
    """Plan `num` hits in a new process, with the compile cache in the folder `caches`.

    The plans are saved to `path`. Returns the process's duration [s] and its output.
    """
    began = time.perf_counter()
    found = subprocess.run(
        [sys.executable, "-c", FIRST_PLANS.format(num=num, path=path)],
        env={**os.environ, "JAX_COMPILATION_CACHE_DIR": caches},
        check=True,
        capture_output=True,
        text=True,
    )
    return time.perf_counter() - began, found.stdout.strip()


def main() -> None:
    """Run both processes, print their durations, and judge their plans."""
    parser = argument_parser("cold_start", __doc__, num=1024)
    options = parser.parse_args()
    bench, rows = begin(parser, options), []
    with tempfile.TemporaryDirectory() as folder:
        for caches in ("empty", "warm"):
            path = os.path.join(folder, f"{caches}.npz")
            seconds, text = first_plans(options.num, path, os.path.join(folder, "compiled"))
            bench.say(
                f"caches {caches}: {seconds:.1f} s to the first plans, {text}; "
                f"load average {os.getloadavg()[0]:.1f}"
            )
            rows.append((caches, seconds, pj.hit.HitPlan.load(path)))
    # This process uses the device only after both processes have ended, because the device's memory
    # may suffice for one process only.
    with bench:
        planner, cases = pj.hit.planner("exact"), pj.hit.draw(options.num)
        for caches, seconds, plans in rows:
            success = pj.hit.judge(cases, plans).success
            bench.count(success, cost_gaps(planner, cases, plans))
            bench.row(caches=caches, seconds=seconds, success=success.mean())


if __name__ == "__main__":
    main()
