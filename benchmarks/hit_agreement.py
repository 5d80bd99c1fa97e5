"""Compare reimplemented planners of hits with the outcomes that [Yu2023bat] published per serve.

    python -m benchmarks.hit_agreement --serves DIR [--rows bat,bat-300] [--num 9000] [--out DIR]

The trial files state for each serve whether the planners Bat, Bat-Lite and Juggle of the paper's
authors succeeded. A row plans the same serves by a planner of this library of the same name:
* `bat` and `bat-lite` with 80 iterations, a number that is fitted to the published rates;
* `bat-300` and `bat-lite-300` with 300 iterations, after which the searches have converged;
* `juggle` with the coefficient of restitution of the paper, 0.7;
* `juggle-0.32` with the coefficient that the published hits of Juggle imply.

"Same outcome" is the share of serves on which both planners succeed or both fail. Cohen's kappa is
the share of agreement beyond chance: 0 for independent outcomes, 1 for equal outcomes. The
correlation is of the success rates in the 36 scenarios of the court. The referee, an independent
check in float64, decides about the success of this library's planners.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.run import Bench, argument_parser, begin, parse_names
from planner_jax.runs.summary import wilson_interval
from planner_jax.task.hit import court
from planner_jax.task.hit.suites import Serves

# Row -> planner, number of iterations of L-BFGS, and coefficient of restitution; None: the default.
ROWS: dict[str, tuple[str, int | None, float | None]] = {
    "bat": ("bat", None, None),
    "bat-300": ("bat", 300, None),
    "bat-lite": ("bat-lite", None, None),
    "bat-lite-300": ("bat-lite", 300, None),
    "juggle": ("juggle", None, None),
    "juggle-0.32": ("juggle", None, 0.32),
}


def kappa(one: np.ndarray, other: np.ndarray) -> float:
    """Return Cohen's kappa of two arrays of outcomes (N,) bool."""
    same = (one == other).mean()
    chance = one.mean() * other.mean() + (1.0 - one.mean()) * (1.0 - other.mean())
    return (same - chance) / (1.0 - chance)


def run_row(bench: Bench, name: str, serves: Serves) -> dict[str, Any]:
    """Plan serves by the planner of a row; return rates, agreement and correlation."""
    planner_name, iterations, restitution = ROWS[name]
    planner: Any = pj.hit.planner(planner_name)
    cases = pj.hit.to_cases(serves)
    if iterations is not None:
        (full,) = planner.attempts
        solver = dataclasses.replace(full.solver, max_steps=iterations)
        planner = dataclasses.replace(planner, attempts=(dataclasses.replace(full, solver=solver),))
    if restitution is not None:
        filled = np.full_like(cases.restitution, restitution)
        cases = dataclasses.replace(cases, restitution=filled)
    success = pj.hit.judge(cases, pj.plan(planner, cases)).success
    bench.count(success)
    assert serves.published is not None
    outcome = serves.published[:, court.PLANNERS.index(planner_name)]
    known = np.isfinite(outcome)
    ours, theirs, scenario = success[known], outcome[known] == 1.0, serves.scenario[known]
    rates = [[each[scenario == k].mean() for k in np.unique(scenario)] for each in (ours, theirs)]
    return {
        "row": name,
        "num": int(known.sum()),
        "success": ours.mean(),
        "wilson_95": wilson_interval(int(ours.sum()), ours.size),
        "published": theirs.mean(),
        "same": (ours == theirs).mean(),
        "kappa": kappa(ours, theirs),
        "correlation": np.corrcoef(np.array(rates))[0, 1],
    }


def main() -> None:
    parser = argument_parser("hit_agreement", __doc__, num=9000)
    parser.add_argument(
        "--serves", type=Path, required=True, help="folder of published trial files"
    )
    parser.add_argument(
        "--rows", default=",".join(ROWS), help="rows, comma-separated; default: all"
    )
    options = parser.parse_args()
    names = parse_names(parser, "--rows", options.rows, ROWS)
    serves = pj.hit.read_serves(options.serves)[: options.num]
    with begin(parser, options) as bench:
        bench.say(
            "| row | serves | success | 95 % interval | published, same serves | same outcome "
            "| kappa | correlation |",
            "|---|---|---|---|---|---|---|---|",
        )
        for name in names:
            row = run_row(bench, name, serves)
            low, high = row["wilson_95"]
            bench.say(
                f"| {name} | {row['num']} | {100 * row['success']:.1f} % | {100 * low:.1f} to "
                f"{100 * high:.1f} % | {100 * row['published']:.1f} % | {100 * row['same']:.1f} % "
                f"| {row['kappa']:.2f} | {row['correlation']:.2f} |"
            )
            bench.row(**row)


if __name__ == "__main__":
    main()
