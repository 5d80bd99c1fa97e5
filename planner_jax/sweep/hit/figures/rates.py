"""Success per scenario, beside what was published."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from planner_jax.baselines.hit.published import published_rates
from planner_jax.runs import style
from planner_jax.runs.manifest import Entries
from planner_jax.runs.style import Look
from planner_jax.runs.summary import wilson_interval
from planner_jax.sweep.report import RunRows
from planner_jax.task.hit import court

_WIDTH = 0.26


def rates_figure(figure: Figure, run: RunRows) -> None:
    """A bar a scenario with its Wilson interval, and both published rates of `compared_with`."""
    manifest = run.manifest
    summary, name = manifest["summary"], manifest["parameters"]["planner"]
    other = compared_with(name)
    published = published_rates()
    column = court.PLANNERS.index(other)
    panels = figure.subplot_mosaic("N" * 10 + "F" * 10 + "\n" + "L" * 16 + "....")
    words = {"N": "near", "F": "far", "L": "the left"}
    for serve, axes in panels.items():
        places = [i for i, scenario in enumerate(court.SCENARIOS) if scenario[0] == serve]
        _draw_bars(axes, summary["per_scenario"], places, name)
        for shift, rates, colour, source in (
            (0.0, published.paper, style.PALE, "paper, Table I"),
            (0.28, published.trials, style.SKY, "trial files"),
        ):
            look: Look = {"color": colour, "label": f"{other}: {source}"}
            axes.bar(np.arange(len(places)) + shift, rates[places, column], _WIDTH, **look)
        axes.set_xticks(range(len(places)), [court.SCENARIOS[i] for i in places])
        axes.grid(axis="x", visible=False)
        axes.set(xlim=(-0.6, len(places) - 0.4), ylim=(0.0, 104.0))
        style.label(axes, "", "success [%]", f"Served from {words[serve]}")
    panels["F"].set_ylabel("")
    panels["L"].set_xlabel(
        "scenario: region of serve, landing and target (N near, F far, L left, R right)"
    )
    legend = panels["L"].legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    legend.set_in_layout(False)


def _draw_bars(axes: Axes, counted: Entries, places: list[int], planner: str) -> None:
    """Draw the run's own rates with their intervals; a gap for a scenario without cases."""
    counts = [counted.get(court.SCENARIOS[i], {"successes": 0, "num": 0}) for i in places]
    num = np.array([count["num"] for count in counts])
    rates = 100.0 * np.array([count["successes"] for count in counts]) / np.maximum(num, 1)
    ends = np.array([wilson_interval(count["successes"], count["num"]) for count in counts])
    look: Look = {"color": style.PLANNER_COLOURS.get(planner, style.INK)}
    look |= {"ecolor": style.INK, "error_kw": {"linewidth": 0.9, "capsize": 1.5}}
    look["label"] = f"{planner}: this run"
    known, off = np.where(num > 0, rates, np.nan), np.abs(100.0 * ends.T - rates)
    axes.bar(np.arange(len(places)) - 0.28, known, _WIDTH, yerr=off, **look)


def compared_with(planner: str) -> str:
    """Return the published planner that a planner's rates stand beside: itself, or else bat."""
    return planner if planner in court.PLANNERS else "bat"
