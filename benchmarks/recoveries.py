"""Measure how often a plan can be followed by a recovery trajectory to a standstill.

    python -m benchmarks.recoveries [--rows ROW,...] [--num 1000] [--seed 1] [--out DIR]

A recovery trajectory brings the robot to a standstill after the last contact of a plan. The command
`planner-jax export` appends it to plans. Cases of each row are drawn and planned. For every plan
that the referee, an independent check in float64, accepts and that does not end at a standstill, a
recovery trajectory is computed. If none is found, the limit that it would exceed is counted.
"""

import time
from collections import Counter
from typing import Any

import jax
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.run import argument_parser, begin, parse_names
from planner_jax.core.errors import NoRecovery
from planner_jax.recovery.after_plan import append_recovery, is_rested

# Row of the table -> module of the task, options of its functions `draw` and `planner`, and kind of
# recovery: "brake" to a standstill at any position, or "home" to the start of the case.
ROWS: dict[str, tuple[Any, dict[str, Any], dict[str, Any], str]] = {
    "hits": (pj.hit, {}, {}, "brake"),
    "hits-home": (pj.hit, {}, {}, "home"),
    "throws": (pj.catch, {"suite": "throws"}, {}, "brake"),
    "triangle3": (pj.catch, {"suite": "triangle3"}, {"decide": "greedy"}, "brake"),
    **{f"car-{suite}": (pj.intercept, {"suite": suite}, {}, "brake") for suite in ("easy", "hard")},
    **{f"arm-{regime}": (pj.block, {"regime": regime}, {}, "brake") for regime in ("R1", "R2")},
}


def count_recoveries(cases: Any, plans: Any, passed: np.ndarray, to: str) -> tuple[Counter, float]:
    """Compute a recovery trajectory, which ends at a standstill, for each accepted plan.

    Args:
        cases: a batch of B cases.
        plans: the plans of these cases.
        passed: (B,) bool, whether the referee, an independent check, accepts the plan.
        to: kind of the recovery, "brake" (stop anywhere) or "home" (return to the start).

    Returns:
        The numbers of plans that already end at a standstill ("rests"), of recovery trajectories
        that were found ("found"), and of failures by the name of the limit. Then the median
        duration of one computation [s].
    """
    counts: Counter[str] = Counter()
    seconds = []
    for place in np.flatnonzero(passed).tolist():
        case, plan = pj.take(cases, place), pj.take(plans, place)
        if is_rested(plan):
            counts["rests"] += 1
            continue
        begin = time.perf_counter()
        try:
            append_recovery(case, plan, to)
            counts["found"] += 1
        except NoRecovery as error:
            counts[str(error).partition(":")[0]] += 1
        seconds.append(time.perf_counter() - begin)
    return counts, float(np.median(seconds)) if seconds else 0.0


def main() -> None:
    parser = argument_parser("recoveries", __doc__, num=1000, seed=1)
    parser.add_argument("--rows", metavar="ROW,...", default=",".join(ROWS), help="default: all")
    options = parser.parse_args()
    rows = parse_names(parser, "--rows", options.rows, ROWS)
    with begin(parser, options) as bench:
        bench.say(
            "| row | accepted plans | end at rest | recovery found | none, by limit | ms each |",
            "|---|---|---|---|---|---|",
        )
        for row in rows:
            task, of_draw, of_planner, to = ROWS[row]
            drawn = task.draw(options.num, seed=options.seed, **of_draw)
            cases = jax.tree.map(np.asarray, drawn)
            plans = pj.plan(task.planner(**of_planner), cases)
            passed = np.asarray(task.judge(cases, plans).success)
            counts, median = count_recoveries(cases, plans, passed, to)
            rests, found = counts.pop("rests", 0), counts.pop("found", 0)
            none = ", ".join(f"{num} {name}" for name, num in counts.most_common()) or "-"
            bench.say(
                f"| {row} | {passed.sum()} | {rests} | {found} | {none} | {1e3 * median:.1f} |"
            )
            bench.row(row=row, passed=int(passed.sum()), rests=rests, found=found, none=counts)
            bench.count(np.arange(passed.sum()) < rests + found)


if __name__ == "__main__":
    main()
