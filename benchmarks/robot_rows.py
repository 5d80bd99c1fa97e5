"""Compare quadrotor models: refereed success, and the computing cost of their rotor limits.

    python -m benchmarks.robot_rows [--robots NAME|FILE ...] [--num 2048] [--repeats 5] [--out DIR]

Every robot plans with and without the limits of its rotors (`rotor_share` null). The two take
turns, so that other load on the machine affects both. Rackets hit the serves of the suite court,
nets catch the throws of parabola2. Plans without rotor limits are judged without them too.
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

SHARE = 0.9  # share of a rotor's range, for robots without a rotor limit


def vary_rotor_limits(robot: QuadrotorModel) -> dict[str, QuadrotorModel]:
    """Return the robot without and with limits of its rotors."""
    share = robot.limits.rotor_share or SHARE

    def with_share(share: float | None) -> QuadrotorModel:
        limits = dataclasses.replace(robot.limits, rotor_share=share)
        return dataclasses.replace(robot, limits=limits)

    return {"without": with_share(None), "with": with_share(share)}


def measure_robot(robot: QuadrotorModel, num: int, repeats: int) -> dict[str, Any]:
    """Return success (num,) and plans/s by wall-clock and by CPU time, without and with limits.

    The first plans compile and are not timed; a rate is the best of the others.
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
