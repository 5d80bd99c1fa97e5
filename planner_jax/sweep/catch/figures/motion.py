"""One plan along its time against the limits, beside the others' (paper 000, Figs 6e-h and 7)."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from planner_jax.sweep.catch.figures.net import due_distance, net_motion
from planner_jax.sweep.figures import style
from planner_jax.sweep.figures.motion import (
    DASHED,
    FORBIDDEN,
    body_rate,
    draw_upper_limit,
    net_thrust,
    planner_look,
    write_verdicts,
)
from planner_jax.sweep.report import RunRows

_LEAST_DISTANCE = 1e-3  # [m], of the logarithmic axis


def motion_figure(figure: Figure, run: RunRows) -> None:
    """Net distance, speed, body rate, thrust and jerk of plans for the same case.

    Args:
        figure: empty.
        run: its example and the other planners' plans for the same case are shown.
    """
    plans, setting = run.same_case(), run.manifest["setting"]
    axes = figure.subplots(2, 3, sharex=True)
    distance, speed, rate, thrust, jerk, words = axes.flat
    for place, (name, row) in reversed(list(enumerate(plans))):
        net = net_motion(row, setting, 800)
        motion, look = net.motion, planner_look(place, name, row["success"])
        away = np.maximum(due_distance(row, net), _LEAST_DISTANCE)
        distance.plot(motion.time, away, **look)
        caught = np.maximum(np.array(row["net_distance"], float), _LEAST_DISTANCE)
        distance.plot(row["catch_times"], caught, "o", color=look["color"], markersize=5)
        speed.plot(motion.time, np.linalg.norm(motion.vel, axis=1), **look)
        rate.plot(motion.time, body_rate(motion, setting["gravity"]), **look)
        force = np.linalg.norm(net_thrust(motion, setting["gravity"]), axis=1)
        thrust.plot(motion.time, force, **look)
        jerks = np.linalg.norm(motion.jerk, axis=1)
        jerk.plot(motion.time, jerks, **look)
        if place == 0:
            jerk.set_ylim(0.0, 3.0 * np.nan_to_num(np.max(jerks)) or None)
    distance.set_yscale("log")
    distance.axhline(setting["net_radius"], **DASHED)
    draw_upper_limit(speed, setting["speed"])
    draw_upper_limit(rate, setting["body_rate"])
    draw_upper_limit(thrust, setting["max_thrust"])
    thrust.axhline(setting["min_thrust"], **DASHED)
    thrust.axhspan(0.0, setting["min_thrust"], **FORBIDDEN)
    thrust.axhline(setting["gravity"], color=style.GREY, linewidth=1.0, linestyle=":")
    _label(distance, "distance [m]", "Net to next target (red: net's radius)")
    _label(speed, "|v| [m/s]", "Speed")
    _label(rate, "|ω| [rad/s]", "Body rate")
    _label(thrust, "‖τ‖ [m/s²]", "Thrust per mass (dotted: hover)")
    _label(jerk, "|j| [m/s³]", "Jerk")
    rate.tick_params(labelbottom=True)
    for panel in (thrust, jerk, rate):
        panel.set_xlabel("time since planning began [s]")
    suite = run.manifest["parameters"]["suite"]
    verdicts = [(name, row["success"], _word(row)) for name, row in plans]
    write_verdicts(words, f"Case {plans[0][1]['index']}, suite {suite}", verdicts)


def _label(axes: Axes, y: str, title: str) -> None:
    style.label(axes, "", y, title)


def _word(row: dict[str, Any]) -> str:
    """What the referee says of a plan."""
    if not row["success"]:
        return row["sentence"]
    num = row["num_caught"]
    farthest = 1e3 * max(row["net_distance"][:num])
    return f"{num} caught by {row['catch_times'][num - 1]:.2f} s, {farthest:.3g} mm off at most"
