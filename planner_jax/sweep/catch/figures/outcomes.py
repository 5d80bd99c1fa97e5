"""Success beside the paper, failures by name, and when targets are caught."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from planner_jax.sweep.catch.published import PUBLISHED
from planner_jax.sweep.figures import style
from planner_jax.sweep.report import RunRows

_PLACES = ("first", "second", "third", "fourth", "fifth", "sixth")


def outcomes_figure(figure: Figure, run: RunRows) -> None:
    """Rates, failures and a histogram of the catches' times.

    Args:
        figure: empty.
        run: all of it is shown.
    """
    failed = run.manifest["summary"]["failed_limits"]
    widths = [1.0, 1.2, 1.8] if failed else [1.0, 3.0]
    panels = figure.subplots(1, len(widths), width_ratios=widths)
    _draw_rates(panels[0], run.manifest)
    _draw_times(panels[-1], run)
    if failed:
        _draw_failures(panels[1], failed)


def _draw_rates(axes: Axes, manifest: dict[str, Any]) -> None:
    """This run's rate with its interval, and the paper's."""
    summary, settings = manifest["summary"], manifest["parameters"]
    published, name = PUBLISHED[settings["suite"]], settings["planner"]
    rate = 100.0 * summary["success_rate"]
    bars = [(f"{name},\nthis run", rate, style.PLANNER_COLOURS.get(name, style.INK))]
    for label, value in (("Catch\nPlanner", published.success), ("MPP", published.mpp_success)):
        if value is not None:
            bars.append((f"{label},\npaper", value, style.PALE))
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
    """How many plans fail each limit first."""
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


def _draw_times(axes: Axes, run: RunRows) -> None:
    """A histogram of the catches that hold, by their place in the order."""
    rows = run.columns("caught", "catch_times")
    caught, times = (np.stack(rows[name].to_pylist()) for name in ("caught", "catch_times"))
    by_place = [times[caught[:, place], place] for place in range(caught.shape[1])]
    style.label(axes, "time since planning began [s]", "catches", "When targets are caught")
    if not caught.any():
        return
    edges = np.linspace(0.0, 1.02 * times[caught].max(), 41)
    colours = [style.BLUE, style.ORANGE, style.GREEN, style.PURPLE, style.SKY, style.GREY]
    axes.hist(
        by_place,
        edges,
        stacked=True,
        color=[colours[place % len(colours)] for place in range(len(by_place))],
        label=[_PLACES[place % len(_PLACES)] for place in range(len(by_place))],
    )
    axes.set_xlim(edges[0], edges[-1])
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.axvline(times[caught].mean(), color=style.INK, linewidth=1.2, linestyle="--", label="mean")
    axes.legend(loc="upper left", fontsize=8.5)
