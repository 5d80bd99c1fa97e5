"""Measure how long a new process takes to its first plans; most of this time is compilation.

    python -m benchmarks.first_plan [--rows hit,block-64] [--out DIR]

Each row of the table is planned by two new processes, one after the other. The first process finds
an empty compile cache on the disk. The second process loads the programs that the first one
compiled. The CPU time is measured from the start of the process until the first call of `pj.plan`
returns; it includes imports and the drawing of cases. The device is JAX's default, or the one that
the variable JAX_PLATFORMS names.

Planners search unsolved cases again in later attempts, which need other programs. A row whose name
starts with "later" measures a case that needs later attempts. Its process first plans a usual case
of the task, and the row's times start after that plan.
"""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from typing import Any

import numpy as np

from planner_jax.benchmarks.run import argument_parser, begin, parse_names


@dataclasses.dataclass(frozen=True)
class Row:
    """One row of the table: a task, and the cases that are drawn for the first plan."""

    task: str
    num: int | None = None  # number of cases in a batch; None for one case without a batch axis
    suite: str | None = None
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    is_later: bool = False  # whether a usual case of the task is planned before


ROWS = {
    "hit": Row("hit"),
    "catch": Row("catch", suite="throws"),
    "triangle3": Row("catch", suite="triangle3"),
    "intercept": Row("intercept", suite="hard"),
    "block": Row("block"),
    "intercept-64": Row("intercept", 64, "hard"),
    "block-64": Row("block", 64),
    "hit-late": Row("hit", 4096, options={"delay": 0.5}),
    # With a fifth of the usual limits there is no solution, so the planner makes all of its
    # attempts.
    "later-hit": Row("hit", options={"limit_scale": 0.2}, is_later=True),
    # Case 2 of the suite: no motion in which all joints move in proportion blocks its ball.
    "later-block": Row("block", options={"first": 2}, is_later=True),
}
_PROCESS = """
import json, sys, time
import jax
import planner_jax as pj
row, started = json.loads(sys.argv[1]), float(sys.argv[2])
task, one = getattr(pj, row["task"]), row["num"] is None
compiled, planner = [], task.planner()
def listen(event, seconds, **_):
    if event == "/jax/core/compile/backend_compile_duration": compiled.append(seconds)
def draw(**options):
    cases = task.draw(row["num"] or 1, row["suite"], **options)
    return pj.take(cases, 0) if one else cases
def run(cases):
    compiled.clear()
    cpu, wall = time.process_time(), time.time()
    plans = jax.block_until_ready(pj.plan(planner, cases))
    return plans, time.process_time() - cpu, time.time() - wall
jax.monitoring.register_event_duration_secs_listener(listen)
if row["is_later"]:
    run(draw())
cases = draw(**row["options"])
plans, cpu, wall = run(cases)
if not row["is_later"]:
    cpu, wall = time.process_time(), time.time() - started
programs = sum(seconds > 0.1 for seconds in compiled)
_, again, _ = run(cases)
if one:
    cases, plans = jax.tree.map(lambda leaf: leaf[None], (cases, plans))
success = task.judge(cases, plans).success.tolist()
print(json.dumps(dict(cpu=cpu, wall=wall, programs=programs, again=again, success=success)))
"""


def plan_in_new_process(row: Row, caches: str) -> dict[str, Any]:
    """Plan the cases of `row` in a new process, with compiled programs in the folder `caches`.

    Returns:
        "cpu" and "wall", the times [s] until the first plans; "programs", the number of programs
            that took more than 0.1 s to compile or load; "again", the CPU time [s] of a second
            call; and "success" of each case.
    """
    usual = {name: text for name, text in os.environ.items() if not name.startswith("JAX_PERS")}
    command = [sys.executable, "-c", _PROCESS, json.dumps(dataclasses.asdict(row))]
    ended = subprocess.run(
        [*command, repr(time.time())],
        env={**usual, "JAX_COMPILATION_CACHE_DIR": caches},
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    return json.loads(ended.stdout)


def main() -> None:
    parser = argument_parser("first_plan", __doc__)
    usual = ",".join(ROWS)
    parser.add_argument("--rows", default=usual, help=f"comma-separated (default: {usual})")
    options = parser.parse_args()
    names = parse_names(parser, "--rows", options.rows, ROWS)
    bench, rows = begin(parser, options), []
    bench.say(
        "| first plans of | compile cache | CPU [s] | wall [s] | programs | again, CPU [s] "
        "| success |",
        "|---|---|---|---|---|---|---|",
    )
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            for cache in ("empty", "warm"):
                found = plan_in_new_process(ROWS[name], folder)
                success = np.mean(found["success"])
                bench.say(
                    f"| {name} | {cache} | {found['cpu']:.1f} | {found['wall']:.1f} | "
                    f"{found['programs']} | {found['again']:.3f} | {100.0 * success:.1f} % |"
                )
                rows.append({"name": name, "cache": cache, **found})
    # This process uses the device only after the child processes have ended, because the device's
    # memory may suffice for one process only.
    with bench:
        for row in rows:
            success = np.array(row.pop("success"))
            bench.count(success)
            bench.row(**row, success=success.mean())


if __name__ == "__main__":
    main()
