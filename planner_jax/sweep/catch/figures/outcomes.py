"""Success beside the paper, failures by name, and when targets are caught."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from planner_jax.runs import style
from planner_jax.sweep.figures.outcomes import draw_outcomes
from planner_jax.sweep.report import RunRows
from planner_jax.task.catch.spec import SUITES

_PLACES = ("first", "second", "third", "fourth", "fifth", "sixth")
_COLOURS = (style.BLUE, style.ORANGE, style.GREEN, style.PURPLE, style.SKY, style.GREY)


def outcomes_figure(figure: Figure, run: RunRows) -> None:
    """Rates, failures and a histogram of the catches that hold, by their place in the order."""
    suite = SUITES.get(run.manifest["parameters"]["suite"])
    rates = (suite.success, suite.mpp_success) if suite else (None, None)
    labelled = zip(("Catch\nPlanner,\npaper", "MPP,\npaper"), rates, strict=True)
    axes = draw_outcomes(figure, run.manifest, [(a, b) for a, b in labelled if b is not None])
    rows = run.columns("caught", "catch_times")
    caught, times = (np.stack(rows[name].to_pylist()) for name in ("caught", "catch_times"))
    style.label(axes, "time since planning began [s]", "catches", "When targets are caught")
    if not caught.any():
        return
    places, edges = range(caught.shape[1]), np.linspace(0.0, 1.02 * times[caught].max(), 41)
    held = [times[caught[:, place], place] for place in places]
    colours, labels = ([kind[k % len(kind)] for k in places] for kind in (_COLOURS, _PLACES))
    axes.hist(held, edges, stacked=True, color=colours, label=labels)
    axes.set_xlim(edges[0], edges[-1])
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.axvline(times[caught].mean(), color=style.INK, linewidth=1.2, linestyle="--", label="mean")
    axes.legend(loc="upper left", fontsize=8.5)
