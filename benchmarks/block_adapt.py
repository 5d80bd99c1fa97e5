"""Measure the planner that adapts stored block motions to the ball, one ball at a time on one core.

    taskset -c 0 python -m benchmarks.block_adapt [--library FILE] [--layout full] [--regime R2]
        [--num 1000] [--seed 7] [--out DIR]

A robot arm blocks thrown balls with a shield. Balls are drawn from the suite `pole`, in which a
pole stands in front of the arm. Each ball must meet the middle of the shield at a right angle, and
the arm may start as soon as the ball is seen. A ball flies through a cell (rectangle) of an outer
box and then of an inner box around the arm. The library stores a motion for each pair of cells.
Without --library a library is built first, for the joint limits --regime and the division --layout
of the boxes into cells. These planners get the same balls:
* `adapt`, with its short search alone, and with a longer search if the short one fails;
* planners that try 6 or 48 straight motions, in which all joints move in proportion;
* the default planner `online`;
* the library's motions without adaptation, which may meet a ball anywhere on the shield.

Wall-clock times are from the ball's arrays to the plan's arrays. The process's CPU time is printed
beside them, because other load on the machine changes it less. The referee, an independent check in
float64, decides whether a ball is blocked. Plans that a planner reports as solved and the referee
rejects are counted.
"""

import argparse
import dataclasses
import os
import time
from typing import Any

import jax
import numpy as np

import planner_jax as pj
from planner_jax.baselines.block.library.adapt import adapt_planner
from planner_jax.baselines.block.library.command import build_library
from planner_jax.benchmarks.block_library import library_options
from planner_jax.benchmarks.run import Bench, argument_parser, begin
from planner_jax.task.block.default_planner import OnlineBlock, Search

WARM = 50  # Number of balls that are planned before the measurement.


def measure_planner(bench: Bench, name: str, planner: Any, cases: Any) -> None:
    """Plan the throws `cases` one by one; print how many are blocked, and the planning times.

    The compile time is printed separately. `name` labels the printed line.
    """
    cases = jax.tree.map(np.asarray, cases)
    lanes = [pj.take(cases, k) for k in range(cases.batch_shape[0])]
    began = time.perf_counter()
    pj.plan(planner, lanes[0])
    compiling = time.perf_counter() - began
    for case in lanes[:WARM]:
        pj.plan(planner, case)
    seconds, busy, plans = [], [], []
    for case in lanes:
        began, cpu_began = time.perf_counter(), time.process_time()
        plans.append(pj.plan(planner, case))
        seconds.append(time.perf_counter() - began)
        busy.append(time.process_time() - cpu_began)
    together: Any = jax.tree.map(lambda *leaves: np.stack(leaves), *plans)
    success, claims = pj.block.judge(cases, together).success, pj.are_solved(together)
    refused = int((claims & ~success).sum())
    p50, p99 = 1e3 * np.percentile(seconds, [50, 99])
    mean = 1e3 * float(np.mean(seconds))
    own = 1e3 * float(np.median(busy)), 1e3 * float(np.mean(busy))
    bench.say(
        f"{name}: {100 * success.mean():.1f} % blocked, "
        f"{100 * claims.mean():.1f} % solved by status, "
        f"{refused} of these rejected; p50 {p50:.3f} ms, mean {mean:.3f} ms, p99 {p99:.3f} ms, "
        f"CPU time p50 {own[0]:.3f} ms, mean {own[1]:.3f} ms; "
        f"compiled in {compiling:.1f} s"
    )
    bench.row(
        planner=name,
        success=success.mean(),
        claims=claims.mean(),
        refused=refused,
        p50_ms=p50,
        mean_ms=mean,
        p99_ms=p99,
        processor_p50_ms=own[0],
        processor_mean_ms=own[1],
        compile_seconds=compiling,
    )
    bench.count(success)


def measure(bench: Bench, options: argparse.Namespace) -> None:
    path = options.library
    if path is None:
        path = bench.path / "library.bin"
        build_library(str(path), layout=options.layout, regime=options.regime)
    adapt = adapt_planner(path)

    def draw_cases(**how: Any) -> Any:
        return pj.block.draw(options.num, "pole", options.seed, regime=options.regime, **how)

    cases = draw_cases()
    adapt.check(cases)
    bench.say(f"{options.num} throws, load average {os.getloadavg()[0]:.1f}")
    few, many = (OnlineBlock(searches=(Search(straight=k, tries=0),)) for k in (6, 48))
    measure_planner(
        bench, "adapt, first effort", dataclasses.replace(adapt, efforts=adapt.efforts[:1]), cases
    )
    measure_planner(bench, "adapt, both efforts", adapt, cases)
    measure_planner(
        bench, "library, anywhere on the shield", adapt.stored, draw_cases(anywhere=True)
    )
    measure_planner(bench, "straight, 6 motions", few, cases)
    measure_planner(bench, "straight, 48 motions", many, cases)
    measure_planner(bench, "online", OnlineBlock(), cases)


def main() -> None:
    parser = argument_parser("block_adapt", __doc__, num=1000, seed=7)
    options = library_options(parser, layout="full")
    with begin(parser, options) as bench:
        measure(bench, options)


if __name__ == "__main__":
    main()
