"""Search with a slow, independent solver for feasible hits, in cases that planners do not solve.

    python -m benchmarks.oracle_hit [--serves DIR] [--delay S] [--limit-scale F]
        [--failures RUN/plans | --indices FILE.npy] [--num N] [--starts K] [--out DIR]

A quadrotor hits a served ball with a racket such that it lands at a target. The search takes a
sample of serves, for example serves for which a planner failed. It shares no code with the
planners, and solves a nonlinear program by direct transcription. The quadrotor's snap is constant
on pieces of free duration, so position to jerk are continuous. The impact and the ball's flight to
the target are equality constraints. Limits are inequalities at samples of every piece. IPOPT
minimises the excess: the largest relative amount by which a limit is exceeded.

Each search starts with few pieces, from one of several starting points. If the excess is small, the
pieces are halved, and limits that are exceeded between samples are tightened on their piece. A hit
counts only if the library's referee, an independent check in float64, accepts it.

A hit that is found proves that its case is feasible. If no hit is found, nothing is proven. But if
all starting points lead to the same excess, the case probably becomes feasible only if all limits
are relaxed by this excess. The program needs the extra `oracle` (CasADi).
"""

import argparse
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.benchmarks.hit_oracle.search import STARTS, Finding, find_hits, starting_points
from planner_jax.benchmarks.run import Bench, argument_parser, begin
from planner_jax.core.errors import ArgumentError
from planner_jax.runs.dataset import Dataset
from planner_jax.runs.summary import wilson_interval
from planner_jax.task.hit.published import read_serves
from planner_jax.task.hit.suites import generate_serves, to_cases

NUM_GENERATED = 9000  # Number of serves that are drawn if no folder of serves is passed.
VERDICTS = ("feasible", "infeasible", "undecided")


def read_failures(plans: Path) -> np.ndarray:
    """Read from the folder `plans` of a sweep the indices of serves whose plans failed."""
    table = Dataset(plans).read(["index", "success"])
    return table["index"].to_numpy()[~table["success"].to_numpy()]


def summarise(findings: list[Finding]) -> dict:
    """Return number and share of cases with each verdict, excesses over limits, and CPU times.

    The verdicts are "feasible", "infeasible" and "undecided". Excesses are of infeasible cases.
    """
    num, verdicts = len(findings), {}
    for name in VERDICTS:
        count = sum(finding.verdict == name for finding in findings)
        interval = list(wilson_interval(count, num))
        verdicts[name] = {"count": count, "share": count / num, "wilson_95": interval}
    excess = [f.least_excess for f in findings if f.verdict == "infeasible"]
    quartiles = np.quantile(excess, (0.0, 0.25, 0.5, 0.75, 1.0)).tolist() if excess else None
    seconds = np.array([finding.cpu_seconds for finding in findings])
    return {
        "num": num,
        **verdicts,
        "least_excess_quartiles_of_infeasible": quartiles,
        "cpu_seconds_median": float(np.median(seconds)),
        "cpu_seconds_p90": float(np.quantile(seconds, 0.9)),
        "cpu_seconds": float(seconds.sum()),
    }


def format_table(summary: dict) -> str:
    """Format numbers of feasible, infeasible and undecided cases as a Markdown table and sentences.

    `summary` also has the excesses over limits of the infeasible cases, and CPU times.
    """
    lines = ["| verdict | cases | share | 95 % interval |", "|---|---|---|---|"]
    for name in VERDICTS:
        row = summary[name]
        low, high = (100.0 * bound for bound in row["wilson_95"])
        share = 100.0 * row["share"]
        lines.append(f"| {name} | {row['count']} | {share:.1f} % | {low:.1f}..{high:.1f} % |")
    if quartiles := summary["least_excess_quartiles_of_infeasible"]:
        listed = ", ".join(f"{100.0 * value:.1f}" for value in quartiles)
        lines += ["", f"Least excess over the limits of infeasible cases, quartiles: {listed} %."]
    lines += [
        "",
        f"{summary['cpu_seconds_median']:.2f} s of CPU time a case (median), "
        f"{summary['cpu_seconds_p90']:.2f} s (90 %), {summary['cpu_seconds']:.0f} s in all.",
    ]
    return "\n".join(lines)


def write_findings(
    bench: Bench, summary: dict, indices: np.ndarray, findings: list[Finding]
) -> None:
    """Store in the run folder a row for each case, and hits.npz with all feasible trajectories."""
    for index, finding in zip(indices, findings, strict=True):
        numbers = {k: v for k, v in vars(finding).items() if k not in ("coeffs", "durations")}
        bench.row(index=index, verdict=finding.verdict, **numbers)
    bench.count([finding.feasible for finding in findings])
    bench.note(**summary)
    hits = [(i, f) for i, f in zip(indices, findings, strict=True) if f.feasible]
    np.savez(
        bench.path / "hits.npz",
        index=np.array([i for i, _ in hits], int),
        coeffs=np.array([f.coeffs for _, f in hits]),
        durations=np.array([f.durations for _, f in hits]),
    )


def make_parser() -> argparse.ArgumentParser:
    parser = argument_parser("oracle_hit", __doc__, num=200, starts=len(STARTS), seed=0, workers=1)
    add = parser.add_argument
    add("--serves", type=Path, help="folder of published trial files (default: draw serves)")
    add("--delay", type=float, default=0.0, help="time from the serve to the planning [s]")
    add(
        "--limit-scale",
        type=float,
        default=1.0,
        help="factor of the limits on speed, acceleration and body rate",
    )
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--failures",
        type=Path,
        help="folder `plans` of a sweep; its failures are judged (default: all serves)",
    )
    which.add_argument("--indices", type=Path, help=".npy file with indices of serves")
    return parser


def main() -> None:
    parser = make_parser()
    options = parser.parse_args()
    try:
        drawn = functools.partial(generate_serves, NUM_GENERATED, options.seed)
        serves = read_serves(options.serves) if options.serves else drawn()
        pool = np.arange(len(serves))
        if options.failures:
            pool = read_failures(options.failures)
        elif options.indices:
            pool = np.load(options.indices)
        if not (pool.size and 0 <= pool.min() and pool.max() < len(serves)):
            parser.error(f"indices must be some of 0..{len(serves) - 1}, got {pool}")
        sample = np.random.default_rng(options.seed).permutation(pool)[: options.num]
        with jax.enable_x64(True):
            cases = to_cases(
                serves[sample],
                delay=options.delay,
                limit_scale=options.limit_scale,
                dtype=jnp.float64,
            )
    except (ArgumentError, OSError, ValueError) as error:
        parser.error(str(error))
    with begin(parser, options) as bench:
        starts = starting_points(options.starts, options.seed)
        findings = find_hits(cases, starts, workers=options.workers)
        summary = summarise(findings) | {"of": int(pool.size)}
        bench.say(format_table(summary))
        write_findings(bench, summary, sample, findings)


if __name__ == "__main__":
    main()
