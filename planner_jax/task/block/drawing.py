"""A drawing of one block: the arm from above and from the side, and the rates of its joints."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from planner_jax.core.checks import require_kind
from planner_jax.core.choices import require
from planner_jax.referee.judging import Verdict
from planner_jax.robot.arm import Arm, ArmLimits, capsules, shield_pose
from planner_jax.robot.arm_scene import Box, Scene
from planner_jax.robot.capsule_fit import directions
from planner_jax.runs import style
from planner_jax.runs.style import Look
from planner_jax.task.block.api import judge
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate

SIZE = (11.0, 4.2)  # [inch], size of a figure
_SHOWN, _SAMPLES = 5, 200  # numbers of drawn poses, and of samples of the rates
_DEEP = 3.0  # [m], depth below the arm's base from which a floor is not drawn
_VIEWS = [0, 1], [0, 2]  # axes of the panels from above and from the side


def draw_plan(case: BlockCase, plan: BlockPlan, figure: Figure) -> None:
    """Draw one plan of a block into a figure of Matplotlib.

    Two panels show the arm at five times, from light to dark, from above and from the side. The
    third panel shows the rates of the joints, divided by their limits.

    Args:
        case: one case.
        plan: its plan, solved or not.
        figure: an empty figure, best of the size `SIZE`.

    Raises:
        ValueError: there is a batch instead of one case.
        TypeError: case or plan is of another class.
    """
    require_kind("case", case, BlockCase)
    require_kind("plan", plan, BlockPlan)
    require(case.batch_shape == (), "case", "one case", shown=f"batch shape {case.batch_shape}")
    case, plan = jax.tree.map(np.asarray, (case, plan))
    parts = case.arm, case.limits, case.scene, plan.motion
    *panels, rates = draw_motion(figure, judge(case, plan), *parts, float(case.delay))
    contact, scene = float(plan.contact_time), case.scene
    flown = np.linspace(0.0, contact, _SAMPLES)[:, None]
    ball = case.ball.pos + case.ball.vel * flown - 0.5 * case.gravity * flown**2 * np.eye(3)[2]
    near = np.all(np.abs(ball - ball[-1]) < 1.5 * scene.outer.upper[0], axis=1)
    inner = Box(scene.inner.lower - scene.inner_radius, scene.inner.upper + scene.inner_radius)
    around = "-" if scene.inner_ends is None else ":"  # the box around an oblique capsule
    for axes, view in zip(panels, _VIEWS, strict=True):
        _draw_box(axes, scene.outer, view, fill=False, linestyle=":", edgecolor=style.GREY)
        _draw_box(axes, inner, view, fill=False, linestyle=around, edgecolor=style.GREEN)
        axes.plot(*ball[near][:, view].T, "--", color=style.INK, zorder=5)
        axes.plot(*ball[-1, view], "o", color=style.RED, zorder=6)
    rates.axvline(contact, color=style.RED, linestyle=":")
    rates.set_title("joints; dotted: contact", loc="left")


def draw_motion(
    figure: Figure,
    verdict: Verdict,
    arm: Arm,
    limits: ArmLimits,
    scene: Scene,
    motion: PiecewisePolynomial,
    begin: float = 0.0,
) -> np.ndarray:
    """Draw a motion of an arm from the time `begin` [s] in three panels, which are returned."""
    figure.suptitle(verdict.sentence(), x=0.01, ha="left", fontsize="medium")
    panels = figure.subplots(1, 3, width_ratios=(1.2, 1.2, 1.0))
    arm, limits, scene = jax.tree.map(np.asarray, (arm, limits, scene))
    end = float(np.sum(motion.durations))
    at = np.linspace(0.0, end, _SAMPLES, dtype=np.float32)
    arms, turns, middles, speeds = jax.device_get(_sample_arm(arm, motion, at))
    corners = middles[:, None] + np.einsum("kij,cj->kci", turns[:, :, 1:], arm.shield_corners)
    turn = np.linspace(0.0, 2.0 * np.pi, 24)
    around = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    for axes, view, title in zip(panels, _VIEWS, ("from above", "from the side"), strict=False):
        _draw_scene(axes, scene, arm, view)
        for k, (body, plate) in enumerate(zip(arms, corners, strict=True)):
            look: Look = {"alpha": ((k + 1.0) / _SHOWN) ** 2, "zorder": 4, "linewidth": 0.6}
            for ends, radius in zip(body[:, :, view], arm.capsule_radius, strict=True):
                _draw_hull(axes, (ends[:, None] + radius * around).reshape(-1, 2), style.BLUE, look)
            _draw_hull(axes, plate[:, view], style.ORANGE, look)
        axes.autoscale_view()
        axes.set_aspect("equal")
        style.label(axes, f"{'xyz'[view[0]]} [m]", f"{'xyz'[view[1]]} [m]", title)
    for name, rate in zip(arm.joint_names, (speeds / limits.velocity).T, strict=True):
        panels[2].plot(begin + at, rate, label=name)
    panels[2].set_ylim(-1.1, 1.6)  # leaves room for the legend
    panels[2].legend(fontsize="x-small", ncols=2, loc="upper center")
    style.label(panels[2], "time [s]", "rate / limit", "joints")
    return panels


@jax.jit
def _sample_arm(arm: Arm, motion: PiecewisePolynomial, at: Array) -> tuple[Array, ...]:
    """Return capsules and shield poses at `_SHOWN` equidistant times, and joint rates at `at`."""
    shown = jnp.linspace(at[0], at[-1], _SHOWN)
    angles = jax.vmap(lambda time: evaluate(motion, time))(shown)
    poses = jax.vmap(shield_pose, (None, 0))(arm, angles)
    rates = jax.vmap(lambda time: evaluate(motion, time, 1))(at)
    return jax.vmap(capsules, (None, 0))(arm, angles), *poses, rates


def _draw_box(axes: Axes, box: Box, view: list[int], **look: Any) -> None:
    corner, size = box.lower[view], (box.upper - box.lower)[view]
    axes.add_patch(Rectangle(tuple(corner), *size, **look))


def _draw_hull(axes: Axes, points: np.ndarray, colour: str, look: Look) -> None:
    corners = points[ConvexHull(points, qhull_options="QJ").vertices]
    axes.add_patch(Polygon(corners, facecolor=colour, edgecolor="white", **look))


def _draw_scene(axes: Axes, scene: Scene, arm: Arm, view: list[int]) -> None:
    _draw_box(axes, Box(*arm.base_box), view, facecolor=style.PALE)
    for points in obstacle_points(scene):
        _draw_hull(axes, points[:, view], style.GREY, {})
    if view[1] == 2 and scene.floor > arm.base_box[0][2] - _DEEP:
        axes.axhline(float(scene.floor), color=style.INK, linewidth=1.0)


def obstacle_points(scene: Scene) -> list[np.ndarray]:
    """Return points (V, 3) [m] for each obstacle, whose convex hull is the obstacle."""
    spread = directions(400)
    rods = zip(scene.capsule_ends, scene.capsule_radius, strict=True)
    found = [] if scene.meshes is None else [*scene.meshes.corners]
    found += [
        (ends[:, None] + radius * spread).reshape(-1, 3) for ends, radius in rods if radius >= 0
    ]
    signs = np.array([*itertools.product((-1.0, 1.0), repeat=3)])
    for middle, turn, half in zip(scene.box_middle, scene.box_turn, scene.box_half, strict=True):
        found.append(middle + Rotation.from_quat(turn, scalar_first=True).apply(signs * half))
    for ends, radius in zip(scene.cylinder_ends, scene.cylinder_radius, strict=True):
        axis = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        rim = spread - np.outer(spread @ axis, axis)
        rim *= radius / np.linalg.norm(rim, axis=1, keepdims=True)
        found.append((ends[:, None] + rim).reshape(-1, 3))
    return found
