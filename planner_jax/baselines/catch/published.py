"""Comparison of success rates on catches by a quadrotor with [Yu2023catch, Tables I and III]."""

from planner_jax.baselines.protocols import BY_ROW, Published
from planner_jax.runs.manifest import Entries
from planner_jax.runs.table import RateTable, rate_cells
from planner_jax.task.catch.spec import SUITES

SOURCE = (
    "Paper: throws is its Table I (50 real throws, planned), the others its Table III (1,000 "
    "simulated each). Their limits, ranges, weights and test are not published: the cases of the "
    "two columns differ, so that the rates can be compared only in kind."
)


def find_number(quantity: str, suite: str) -> Published | None:
    """Return a number of [Yu2023catch] for a suite: "success", "OTR" or "MPP success"."""
    name = suite.removeprefix("paper-")
    table = "Table I" if name == "throws" else "Table III"
    return BY_ROW.get(("Yu2023catch", table, f"{quantity} {name}"))


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
            ratio = summary["optimal_time_ratio"]
            own = [
                *rate_cells(summary["successes"], summary["num"]),
                "" if ratio is None else f"{ratio:.3f}",
            ]
        paper = (find_number(quantity, name) for quantity in ("success", "OTR", "MPP success"))
        rows.append([name, *own, *(f"{each.value:g}" if each else "" for each in paper)])
    return RateTable("Success beside the paper", header, rows, strong)
