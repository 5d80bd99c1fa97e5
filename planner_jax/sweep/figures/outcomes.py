"""Success, failures by name, and iterations of any sweep."""

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
    """Draw the rate, failures if there are any, and a histogram of iterations."""
    failed = run.manifest["summary"]["failed_limits"]
    widths = [1.0, 1.2, 1.8] if failed else [1.0, 3.0]
    panels = figure.subplots(1, len(widths), width_ratios=widths)
    _draw_rate(panels[0], run.manifest)
    if failed:
        _draw_failures(panels[1], failed)
    iterations = np.asarray(run.columns("iterations")["iterations"])
    last = panels[-1]
    style.label(last, "iterations of the attempt that gave the plan", "plans", "Effort")
    last.hist(iterations, bins=np.arange(iterations.min(), iterations.max() + 2) - 0.5)
    last.xaxis.set_major_locator(MaxNLocator(integer=True))


def _draw_rate(axes: Axes, manifest: Entries) -> None:
    """Draw the success rate with its interval."""
    summary, settings = manifest["summary"], manifest["parameters"]
    rate, name = 100.0 * summary["success_rate"], settings["planner"]
    axes.bar(0, rate, 0.7, color=style.PLANNER_COLOURS.get(name, style.INK))
    colour, level = ("white", 2.0) if rate >= 10.0 else (style.INK, rate + 2.0)
    axes.annotate(f"{rate:.1f}", (0, level), ha="center", weight="bold", color=colour)
    ends = 100.0 * np.array(summary["wilson_95"])
    axes.errorbar(0, rate, np.abs(ends[:, None] - rate), color=style.INK, capsize=3)
    axes.set_xticks([0], [name])
    axes.set(xlim=(-0.6, 0.6), ylim=(0.0, 104.0))
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
