"""Measure reimplemented planners of hits on published serves, beside the results of [Yu2023bat].

    python -m benchmarks.hit_published [--serves DIR] [--rows bat,juggle] [--num 9000] [--home]
                                       [--sensitivity] [--tune juggle] [--out DIR]

The trial files in DIR (default: ../shared/data/serves) state for each serve whether the planners
Bat, Bat-Lite and Juggle of the paper's authors succeeded. A row plans the same serves by a planner
of this library, and compares it with the authors' planner of the same name, or with Bat:
* `bat` and `bat-lite` search until the stopping rule of LBFGS-Lite holds;
* `bat-fitted` and `bat-lite-fitted` stop after 80 iterations, which are fitted to published rates;
* `juggle` has the coefficient of restitution of the paper, 0.7, and `juggle-0.32` the coefficient
  that the published hits of Juggle imply;
* `exact` is the default planner of this library.

A success is a plan within the limits that sends the ball to the target, decided by the referee, an
independent check in float64. With --home a second rate is of plans with a return to the start
within the limits, as in the experiments of the paper. "Same outcome" is the share of serves on
which both planners succeed or both fail. Cohen's kappa is the share of agreement beyond chance: 0
for independent outcomes, 1 for equal outcomes. The correlation is of the success rates in the 36
scenarios of the court. The file scenarios.csv of the run folder has the rates by scenario.

--sensitivity instead measures `bat` with each number that the paper does not state changed in turn:
weights and the width of the penalties times 0.1 and 10, and 8 polynomial pieces instead of 4.
--tune juggle instead selects the height of the hit and the apex of the returned ball by scenario,
as the authors did, on --drawn serves a scenario that are drawn and not judged.
"""

import csv
import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np

import planner_jax as pj
from planner_jax.baselines.hit.bat import BatHit
from planner_jax.baselines.hit.comparison import choose_reference
from planner_jax.baselines.protocols import BY_ROW
from planner_jax.benchmarks.run import Bench, argument_parser, begin, parse_names
from planner_jax.runs.summary import wilson_interval
from planner_jax.task.hit import court
from planner_jax.task.hit.suites import Serves, generate_serves

SERVES = Path("../shared/data/serves")


@dataclasses.dataclass(frozen=True)
class Row:
    """A planner of one row of the table."""

    planner: str
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    restitution: float | None = None  # None: the coefficient of the paper


_NAMES = ("bat", "bat-lite", "bat-fitted", "bat-lite-fitted", "juggle")
ROWS = {name: Row(name) for name in _NAMES}
ROWS |= {"juggle-0.32": Row("juggle", restitution=0.32), "exact": Row("exact")}
UNKNOWN = ("time_weight", "limit_weight", "terminal_weight", "hinge_width")
SENSITIVITY = {"bat": ROWS["bat"], "8 pieces": Row("bat", {"num_pieces": 8})} | {
    f"{name} x {factor:g}": Row("bat", {name: factor * getattr(BatHit, name)})
    for name in UNKNOWN
    for factor in (0.1, 10.0)
}
# Heights [m] of the hit and apexes [m] of the returned ball among which --tune selects.
GRID = tuple(itertools.product((1.0, 1.25, 1.5, 1.75, 2.0), (2.2, 2.5, 2.8, 3.1, 3.4, 4.0)))
_HEAD = (
    "| row | serves | success | 95 % interval | published, same serves | trial files, published "
    "| Table I, published | same outcome | kappa | correlation | with return |"
)


def kappa(one: np.ndarray, other: np.ndarray) -> float:
    """Return Cohen's kappa of two arrays of outcomes (N,) bool; 0 if chance explains all."""
    same = (one == other).mean()
    chance = one.mean() * other.mean() + (1.0 - one.mean()) * (1.0 - other.mean())
    return (same - chance) / (1.0 - chance) if chance < 1.0 else 0.0


def rates_by_scenario(success: np.ndarray, scenario: np.ndarray) -> np.ndarray:
    """Return the success rates in the 36 scenarios (36,) of N outcomes; NaN without a serve."""
    counts = [np.bincount(scenario, weight, len(court.SCENARIOS)) for weight in (success, None)]
    return counts[0] / np.where(counts[1] > 0, counts[1], np.nan)


def agreement(ours: np.ndarray, theirs: np.ndarray, scenario: np.ndarray) -> dict[str, float]:
    """Compare two planners' outcomes (N,) bool of the same serves in scenarios (N,).

    Returns the share of equal outcomes, kappa, and the correlation of rates by scenario, which is
    NaN if one planner has equal rates in all scenarios.
    """
    pair = np.array([rates_by_scenario(each, scenario) for each in (ours, theirs)])
    pair = pair[:, np.isfinite(pair[0])]
    varies = pair.shape[1] > 1 and (np.ptp(pair, axis=1) > 0.0).all()
    correlation = np.corrcoef(pair)[0, 1] if varies else np.nan
    same = (ours == theirs).mean()
    return {"same": same, "kappa": kappa(ours, theirs), "correlation": correlation}


def plan_and_judge(row: Row, serves: Serves, **options: Any) -> np.ndarray:
    """Plan serves by the planner of a row; return the referee's verdicts (N,) bool."""
    cases = pj.hit.to_cases(serves)
    if row.restitution is not None:
        filled = np.full_like(cases.restitution, row.restitution)
        cases = dataclasses.replace(cases, restitution=filled)
    planner = pj.hit.planner(row.planner, **row.options, **options)
    return pj.hit.judge(cases, pj.plan(planner, cases)).success


def tune(row: Row, drawn: int) -> list[Row]:
    """Return for each of the 36 scenarios the row of the grid with the most successes.

    Each scenario has `drawn` random serves. Of equal rates the first one of `GRID` is selected.
    """
    serves = generate_serves(drawn * len(court.SCENARIOS), 1)
    grid = [
        dataclasses.replace(row, options={"height": height, "apex": apex}) for height, apex in GRID
    ]
    rates = [rates_by_scenario(plan_and_judge(each, serves), serves.scenario) for each in grid]
    return [grid[best] for best in np.argmax(rates, axis=0)]


def judge_tuned(rows: list[Row], serves: Serves) -> np.ndarray:
    """Return the verdicts (N,) bool of serves, each planned by the row of its scenario."""
    success = np.zeros(len(serves), bool)
    for row in {str(row): row for row in rows}.values():
        own = np.flatnonzero([rows[scenario] == row for scenario in serves.scenario])
        if own.size:
            success[own] = plan_and_judge(row, serves[own])
    return success


def report(
    bench: Bench, name: str, row: Row, serves: Serves, success: np.ndarray, home: np.ndarray | None
) -> None:
    """Print a row beside the published results, and add it to scenarios.csv of the run folder.

    `success` and `home` are the referee's verdicts (N,) bool of plans without and with a return to
    the start; `home` is None if such plans were not made.
    """
    bench.count(success)
    assert serves.published is not None
    other = choose_reference(row.planner)
    outcome = serves.published[:, court.PLANNERS.index(other)]
    known = np.isfinite(outcome)
    ours, theirs, scenario = success[known], outcome[known] == 1.0, serves.scenario[known]
    found = agreement(ours, theirs, scenario)
    low, high = wilson_interval(int(ours.sum()), ours.size)
    files, paper = (BY_ROW["Yu2023bat", table, other] for table in ("trial files", "Table I"))
    with_return = "-" if home is None else f"{100 * home.mean():.1f} %"
    bench.say(
        f"| {name} | {ours.size} | {100 * ours.mean():.1f} % | {100 * low:.1f} to "
        f"{100 * high:.1f} % | {100 * theirs.mean():.1f} % | {files} | {paper} | "
        f"{100 * found['same']:.1f} % | {found['kappa']:.2f} | {found['correlation']:.2f} | "
        f"{with_return} |"
    )
    bench.row(row=name, num=ours.size, success=ours.mean(), wilson_95=(low, high), **found,
              published=theirs.mean(), home=None if home is None else home.mean())  # fmt: skip
    with (bench.path / "scenarios.csv").open("a", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        if file.tell() == 0:
            table.writerow(["row", "scenario", "success", "same serves", "trial files", "Table I"])
        rates = [rates_by_scenario(each, scenario) for each in (ours, theirs)]
        for k, place in enumerate(court.SCENARIOS):
            beside = [
                BY_ROW["Yu2023bat", source, f"{other} {place}"].value
                for source in ("trial files", "Table I")
            ]
            table.writerow([name, place, *(f"{100 * rate[k]:.2f}" for rate in rates), *beside])


def main() -> None:
    parser = argument_parser("hit_published", __doc__, num=9000, drawn=250)
    parser.add_argument(
        "--serves", type=Path, default=SERVES, help=f"folder of published trial files; {SERVES}"
    )
    parser.add_argument(
        "--rows", default=",".join(ROWS), help="rows, comma-separated; default: all"
    )
    parser.add_argument("--home", action="store_true", help="also plans with a return to the start")
    modes = parser.add_mutually_exclusive_group()
    modes.add_argument("--sensitivity", action="store_true", help="rows of changed weights of bat")
    modes.add_argument("--tune", choices=("juggle",), help="select options of juggle by scenario")
    options = parser.parse_args()
    names = parse_names(parser, "--rows", options.rows, ROWS)
    if not options.serves.is_dir():
        parser.error(f"argument --serves: must be the folder of trial files, not {options.serves}")
    serves = pj.hit.read_serves(options.serves)[: options.num]
    rows = SENSITIVITY if options.sensitivity else {name: ROWS[name] for name in names}
    if options.tune:
        rows = {name: row for name, row in ROWS.items() if row.planner == options.tune}
    with begin(parser, options) as bench:
        bench.say(_HEAD, "|---" * _HEAD.count(" |") + "|")
        for name, row in rows.items():
            if options.tune:
                found = tune(row, options.drawn)
                success, home, name = judge_tuned(found, serves), None, f"{name}, tuned"
                bench.note(**{name: {k: each.options for k, each in
                                     zip(court.SCENARIOS, found, strict=True)}})  # fmt: skip
            else:
                success = plan_and_judge(row, serves)
                home = plan_and_judge(row, serves, recovery="home") if options.home else None
            report(bench, name, row, serves, success, home)


if __name__ == "__main__":
    main()
