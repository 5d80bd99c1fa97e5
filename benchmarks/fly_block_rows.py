"""Measure the share of balls that a simulated arm blocks, with different errors of its drives.

    python -m benchmarks.fly_block_rows [--num 200] [--seed 0] [--suite pole]
                                        [--regimes R1,R2] [--rows ideal,drives,...] [--by-clock]

An arm with a shield protects a box from thrown balls. Each row of the table simulates joint drives
with one kind of error, such as a lag of the torques or noise of the encoders. Plans are computed
once for each set of joint limits (`--regimes`), one at a time, and the same plans are executed in
every row. A ball is blocked if it hits the face of the shield before the ball's centre enters the
box. The block is a success if the arm has touched nothing until then. The program also prints the
share of balls whose plans the referee, an independent check in float64, accepts. An arm that
followed its plans exactly would block this share.

The arm may start 163 ms after a ball is first seen. This is the sum of 83 ms for perception and 50
ms of overheads [Natarajan2024, Section VI-B], and of 30 ms for planning. Planning times depend on
the machine, so by default a plan that takes longer than 30 ms counts as ready after 30 ms. With
`--by-clock` such a plan starts late.
"""

import dataclasses
import time
from typing import Any

import numpy as np

from planner_jax.benchmarks.run import Bench, argument_parser, begin, parse_names
from planner_jax.runs.summary import percent, wilson_interval
from planner_jax.sweep.block.settings import REGIMES

# Row of the printed table -> fields of the simulated joint drives (`Drives`) that differ from
# drives without errors. The key "share" is not a field of `Drives` but a factor of the torque
# limits.
ROWS: dict[str, dict[str, Any]] = {
    "ideal": {},
    "lag 5 ms": {"lag": 0.005},
    "fine encoders": {"angle_std": 1e-4, "rate_std": 0.01},
    "coarse encoders": {"angle_std": 1e-3, "rate_std": 0.1},
    "masses believed 5 % wrong": {"mass_error": 0.05},
    "masses believed 20 % wrong": {"mass_error": 0.2},
    "default": {"lag": 0.005, "angle_std": 1e-4, "rate_std": 0.01, "mass_error": 0.05},
    "latency 10 ms": {"latency": 0.01},
    "latency 30 ms": {"latency": 0.03},
    "torques halved": {"share": 0.5},
    "torques quartered": {"share": 0.25},
}
HEADER = (
    "| regime | row | success % (95 %) | blocked, % | collision before / after, % | "
    "miss of blocked p50 / worst, cm | tracking p50 / worst, cm | "
    "error rms of joints 1 to 6, mrad | torque rms of joints 1 to 3, N m | worst, N m | "
    "at the limit, % of the time | s |"
)


def line(regime: str, name: str, flights: Any, seconds: float) -> str:
    from planner_jax.sims.tasks.block_flights import TOUCH

    number, good, some = len(flights.miss), flights.success, flights.planned
    low, high = (100.0 * end for end in wilson_interval(int(good.sum()), number))
    touched, after = (
        percent(int((clearance[some] < -TOUCH).sum()), int(some.sum()))
        for clearance in (flights.clearance, flights.clearance_after)
    )
    flown, miss = flights.flown, 100.0 * flights.miss[flights.blocked]
    tracking = 100.0 * flown.tracking[some]
    error = 1e3 * np.sqrt((flown.error_rms[some] ** 2).mean(axis=0))
    torque = np.sqrt((flown.torque_rms[some, :3] ** 2).mean(axis=0))
    most, share = flown.torque_worst[some, :3].max(axis=0), flown.saturation[some, :3].mean(axis=0)

    missed = f"{np.median(miss):.2f} / {miss.max():.1f}" if miss.size else "-"

    def join(values: np.ndarray, form: str) -> str:
        return " / ".join(format(value, form) for value in values)

    return (
        f"| {regime} | {name} | {percent(int(good.sum()), number)} ({low:.1f} to {high:.1f}) | "
        f"{percent(int(flights.blocked.sum()), number)} | {touched} / {after} | "
        f"{missed} | "
        f"{np.median(tracking[:, 0]):.2f} / {tracking[:, 1].max():.1f} | {join(error, '.2f')} | "
        f"{join(torque, '.0f')} | {join(most, '.0f')} | {join(100.0 * share, '.1f')} | "
        f"{seconds:.1f} |"
    )


def measure(bench: Bench, regime: str, rows: list[str], options: Any) -> None:
    """Plan all throws once, simulate the plans with different errors of the drives, and print rows.

    Each row has the errors that `ROWS` names, such as a lag of the torques or noise of the
    encoders. `regime` names the joint limits, `options` are the command-line options.
    """
    from planner_jax.core.protocol import is_solved
    from planner_jax.runs.timing import measure_plans
    from planner_jax.sims.robots.arm.drives import TORQUES, Drives
    from planner_jax.sims.tasks.block_flights import BLOCK_WORLD, fly_blocks, throws
    from planner_jax.task.block.api import judge, planner

    observe, budget = 0.133, 0.03
    cases = throws(
        options.suite,
        options.num,
        options.seed,
        regime=regime,
        wide=options.wide,
        delay=observe + budget,
    )
    plan, seconds = measure_plans(planner(options.planner), cases.cases)
    accepted = judge(cases.cases, plan).success & is_solved(plan.status)
    quick, slow = (1e3 * np.quantile(seconds, share) for share in (0.5, 0.99))
    bench.say(
        f"{regime}: {percent(int(accepted.sum()), len(accepted))} % of the balls have a plan that "
        f"the referee accepts; planning p50 {quick:.1f} ms, p99 {slow:.1f} ms, "
        f"{percent(int((seconds > budget).sum()), len(seconds))} % above {1e3 * budget:g} ms"
    )
    for name in rows:
        given = dict(ROWS[name])
        share = given.pop("share", 1.0)
        drives = Drives(torques=tuple(share * torque for torque in TORQUES), **given)
        began = time.perf_counter()
        flights = fly_blocks(
            BLOCK_WORLD,
            cases,
            options.seed,
            drives=drives,
            planning_budget=budget if options.by_clock else None,
            plan=plan,
            seconds=seconds,
        )
        spent = time.perf_counter() - began
        bench.say(line(regime, name, flights, spent))
        bench.count(flights.success)
        bench.row(
            regime=regime,
            row=name,
            drives=dataclasses.asdict(drives),
            success=int(flights.success.sum()),
            blocked=int(flights.blocked.sum()),
            accepted=int(accepted.sum()),
            num=len(flights.success),
            seconds=spent,
        )


def main() -> None:
    known = ", ".join(ROWS).replace("%", "%%")
    parser = argument_parser("fly_block_rows", __doc__, num=200, seed=0)
    parser.add_argument(
        "--suite", default="pole", choices=("pole", "open", "short"), help="default: pole"
    )
    parser.add_argument("--planner", default="online", help="default: online")
    parser.add_argument(
        "--regimes", default="R1,R2", help=f"joint limits, of {', '.join(REGIMES)}; default: R1,R2"
    )
    parser.add_argument(
        "--rows", default=",".join(ROWS), help=f"rows to print, of {known}; default: all"
    )
    parser.add_argument(
        "--wide",
        action="store_true",
        help="balls may meet the shield off its middle and at an angle",
    )
    parser.add_argument(
        "--by-clock", action="store_true", help="plans that take longer than 30 ms start late"
    )
    options = parser.parse_args()
    regimes = parse_names(parser, "--regimes", options.regimes, REGIMES)
    rows = parse_names(parser, "--rows", options.rows, ROWS)
    with begin(parser, options) as bench:
        bench.say(HEADER, "|---" * HEADER.count(" | ") + "|---|")
        for regime in regimes:
            measure(bench, regime, rows, options)


if __name__ == "__main__":
    main()
