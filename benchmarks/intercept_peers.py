"""Compare all planners of interceptions on the same cases, beside Tables II and III of [Qu2022].

    python -m benchmarks.intercept_peers [--suite hard] [--num 200] [--timed 50] [--out DIR]

A car meets a moving target among obstacles. The referee, an independent check in float64, decides
about success, whatever a planner reports. The tables list the root mean square and the greatest
acceleration along the trajectory, as means over successful plans. Two planners of a pair are
compared on the cases where both succeed. The planners `lattice, best path` and `em` drive along the
same path, so that only their speeds differ.

Times are for one case at a time, from arrays to arrays, without compilation. For each of --timed
cases the fastest of three calls counts. Planners that first search a path and then plan the speed
along it have a time for each part. The first call of a process is reported separately. It includes
compilation, unless JAX's compile cache holds the program. The planner `paper`, whose search is
compiled by numba, is left out if the extra `baselines` is not installed.

The paper's tables are for one scenario, which the paper does not specify, on another computer. The
columns "Max Acc." and "Ave. Acc." of its Table II are presumably swapped, because the printed
average values exceed the maximum values.
"""

import dataclasses
import importlib.util
import os
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax as pj
from planner_jax.baselines.intercept.paper import PaperIntercept, paper_speed_step
from planner_jax.baselines.intercept.path_then_speed import PathThenSpeed
from planner_jax.baselines.protocols import BY_ROW
from planner_jax.benchmarks.run import Bench, argument_parser, at_least, begin
from planner_jax.benchmarks.speed_problems import SOFT_END
from planner_jax.referee.intercept import InterceptVerdict
from planner_jax.task.intercept.spec import SUITES

BASELINES = "numba not installed: pip install 'planner-jax[baselines]' for the planner paper"
PAIRS = (
    ("spacetime", "em"),
    ("effort best", "lattice"),
    ("lattice, best path", "em"),
    ("lattice, best path", "constant"),
    ("lattice", "em"),
    ("paper", "em"),
)
PARTS = ("path", "speed", "total")  # parts of a plan in Table III of [Qu2022]


def planners() -> dict[str, Any]:
    """Return the planners of interceptions by name, with `paper` only if numba is installed."""
    named = {
        **{name: pj.intercept.planner(name) for name in ("spacetime", "quick")},
        "effort best": pj.intercept.planner(effort="best"),
        "lattice": pj.intercept.planner("lattice"),
        "lattice, best path": pj.intercept.planner("lattice", tries=1),
        "em": pj.intercept.planner("em"),
        "constant": pj.intercept.planner("constant"),
    }
    if importlib.util.find_spec("numba") is not None:
        named["paper"] = pj.intercept.planner("paper")
        named["paper, soft end"] = pj.intercept.planner("paper", step=paper_speed_step(SOFT_END))
    return named


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Results of one planner on all cases: verdicts, statuses, and the time of the first call."""

    verdict: InterceptVerdict
    status: np.ndarray  # (B,), the planner's own report for each case
    first_call: float  # [s], duration of the first call, with compilation


def run_planner(planner: Any, cases: Any) -> Outcome:
    """Plan a batch of cases in one call, time the call, and judge the plans."""
    began = time.perf_counter()
    plans = jax.tree.map(np.asarray, pj.plan(planner, cases))
    seconds = time.perf_counter() - began
    return Outcome(pj.intercept.judge(cases, plans), plans.status, seconds)


def split_planner(planner: Any) -> dict[str, Callable]:
    """Return the parts of a planner as functions, such as the path search and the speed planner.

    Each function takes the result of the function before it; the first takes a case.
    """
    if isinstance(planner, PathThenSpeed):
        attempt = planner.attempts[0]
        return {
            "path": jax.jit(lambda case: (case, planner.source.paths(case, attempt))),
            "speed": jax.jit(lambda found: planner.best_drive(*found)),
        }
    if isinstance(planner, PaperIntercept):
        smooth = jax.jit(
            lambda case, searched: (case, planner.path(case, searched[0], searched[1], searched[2]))
        )
        return {
            "path": lambda case: smooth(case, planner.search_path(case)),
            "speed": jax.jit(
                lambda found: planner.step.drive(
                    found[0], found[1], planner.step.problem(found[0], found[1])
                )
            ),
        }
    attempt = planner.attempts[0]
    return {"total": jax.jit(lambda case: planner.solve(case, attempt))}


def time_parts(planner: Any, lanes: list) -> dict[str, np.ndarray]:
    """Plan N cases one by one; return durations (N,) [s] of each part and of all parts together.

    The parts of a planner are, for example, path search and speed planning. All programs are
    compiled before, and the fastest of three calls counts.
    """
    parts = split_planner(planner)
    best = {name: np.full(len(lanes), np.inf) for name in (*parts, "total")}
    given = lanes[0]
    for part in parts.values():
        given = jax.block_until_ready(part(given))
    for k, lane in enumerate(lanes):
        for _ in range(3):
            given, total = lane, 0.0
            for name, part in parts.items():
                began = time.perf_counter()
                given = jax.block_until_ready(part(given))
                spent = time.perf_counter() - began
                total += spent
                best[name][k] = min(best[name][k], spent)
            best["total"][k] = min(best["total"][k], total)
    return best


def mean_of(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else np.nan


def table_of_outcomes(bench: Bench, outcomes: dict[str, Outcome]) -> None:
    """Print a row for each planner: success rate, accelerations, and statuses of failures."""
    bench.say(
        "| planner | success | solved by status, rejected | rms acc. [m/s2] | peak acc. [m/s2] "
        "| failures | first call [s] |",
        "|---|---|---|---|---|---|---|",
    )
    for name, found in outcomes.items():
        verdict, good = found.verdict, found.verdict.success
        claimed = (found.status == pj.Status.CONVERGED) | (found.status == pj.Status.FEASIBLE)
        reasons = {
            pj.Status(value).name: int((found.status[~claimed] == value).sum())
            for value in np.unique(found.status[~claimed])
        }
        listed = ", ".join(f"{number} {reason}" for reason, number in reasons.items()) or "none"
        figures = {
            "success": good.mean(),
            "refused": int((claimed & ~good).sum()),
            "rms": mean_of(verdict.rms_acceleration[good]),
            "peak": mean_of(verdict.max_acceleration[good]),
        }
        bench.say(
            f"| {name} | {100 * figures['success']:.1f} % | {figures['refused']} | "
            f"{figures['rms']:.3f} | {figures['peak']:.3f} | {listed} | {found.first_call:.1f} |"
        )
        bench.row(table="outcomes", planner=name, **figures, reasons=reasons)


def table_of_accelerations(bench: Bench, outcomes: dict[str, Outcome]) -> None:
    """Print mean accelerations of two planners at a time, on cases where both succeed.

    The first row has the values of Table II of [Qu2022].
    """
    bench.say(
        "",
        "| Table II | both succeed | rms acc. [m/s2] | reference | less | peak acc. "
        "| reference | less |",
        "|---|---|---|---|---|---|---|---|",
    )
    rms, peak, rms_em, peak_em = (
        BY_ROW["Qu2022", "Table II", row].value
        for row in ("theirs max", "theirs ave", "EM max", "EM ave")
    )
    bench.say(
        f"| theirs beside EM, as printed, columns swapped | - | {rms:.3f} | {rms_em:.3f} | "
        f"{100 * (1 - rms / rms_em):.1f} % | {peak:.3f} | {peak_em:.3f} | "
        f"{100 * (1 - peak / peak_em):.1f} % |"
    )
    for pair in PAIRS:
        if not all(name in outcomes for name in pair):
            continue
        one, other = (outcomes[name].verdict for name in pair)
        both = one.success & other.success
        figures = {
            name: (mean_of(getattr(one, leaf)[both]), mean_of(getattr(other, leaf)[both]))
            for name, leaf in (("rms", "rms_acceleration"), ("peak", "max_acceleration"))
        }
        cells = " | ".join(
            f"{ours:.3f} | {theirs:.3f} | {100 * (1 - ours / theirs):.1f} %"
            for ours, theirs in figures.values()
        )
        bench.say(f"| {pair[0]} beside {pair[1]} | {100 * both.mean():.1f} % | {cells} |")
        bench.row(table="II", planner=pair[0], beside=pair[1], both=both.mean(), **figures)


def table_of_times(bench: Bench, named: dict[str, Any], lanes: list) -> None:
    """Print each planner's times to plan the path, to plan the speed, and to plan both.

    The first row has the values of Table III of [Qu2022].
    """
    bench.say(
        "",
        "| Table III, p50 / p95 / p99 [ms] | path | speed | total |",
        "|---|---|---|---|",
        f"| theirs, as printed, mean | "
        f"{' | '.join(str(BY_ROW['Qu2022', 'Table III', part]) for part in PARTS)} |",
    )
    for name, planner in named.items():
        seconds = time_parts(planner, lanes)
        times = {part: 1e3 * np.percentile(each, [50, 95, 99]) for part, each in seconds.items()}
        cells = [
            " / ".join(f"{value:.1f}" for value in times[part]) if part in times else "-"
            for part in PARTS
        ]
        bench.say(f"| {name} | {' | '.join(cells)} |")
        bench.row(table="III", planner=name, ms=times)


def main() -> None:
    parser = argument_parser("intercept_peers", __doc__, num=200, seed=0)
    parser.add_argument("--suite", choices=list(SUITES), default="hard", help="default: hard")
    parser.add_argument("--timed", type=at_least(1), default=50, help="timed cases; default: 50")
    options = parser.parse_args()
    with begin(parser, options) as bench:
        cases = pj.intercept.draw(options.num, options.suite, options.seed)
        bench.say(
            f"{options.num} cases of suite {options.suite}, seed {options.seed}, "
            f"{jax.devices()[0].platform}, jax {jax.__version__}, load average "
            f"{os.getloadavg()[0]:.1f}",
            "",
        )
        named = planners()
        if "paper" not in named:
            bench.say(BASELINES, "")
        on_host = jax.tree.map(np.asarray, cases)
        outcomes = {name: run_planner(planner, on_host) for name, planner in named.items()}
        table_of_outcomes(bench, outcomes)
        table_of_accelerations(bench, outcomes)
        num = min(options.timed, options.num)
        lanes = [jax.tree.map(jnp.asarray, pj.take(on_host, k)) for k in range(num)]
        table_of_times(bench, named, lanes)
        bench.count(outcomes["lattice"].verdict.success)


if __name__ == "__main__":
    main()
