"""Comparison of success rates on catches by a quadrotor with [Yu2023catch, Tables I and III]."""

from typing import NamedTuple

from planner_jax.runs.manifest import Entries
from planner_jax.runs.table import RateTable, rate_cells
from planner_jax.task.catch.spec import SUITES


class PublishedRates(NamedTuple):
    """Results of [Yu2023catch] for one suite: 50 real throws, or 1,000 simulated cases.

    The paper does not publish the ranges of its cases, so that this library's cases differ.
    """

    success: float | None = None  # [%], success rate of the paper's planner
    time_ratio: float | None = None  # mean relative change of the catching times by the optimiser
    mpp_success: float | None = None  # [%], success rate of the planner MPP (motion primitives)


RATES = {
    "throws": PublishedRates(96.0, 0.092, 14.0),
    "parabola1": PublishedRates(99.3, 0.052),
    "parabola2": PublishedRates(98.2, 0.119),
    "harmonic2": PublishedRates(84.7, 0.234),
    "triangle3": PublishedRates(99.7, 0.126),
    "hexagon6": PublishedRates(76.3, 0.458),
}
SOURCE = (
    "Paper: throws is its Table I (50 real throws, planned), the others its Table III (1,000 "
    "simulated each). Their limits, weights and test are not published."
)


def make_table(manifest: Entries) -> RateTable:
    """Return a table of a run's success rate and optimal time ratio beside [Yu2023catch].

    The optimal time ratio is the mean relative change from initial to optimised catching times.
    """
    summary, settings = manifest["summary"], manifest["parameters"]
    planner, names = settings["planner"], list({**SUITES, settings["suite"]: None})
    header = ["suite", "cases", f"{planner} %", "95 % interval", f"{planner} OTR"]
    header += ["Catch Planner, paper %", "Catch Planner, paper OTR", "MPP, paper %"]
    strong, rows = names.index(settings["suite"]), []
    for index, name in enumerate(names):
        own = ["", "", "", ""]
        if index == strong:
            ratio = _format(summary["optimal_time_ratio"], 3)
            own = [*rate_cells(summary["successes"], summary["num"]), ratio]
        rows.append([name, *own, *map(_format, RATES.get(name, PublishedRates()), (1, 3, 1))])
    return RateTable("Success beside the paper", header, rows, strong)


def _format(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
