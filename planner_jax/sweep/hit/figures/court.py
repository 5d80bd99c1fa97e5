"""The court from above and from the side, with serves, plans, returned balls and failures."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from planner_jax.sweep.figures import style
from planner_jax.sweep.figures.motion import sample_motion
from planner_jax.sweep.report import RunRows
from planner_jax.task.hit import court
from planner_jax.task.hit.validate import fly, landing

_SAMPLES = 48


def court_figure(figure: Figure, run: RunRows) -> None:
    """Sampled cases in both views.

    Args:
        figure: empty.
        run: a sample of its cases is shown.
    """
    rows, setting = run.sample(), run.manifest["setting"]
    drag_after = run.manifest["parameters"]["drag_after_impact"]
    aside, top = court.HALF_WIDTH + 0.3, 6.4
    above, side = figure.subplots(2, 1, sharex=True, height_ratios=[2.0 * aside, top + 0.25])
    above.set_ylim(-aside, aside)
    side.set_ylim(-0.25, top)
    for axes, second in ((above, 1), (side, 2)):
        for row in rows:
            _draw_case(axes, row, second, setting, drag_after)
        axes.set_aspect("equal")
        axes.set_xlim(-court.HALF_LENGTH - 0.6, court.HALF_LENGTH + 0.6)
    _draw_floor(above)
    _mark_side(side)
    num_failed = sum(not row["success"] for row in rows)
    title = f"From above: {len(rows)} cases" + (f", {num_failed} failed" if num_failed else "")
    style.label(above, "", "y [m]", title)
    style.label(side, "x [m], net at 0, opponent to the right", "z [m]", "From the side")
    _legend(figure, num_failed > 0)


def _draw_case(
    axes: Axes, row: dict[str, Any], second: int, setting: dict[str, Any], drag_after: bool
) -> None:
    """Serve, trajectory and returned ball of one case in the plane of x and a second axis."""
    good, gravity, drag = row["success"], setting["gravity"], setting["drag"]
    pos, vel = np.array(row["ball_pos"]), np.array(row["ball_vel"])
    end = row["contact_time"] if good else float(landing(pos, vel, drag, gravity)[0])
    serve = _flight(pos, vel, end, drag, gravity)
    motion = sample_motion(row["coeffs"], row["durations"], _SAMPLES)
    if not good:
        _line(axes, serve, second, style.RED, 1.0, 0.9, "--")
        _line(axes, motion.pos, second, style.RED, 1.3, 0.9, "-")
        tip = motion.pos[-1]
        axes.plot(tip[0], tip[second], "X", color=style.RED, markersize=8, mec="white", zorder=6)
        return
    after = np.array(row["ball_vel_after"])
    back = _flight(
        np.array(row["contact_pos"]),
        after,
        row["flight_time"],
        drag if drag_after else 0.0,
        gravity,
    )
    _line(axes, serve, second, style.ORANGE, 0.8, 0.6, "-")
    _line(axes, back, second, style.GREEN, 0.8, 0.6, "-")
    _line(axes, motion.pos, second, style.BLUE, 1.3, 0.75, "-")
    contact = row["contact_pos"]
    axes.plot(contact[0], contact[second], "o", color=style.INK, markersize=2.5, zorder=5)


def _flight(
    pos: np.ndarray, vel: np.ndarray, end: float, drag: float, gravity: float
) -> np.ndarray:
    """Places (N, 3) [m] of a ball up to a time [s]."""
    time = np.linspace(0.0, end, _SAMPLES)
    again = (_SAMPLES, 1)
    return fly(np.tile(pos, again), np.tile(vel, again), time, drag, gravity)[0]


def _line(
    axes: Axes, path: np.ndarray, second: int, colour: str, width: float, alpha: float, dash: str
) -> None:
    axes.add_collection(
        LineCollection(
            [path[:, [0, second]]],
            colors=colour,
            linewidths=width,
            alpha=alpha,
            linestyles=dash,
            zorder=4 if colour == style.RED else 3,
        )
    )


def _draw_floor(axes: Axes) -> None:
    """Lines, dead zone, region letters and targets, from above."""
    length, width = court.HALF_LENGTH, court.HALF_WIDTH
    line = {"color": style.GREY, "linewidth": 1.0, "zorder": 1}
    axes.add_patch(
        Rectangle(
            (-length, -width), 2 * length, 2 * width, facecolor="#F6F8FA", edgecolor=style.GREY
        )
    )
    axes.add_patch(
        Rectangle(
            (-court.DEAD_ZONE, -width),
            2 * court.DEAD_ZONE,
            2 * width,
            facecolor=style.RED,
            alpha=0.12,
            linewidth=0.0,
        )
    )
    axes.axvline(0.0, color=style.INK, linewidth=1.6, zorder=1)
    for way in (-1.0, 1.0):
        axes.plot([way * court.DEAD_ZONE, way * length], [court.LANE_LINE] * 2, **line)
        axes.plot([way * court.DEAD_ZONE, way * length], [-court.LANE_LINE] * 2, **line)
        near = [way * court.NEAR_LINE] * 2
        axes.plot(near, [-court.LANE_LINE, court.LANE_LINE], **line)
    paper = {"facecolor": "#F6F8FA", "edgecolor": "none", "alpha": 0.75, "pad": 1.0}
    for letter, x, y in (("N", 1.0, 0.0), ("F", 4.7, 0.0), ("L", 4.7, 2.2), ("R", 4.7, -2.2)):
        for way in (-1.0, 1.0):
            axes.text(
                way * x, y, letter, color=style.INK, ha="center", va="center", zorder=7, bbox=paper
            )
    for target in court.TARGETS:
        axes.plot(
            target[0], target[1], "o", markersize=11, mfc="none", mec=style.INK, mew=1.6, zorder=6
        )
    axes.grid(visible=False)


def _mark_side(axes: Axes) -> None:
    """Ground, net and targets, from the side."""
    axes.axhline(0.0, color=style.GREY, linewidth=1.5)
    axes.axvline(0.0, color=style.INK, linewidth=1.2, linestyle=":", zorder=1)
    for target in court.TARGETS:
        axes.plot(target[0], 0.0, "o", markersize=11, mfc="none", mec=style.INK, mew=1.6, zorder=6)


def _legend(figure: Figure, failures: bool) -> None:
    entries = [
        Line2D([], [], color=style.ORANGE, label="served ball"),
        Line2D([], [], color=style.BLUE, linewidth=2, label="quadrotor"),
        Line2D([], [], color=style.INK, marker="o", markersize=4, linestyle="", label="impact"),
        Line2D([], [], color=style.GREEN, label="returned ball"),
        Line2D([], [], mec=style.INK, mfc="none", mew=1.6, marker="o", markersize=9, linestyle="",
               label="target"),
    ]  # fmt: skip
    if failures:
        entries.append(
            Line2D(
                [], [], color=style.RED, linestyle="--", marker="X", label="failed: ball and plan"
            )
        )
    figure.legend(handles=entries, loc="outside upper center", ncols=len(entries))
