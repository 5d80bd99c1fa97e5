"""Both catch planners on the 240 throws whose optimum a C++ program has published.

    python -m benchmarks.catch_reference [--data tests/data] [--repeats 5]

The C++ program is the same problem on the reference MINCO and L-BFGS headers: one thread,
double, 2.96 ms a plan and 320 plans/s on a core on the easy set (220 iterations), 4.40 ms on
the hard one, 98 % of which it solves. Printed here: the cost of the guess against its J0
(float64), the cost gap of `catch` to its optimum (float64 and float32), `exact`'s refereed
success and mean catching time (float32), and the speed of both, one by one and in a batch.
Run it on an idle machine; `taskset -c 0` holds it to one core.
"""

import argparse
import csv
import dataclasses
import os
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.ball.flight import BallState
from planner_jax.ball.target import BallPath
from planner_jax.optimise.problem import Round, Stage
from planner_jax.referee.catch import referee_catches
from planner_jax.task.catch.exact import ExactCatch
from planner_jax.task.catch.paper import COST_UNIT, PaperCatch
from planner_jax.task.catch.scenario import CatchScenario, catch_scenario
from planner_jax.task.solve import plan

SETS = ("paper", "hard")
BATCH_COPIES = 64


def read_set(path: Path, dtype) -> tuple[CatchScenario, dict[str, np.ndarray]]:
    """The scenarios of a file and its published columns."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))

    def column(*names: str) -> np.ndarray:
        return np.array([[float(row[name]) for name in names] for row in rows])

    num = len(rows)
    ball = BallState(
        pos=jnp.asarray(column("b0_x", "b0_y", "b0_z")[:, None], dtype),
        vel=jnp.asarray(column("bv0_x", "bv0_y", "bv0_z")[:, None], dtype),
    )
    paths = BallPath(
        ball=ball, drag=jnp.full((num, 1, 3), 0.5, dtype), gravity=jnp.full((num, 1), 9.81, dtype)
    )
    scenarios = catch_scenario(paths, np.full((num, 1), 3.0), dtype=dtype)
    names = ("Tp", "J0_M4", "J0_M8", "T_ref", "cost_ref")
    known = {name: column(name)[:, 0] for name in names}
    scenarios = dataclasses.replace(scenarios, times=jnp.asarray(known["Tp"][:, None], dtype))
    return scenarios, known


def guess_cost(planner: PaperCatch, scenario: CatchScenario) -> jax.Array:
    """The published cost of a planner's first guess."""
    context = planner.prepare(scenario)
    return COST_UNIT * planner.objective(planner.guesses(context, 1)[0], context).cost


def latencies(planner, scenarios: CatchScenario, repeats: int) -> str:
    """Percentiles of one plan at a time."""
    host = jax.tree.map(np.asarray, scenarios)
    num = host.batch_shape[0]
    lanes = [jax.tree.map(lambda leaf, k=k: leaf[k], host) for k in range(num)]
    for lane in lanes:
        plan(planner, lane)
    seconds = []
    for lane in lanes * repeats:
        began = time.perf_counter()
        plan(planner, lane)
        seconds.append(time.perf_counter() - began)
    p50, p90, p99 = 1e3 * np.percentile(seconds, [50, 90, 99])
    return f"one by one p50 {p50:.3f}, p90 {p90:.3f}, p99 {p99:.3f} ms"


def throughput(planner, scenarios: CatchScenario) -> str:
    """Best of three warm batches."""
    many = jax.tree.map(lambda leaf: np.tile(leaf, (BATCH_COPIES,) + (1,) * (leaf.ndim - 1)),
                        jax.tree.map(np.asarray, scenarios))  # fmt: skip
    plan(planner, many)
    best = np.inf
    for _ in range(3):
        began = time.perf_counter()
        plan(planner, many)
        best = min(best, time.perf_counter() - began)
    num = many.batch_shape[0]
    return f"batch of {num}: {num / best:.0f} plans/s"


def report_paper_planner(data: Path) -> None:
    """Cost of the guess and of the optimum in float64."""
    with jax.enable_x64(True):
        for name in SETS:
            scenarios, known = read_set(data / f"catch_{name}.csv", jnp.float64)
            for pieces in (4, 8):
                chosen = PaperCatch(num_pieces=pieces, scale=(1.0,) * (3 * (pieces - 1) + 13))
                cost = jax.jit(jax.vmap(lambda s, p=chosen: guess_cost(p, s)))(scenarios)
                error = np.abs(np.asarray(cost) / known[f"J0_M{pieces}"] - 1.0).max()
                print(f"{name}: cost of the guess, M = {pieces}: off by {error:.1e} at most")
            plans = plan(PaperCatch(), scenarios)
            print(f"{name}: catch, float64: {_gap(plans, known)}")


def _gap(plans, known: dict[str, np.ndarray]) -> str:
    gap = COST_UNIT * plans.cost / known["cost_ref"] - 1.0
    return (
        f"gap <= 1e-3 on {100 * np.mean(gap <= 1e-3):.1f} %, median {np.median(gap):.1e}, "
        f"largest {gap.max():.1e}, {plans.iterations.mean():.0f} iterations"
    )


def quick_paper_catch() -> PaperCatch:
    """`PaperCatch` with as many iterations as a gap of 1e-3 mostly takes on the easy set.

    The soft stages, which only bring the hinges on, do with a quarter of the samples.
    """
    chosen = PaperCatch()
    (full,) = chosen.rounds
    solver = dataclasses.replace(full.solver, max_steps=28, tolerance=1e-6, patience=4)
    stages = tuple(
        Stage(dataclasses.replace(solver, max_steps=steps), (*stage.settings, ("nodes", 4)))
        for stage, steps in zip(full.stages, (10, 15), strict=True)
    )
    return dataclasses.replace(chosen, rounds=(Round(1, solver, (), stages),))


def main() -> None:
    """Print everything."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("tests/data"))
    parser.add_argument("--repeats", type=int, default=5, help="of every single plan")
    args = parser.parse_args()
    print(f"jax {jax.__version__}, {jax.devices()[0]}, load average {os.getloadavg()[0]:.1f}")
    report_paper_planner(args.data)
    for name in SETS:
        scenarios, known = read_set(args.data / f"catch_{name}.csv", jnp.float32)
        host = jax.tree.map(np.asarray, scenarios)
        quick = quick_paper_catch()
        print(f"{name}: catch, float32, quick: {_gap(plan(quick, scenarios), known)}")
        print(f"{name}: catch, float32, quick: {throughput(quick, scenarios)}")
        plans = plan(ExactCatch(), scenarios)
        verdict = referee_catches(host, plans)
        later = plans.times[:, 0].mean() - known["T_ref"].mean()
        print(
            f"{name}: exact: {verdict.success.sum()} of {verdict.success.size} pass the referee, "
            f"caught {later:+.3f} s after the published optimum on average"
        )
        print(f"{name}: exact: {latencies(ExactCatch(), scenarios, args.repeats)}")
        print(f"{name}: exact: {throughput(ExactCatch(), scenarios)}")


if __name__ == "__main__":
    main()
