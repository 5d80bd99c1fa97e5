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

import copy
import csv
import dataclasses
import itertools
from pathlib import Path
from typing import Any

import jax
import numpy as np

import planner_jax as pj
from planner_jax.baselines.hit.bat import BatHit
from planner_jax.baselines.hit.comparison import choose_reference
from planner_jax.baselines.hit.juggle import JuggleHit
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


def cases_of(row: Row, serves: Serves) -> pj.hit.HitCase:
    """Convert serves to cases with the coefficient of restitution of a row."""
    cases = pj.hit.to_cases(serves)
    if row.restitution is None:
        return cases
    filled = np.full_like(cases.restitution, row.restitution)
    return dataclasses.replace(cases, restitution=filled)


def plan_and_judge(row: Row, serves: Serves, **options: Any) -> np.ndarray:
    """Plan serves by the planner of a row; return the referee's verdicts (N,) bool."""
    cases, planner = cases_of(row, serves), pj.hit.planner(row.planner, **row.options, **options)
    return pj.hit.judge(cases, pj.plan(planner, cases)).success


@jax.jit
@jax.vmap
def _juggle(height: jax.Array, apex: jax.Array, case: pj.hit.HitCase) -> pj.hit.HitPlan:
    planner = copy.copy(JuggleHit())  # one program for all heights and apexes
    object.__setattr__(planner, "height", height)
    object.__setattr__(planner, "apex", apex)
    return planner.solve(case, planner.attempts[0])


def judge_tuned(options: np.ndarray, row: Row, serves: Serves) -> np.ndarray:
    """Plan serves by Juggle with the options of their scenarios; return verdicts (N,) bool.

    `options` (36, 2) [m] has the height of the hit and the apex of the returned ball.
    """
    cases = cases_of(row, serves)
    height, apex = options[serves.scenario].T.astype(cases.gravity.dtype)
    return pj.hit.judge(cases, jax.device_get(_juggle(height, apex, cases))).success


def tune(row: Row, drawn: int) -> np.ndarray:
    """Return for each of the 36 scenarios the options of `GRID` with the most successes, (36, 2).

    Each scenario has `drawn` random serves. Of equal rates the first one of `GRID` is selected.
    """
    serves, num = generate_serves(drawn * len(court.SCENARIOS), 1), len(court.SCENARIOS)
    rates = [
        rates_by_scenario(judge_tuned(np.tile(pair, (num, 1)), row, serves), serves.scenario)
        for pair in GRID
    ]
    return np.array(GRID)[np.argmax(rates, axis=0)]


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
                success, home, name = judge_tuned(found, row, serves), None, f"{name}, tuned"
                bench.note(**{name: dict(zip(court.SCENARIOS, found.tolist(), strict=True))})
            else:
                success = plan_and_judge(row, serves)
                home = plan_and_judge(row, serves, recovery="home") if options.home else None
            report(bench, name, row, serves, success, home)


if __name__ == "__main__":
    main()
