"""Figures that the reports of several tasks share, drawn from the files in a run's folder."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from planner_jax.runs import style
from planner_jax.runs.manifest import Entries, Row
from planner_jax.runs.run_folder import RunRows
from planner_jax.runs.style import Look
from planner_jax.sweep import quadrotor
from planner_jax.sweep.quadrotor import SampledMotion

DASHED: Look = {"color": style.RED, "linewidth": 1.2, "linestyle": "--", "zorder": 1}
FORBIDDEN: Look = {"color": style.RED, "alpha": 0.08, "linewidth": 0.0}
_SAMPLES = 800  # number of times at which a plan is sampled for its curves
_FEWEST_BARS, _MOST_BARS = 10, 60  # of the histogram of iterations
CAPTION = (
    "Plans of several planners for one case over time, with the limits. Thin lines: the recovery "
    "trajectory after the last contact, if there is one."
)
_OF_REST: Look = {"linewidth": 0.9}


class Drawn(NamedTuple):
    """One planner's plan in a figure that compares planners: its curves and their style."""

    row: Row
    motion: SampledMotion  # trajectory up to the last contact
    rest: SampledMotion | None  # recovery trajectory after the last contact, if there is one
    look: Look  # keyword arguments of Matplotlib for the lines of this plan

    def draw(self, axes: Axes, values: Callable[[SampledMotion], np.ndarray]) -> None:
        """Draw a quantity over time, which the function `values` computes from a trajectory."""
        axes.plot(self.motion.time, values(self.motion), **self.look)
        if self.rest is not None:
            axes.plot(self.rest.time, values(self.rest), **{**self.look, **_OF_REST})


# Panels by name. Each has the label of its y axis, its title, and a function that computes the
# plotted values from a sampled trajectory and the gravity [m/s^2].
PANELS: dict[str, tuple[str, str, Callable[[SampledMotion, float], np.ndarray]]] = {
    "speed": ("|v| [m/s]", "Speed", lambda m, g: np.linalg.norm(m.vel, axis=1)),
    "acceleration": ("|a| [m/s²]", "Acceleration", lambda m, g: np.linalg.norm(m.acc, axis=1)),
    "jerk": ("|j| [m/s³]", "Jerk", lambda m, g: np.linalg.norm(m.jerk, axis=1)),
    "body_rate": ("|ω| [rad/s]", "Body rate", quadrotor.body_rate),
    "thrust": ("‖τ‖ [m/s²]", "Thrust per mass (dotted: hover)", quadrotor.thrust_size),
}


def quadrotor_figure(
    figure: Figure,
    run: RunRows,
    panels: Sequence[str],
    first: Callable[[Axes, Entries, list[Drawn]], None],
    word: Callable[[Row], str],
) -> None:
    """Draw several planners' plans for one case over time, together with the limits.

    The function `first` draws the first panel, which differs between tasks. `panels` are names of
    further panels, keys of `PANELS`. The function `word` describes a successful plan briefly.
    """
    plans, setting = run.same_case(), run.manifest["setting"]
    axes, air = figure.subplots(2, 3, sharex=True), quadrotor.air_of(setting)
    drawn: list[Drawn] = []
    for k, (name, row) in enumerate(plans):
        motion = quadrotor.sample_motion(row["coeffs"], row["durations"], _SAMPLES, air)
        rest = quadrotor.sample_rest(row, _SAMPLES, air)
        drawn.insert(0, Drawn(row, motion, rest, look_of(k, name, row)))
    first(axes[0, 0], setting, drawn)
    for panel, name in zip(axes.flat[1:5], panels, strict=True):
        unit, title, values = PANELS[name]
        for plan in drawn:
            curve = lambda motion, values=values: values(motion, setting["gravity"])  # noqa: E731
            plan.draw(panel, curve)
            if name == "jerk" and plan is drawn[-1]:
                panel.set_ylim(0.0, 3.0 * np.nan_to_num(np.max(curve(plan.motion))) or None)
        style.label(panel, "", unit, title)
        if name == "thrust":
            _draw_thrust_limits(panel, setting)
        elif name in setting:
            draw_upper_limit(panel, setting[name])
    axes[0, 2].tick_params(labelbottom=True)
    for panel in (*axes[1, :2], axes[0, 2]):
        panel.set_xlabel("time since planning began [s]")
    write_verdicts(axes[1, 2], run, plans, word)


def look_of(index: int, name: str, row: Row) -> Entries:
    """Return the line style of plan `index`: dashed if it failed, thick if it is the first."""
    return {
        "color": style.PLANNER_COLOURS.get(name, style.INK),
        "linestyle": "-" if row["success"] else (0, (4, 1.5)),
        "linewidth": 2.2 if index == 0 else 1.5,
        "zorder": 3 if index == 0 else 2,
    }


def draw_upper_limit(axes: Axes, limit: float) -> None:
    """Draw a limit as a dashed line, and shade the forbidden region above it."""
    top = min(max(axes.get_ylim()[1], 1.15 * limit), 3.0 * limit)
    axes.axhline(limit, **DASHED)
    axes.axhspan(limit, top, **FORBIDDEN)
    axes.set_ylim(0.0, top)


def _draw_thrust_limits(axes: Axes, setting: Entries) -> None:
    gravity = setting["gravity"]
    axes.axhline(gravity, color=style.GREY, linewidth=1.0, linestyle=":")
    if "max_thrust" in setting:
        draw_upper_limit(axes, setting["max_thrust"])
        axes.axhline(setting["min_thrust"], **DASHED)
        axes.axhspan(0.0, setting["min_thrust"], **FORBIDDEN)
        return
    most = setting.get("acceleration")
    # If only the thrusts of single rotors are limited, the plotted total thrust has no limit.
    if most is None:
        return
    bound = gravity + most
    axes.set_ylim(0.0, min(max(axes.get_ylim()[1], 1.1 * bound), 3.0 * most))
    axes.axhline(bound, **{**DASHED, "color": style.GREY})
    words = {"textcoords": "offset points", "color": style.GREY, "fontsize": 8.5}
    axes.annotate("g + acceleration limit", (0.0, bound), (4, 3), **words)


def write_verdicts(
    axes: Axes, run: RunRows, plans: Sequence[tuple[str, Row]], word: Callable[[Row], str]
) -> None:
    """Write the name of each planner in its colour, with the referee's verdict on its plan.

    For a successful plan, `word` returns a short text from its row.
    """
    axes.axis("off")
    look: Look = {"va": "top", "transform": axes.transAxes}
    row, suite = plans[0][1], run.manifest["parameters"].get("suite")
    origin = "single case" if suite is None else f"suite {suite}"
    origin = f"scenario {row['scenario']}" if "scenario" in row else origin
    words = f"Case {row['index']}, {origin}\nlimits: red; curves of failed plans: dashed"
    axes.text(0.0, 1.0, words, **look)
    step = min(0.22, 0.9 / len(plans))
    for index, (name, row) in enumerate(plans):
        top = 0.78 - step * index
        text = f"success: {word(row)}" if row["success"] else f"fails: {row['sentence']}"
        colour = style.PLANNER_COLOURS.get(name, style.INK)
        axes.text(0.0, top, name, color=colour, weight="bold", **look)
        axes.text(0.0, top - 0.075, text, wrap=True, fontsize=9.0, **look)


def outcomes_figure(figure: Figure, run: RunRows) -> None:
    """Draw a histogram of the optimiser's iterations over all plans of a run."""
    axes, rows = figure.subplots(), run.folder.plans.read(["iterations"])
    iterations = np.asarray(rows["iterations"])
    style.label(axes, "iterations of the attempt that gave the plan", "plans", "Effort")
    first = int(iterations.min())
    num = max(int(iterations.max()) - first + 1, _FEWEST_BARS)
    width = -(-num // _MOST_BARS)  # number of values that share a bar
    bins = np.arange(first, first + num + width, width) - 0.5
    axes.hist(iterations, bins=bins.tolist())
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(integer=True))
