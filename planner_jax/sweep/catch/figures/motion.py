"""One plan along its time against the limits, beside others [Yu2023catch, Figs 6e-h, 7]."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from planner_jax.runs import style
from planner_jax.runs.manifest import Entries, Row
from planner_jax.sweep.catch.targets import due_distance, sampled_catch
from planner_jax.sweep.figures.motion import DASHED, Drawn, quadrotor_figure
from planner_jax.sweep.report import RunRows

_PANELS = ("speed", "body_rate", "thrust", "jerk")
_LEAST_DISTANCE = 1e-3  # [m], of the logarithmic axis


def motion_figure(figure: Figure, run: RunRows) -> None:
    """Draw net distance, speed, body rate, thrust and jerk of plans for the same case."""
    quadrotor_figure(figure, run, _PANELS, _draw_distances, _word)


def _draw_distances(axes: Axes, setting: Entries, plans: list[Drawn]) -> None:
    """Draw distance of the net to the target that it catches next."""
    for plan in plans:
        away = due_distance(sampled_catch(plan.row, plan.motion, setting))
        axes.plot(plan.motion.time, np.maximum(away, _LEAST_DISTANCE), **plan.look)
        caught = np.maximum(np.array(plan.row["net_distance"], float), _LEAST_DISTANCE)
        axes.plot(plan.row["catch_times"], caught, "o", color=plan.look["color"], markersize=5)
    axes.set_yscale("log")
    axes.axhline(setting["net_radius"], **DASHED)
    style.label(axes, "", "distance [m]", "Net to next target (red: net's radius)")


def _word(row: Row) -> str:
    num = row["num_caught"]
    farthest = 1e3 * max(row["net_distance"][:num])
    return f"{num} caught by {row['catch_times'][num - 1]:.2f} s, {farthest:.3g} mm off at most"
