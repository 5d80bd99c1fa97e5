"""A drawing of one block: the arm from above and from the side, and the rates of its joints."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from planner_jax.core.checks import require_kind
from planner_jax.core.choices import require
from planner_jax.robot.arm import capsules, shield_pose
from planner_jax.robot.capsule_fit import directions
from planner_jax.runs import style
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan
from planner_jax.task.block.scene import Box, Scene
from planner_jax.trajectory.polynomial import evaluate

SIZE = (11.0, 4.2)  # [inch], size of a figure
_SHOWN, _SAMPLES = 5, 200  # numbers of drawn poses, and of samples of the rates


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
    motion, arm = jax.tree.map(jnp.asarray, (plan.motion, case.arm))
    case, plan = jax.tree.map(np.asarray, (case, plan))
    above, side, rates = figure.subplots(1, 3, width_ratios=(1.2, 1.2, 1.0))
    end = float(jnp.sum(motion.durations))
    times = jnp.linspace(0.0, end, _SHOWN)
    angles = jax.vmap(lambda time: evaluate(motion, time))(times)
    arms = np.asarray(jax.vmap(capsules, (None, 0))(arm, angles))
    turns, middles = (np.asarray(x) for x in jax.vmap(shield_pose, (None, 0))(arm, angles))
    outline = case.arm.shield_corners
    corners = middles[:, None] + np.einsum("kij,cj->kci", turns[:, :, 1:], outline)
    contact = float(plan.contact_time)
    flown = np.linspace(0.0, contact, _SAMPLES)[:, None]
    ball = case.ball.pos + case.ball.vel * flown - 0.5 * case.gravity * flown**2 * np.eye(3)[2]
    views = (above, (0, 1), "from above"), (side, (0, 2), "from the side")
    for axes, (across, up), title in views:
        _draw_scene(axes, case, across, up)
        for k, (body, plate) in enumerate(zip(arms, corners, strict=True)):
            look = {"alpha": (k + 1.0) / _SHOWN, "color": style.BLUE, "solid_capstyle": "round"}
            for ends, radius in zip(body, case.arm.capsule_radius, strict=True):
                axes.plot(ends[:, across], ends[:, up], linewidth=40.0 * radius, **look)
            shape = {"color": style.ORANGE, "alpha": look["alpha"], "linewidth": 2.0}
            axes.add_patch(Polygon(plate[:, [across, up]], zorder=4, **shape))
        near = np.all(np.abs(ball - middles[-1]) < 1.5 * case.scene.outer.upper[0], axis=1)
        axes.plot(ball[near, across], ball[near, up], "--", color=style.INK, zorder=5)
        axes.plot(ball[-1, across], ball[-1, up], "o", color=style.RED, zorder=6)
        axes.set_aspect("equal")
        style.label(axes, "xyz"[across] + " [m]", "xyz"[up] + " [m]", title)
    at = jnp.linspace(0.0, end, _SAMPLES)
    speeds = np.asarray(jax.vmap(lambda time: evaluate(motion, time, 1))(at))
    for name, rate in zip(case.arm.joint_names, (speeds / case.limits.velocity).T, strict=True):
        rates.plot(float(case.delay) + at, rate, label=name)
    rates.axvline(contact, color=style.RED, linestyle=":")
    rates.set_ylim(-1.1, 1.6)  # leaves room for the legend
    rates.legend(fontsize="x-small", ncols=2, loc="upper center")
    style.label(rates, "time [s]", "rate / limit", "joints; dotted: contact")


def _draw_scene(axes: Axes, case: BlockCase, across: int, up: int) -> None:
    scene, arm = case.scene, case.arm
    base = Box(lower=arm.base_box[0], upper=arm.base_box[1])
    inner = Box(scene.inner.lower - scene.inner_radius, scene.inner.upper + scene.inner_radius)
    around = "-" if scene.inner_ends is None else ":"  # the box around an oblique capsule
    for box, look in (
        (scene.outer, {"fill": False, "linestyle": ":", "edgecolor": style.GREY}),
        (inner, {"fill": False, "linestyle": around, "edgecolor": style.GREEN}),
        (base, {"facecolor": style.PALE}),
    ):
        corner, size = box.lower[[across, up]], (box.upper - box.lower)[[across, up]]
        axes.add_patch(Rectangle(tuple(corner), *size, **look))
    for points in obstacle_points(scene):
        flat = points[:, [across, up]]
        corners = flat[ConvexHull(flat, qhull_options="QJ").vertices]
        axes.add_patch(Polygon(corners, color=style.GREY))
    if up == 2:
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
