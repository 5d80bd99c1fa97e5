"""Pictures and tables of blocks: the arm's surroundings, times until contact, and joint errors."""

from typing import Any

import numpy as np

from planner_jax.robot.arm import Arm
from planner_jax.robot.arm_scene import FLOOR, Scene
from planner_jax.runs.style import BLUE, GREEN, GREY, INK, PALE, PURPLE, RED, SKY, label
from planner_jax.runs.table import RateTable
from planner_jax.sims.scenery import Part, make_hull_part
from planner_jax.task.block.drawing import obstacle_points

_BARS = 32  # greatest number of balls in the picture of the time budget
_DEEP = -10.0  # [m], a floor below this height stands for no floor, and is not drawn
# Parts of a ball's time of flight, each a name of a field of `Budget` with its description.
BUDGET = {
    "sense": "until the ball's flight is known",
    "plan": "wall time of planning",
    "wait": "unused part of the planning budget",
    "move": "the plan's motion",
    "stand": "from its end until the planned contact",
    "rest": "from the planned contact until the ball is in the inner box",
}


def ground_of(scene: Scene) -> float:
    """Return the height [m] of the drawn ground; a scene without a floor has the paper's."""
    height = round(float(scene.floor), 6)
    return height if height > _DEEP else FLOOR


def _make_box_part(corners: np.ndarray, colour: str, opacity: float) -> Part:
    lower, upper = corners
    (x, y, z), (length, width, height) = 0.5 * (lower + upper), upper - lower
    return Part("box", (length, width, height), (x, y, z), colour, opacity=opacity)


def scenery(arm: Arm, scene: Scene) -> tuple[Part, ...]:
    """Return the drawn parts: outer box, protected inner box, beams, pedestal and obstacles."""
    raised = np.array([0.0, 0.0, -ground_of(scene)])
    inner, outer, base = (
        raised + np.asarray(corners, float)
        for corners in (
            (scene.inner.lower - scene.inner_radius, scene.inner.upper + scene.inner_radius),
            (scene.outer.lower, scene.outer.upper),
            arm.base_box,
        )
    )
    parts = [_make_box_part(inner, GREEN, 0.1), _make_box_part(outer, SKY, 0.07)]
    for ends, radius in zip(np.asarray(scene.beam_ends), scene.beam_radius, strict=True):
        across = radius * (ends[0] == ends[1])
        beam = raised + [ends.min(axis=0) - across, ends.max(axis=0) + across]
        parts.append(_make_box_part(beam, GREY, 1.0))
    base[:, 2] = 0.0, raised[2]  # a pedestal below the base
    if np.ptp(base, axis=0).all():
        parts.append(_make_box_part(base, GREY, 1.0))
    return (*parts, *(make_hull_part(raised + each, "#5B6B73") for each in obstacle_points(scene)))


def budget_table(rows: Any) -> RateTable:
    """Make the table of the parts of the balls' times of flight [Natarajan2024, eq. 1]."""
    planned = np.asarray(rows["planned"])
    parts = {name: 1e3 * np.asarray(rows[f"time_{name}"])[planned] for name in BUDGET}
    parts["flight, the sum"] = np.sum(list(parts.values()), axis=0)
    cells = []
    for name, values in parts.items():
        figures = [values.mean(), *np.quantile(values, (0.1, 0.5, 0.9))] if values.size else []
        words = f"{name}: {BUDGET[name]}" if name in BUDGET else name
        cells.append([words, *(f"{figure:.1f}" for figure in figures)])
    title = "Time until the ball enters the inner box, of balls with a plan [ms]"
    return RateTable(title, ["part", "mean", "10 %", "median", "90 %"], cells)


def joint_table(rows: Any) -> RateTable:
    """Make the table of each joint's tracking errors and torques, over all arms with a plan."""
    planned = np.asarray(rows["planned"])

    def of(name: str) -> np.ndarray:
        return np.stack(rows[name].to_numpy(zero_copy_only=False))[planned]

    cells = []
    for joint in range(of("error_rms").shape[1]) if planned.any() else ():
        rms = (np.sqrt((of(name)[:, joint] ** 2).mean()) for name in ("error_rms", "torque_rms"))
        error, torque = rms
        worst = (of(name)[:, joint].max() for name in ("error_worst", "torque_worst"))
        error_worst, torque_worst = worst
        share = 100.0 * of("saturated")[:, joint].mean()
        cells.append(
            [
                f"{joint + 1}",
                f"{1e3 * error:.2f}",
                f"{1e3 * error_worst:.2f}",
                f"{torque:.3g}",
                f"{torque_worst:.3g}",
                f"{share:.2f}",
            ]
        )
    header = ["joint", "error rms [mrad]", "worst", "torque rms [N m]", "worst", "at its limit %"]
    return RateTable("Joints, from the start of the arm to the contact", header, cells)


def budget_figure(figure: Any, rows: Any) -> None:
    """Draw one bar per ball: the times from its first sight to its entry into the protected box."""
    axes = figure.add_subplot()
    number = min(len(rows), _BARS)
    flights = np.arange(number)
    left = np.zeros(number)
    for name, colour in zip(BUDGET, (PURPLE, RED, PALE, BLUE, GREEN, SKY), strict=True):
        width = 1e3 * np.asarray(rows[f"time_{name}"])[:number]
        axes.barh(flights, np.maximum(width, 0.0), 0.8, left, color=colour, label=name)
        left += width  # a width is negative if the arm still moves at the planned contact
    contact = 1e3 * np.asarray(rows["contact_time"])[:number]
    axes.plot(contact, flights, "|", color=INK, ms=9, label="blocked")
    axes.set_yticks([])
    axes.invert_yaxis()
    axes.legend(ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.06))
    label(axes, "time since the ball is first seen [ms]", f"the first {number} balls")
