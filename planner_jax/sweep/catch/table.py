"""The table of a catch run: its suite beside the published rates, and what the numbers mean."""

from typing import Any

from planner_jax.sweep.catch.published import PUBLISHED
from planner_jax.sweep.table import RateTable, own_cells

_DECISIONS = {
    "best": "the most promising of all orders planned, the earliest last catch kept",
    "greedy": "next whatever can be caught earliest",
    "given": "the targets as they come, at even shares of the horizon",
}
_NET_TESTS = {
    "plane": "5 mm from the net's plane and there within its radius",
    "ball": "within the net's radius of its centre in any direction",
}


def rate_table(manifest: dict[str, Any]) -> RateTable:
    """Success and optimal time ratio, beside Tables I and III of paper 000 for every suite."""
    summary, settings = manifest["summary"], manifest["parameters"]
    planner, suites = settings["planner"], list(PUBLISHED)
    header = ["suite", "cases", f"{planner} %", "95 % interval", f"{planner} OTR"]
    header += ["Catch Planner, paper %", "Catch Planner, paper OTR", "MPP, paper %"]
    rows = []
    for suite, published in PUBLISHED.items():
        own = ["", "", "", ""]
        if suite == settings["suite"]:
            ratio = _number(summary["optimal_time_ratio"], 3)
            own = [*own_cells(summary["successes"], summary["num"]), ratio]
        paper = [_number(value, digits) for value, digits in zip(published, (1, 3, 1), strict=True)]
        rows.append([suite, *own, *paper])
    strong = suites.index(settings["suite"])
    return RateTable("Success beside the paper", header, rows, strong)


def findings(manifest: dict[str, Any]) -> list[str]:
    """What was caught, when, and how close the decision was."""
    summary = manifest["summary"]
    text = f"{100.0 * summary['caught']:.2f} % of the targets caught"
    if summary["mean_catch_time"] is not None:
        text += f", after {summary['mean_catch_time']:.3f} s on average"
    if summary["optimal_time_ratio"] is not None:
        text += f"; optimal time ratio {summary['optimal_time_ratio']:.3f}"
    return [f"{text}."]


def remarks(manifest: dict[str, Any]) -> list[str]:
    """Where the numbers come from."""
    summary, settings, limits = manifest["summary"], manifest["parameters"], manifest["setting"]
    gravity = limits["gravity"]
    return [
        f"Scenarios: {summary['num']:,} of suite {settings['suite']}, seed {settings['seed']}, "
        f"{manifest['suite']['num_targets']} target(s) each. Suites of a name are of the paper's "
        "kind; the paper gives no ranges of its own.",
        f"Order and first times, decision {settings['decide']}: {_DECISIONS[settings['decide']]}.",
        f"Limits: speed {limits['speed']:g} m/s, body rate {limits['body_rate']:g} rad/s, thrust "
        f"{limits['min_thrust'] / gravity:.3g} to {limits['max_thrust'] / gravity:.3g} g, height "
        f"{limits['min_height']:g} m; scale {settings['limit_scale']:g} on speed, body rate and "
        "the thrust's distance from hover.",
        "A success is the referee's: all targets caught and every limit within "
        f"{settings['tolerance']:g} relative, the target {_NET_TESTS[settings['net_test']]}. A "
        "target counts as caught where its catch holds, even if a limit fails on the way.",
        "OTR is the optimal time ratio, the mean of |T_o - T_p| / T_o over the targets of solved "
        "cases, T_p decided and T_o optimised (eq. 29 of the paper); mpp, which decides on its "
        "own times, has none.",
        "Paper: throws is its Table I (50 real throws, planned), the others its Table III (1,000 "
        "simulated each). Their limits, weights and test are not published.",
    ]


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
