"""Measure two planners of catches on the 240 throws with published optima of a C++ program.

    python -m benchmarks.catch_reference [--data tests/data] [--repeats 5] [--out DIR]

A quadrotor catches a thrown ball with a net. A C++ program for this problem [Yu2023catch] is
published, with its optima for an easy and a hard set of throws. It uses the reference headers of
MINCO and L-BFGS, in one thread and in double precision. On the easy set it takes 2.96 ms and 220
iterations a plan, and makes 320 plans/s on a core. On the hard set it takes 4.40 ms a plan and
solves 98 % of the throws. With better settings of its search it makes 582 plans/s on the easy set
and 453 on the hard set.

The benchmark measures two planners of this library: `catch`, which minimises the same objective as
the C++ program, and `exact`, the default. It prints
* for `catch`, the cost at the initial guess and at the optimum, relative to the published costs;
* for `exact`, the mean catching time, and the success rate by the referee, an independent check in
  float64;
* the speed of both planners in a batch, and of `exact` one throw at a time.

The run's summary has the success and cost of `exact`. Run this benchmark on an idle machine. The
command `taskset -c 0` binds it to one core.
"""

import csv
import dataclasses
import os
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax as pj
from planner_jax.baselines.catch.paper import COST_UNIT, PaperCatch
from planner_jax.benchmarks.cost_gap import cost_gaps, gap_figures
from planner_jax.benchmarks.run import Bench, argument_parser, begin
from planner_jax.optimise.settings import Attempt, Stage

SETS = ("paper", "hard")
BATCH_COPIES = 64
# Maximum numbers of the planner's iterations in the second stage of its search, which checks limits
# at all samples of a trajectory, and in the first stage, which checks them at every fourth sample.
_QUICK, _QUICK_COARSE = 45, 60


def read_set(path: Path, dtype) -> tuple[pj.catch.CatchCase, dict[str, np.ndarray]]:
    """Read a CSV file of throws; return cases, and published numbers by their columns.

    `Tp` and `T_ref` [s] are the catching times of the initial guess and of the optimum. `J0_M4` and
    `J0_M8` are the costs of a guess with 4 and 8 polynomial pieces, `cost_ref` is the optimal cost.
    """
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))

    def column(*names: str) -> np.ndarray:
        return np.array([[float(row[name]) for name in names] for row in rows])

    num = len(rows)
    ball = pj.BallState(
        pos=jnp.asarray(column("b0_x", "b0_y", "b0_z")[:, None], dtype),
        vel=jnp.asarray(column("bv0_x", "bv0_y", "bv0_z")[:, None], dtype),
    )
    paths = pj.BallPath(
        ball=ball, drag=jnp.full((num, 1, 3), 0.5, dtype), gravity=jnp.full((num, 1), 9.81, dtype)
    )
    cases = pj.catch.case(paths, np.full((num, 1), 3.0), dtype=dtype)
    names = ("Tp", "J0_M4", "J0_M8", "T_ref", "cost_ref")
    known = {name: column(name)[:, 0] for name in names}
    cases = dataclasses.replace(cases, times=jnp.asarray(known["Tp"][:, None], dtype))
    return cases, known


def guess_cost(problem: PaperCatch, case: pj.catch.CatchCase) -> jax.Array:
    """Return the cost [Yu2023catch, eqs 18-28] at the initial guess for a case.

    The problem divides its cost by the constant `COST_UNIT`; the returned cost is not divided.
    """
    context = problem.prepare(case)
    return COST_UNIT * problem.objective(problem.guesses(context, 1)[0], context).cost


def latencies(planner, cases: pj.catch.CatchCase, repeats: int) -> str:
    """Plan the cases one at a time, `repeats` times; return percentiles of the time as text."""
    host = jax.tree.map(np.asarray, cases)
    num = host.batch_shape[0]
    lanes = [pj.take(host, k) for k in range(num)]
    for lane in lanes:
        pj.plan(planner, lane)
    seconds = []
    for lane in lanes * repeats:
        began = time.perf_counter()
        pj.plan(planner, lane)
        seconds.append(time.perf_counter() - began)
    p50, p90, p99 = 1e3 * np.percentile(seconds, [50, 90, 99])
    return f"one by one p50 {p50:.3f}, p90 {p90:.3f}, p99 {p99:.3f} ms"


def throughput(planner, cases: pj.catch.CatchCase) -> str:
    """Plan a large batch five times without compilation; return its best speed as text.

    The batch contains 64 copies of the cases. The speed is in plans per second of wall-clock time
    and of CPU time.
    """
    many = jax.tree.map(lambda leaf: np.tile(leaf, (BATCH_COPIES,) + (1,) * (leaf.ndim - 1)),
                        jax.tree.map(np.asarray, cases))  # fmt: skip
    pj.plan(planner, many)
    seconds = []
    for _ in range(5):
        began = time.perf_counter(), time.process_time()
        pj.plan(planner, many)
        seconds.append((time.perf_counter() - began[0], time.process_time() - began[1]))
    num, (clock, cores) = many.batch_shape[0], np.min(seconds, axis=0)
    return f"batch of {num}: {num / clock:.0f} plans/s, {num / cores:.0f} a second of a core"


def report_paper_planner(bench: Bench, data: Path) -> None:
    """Print how far the costs of the planner `catch` in float64 are from the published costs.

    The planner minimises the objective of [Yu2023catch]. The costs at the initial guess and at the
    end of the search are compared with the costs in the files of the folder `data`.
    """
    with jax.enable_x64(True):
        for name in SETS:
            cases, known = read_set(data / f"catch_{name}.csv", jnp.float64)
            for pieces in (4, 8):
                chosen = PaperCatch(num_pieces=pieces, scale=(1.0,) * (3 * (pieces - 1) + 13))
                cost = jax.jit(jax.vmap(lambda s, p=chosen: guess_cost(p, s)))(cases)
                error = np.abs(np.asarray(cost) / known[f"J0_M{pieces}"] - 1.0).max()
                bench.say(f"{name}: cost of the guess, M = {pieces}: largest error {error:.1e}")
            plans = pj.plan(PaperCatch.planner(), cases)
            bench.say(f"{name}: catch, float64: {_gap(plans, known)}")


def _gap(plans, known: dict[str, np.ndarray]) -> str:
    gap = COST_UNIT * plans.cost / known["cost_ref"] - 1.0
    return (
        f"gap <= 1e-3 on {100 * np.mean(gap <= 1e-3):.1f} %, median {np.median(gap):.1e}, "
        f"largest {gap.max():.1e}, {plans.iterations.mean():.0f} iterations"
    )


def quick_paper_catch() -> pj.SearchPlanner:
    """Return a planner that minimises the objective of [Yu2023catch] in few iterations.

    Its speed is measured. On most of the 240 throws its costs are within 1e-3 (relative) of the
    optimum. The first stage of the search checks limits at a quarter of the samples, the second
    stage at all samples. The weights of the penalties are as published with [Yu2023catch].
    """
    chosen = PaperCatch.planner()
    (full,) = chosen.attempts
    solver = dataclasses.replace(full.solver, max_steps=_QUICK, tolerance=1e-7, patience=5)
    coarse = dataclasses.replace(solver, max_steps=_QUICK_COARSE)
    stages = (Stage(coarse, (("nodes", 4),)),)
    return dataclasses.replace(chosen, attempts=(Attempt(1, solver, (), stages),))


def report_set(bench: Bench, data: Path, name: str, repeats: int) -> None:
    """Print cost, success and speed of two planners on a set of published throws, in float32.

    The planner `catch` minimises the objective of [Yu2023catch], `exact` is the default planner.
    The set `name` is "paper" for easy and "hard" for hard throws, in a file of the folder `data`.
    """
    cases, known = read_set(data / f"catch_{name}.csv", jnp.float32)
    quick, exact = quick_paper_catch(), pj.catch.CatchProblem.planner()
    bench.say(
        f"{name}: catch, float32, quick: {_gap(pj.plan(quick, cases), known)}",
        f"{name}: catch, float32, quick: {throughput(quick, cases)}",
    )
    plans = pj.plan(exact, cases)
    success, gaps = pj.catch.judge(cases, plans).success, cost_gaps(exact, cases, plans)
    bench.count(success, gaps)
    later = plans.times[:, 0].mean() - known["T_ref"].mean()
    bench.say(
        f"{name}: exact: {success.sum()} of {success.size} pass the referee, "
        f"caught {later:+.3f} s after the published optimum on average",
        f"{name}: exact: {latencies(exact, cases, repeats)}",
        f"{name}: exact: {throughput(exact, cases)}",
    )
    bench.row(set=name, num=success.size, success=success.mean(), **gap_figures(gaps))


def main() -> None:
    parser = argument_parser("catch_reference", __doc__, repeats=5)
    parser.add_argument("--data", type=Path, default=Path("tests/data"), help="folder of the sets")
    options = parser.parse_args()
    with begin(parser, options) as bench:
        bench.say(
            f"jax {jax.__version__}, {jax.devices()[0]}, load average {os.getloadavg()[0]:.1f}"
        )
        report_paper_planner(bench, options.data)
        for name in SETS:
            report_set(bench, options.data, name, options.repeats)


if __name__ == "__main__":
    main()
