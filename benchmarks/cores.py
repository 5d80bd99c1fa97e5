"""How much quicker a batch is planned on every core than on one, on this machine, now.

    python -m benchmarks.cores [--num 36000] [--turns 8]

Three kinds of processes stay alive and take turns, so that a slow minute of the machine meets
all of them: one process on one core; one on every core; and a process for each core, bound to
it, all at the same time. The last says how much the cores of this machine give at most: they
may share caches, memory or a clock. Printed are plans a second, warm, and the ratio to the one
core of the same turn. Linux, because processes are bound to cores.
"""

import argparse
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence


def _serve(num: int, cores: Sequence[int]) -> None:
    """The child: plans once for every line it is given and says how long it took."""
    os.sched_setaffinity(0, cores)  # before JAX starts its threads
    import numpy as np

    from planner_jax.referee.hit import referee_hits
    from planner_jax.task.hit.exact import ExactHit
    from planner_jax.task.hit.serves import generate_serves, to_scenarios
    from planner_jax.task.solve import plan

    planner, scenarios = ExactHit(), to_scenarios(generate_serves(num, 0))
    plans = plan(planner, scenarios)
    success = referee_hits(scenarios, plans).success.mean()
    print(f"{100 * success:.2f} % refereed, median cost {np.median(plans.cost):.3g}", flush=True)
    for _ in sys.stdin:
        began = time.perf_counter()
        plan(planner, scenarios)
        print(time.perf_counter() - began, flush=True)


class _Child:
    """A process that plans `num` hits on some cores when told to."""

    def __init__(self, num: int, cores: Sequence[int]) -> None:
        self.num = num
        names = ",".join(map(str, cores))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.cores", "--num", str(num), "--serve", names],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.quality = self._line()

    def begin(self) -> None:
        assert self.process.stdin
        self.process.stdin.write("\n")
        self.process.stdin.flush()

    def rate(self) -> float:
        """Plans a second of what was begun."""
        return self.num / float(self._line())

    def end(self) -> None:
        self.process.communicate()

    def _line(self) -> str:
        assert self.process.stdout
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit("a planning process ended early")
        return line.strip()


def main() -> None:
    """Take turns and print the rates."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num", type=int, default=36000, help="hits a process plans at a time")
    parser.add_argument("--turns", type=int, default=8)
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.serve:
        _serve(args.num, [int(core) for core in args.serve.split(",")])
        return
    cores = sorted(os.sched_getaffinity(0))
    groups = {
        "one core": [_Child(args.num, cores[-1:])],
        f"all {len(cores)} cores": [_Child(args.num, cores)],
        "a process for each core": [_Child(args.num, [core]) for core in cores],
    }
    rates: dict[str, list[float]] = {name: [] for name in groups}
    for _ in range(args.turns):
        for name, children in groups.items():
            for child in children:
                child.begin()
            rates[name].append(sum(child.rate() for child in children))
    print(f"load average {os.getloadavg()[0]:.1f}; {args.turns} turns")
    print("| process | plans/s, median | lowest | highest | times one core | success |")
    print("|---|---|---|---|---|---|")
    alone = rates["one core"]
    for name, found in rates.items():
        times = statistics.median(f / a for f, a in zip(found, alone, strict=True))
        print(
            f"| {name} | {statistics.median(found):.0f} | {min(found):.0f} | {max(found):.0f} "
            f"| {times:.2f} | {groups[name][0].quality} |"
        )
    for children in groups.values():
        for child in children:
            child.end()


if __name__ == "__main__":
    main()
