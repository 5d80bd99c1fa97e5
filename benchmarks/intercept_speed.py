"""Compare planners of the speed along a given path, as in [Qu2022, Table II].

    python -m benchmarks.intercept_speed [--num 500] [--paper] [--batch 65536] [--out DIR]

A car must reach the end of a given path at a given time and avoid moving obstacles. The station
is the distance along the path. In the graph of station over time, obstacles are polygons. A planner
first finds a line between the polygons by dynamic programming. Then a quadratic program finds the
curve of least acceleration whose bounds keep it on the same side of each polygon as the line.

The planners differ only in these bounds. The bounds of `trapezoid` are tilted lines, the bounds of
`trapezoid-edges` are the edges of the polygons as in [Qu2022], and the bounds of `rectangle` are
constant for each piece of the curve. These bounds apply to control points. `em`, the speed step of
[Fan2018], has constant bounds too, but only at samples every 0.1 s.

Problems are drawn with a seed. A plan counts as good if its status is CONVERGED and its curve is
outside of every polygon, checked every millisecond. The first table has means of acceleration and
jerk over good plans, and the least distance from a polygon. The second table compares pairs of
planners on the problems where both plans are good. Times are for one problem at a time without
compilation, from the problem's arrays to the plan's arrays. The planners take turns, so that other
load affects all of them.

With --paper only the two planners of Table II are compared: the lines of the paper with its weight
of the end (eq. 19), and `em`, whose end is exact or has this weight, too. The printed columns of
Table II cannot both be right, because "Max Acc." is below "Ave. Acc.", a root mean square.

With --batch the program also prints how many problems per second the device solves in a batch. With
the extra `peers`, the solvers Clarabel and OSQP also solve the quadratic programs of `trapezoid`
and `em`. The cost gap in the run's summary is the relative excess of this library's costs over
the costs of Clarabel.
"""

import dataclasses
import os
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.baselines.intercept.qp import solve_qp
from planner_jax.baselines.intercept.speed import (
    SPEED_PLANNERS,
    SpeedPlanner,
    plan_speed,
    speed_bounds,
    speed_matrices,
    speed_template,
)
from planner_jax.baselines.intercept.station_time import StationTimeProblem, reference_line
from planner_jax.baselines.protocols import PUBLISHED
from planner_jax.benchmarks.qp_peers import INSTALL, PEERS, is_installed
from planner_jax.benchmarks.run import Bench, argument_parser, at_least, begin
from planner_jax.benchmarks.speed_problems import SOFT_END, speed_problems
from planner_jax.core.protocol import Status
from planner_jax.trajectory.bezier import BezierCurve, bernstein, hodograph

PIECES = (10, 20)  # Numbers of polynomial pieces of the planned curve.
CONSTANT = "constant speed"
OURS = "this library"


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Speed planners, the pairs of them that are compared, and the ones whose programs are solved.

    A planner and a reference planner are compared on the problems that both solve without a
    collision. The first planner to solve is the one in the run's summary.
    """

    planners: dict[str, SpeedPlanner]
    pairs: tuple[tuple[str, str], ...]
    solved: tuple[str, ...]


ALL = Comparison(
    SPEED_PLANNERS,
    (
        ("trapezoid", "em"),
        ("trapezoid-edges", "em"),
        ("trapezoid", "trapezoid-edges"),
        ("trapezoid", "rectangle"),
    ),
    ("trapezoid", "em"),
)
PAPER = Comparison(
    {
        "edges, soft end": dataclasses.replace(
            SPEED_PLANNERS["trapezoid-edges"], end_weight=SOFT_END
        ),
        "em": SPEED_PLANNERS["em"],
        "em, soft end": dataclasses.replace(SPEED_PLANNERS["em"], end_weight=SOFT_END),
    },
    (("edges, soft end", "em"), ("edges, soft end", "em, soft end")),
    ("edges, soft end",),
)


@dataclasses.dataclass(frozen=True)
class Judged:
    """Results of one speed planner: arrays with one number for each problem."""

    good: np.ndarray  # bool, whether the problem is solved and the curve is outside all polygons
    rms: np.ndarray  # [m/s^2], root mean square acceleration
    peak: np.ndarray  # [m/s^2], greatest acceleration
    jerk: np.ndarray  # [m/s^3], greatest jerk
    end_error: np.ndarray  # [m], distance of the curve's end from the required station
    clearance: np.ndarray  # [m], least distance from a polygon; negative inside of a polygon


def planners(compared: Comparison = ALL) -> dict[str, SpeedPlanner]:
    """Return the compared planners by name, each with 10 and with 20 pieces.

    The pieces are polynomials of the planned curve. A planner whose limits are checked only at
    samples has 100 samples, 0.1 s apart for 10 s.
    """
    return {
        f"{name}, {pieces}": dataclasses.replace(
            planner, pieces=pieces, samples=planner.samples and 100 // pieces
        )
        for pieces in PIECES
        for name, planner in compared.planners.items()
    }


def constant_speed(problem: StationTimeProblem, degree: int = 5) -> BezierCurve:
    """Return a curve of constant speed to the end, which ignores obstacles and initial speed."""
    points = jnp.linspace(0.0, 1.0, degree + 1)[None] * problem.end_station
    return BezierCurve(points=points, horizon=problem.horizon)


def judge(problems: Any, points: np.ndarray, solved: np.ndarray) -> Judged:
    """Compute acceleration, error at the end and clearance of B planned curves, in float64.

    Args:
        problems: a batch of B problems.
        points: (B, K, n + 1) [m], control points of K Bezier pieces of degree n, which state the
            distance along the path over time. The curves are evaluated every millisecond.
        solved: (B,) bool, whether the planner reports the problem as solved.
    """
    pieces, degree = points.shape[1], points.shape[2] - 1
    horizon = float(problems.horizon[0])
    times = np.linspace(0.0, horizon, round(1000 * horizon) + 1)
    piece = np.minimum((times / horizon * pieces).astype(int), pieces - 1)
    share = times / horizon * pieces - piece
    points = points.astype(float)

    def derivative(order: int, lane: int) -> np.ndarray:
        basis = bernstein(degree - order, share) @ hodograph(degree, order, pieces)
        return np.sum(basis * points[lane, piece], axis=1) / horizon**order

    rows = []
    for lane in range(len(points)):
        station, acceleration, jerk = (derivative(order, lane) for order in (0, 2, 3))
        blocked = jax.tree.map(lambda leaf, lane=lane: leaf[lane], problems.blocked)
        passed = (times[:, None] - blocked.start) / (blocked.end - blocked.start)
        lower, upper = (
            edge[:, 0] + passed * (edge[:, 1] - edge[:, 0])
            for edge in (blocked.lower.astype(float), blocked.upper.astype(float))
        )
        away = np.maximum(lower - station[:, None], station[:, None] - upper)
        is_met = (passed >= 0.0) & (passed <= 1.0) & blocked.present
        rows.append(
            (
                np.sqrt(np.trapezoid(acceleration**2, times) / horizon),
                np.abs(acceleration).max(),
                np.abs(jerk).max(),
                abs(station[-1] - problems.end_station[lane]),
                np.where(is_met, away, np.inf).min(),
            )
        )
    rms, peak, jerk, end_error, clearance = np.array(rows).T
    return Judged(solved & (clearance >= 0.0), rms, peak, jerk, end_error, clearance)


def run_in_turns(runs: dict[str, Callable], lanes: list[tuple]) -> tuple[dict, dict]:
    """Call every function on every problem, one at a time, in a random order of the functions.

    Args:
        runs: functions by name.
        lanes: arguments of the functions, one tuple for each of N problems.

    Returns:
        results: by name, in NumPy arrays that are stacked over the problems.
        seconds: by name, (N,) [s], the fastest of three calls, because other programs may run too.
    """
    seconds = {name: np.full(len(lanes), np.inf) for name in runs}
    results: dict[str, list] = {name: [] for name in runs}
    for run in runs.values():
        jax.block_until_ready(run(*lanes[0]))
    rng = np.random.default_rng(0)
    for k, lane in enumerate(lanes):
        for _ in range(3):
            for name in rng.permutation(list(runs)):
                began = time.perf_counter()
                result = jax.block_until_ready(runs[name](*lane))
                seconds[name][k] = min(seconds[name][k], time.perf_counter() - began)
                results[name][k:] = [result]
    stacked = {
        name: jax.tree.map(lambda *leaves: np.stack(leaves), *each)
        for name, each in results.items()
    }
    return stacked, seconds


def split_batches(*batches: Any) -> list[tuple]:
    """Split batches of equal size into tuples of their elements, with arrays on the device."""
    num = len(jax.tree.leaves(batches)[0])
    return [jax.tree.map(lambda leaf, k=k: jnp.asarray(leaf[k]), batches) for k in range(num)]


def table_of_planners(bench: Bench, problems: Any, compared: Comparison) -> dict[str, Judged]:
    """Plan the speed in all problems with every planner, and print one row for each planner.

    In a problem, a car must reach the end of a path at a given time and avoid moving obstacles.
    Returns the results by planner.
    """
    named = planners(compared)
    single = {
        name: jax.jit(lambda problem, planner=planner: plan_speed(problem, planner))
        for name, planner in named.items()
    }
    single[CONSTANT] = jax.jit(constant_speed)
    planned, seconds = run_in_turns(single, split_batches(problems))
    bench.say(
        "| planner, pieces | good | rms acc. [m/s2] | peak acc. [m/s2] | peak jerk [m/s3] "
        "| greatest end error [m] | least clearance [m] | p50 / p95 / p99 [ms] |",
        "|---|---|---|---|---|---|---|---|",
    )
    judged = {}
    for name in single:
        if name == CONSTANT:
            points, solved = planned[name].points, np.ones(len(problems.horizon), bool)
        else:
            points, solved = planned[name].curve.points, planned[name].status == Status.CONVERGED
        judged[name] = found = judge(problems, points, solved)
        good = found.good
        times = 1e3 * np.percentile(seconds[name], [50, 95, 99])
        figures = {
            "good": good.mean(),
            "rms": found.rms[good].mean(),
            "peak": found.peak[good].mean(),
            "jerk": found.jerk[good].mean(),
            "end_error": found.end_error[good].max(),
            "clearance": found.clearance[solved].min(),
        }
        bench.say(
            f"| {name} | {100 * figures['good']:.1f} % | {figures['rms']:.4f} | "
            f"{figures['peak']:.4f} | {figures['jerk']:.3f} | {figures['end_error']:.1e} | "
            f"{figures['clearance']:.4f} | {times[0]:.3f} / {times[1]:.3f} / {times[2]:.3f} |"
        )
        bench.row(table="planners", planner=name, **figures, ms=times)
    bench.say("", *_compare_pairs(bench, compared.pairs, judged, seconds))
    return judged


def _compare_pairs(
    bench: Bench,
    pairs: tuple[tuple[str, str], ...],
    judged: dict[str, Judged],
    seconds: dict[str, np.ndarray],
) -> list[str]:
    """Return the lines of a table that compares pairs of planners on problems that both solve.

    `seconds` has by planner the planning time [s] of each problem.
    """
    lines = [
        "| planner and reference | both good | good, difference | rms acc. | peak acc. "
        "| time, median |",
        "|---|---|---|---|---|---|",
    ]
    for pieces in PIECES:
        for pair in pairs:
            ours, theirs = (f"{name}, {pieces}" for name in pair)
            one, other = judged[ours], judged[theirs]
            both = one.good & other.good
            figures = {
                "both_good": both.mean(),
                "more_good": one.good.mean() - other.good.mean(),
                "rms": one.rms[both].mean() / other.rms[both].mean() - 1.0,
                "peak": one.peak[both].mean() / other.peak[both].mean() - 1.0,
                "time": np.median(seconds[ours] / seconds[theirs]) - 1.0,
            }
            lines.append(
                f"| {ours} beside {pair[1]} | {100 * figures['both_good']:.1f} % | "
                f"{100 * figures['more_good']:+.1f} points | {100 * figures['rms']:+.1f} % | "
                f"{100 * figures['peak']:+.1f} % | {100 * figures['time']:+.1f} % |"
            )
            bench.row(table="pairs", planner=ours, beside=theirs, **figures)
    return lines


def table_of_solvers(bench: Bench, problems: Any, compared: Comparison) -> list[np.ndarray]:
    """Solve quadratic programs with this library, Clarabel and OSQP, and print a table.

    The programs plan the speed of a car along a path, with least acceleration. Returns by what
    fraction this library's costs exceed Clarabel's costs, an array for each planner.
    """
    bench.say(
        "",
        "| program of | solver | solved | cost above Clarabel's, median / 95 % / largest "
        "| p50 / p95 / p99 [ms] |",
        "|---|---|---|---|---|",
    )
    gaps = []
    named = planners(compared)
    for name in (f"{kind}, {pieces}" for pieces in PIECES for kind in compared.solved):
        rows = solve_by_all(problems, named[name])
        for solver, (solved, cost, seconds) in rows.items():
            times = 1e3 * np.nanpercentile(seconds, [50, 95, 99])
            gap = np.full(3, np.nan)
            if "clarabel" in rows:
                best_solved, best, _ = rows["clarabel"]
                both = solved & best_solved
                relative = cost[both] / best[both] - 1.0
                gap = np.percentile(relative, [50, 95, 100])
                gaps += [relative] if solver == OURS else []
            bench.say(
                f"| {name} | {solver} | {100 * solved.mean():.1f} % | "
                f"{gap[0]:.1e} / {gap[1]:.1e} / {gap[2]:.1e} | "
                f"{times[0]:.3f} / {times[1]:.3f} / {times[2]:.3f} |"
            )
            bench.row(table="solvers", planner=name, solver=solver, ms=times, gaps=gap)
    missing = [peer for peer in PEERS if not is_installed(peer)]
    if missing:
        bench.say(f"{' and '.join(missing)} not installed: {INSTALL}")
    return gaps


def solve_by_all(problems: Any, planner: SpeedPlanner) -> dict[str, tuple]:
    """Solve a planner's quadratic programs for B problems with every installed solver.

    Returns by solver which programs are solved (B,), the costs (B,) and the durations (B,) [s].
    """
    programs = jax.jit(jax.vmap(lambda problem: program_of(problem, planner)))(problems)
    template = speed_template(planner)
    solve = jax.jit(lambda *program: solve_qp(template, *program))
    results, seconds = run_in_turns({OURS: solve}, split_batches(*programs))
    found = results[OURS]
    rows: dict[str, tuple] = {
        OURS: (found.status == Status.CONVERGED, found.cost.astype(float), seconds[OURS])
    }
    on_host = list(zip(*map(np.asarray, programs), strict=True))
    for peer, make in PEERS.items():
        if is_installed(peer):
            run = make(speed_matrices(planner))
            # OSQP starts at its previous solution. To give no solver an advantage, all programs are
            # solved once before any of them is solved again.
            tries = [[run(*program) for program in on_host] for _ in range(3)]
            rows[peer] = (
                np.array([each.solved for each in tries[0]]),
                np.array([each.cost for each in tries[0]]),
                np.min([[one.seconds for one in each] for each in tries], axis=0),
            )
    return rows


def program_of(problem: Any, planner: SpeedPlanner) -> tuple:
    """Return the numbers of a planner's quadratic program that depend on the problem.

    These are the right-hand sides of the equalities, and the bounds of the inequalities.
    """
    return speed_bounds(problem, reference_line(problem, planner.grid), planner)


def table_of_batches(bench: Bench, problems: Any, batch: int) -> None:
    """Print how many plans, and how many quadratic programs alone, a device solves per second."""
    places = np.arange(batch) % len(problems.horizon)
    many = jax.device_put(jax.tree.map(lambda leaf: leaf[places], problems))
    bench.say("", "| batch | planner, pieces | plans/s | programs alone, 1/s |")
    bench.say("|---|---|---|---|")
    for name, planner in planners().items():
        if not name.startswith("trapezoid,"):
            continue
        template = speed_template(planner)
        programs = jax.jit(jax.vmap(lambda problem, planner=planner: program_of(problem, planner)))(
            many
        )
        whole = jax.jit(jax.vmap(lambda problem, planner=planner: plan_speed(problem, planner)))
        alone = jax.jit(jax.vmap(lambda *program, t=template: solve_qp(t, *program)))
        rates = {}
        for kind, run, given in (("plans", whole, (many,)), ("programs", alone, programs)):
            seconds = []
            for _ in range(6):
                began = time.perf_counter()
                jax.block_until_ready(run(*given))
                seconds.append(time.perf_counter() - began)
            rates[kind] = batch / np.median(seconds[1:])
        bench.say(f"| {batch} | {name} | {rates['plans']:.3g} | {rates['programs']:.3g} |")
        bench.row(table="batches", batch=batch, planner=name, **rates)


def main() -> None:
    parser = argument_parser("intercept_speed", __doc__, num=500, seed=0)
    parser.add_argument(
        "--batch", type=at_least(0), default=0, help="problems in a batch; default: 0, no batch"
    )
    parser.add_argument("--paper", action="store_true", help="only the planners of Table II")
    options = parser.parse_args()
    compared = PAPER if options.paper else ALL
    with begin(parser, options) as bench:
        problems = speed_problems(options.num, options.seed)
        bench.say(
            f"{options.num} problems, seed {options.seed}, {jax.devices()[0].platform}, "
            f"jax {jax.__version__}, load average {os.getloadavg()[0]:.1f}",
            "",
        )
        judged = table_of_planners(bench, problems, compared)
        if options.paper:
            rows = (
                each for each in PUBLISHED if (each.paper, each.table) == ("Qu2022", "Table II")
            )
            bench.say("", *(f"[Qu2022, Table II] {each.row}: {each}" for each in rows))
        gaps = table_of_solvers(bench, problems, compared)
        if options.batch:
            table_of_batches(bench, problems, options.batch)
        bench.count(judged[f"{compared.solved[0]}, {PIECES[0]}"].good, *gaps)


if __name__ == "__main__":
    main()
