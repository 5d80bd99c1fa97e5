"""Compare quadrotor models: success of their plans, and the time that rotor limits add to planning.

    python -m benchmarks.robot_rows [--robots NAME|FILE ...] [--num 2048] [--repeats 5] [--out DIR]

For every model, cases are planned with limits on the thrust of each rotor, and without them
(`rotor_share` null). Both kinds of calls take turns, so that other load on the machine affects
both. Models with a racket hit the serves of the suite `court`. Models with a net catch the balls of
the suite `parabola2`. The referee, an independent check in float64, judges the plans. Plans without
rotor limits are judged without rotor limits, too.
"""

import dataclasses
import time
from typing import Any

import jax
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.run import argument_parser, begin
from planner_jax.robot.quadrotor_model import NET, QuadrotorModel
from planner_jax.robot.quadrotor_models import MODELS, robot_named

# Part of a rotor's thrust range that plans may use, for models that state no rotor limit.
SHARE = 0.9


def vary_rotor_limits(robot: QuadrotorModel) -> dict[str, QuadrotorModel]:
    """Return two copies of a quadrotor model, without and with limits on its rotors' thrust."""
    share = robot.limits.rotor_share or SHARE

    def with_share(share: float | None) -> QuadrotorModel:
        limits = dataclasses.replace(robot.limits, rotor_share=share)
        return dataclasses.replace(robot, limits=limits)

    return {"without": with_share(None), "with": with_share(share)}


def measure_robot(robot: QuadrotorModel, num: int, repeats: int) -> dict[str, Any]:
    """Plan `num` cases for a quadrotor model without and with rotor limits, `repeats` times each.

    Returns for both kinds, by name, whether the referee (an independent check) accepts the plans,
    (num,) bool, and plans per second of wall-clock time and of CPU time. The first call compiles
    and is not timed. The fastest of the other calls counts.
    """
    task, suite = (pj.catch, "parabola2") if robot.tool.kind == NET else (pj.hit, "court")
    planner, found = task.planner(), {}
    for repeat in range(repeats + 1):
        for name, one in vary_rotor_limits(robot).items():
            cases = jax.tree.map(np.asarray, task.draw(num, suite, seed=3, robot=one))
            clock, busy = time.perf_counter(), time.process_time()
            plans = jax.block_until_ready(pj.plan(planner, cases))
            seconds = np.array([time.perf_counter() - clock, time.process_time() - busy])
            if repeat == 0:
                success = np.asarray(task.judge(cases, plans).success)
                found[name] = (success, np.zeros(2))
            else:
                found[name] = (found[name][0], np.maximum(found[name][1], num / seconds))
    return found


def main() -> None:
    parser = argument_parser("robot_rows", __doc__, num=2048, repeats=5)
    parser.add_argument(
        "--robots", nargs="+", metavar="NAME|FILE", default=list(MODELS), help="default: all"
    )
    options = parser.parse_args()
    try:
        robots = [robot_named(word) for word in options.robots]
    except ValueError as error:
        parser.error(f"argument --robots: {error}")
    with begin(parser, options) as bench:
        bench.say(
            "| robot | rotor limits | success % | plans/s, wall clock | plans/s, CPU time |",
            "|---|---|---|---|---|",
        )
        for robot in robots:
            for name, (success, speed) in measure_robot(
                robot, options.num, options.repeats
            ).items():
                bench.say(
                    f"| {robot.name} | {name} | {100 * success.mean():.2f} "
                    f"| {speed[0]:,.0f} | {speed[1]:,.0f} |"
                )
                bench.row(robot=robot.name, rotors=name, success=success.mean(), speed=speed)
                bench.count(success)


if __name__ == "__main__":
    main()
