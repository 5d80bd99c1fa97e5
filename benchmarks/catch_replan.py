"""Measure how long a catch takes to plan again, from a new estimate of the ball.

    taskset -c 1 python -m benchmarks.catch_replan [--num 1000] [--noise 0.005] [--out DIR]

A quadrotor catches a thrown ball with a net. Each throw is planned from scratch, and planned again
once, at a random time of the first plan. The ball's position [m] and velocity [m/s] then deviate
from the expected values by random errors with the standard deviation --noise. Plans from scratch of
the same throws are timed, too; their order and times of the catches are specified.

The re-plans are judged by the protocol of [Yu2023catch]: limits with a tolerance of 5 %, and the
ball within the net's radius of its centre. The run's summary contains their success rate, and their
excess cost over a longer search. All programs run in the calling thread, as in the planning server,
because starting a program of 0.1 ms in one of JAX's threads adds 0.05 ms. Run the benchmark on an
idle machine; the load average is printed.
"""

import dataclasses
import os
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax as pj
from planner_jax.ball.flight import BallState
from planner_jax.benchmarks.cost_gap import cost_gaps
from planner_jax.benchmarks.run import Bench, argument_parser, begin
from planner_jax.live.server import compute_in_place
from planner_jax.policies.published import PAPER_RULE
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.plan import CatchPlan

PERIOD = 0.01  # [s] Plans start this long after the throw, and at multiples of it.
LATEST = 0.6  # [s] Re-plans start before this time of the first plan.
SCRATCH = pj.catch.CatchProblem.planner()
AGAIN: Any = SCRATCH.replanner()


def stack(trees: list) -> Any:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def balls_of(case: CatchCase) -> pj.BallPath:
    assert isinstance(case.targets, pj.BallPath)
    return case.targets


def first_plan(case: CatchCase) -> tuple[CatchCase, CatchPlan]:
    """Estimate the earliest time at which the ball can be caught, and plan a catch from scratch.

    The planner's search starts from this time. Returns the case with the time, and the plan.
    """
    case = case.with_choice(jax.tree.map(lambda leaf: np.asarray(leaf)[0], _propose(case)))
    return case, pj.plan(SCRATCH, case)


_propose = jax.jit(pj.catch.Greedy().propose)


def warm_up(case: CatchCase) -> None:
    """Compile all searches of the planner and the re-planner.

    The planner starts a later search only for cases that are not solved. The quadrotor's speed
    limit is therefore set near zero, so that no search solves the case and all are compiled.
    """
    stuck = dataclasses.replace(
        case, limits=dataclasses.replace(case.limits, speed=np.float32(1e-3))
    )
    _, flown = first_plan(stuck)
    pj.replan(AGAIN, stuck, flown, 0.01, targets=stuck.targets)


def report_times(bench: Bench, name: str, seconds: list[float]) -> None:
    """Print percentiles of durations [s], and store them in the run folder under `name`."""
    p50, p90, p99 = 1e3 * np.percentile(seconds, [50, 90, 99])
    bench.row(name=name, num=len(seconds), p50_ms=p50, p90_ms=p90, p99_ms=p99)
    bench.say(
        f"{name}: p50 {p50:.3f} ms, p90 {p90:.3f} ms, p99 {p99:.3f} ms, "
        f"max {1e3 * max(seconds):.3f} ms ({len(seconds)})"
    )


def throws(num: int) -> CatchCase:
    """Draw `num` throws; return them as cases whose time 0 is one period after the throw."""
    suite = pj.catch.draw(num)
    ahead = jax.vmap(lambda path: path.at(jnp.asarray(PERIOD)))(
        jax.tree.map(lambda leaf: leaf[:, 0], suite.targets)
    )
    ball = jax.tree.map(lambda leaf: leaf[:, None], ahead)
    targets = dataclasses.replace(balls_of(suite), ball=ball)
    cases = dataclasses.replace(suite, targets=targets, horizon=suite.horizon - PERIOD)
    return jax.tree.map(np.asarray, cases)


def time_replans(bench: Bench, lanes: list[CatchCase], noise: float) -> None:
    """Time one re-plan and one plan from scratch for each case, and print percentiles.

    A re-plan starts at a random time of the first plan. The ball's position [m] and velocity [m/s]
    then deviate from the expected values by random errors with the standard deviation `noise`.
    """
    random = np.random.default_rng(0)
    tasks = []
    for case in lanes:
        task, current = first_plan(case)
        elapsed = np.float32(PERIOD * random.integers(1, round(LATEST / PERIOD)))
        path = balls_of(case)
        ball = jax.tree.map(
            np.asarray,
            pj.BallPath(
                BallState(path.ball.pos[0], path.ball.vel[0]), path.drag[0], path.gravity[0]
            ).at(jnp.asarray(elapsed)),
        )
        moved = BallState(
            (ball.pos + noise * random.standard_normal(3)).astype(np.float32)[None],
            (ball.vel + noise * random.standard_normal(3)).astype(np.float32)[None],
        )
        tasks.append((task, current, elapsed, dataclasses.replace(path, ball=moved)))
    seconds, scratch, replans = [], [], []
    for task, current, elapsed, targets in tasks:
        began = time.perf_counter()
        left = AGAIN.begin(task, current, elapsed, targets=targets)
        found = pj.plan(AGAIN, left)
        ended = time.perf_counter()
        pj.plan(SCRATCH, task)
        scratch.append(time.perf_counter() - ended)
        seconds.append(ended - began)
        replans.append((left, found))
    report_times(bench, "from scratch, with order and time fixed", scratch)
    report_times(bench, "re-plan alone", seconds)
    cases, plans = stack(replans)
    bench.say(f"solved {100.0 * pj.are_solved(plans).mean():.2f} %")
    verdict = pj.catch.judge(cases.case, plans, **PAPER_RULE)
    bench.count(verdict.success, cost_gaps(AGAIN, cases, plans))


def main() -> None:
    parser = argument_parser("catch_replan", __doc__, num=1000)
    parser.add_argument(
        "--noise", type=float, default=0.005, help="standard deviation of position and velocity"
    )
    options = parser.parse_args()
    compute_in_place()
    with begin(parser, options) as bench:
        cases = throws(options.num)
        lanes = [pj.take(cases, k) for k in range(options.num)]
        began = time.perf_counter()
        warm_up(lanes[0])
        bench.say(
            f"{options.num} throws, {jax.devices()[0].platform}, jax {jax.__version__}, load "
            f"average {os.getloadavg()[0]:.1f}; compilation of all attempts "
            f"{time.perf_counter() - began:.1f} s"
        )
        time_replans(bench, lanes, options.noise)


if __name__ == "__main__":
    main()
