"""Success, failures by name, and iterations: what every task's runs can show."""

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from planner_jax.runs import style
from planner_jax.runs.manifest import Entries

if TYPE_CHECKING:
    from planner_jax.sweep.report import RunRows


def outcomes_figure(figure: Figure, run: "RunRows") -> None:
    """Draw the rate, failures and a histogram of iterations.

    Args:
        figure: empty.
        run: `report.RunRows`, all of which is shown.
    """
    iterations = np.asarray(run.columns("iterations")["iterations"])
    last = draw_outcomes(figure, run.manifest, [])
    style.label(last, "iterations of the attempt that gave the plan", "plans", "Effort")
    last.hist(iterations, bins=np.arange(iterations.min(), iterations.max() + 2) - 0.5)
    last.xaxis.set_major_locator(MaxNLocator(integer=True))


def draw_outcomes(figure: Figure, manifest: Entries, published: list[tuple[str, float]]) -> Axes:
    """Panels of success and, where there are any, of failures, and an empty one beside them.

    Args:
        figure: empty.
        manifest: of the run.
        published: rates [%] to stand beside, with their labels.
    """
    failed = manifest["summary"]["failed_limits"]
    widths = [1.0, 1.2, 1.8] if failed else [1.0, 3.0]
    panels = figure.subplots(1, len(widths), width_ratios=widths)
    _draw_rates(panels[0], manifest, published)
    if failed:
        _draw_failures(panels[1], failed)
    return panels[-1]


def _draw_rates(axes: Axes, manifest: Entries, published: list[tuple[str, float]]) -> None:
    """This run's rate with its interval, and published ones."""
    summary, settings = manifest["summary"], manifest["parameters"]
    rate, name = 100.0 * summary["success_rate"], settings["planner"]
    bars = [(f"{name},\nthis run", rate, style.PLANNER_COLOURS.get(name, style.INK))]
    bars += [(label, value, style.PALE) for label, value in published]
    for place, (_, value, colour) in enumerate(bars):
        axes.bar(place, value, 0.7, color=colour)
        inside = value >= 10.0
        colour = "white" if place == 0 and inside else style.INK
        level = 2.0 if inside else value + 2.0
        axes.annotate(f"{value:.1f}", (place, level), ha="center", weight="bold", color=colour)
    ends = 100.0 * np.array(summary["wilson_95"])
    axes.errorbar(0, rate, np.abs(ends[:, None] - rate), color=style.INK, capsize=3)
    axes.set_xticks(range(len(bars)), [label for label, _, _ in bars])
    axes.set(xlim=(-0.6, len(bars) - 0.4), ylim=(0.0, 104.0))
    axes.grid(axis="x", visible=False)
    style.label(axes, "", "success [%]", f"Suite {settings['suite']}")


def _draw_failures(axes: Axes, failed: dict[str, int]) -> None:
    """Draw how many plans fail each limit first."""
    style.label(axes, "plans", "", f"First failed limit of {sum(failed.values()):,}")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    places = range(len(failed))
    axes.barh(places, list(failed.values()), 0.7, color=style.RED)
    for place, count in zip(places, failed.values(), strict=True):
        axes.annotate(f" {count:,}", (count, place), va="center")
    axes.set_yticks(places, list(failed))
    axes.set_ylim(max(len(failed), 4) - 0.5, -0.5)
    axes.margins(x=0.15)
    axes.grid(axis="y", visible=False)
