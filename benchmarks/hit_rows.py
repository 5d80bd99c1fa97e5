"""Refereed success of a hit planner on every row of the published protocol.

    python -m benchmarks.hit_rows --serves DIR [--rows base,late-0.5] [--num N] [--out DIR]

Without --serves the serves are drawn by the generator (seed 0). Rows: the base start, a start
drawn over the half court, planning that begins late, weaker limits, and drag after the
impact. Prints a table and, with --out, writes rows.json and the indices of the failures.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np

from planner_jax.protocol import is_solved
from planner_jax.referee.hit import referee_hits
from planner_jax.sweep.summary import wilson_interval
from planner_jax.task.hit.exact import ExactHit
from planner_jax.task.hit.serves import Serves, generate_serves, read_serves, to_scenarios
from planner_jax.task.solve import plan

ROWS: dict[str, dict] = {
    "base": {},
    "uniform-start": {"start": "uniform"},
    **{f"late-{delay}": {"delay": delay} for delay in (0.3, 0.5, 0.6, 0.8)},
    **{f"limits-{scale}": {"limit_scale": scale} for scale in (0.7, 0.5, 0.35)},
    "drag-after-impact": {},
}


def run_row(name: str, serves: Serves) -> tuple[dict, np.ndarray]:
    """One row's figures, and which of its lanes failed."""
    drag_after = name == "drag-after-impact"
    planner = ExactHit(drag_after_impact=drag_after)
    scenarios = to_scenarios(serves, **ROWS[name])
    began = time.perf_counter()
    plan(planner, scenarios)
    first = time.perf_counter() - began
    began = time.perf_counter()
    plans = plan(planner, scenarios)
    warm = time.perf_counter() - began
    verdict = referee_hits(scenarios, plans, drag_after_impact=drag_after)
    solved = verdict.success
    low, high = wilson_interval(int(solved.sum()), solved.size)
    figures = {
        "row": name,
        "num": solved.size,
        "failures": int((~solved).sum()),
        "success": float(solved.mean()),
        "wilson_95": [low, high],
        "first_seconds": first,
        "warm_seconds": warm,
        "plans_per_second_warm": solved.size / warm,
        "median_cost": float(np.median(plans.cost)),
        "refused_by_referee_alone": int((is_solved(plans.status) & ~solved).sum()),
        "largest_landing_error": float(verdict.landing_error[solved].max(initial=0.0)),
    }
    return figures, np.flatnonzero(~solved)


def main() -> None:
    """Run the rows asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--serves", type=Path, help="folder of published trial files")
    parser.add_argument("--rows", default=",".join(ROWS), help="comma-separated; default all")
    parser.add_argument("--num", type=int, default=9000)
    parser.add_argument("--out", type=Path, help="folder for rows.json and failure indices")
    args = parser.parse_args()
    names = args.rows.split(",")
    for name in names:
        if name not in ROWS:
            parser.error(f"argument --rows: must be among {', '.join(ROWS)}, got {name!r}")
    serves = read_serves(args.serves) if args.serves else generate_serves(args.num, 0)
    serves = serves[: args.num]
    print("| row | success | failures | 95 % interval | warm [s] | plans/s | median cost |")
    print("|---|---|---|---|---|---|---|")
    results = []
    for name in names:
        figures, failures = run_row(name, serves)
        results.append(figures)
        low, high = figures["wilson_95"]
        print(
            f"| {name} | {100 * figures['success']:.3f} % | {figures['failures']} of "
            f"{figures['num']} | {100 * low:.2f}..{100 * high:.2f} | "
            f"{figures['warm_seconds']:.2f} | {figures['plans_per_second_warm']:.0f} | "
            f"{figures['median_cost']:.3g} |",
            flush=True,
        )
        if args.out:
            args.out.mkdir(parents=True, exist_ok=True)
            np.save(args.out / f"failures-{name}.npy", failures)
            (args.out / "rows.json").write_text(json.dumps(results, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
