"""One plan along its time against the limits, beside the other planners' (paper 002, Fig. 7)."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from planner_jax.sweep.figures import style
from planner_jax.task.hit.validate import fly, landing


@dataclasses.dataclass(frozen=True)
class SampledMotion:
    """A trajectory at N times."""

    time: np.ndarray  # (N,) [s]
    pos: np.ndarray  # (N, 3) [m]
    vel: np.ndarray  # (N, 3) [m/s]
    acc: np.ndarray  # (N, 3) [m/s^2]
    jerk: np.ndarray  # (N, 3) [m/s^3]


def sample_motion(coeffs: Sequence[float], durations: Sequence[float], num: int) -> SampledMotion:
    """A trajectory as `plans.parquet` holds it, at even times.

    Args:
        coeffs: flat, M pieces x ascending powers of the piece's own time x 3 axes.
        durations: (M,) [s].
        num: how many samples.
    """
    ends = np.cumsum(np.asarray(durations, float))
    pieces = np.asarray(coeffs, float).reshape(len(ends), -1, 3)
    time = np.linspace(0.0, ends[-1], num)
    piece = np.minimum(np.searchsorted(ends, time, side="right"), len(ends) - 1)
    local = time - np.concatenate([[0.0], ends[:-1]])[piece]
    powers = local[:, None] ** np.arange(pieces.shape[1])
    derivatives = []
    for order in range(4):
        factors = [math.perm(k, order) for k in range(order, pieces.shape[1])]
        scaled = pieces[piece, order:] * np.array(factors, float)[:, None]
        derivatives.append(np.einsum("nk,nki->ni", powers[:, : scaled.shape[1]], scaled))
    return SampledMotion(time, *derivatives)


def net_thrust(motion: SampledMotion, gravity: float) -> np.ndarray:
    """Thrust per unit mass  a + g e_3, (N, 3) [m/s^2]."""
    return motion.acc + gravity * np.array([0.0, 0.0, 1.0])


def body_rate(motion: SampledMotion, gravity: float) -> np.ndarray:
    """Size (N,) [rad/s] of the body rate by the Hopf fibration at zero heading.

    From  c = thrust x jerk: |z'| = |c| / |thrust|^2 across the body z axis, and
    -c_z / (|thrust| (|thrust| + thrust_z)) about it. NaN without thrust and upside down.
    """
    thrust = net_thrust(motion, gravity)
    size = np.linalg.norm(thrust, axis=1)
    cross = np.cross(thrust, motion.jerk)
    with np.errstate(all="ignore"):
        across = np.linalg.norm(cross, axis=1) / size**2
        about = cross[:, 2] / (size * (size + thrust[:, 2]))
        return np.hypot(across, about)


def motion_figure(
    figure: Figure, plans: Sequence[tuple[str, dict[str, Any]]], setting: dict[str, Any]
) -> None:
    """Height, speed, acceleration, body rate and thrust of plans for the same serve.

    Args:
        figure: empty.
        plans: planner and row of `plans.parquet`, the sweep's own first.
        setting: physics and limits, as in the manifest.
    """
    axes = figure.subplots(2, 3, sharex=True)
    gravity = setting["gravity"]
    height, speed, acceleration, rate, thrust, words = axes.flat
    _draw_ball(height, plans[0][1], setting)
    for place, (name, row) in reversed(list(enumerate(plans))):
        motion = sample_motion(row["coeffs"], row["durations"], 400)
        look: dict[str, Any] = {
            "color": style.PLANNER_COLOURS.get(name, style.INK),
            "linestyle": "-" if row["success"] else (0, (4, 1.5)),
            "linewidth": 2.2 if place == 0 else 1.5,
            "zorder": 3 if place == 0 else 2,
        }
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
    style.label(thrust, "time since planning began [s]", "‖τ‖ [m/s²]", "Thrust per mass")
    _write_verdicts(words, plans)


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
    dashed = {"color": style.RED, "linewidth": 1.2, "linestyle": "--", "zorder": 1}
    height.axhline(setting["min_height"], **dashed)
    height.axhspan(0.0, setting["min_height"], color=style.RED, alpha=0.08, linewidth=0.0)
    height.set_ylim(bottom=0.0)
    for axes, name in ((speed, "speed"), (acceleration, "acceleration"), (rate, "body_rate")):
        limit = setting[name]
        top = min(max(axes.get_ylim()[1], 1.15 * limit), 3.0 * limit)
        axes.axhline(limit, **dashed)
        axes.axhspan(limit, top, color=style.RED, alpha=0.08, linewidth=0.0)
        axes.set_ylim(0.0, top)
    gravity, most = setting["gravity"], setting["acceleration"]
    follows = {"color": style.GREY, "linewidth": 1.2, "linestyle": "--", "zorder": 1}
    thrust.set_ylim(0.0, min(max(thrust.get_ylim()[1], 1.1 * (gravity + most)), 3.0 * most))
    thrust.axhline(gravity, color=style.GREY, linewidth=1.0, linestyle=":")
    thrust.axhline(gravity + most, **follows)
    for level, text in ((gravity, "hover"), (gravity + most, "g + acceleration limit")):
        thrust.annotate(
            text, (0.0, level), (4, 3), textcoords="offset points", color=style.GREY, fontsize=8.5
        )


def _write_verdicts(axes: Axes, plans: Sequence[tuple[str, dict[str, Any]]]) -> None:
    """The legend, each planner with the referee's word."""
    axes.axis("off")
    index, scenario = plans[0][1]["index"], plans[0][1]["scenario"]
    place = 1.0
    axes.text(
        0.0,
        place,
        f"Case {index}, scenario {scenario}\nlimits: red; curves of failed plans: dashed",
        va="top",
        transform=axes.transAxes,
    )
    for name, row in plans:
        place -= 0.22
        colour = style.PLANNER_COLOURS.get(name, style.INK)
        if row["success"]:
            text = f"success: lands {1e3 * row['landing_error']:.2g} mm from the target"
        else:
            text = f"fails: {row['sentence']}"
        axes.text(0.0, place, name, va="top", color=colour, weight="bold", transform=axes.transAxes)
        axes.text(
            0.0, place - 0.075, text, va="top", wrap=True, fontsize=9.0, transform=axes.transAxes
        )
