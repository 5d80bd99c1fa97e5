"""One plan along its time against the limits, beside the other planners' (paper 002, Fig. 7)."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from planner_jax.sweep.figures import style
from planner_jax.sweep.figures.motion import (
    DASHED,
    FORBIDDEN,
    body_rate,
    draw_upper_limit,
    net_thrust,
    planner_look,
    sample_motion,
    write_verdicts,
)
from planner_jax.sweep.report import RunRows
from planner_jax.task.hit.validate import fly, landing


def motion_figure(figure: Figure, run: RunRows) -> None:
    """Height, speed, acceleration, body rate and thrust of plans for the same serve.

    Args:
        figure: empty.
        run: its example and the other planners' plans for the same serve are shown.
    """
    plans, setting = run.same_case(), run.manifest["setting"]
    axes = figure.subplots(2, 3, sharex=True)
    gravity = setting["gravity"]
    height, speed, acceleration, rate, thrust, words = axes.flat
    _draw_ball(height, plans[0][1], setting)
    for place, (name, row) in reversed(list(enumerate(plans))):
        motion = sample_motion(row["coeffs"], row["durations"], 400)
        look = planner_look(place, name, row["success"])
        height.plot(motion.time, motion.pos[:, 2], **look)
        height.plot(motion.time[-1], motion.pos[-1, 2], "o", color=look["color"], markersize=5)
        speed.plot(motion.time, np.linalg.norm(motion.vel, axis=1), **look)
        acceleration.plot(motion.time, np.linalg.norm(motion.acc, axis=1), **look)
        rate.plot(motion.time, body_rate(motion, gravity), **look)
        thrust.plot(motion.time, np.linalg.norm(net_thrust(motion, gravity), axis=1), **look)
    _draw_limits(axes.flat, setting)
    style.label(height, "", "height z [m]", "Propeller plane and ball")
    style.label(speed, "", "|v| [m/s]", "Speed")
    style.label(acceleration, "time since planning began [s]", "|a| [m/s²]", "Acceleration")
    acceleration.tick_params(labelbottom=True)
    style.label(rate, "time since planning began [s]", "|ω| [rad/s]", "Body rate")
    style.label(
        thrust, "time since planning began [s]", "‖τ‖ [m/s²]", "Thrust per mass (dotted: hover)"
    )
    case = f"Case {plans[0][1]['index']}, scenario {plans[0][1]['scenario']}"
    verdicts = [(name, row["success"], _word(row)) for name, row in plans]
    write_verdicts(words, case, verdicts)


def _word(row: dict[str, Any]) -> str:
    """What the referee says of a plan."""
    if row["success"]:
        return f"lands {1e3 * row['landing_error']:.2g} mm from the target"
    return row["sentence"]


def _draw_ball(axes: Axes, row: dict[str, Any], setting: dict[str, Any]) -> None:
    """Height of the incoming ball, down to the floor as if nobody hit it."""
    ball_pos, ball_vel = np.array(row["ball_pos"]), np.array(row["ball_vel"])
    end, _ = landing(ball_pos, ball_vel, setting["drag"], setting["gravity"])
    time = np.linspace(0.0, float(end), 80)
    start, vel = (np.tile(vector, (len(time), 1)) for vector in (ball_pos, ball_vel))
    pos, _ = fly(start, vel, time, setting["drag"], setting["gravity"])
    axes.plot(
        time,
        pos[:, 2],
        color=style.INK,
        linewidth=1.2,
        linestyle=":",
        label="ball, if nobody hits it",
    )
    axes.legend(loc="upper right", fontsize=8.5)


def _draw_limits(panels: Any, setting: dict[str, Any]) -> None:
    """Limits as dashed lines; a forbidden side is shaded, a bound that only follows is not."""
    height, speed, acceleration, rate, thrust, _ = panels
    height.axhline(setting["min_height"], **DASHED)
    height.axhspan(0.0, setting["min_height"], **FORBIDDEN)
    height.set_ylim(bottom=0.0)
    for axes, name in ((speed, "speed"), (acceleration, "acceleration"), (rate, "body_rate")):
        draw_upper_limit(axes, setting[name])
    gravity, most = setting["gravity"], setting["acceleration"]
    follows = {"color": style.GREY, "linewidth": 1.2, "linestyle": "--", "zorder": 1}
    thrust.set_ylim(0.0, min(max(thrust.get_ylim()[1], 1.1 * (gravity + most)), 3.0 * most))
    thrust.axhline(gravity, color=style.GREY, linewidth=1.0, linestyle=":")
    thrust.axhline(gravity + most, **follows)
    thrust.annotate(
        "g + acceleration limit",
        (0.0, gravity + most),
        (4, 3),
        textcoords="offset points",
        color=style.GREY,
        fontsize=8.5,
    )
