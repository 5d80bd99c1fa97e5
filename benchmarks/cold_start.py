"""Seconds from the start of a process to its first plans, with empty and with warm caches.

    python -m benchmarks.cold_start [--num 1024]

Two fresh processes plan a batch of hits each, the second with what the first compiled.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time

FIRST_PLANS = """
import planner_jax as pj
pj.keep_compiled_programs()
plans = pj.plan(pj.ExactHit(), pj.to_scenarios(pj.generate_serves({num}, 0)))
print(int((plans.status <= 1).sum()), "of {num} solved")
"""


def main() -> None:
    """Run both processes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num", type=int, default=1024)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for caches in ("empty", "warm"):
            began = time.perf_counter()
            found = subprocess.run(
                [sys.executable, "-c", FIRST_PLANS.format(num=args.num)],
                env={**os.environ, "JAX_COMPILATION_CACHE_DIR": folder},
                check=True,
                capture_output=True,
                text=True,
            )
            print(
                f"caches {caches}: {time.perf_counter() - began:.1f} s to the first plans, "
                f"{found.stdout.strip()}; load average {os.getloadavg()[0]:.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
