"""One plan along its time against the limits, beside the other planners' [Yu2023bat, Fig. 7]."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from planner_jax.runs import style
from planner_jax.runs.manifest import Entries, Row
from planner_jax.runs.style import Look
from planner_jax.sweep.figures.motion import DASHED, FORBIDDEN, Drawn, quadrotor_figure
from planner_jax.sweep.hit.figures.court import ball_path
from planner_jax.sweep.report import RunRows
from planner_jax.task.hit.court import landing

_PANELS = ("speed", "acceleration", "body_rate", "thrust")


def motion_figure(figure: Figure, run: RunRows) -> None:
    """Draw height, speed, acceleration, body rate and thrust of plans for the same serve."""
    quadrotor_figure(figure, run, _PANELS, _draw_heights, _word)


def _word(row: Row) -> str:
    return f"lands {1e3 * row['landing_error']:.2g} mm from the target"


def _draw_heights(axes: Axes, setting: Entries, plans: list[Drawn]) -> None:
    """Draw height of the quadrotor, and of the ball down to the floor as if nobody hit it."""
    row, physics = plans[-1].row, (setting["drag"], setting["gravity"])
    pos, vel = np.array(row["ball_pos"]), np.array(row["ball_vel"])
    time, path = ball_path(pos, vel, float(landing(pos, vel, *physics)[0]), *physics)
    look: Look = {"color": style.INK, "linewidth": 1.2, "linestyle": ":"}
    axes.plot(time, path[:, 2], label="ball, if nobody hits it", **look)
    axes.legend(loc="upper right", fontsize=8.5)
    for plan in plans:
        plan.draw(axes, lambda motion: motion.pos[:, 2])
        end = (plan.motion.time[-1], plan.motion.pos[-1, 2])
        axes.plot(*end, "o", color=plan.look["color"], markersize=5)
    axes.axhline(setting["min_height"], **DASHED)
    axes.axhspan(0.0, setting["min_height"], **FORBIDDEN)
    axes.set_ylim(bottom=0.0)
    style.label(axes, "", "height z [m]", "Propeller plane and ball")
