"""Refereed success of the catch planners on every suite, beside the paper's rates.

    python -m benchmarks.catch_rows [--suites throws,hard] [--planners exact,catch,mpp]
        [--decide best] [--num 1000] [--seed 0] [--out DIR]

Every plan is judged with a tolerance of 1e-3. The paper's `catch` has soft penalties, so it is
judged a second time by the protocol of the published C++ program: limits to 5 %, the ball
within the net's radius of its centre. Prints a table and, with --out, writes rows.json.
"""

import argparse
import json
import time
from pathlib import Path

import jax

from planner_jax.referee.catch import referee_catches
from planner_jax.sweep.catch.published import PUBLISHED
from planner_jax.sweep.summary import wilson_interval
from planner_jax.task.catch.decide import DECISIONS, optimal_time_ratio, plan_catches
from planner_jax.task.catch.planners import PLANNERS, catch_planner
from planner_jax.task.catch.suites import SUITES, make_suite


def run_row(suite: str, name: str, decide: str, num: int, seed: int) -> dict:
    """One suite's figures with one planner."""
    chosen, scenarios = catch_planner(name), make_suite(suite, num, seed)
    began = time.perf_counter()
    plan_catches(chosen, scenarios, decide)
    first = time.perf_counter() - began
    began = time.perf_counter()
    ordered, plans = plan_catches(chosen, scenarios, decide)
    warm = time.perf_counter() - began
    verdict = referee_catches(ordered, plans)
    loose = referee_catches(ordered, plans, tolerance=0.05, net_test="ball")
    solved = verdict.success
    ratio = optimal_time_ratio(ordered, plans)
    return {
        "suite": suite,
        "planner": name,
        "decide": decide,
        "num": num,
        "seed": seed,
        "success": float(solved.mean()),
        "wilson_95": wilson_interval(int(solved.sum()), num),
        "success_protocol": float(loose.success.mean()),
        "caught": float(verdict.num_caught.mean() / max(SUITES[suite].num_targets, 1)),
        "optimal_time_ratio": float(ratio[solved].mean()) if solved.any() else None,
        "mean_last_catch": float(plans.times[solved, -1].mean()) if solved.any() else None,
        "first_seconds": first,
        "warm_seconds": warm,
        "plans_per_second_warm": num / warm,
    }


def _chosen(parser: argparse.ArgumentParser, flag: str, text: str, known) -> list[str]:
    names = text.split(",")
    for name in names:
        if name not in known:
            parser.error(f"argument {flag}: must be among {', '.join(known)}, got {name!r}")
    return names


def main() -> None:
    """Run the rows asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--suites", default=",".join(SUITES), help="comma-separated; default all")
    parser.add_argument("--planners", default="exact", help=f"of {', '.join(PLANNERS)}")
    parser.add_argument("--decide", choices=DECISIONS, default="best")
    parser.add_argument("--num", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder for rows.json")
    args = parser.parse_args()
    suites = _chosen(parser, "--suites", args.suites, SUITES)
    names = _chosen(parser, "--planners", args.planners, PLANNERS)
    print(f"{args.num} cases each, seed {args.seed}, decide {args.decide}, {jax.devices()[0]}")
    print(
        "| suite | planner | success | 95 % | by the protocol | paper | OTR | last catch | warm |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    rows = []
    for suite in suites:
        for name in names:
            row = run_row(suite, name, args.decide, args.num, args.seed)
            rows.append(row)
            low, high = row["wilson_95"]
            ratio, last = (
                "-" if row[key] is None else f"{row[key]:.3f}"
                for key in ("optimal_time_ratio", "mean_last_catch")
            )
            print(
                f"| {suite} | {name} | {100 * row['success']:.2f} % | "
                f"{100 * low:.2f}..{100 * high:.2f} | {100 * row['success_protocol']:.2f} % | "
                f"{PUBLISHED[suite].success or '-'} | {ratio} | {last} s | "
                f"{row['warm_seconds']:.2f} s |",
                flush=True,
            )
            if args.out:
                args.out.mkdir(parents=True, exist_ok=True)
                (args.out / "rows.json").write_text(json.dumps(rows, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
