"""Drawings of interceptions from above: map, obstacles, target, and the car along its plan."""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import ListedColormap, Normalize, to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.transforms import offset_copy
from scipy.spatial import ConvexHull

from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import take
from planner_jax.plane.obstacles import Obstacles, Placement, place
from planner_jax.plane.target import PlanePath, rotate
from planner_jax.referee.intercept import InterceptVerdict
from planner_jax.robot.car import knots_at, pose_at
from planner_jax.runs import style
from planner_jax.runs.style import Look
from planner_jax.task.intercept.api import judge
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan

# Greatest numbers of times at which a panel shows the car, and of polygons of moving obstacles.
_MOST_BODIES, _MOST_MOVERS = 6, 16
_SAMPLES = 241  # number of times at which a plan is sampled
# The colour map Viridis without its light end, which is hard to see on white paper.
COLOURS = ListedColormap(colormaps["viridis"](np.linspace(0.0, 5.0 / 6.0, 256)))


@dataclasses.dataclass(frozen=True)
class SampledDrive:
    """A plan, sampled at K times, among obstacles as polygons with V corners (V, 2) [m] each."""

    bounds: np.ndarray  # (2, 2) [m], lower and upper corner of the map
    walls: list[np.ndarray]
    movers_at: Callable[[float], list[np.ndarray]]  # returns the moving obstacles at a time [s]
    target_at: Callable[[np.ndarray], np.ndarray]  # returns predicted positions [m] at T times [s]
    due: float  # [s], prescribed or latest time of the meeting
    size: tuple[float, float, float]  # [m], length, width and rear overhang of the car's body
    failed: float | None  # [s], time at which the referee found a limit exceeded; None: success
    time: np.ndarray  # (K,) [s]
    pose: np.ndarray  # (K, 3), rear axle: x, y [m], heading [rad]
    speed: np.ndarray  # (K,) [m/s]
    acceleration: np.ndarray  # (K,) [m/s^2], along the path
    curvature: np.ndarray  # (K,) [1/m]
    # Paths (101, 2) [m] of other targets, each up to its meeting with the car.
    earlier: Sequence[np.ndarray] | np.ndarray = ()

    @property
    def middle(self) -> np.ndarray:
        """Middle of the car's body at the K times, (K, 2) [m]."""
        heading, (length, _, behind) = self.pose[:, 2], self.size
        direction = np.stack([np.cos(heading), np.sin(heading)], axis=1)
        return self.pose[:, :2] + (0.5 * length - behind) * direction

    def pose_at(self, time: float) -> np.ndarray:
        """Interpolate the rear axle's pose (3,), x, y [m] and heading [rad], at one time [s]."""
        return np.array([np.interp(time, self.time, self.pose[:, k]) for k in range(3)])

    def footprint(self, pose: np.ndarray) -> np.ndarray:
        """Return the corners (4, 2) [m] of the car's body for a pose (3,) of its rear axle."""
        behind, half = -self.size[2], 0.5 * self.size[1]
        ahead = behind + self.size[0]
        corners = np.array([(behind, -half), (ahead, -half), (ahead, half), (behind, half)])
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        return pose[:2] + corners @ np.array([[cos, sin], [-sin, cos]])


def sample_motion(
    start: ArrayLike, end: ArrayLike, speed: ArrayLike, curvature: ArrayLike, num: int
) -> dict[str, np.ndarray]:
    """Sample a car's plan at `num` evenly spaced times; return the arrays of a `SampledDrive`."""
    pose = np.array(start, float)
    numbers = ((0.0, 0.0, pose[2]), end, speed, curvature, np.linspace(0.0, 1.0, num))
    found = _sample(*(jnp.asarray(each, jnp.float32) for each in numbers))
    sampled = {name: np.array(leaf, float) for name, leaf in found.items()}
    sampled["pose"][:, :2] += pose[:2]  # in float64, for maps that are far from their origin
    return sampled


@jax.jit
def _sample(
    start: Array, end: Array, speed: Array, curvature: Array, shares: Array
) -> dict[str, Array]:
    time = end * shares

    def at(time: Array) -> tuple[Array, ...]:
        return pose_at(start, end, speed, curvature, time), *knots_at(end, speed, curvature, time)

    pose, v, c, acceleration = jax.vmap(at)(time)
    return {"time": time, "pose": pose, "speed": v, "curvature": c, "acceleration": acceleration}


def draw_plan(
    case: InterceptCase, plan: InterceptPlan, ax: Axes | None = None, *, index: int | None = None
) -> Axes:
    """Draw a plan from above: walls, moving obstacles, target, and the car, coloured by its speed.

    Bodies of the car, targets and moving obstacles are shown at up to six equally spaced times,
    and moving obstacles are fainter the earlier their time is. The title says what the referee
    finds; a red cross marks where the plan fails.

    Args:
        case: one case, or a batch of cases.
        plan: its plan, or the plans of the batch.
        ax: axes to draw in; by default a new figure of pyplot.
        index: number of the case in the batch, from 0; None for one case.

    Returns:
        The axes.

    Raises:
        ArgumentTypeError: `case` or `plan` is of another class.
        ArgumentError: `index` is missing for a batch, or is no index of a case.
    """
    verdict = judge(case, plan)
    if case.batch_shape:
        num = case.batch_shape[0]
        if index is None or not 0 <= index < num:
            raise ArgumentError("index", f"a case of the batch, from 0 to {num - 1}", index)
        case, plan = take(case, index), take(plan, index)
        fields = {name: np.asarray(value)[index] for name, value in vars(verdict).items()}
        verdict = dataclasses.replace(verdict, **fields)
    elif index is not None:
        raise ArgumentError("index", "None for one case", index)
    return draw_judged(sample_drive(case, [plan], [case.target], verdict), verdict, ax)


def sample_drive(
    case: InterceptCase,
    legs: Sequence[InterceptPlan],
    targets: Sequence[PlanePath],
    verdict: InterceptVerdict,
) -> SampledDrive:
    """Sample the drives to one or more targets, one after another, from the start of a case."""
    parts = [sample_motion(x.start, x.time, x.speed, x.curvature, _SAMPLES) for x in legs]
    ends = np.cumsum([part["time"][-1] for part in parts])
    for part, end in zip(parts, ends, strict=True):
        part["time"] += end - part["time"][-1]
    motion = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def follow(target: PlanePath, times: np.ndarray) -> np.ndarray:
        return np.asarray(jax.vmap(lambda t: target.at(t).pos)(jnp.asarray(times, jnp.float32)))

    *earlier, _ = (
        follow(each, np.linspace(0.0, end, 101)) for each, end in zip(targets, ends, strict=True)
    )
    target_at = functools.partial(follow, targets[-1])
    places = [motion["pose"][:, :2], target_at(motion["time"]), *earlier]
    return SampledDrive(
        bounds=_bounds_of(case, np.concatenate(places)),
        walls=find_outlines(case.walls, 0.0),
        movers_at=lambda time: find_outlines(case.movers, time),
        target_at=target_at,
        due=float(case.time),
        size=(float(case.body.length), float(case.body.width), float(case.body.rear_overhang)),
        failed=None if verdict.success else float(np.nan_to_num(verdict.failed_time)),
        earlier=earlier,
        **motion,
    )


def draw_judged(drive: SampledDrive, verdict: InterceptVerdict, ax: Axes | None = None) -> Axes:
    """Draw a drive from above as `draw_plan` does, with the referee's verdict as its title."""
    speed = np.nan_to_num(drive.speed)  # negative in reverse
    bounds = min(float(speed.min()), 0.0), max(float(speed.max()), 1e-9)
    colours = ScalarMappable(Normalize(*bounds), COLOURS)
    with style.context():
        if ax is None:
            import matplotlib.pyplot as plt

            ax = plt.subplots(figsize=figure_size(drive))[1]
        draw_drive(ax, drive, colours, by_speed=True)
        ax.figure.colorbar(colours, ax=ax, label="speed of the car [m/s]", fraction=0.045, pad=0.02)
        # 0.45 inch below the axes, which is below the label of the axis
        below = offset_copy(ax.transAxes, ax.get_figure(root=True), y=-0.45)
        look: Look = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.0), "ncols": 3}
        ax.legend(handles=entries(colours, by_speed=True), bbox_transform=below, **look)
        style.label(ax, "x [m]", "y [m]")
        ax.set_title(verdict.sentence(), wrap=True)
    return ax


def _bounds_of(case: InterceptCase, places: np.ndarray) -> np.ndarray:
    """Return the corners (2, 2) [m] of the rectangle that is drawn.

    It holds the map, or if the map is unbounded the `places` (K, 2) [m] of the car and the targets.
    """
    sides = np.array([case.lower, case.upper], float)
    points = np.stack(np.meshgrid(*sides.T), axis=-1).reshape(-1, 2)
    points, margin = np.asarray(rotate(jnp.asarray(points), case.map_heading)), 0.0
    if not np.isfinite(sides).all():
        points, margin = places, 3.0 * float(case.body.length)
    return np.array([points.min(axis=0) - margin, points.max(axis=0) + margin])


def find_outlines(group: Obstacles, time: float) -> list[np.ndarray]:
    """Return the outlines (V, 2) [m] of the obstacles at one time [s]; absent ones are NaN."""
    placed, corners = _place_corners(group, jnp.asarray(time, group.centre.dtype))
    exists, radius = np.broadcast_arrays(placed.present, placed.radius)
    angles = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    outlines = []
    for k in np.flatnonzero(group.present):
        outline = np.asarray(corners[k], float)
        if radius[k, 0] > 0.0:
            points = (outline[:, None] + radius[k, 0] * around).reshape(-1, 2)
            outline = points[ConvexHull(points).vertices]
        outlines.append(outline if exists[k, 0] else np.full_like(outline, np.nan))
    return outlines


@jax.jit
def _place_corners(group: Obstacles, time: Array) -> tuple[Placement, Array]:
    return place(group, time[None]), group.vertices(time)


def figure_size(drive: SampledDrive) -> tuple[float, float]:
    """Return width and height [inch] of a figure in which `draw_judged` draws a drive."""
    wide, tall = np.diff(drive.bounds, axis=0)[0]
    scale = 6.4 / max(wide, tall)
    return max(scale * wide, 3.9) + 1.6, max(scale * tall, 1.2) + 1.3


def draw_drive(
    axes: Axes, drive: SampledDrive, colours: ScalarMappable, *, by_speed: bool = False
) -> None:
    """Draw car, target and moving obstacles from above.

    `colours` maps times [s] to colours, or with `by_speed` the car's speeds [m/s]; the moving
    obstacles are then orange, and fainter the earlier their time is.
    """
    draw_map(axes, drive)
    end, values = float(np.nan_to_num(drive.time[-1])), drive.speed if by_speed else drive.time
    times = instants(end, _MOST_BODIES)
    shades = [colours.to_rgba(np.interp(time, drive.time, values)) for time in times]
    every = max(-(-len(times) * len(drive.movers_at(0.0)) // _MOST_MOVERS), 1)
    for time, shade in list(zip(times, shades, strict=True))[::every]:
        alpha = 0.08 + 0.5 * time / max(end, time, 1e-9) if by_speed else 0.25
        colour = to_rgba(style.ORANGE, 0.25 + alpha) if by_speed else shade
        draw_polygons(axes, drive.movers_at(time), colour, alpha=alpha)
    middles = [[p.mean(axis=0) for p in drive.movers_at(t)] for t in np.linspace(0.0, end, 33)]
    for path in np.swapaxes(middles, 0, 1) if middles[0] else ():
        axes.plot(*path.T, color=style.GREY, linewidth=0.7, zorder=1.5)
    path = drive.target_at(np.linspace(0.0, drive.due, 101))
    axes.plot(*path.T, color=style.INK, linewidth=1.0, linestyle=(0, (4, 2)), zorder=3)
    for point, shade in zip(drive.target_at(times), shades, strict=True):
        colour = style.INK if by_speed else shade
        axes.plot(*point, "o", zorder=6, color=colour, markersize=5.5, mec=style.INK, mew=0.6)
    parts = np.stack([drive.middle[:-1], drive.middle[1:]], axis=1)
    line = LineCollection(list(parts), cmap=colours.cmap, norm=colours.norm, linewidths=2.2)
    line.set(array=values[:-1], zorder=4, capstyle="round")
    axes.add_collection(line)
    for time, shade in zip(times, shades, strict=True):
        body = [drive.footprint(drive.pose_at(time))]
        draw_polygons(axes, body, shade, alpha=0.55, zorder=5)
    if by_speed:  # else the colours say which positions are of one time
        _label_times(axes, times, drive.target_at(times), drive.size[0], -1.0)
        middles = [drive.footprint(drive.pose_at(time)).mean(axis=0) for time in times]
        _label_times(axes, times, np.array(middles), drive.size[0], 1.0)
    look = {"marker": "o", "markersize": 13, "mfc": "none", "mew": 1.8, "zorder": 7}
    is_met = drive.failed is None
    (meeting,) = drive.target_at(np.array([end]))
    axes.plot(*meeting, mec=style.INK if is_met else style.RED, **look)
    for other in drive.earlier:
        axes.plot(*other.T, color=style.INK, linewidth=1.0, linestyle=(0, (4, 2)), zorder=3)
        axes.plot(*other[0], "o", zorder=6, color=style.INK, markersize=5.5)
        axes.plot(*other[-1], mec=style.INK, **look)
    if drive.failed is not None:
        moment = drive.pose_at(drive.failed)
        axes.plot(*moment[:2], "X", color=style.RED, markersize=10, mec="white", zorder=8)


def _label_times(
    axes: Axes, times: np.ndarray, places: np.ndarray, gap: float, side: float
) -> None:
    """Write times [s] at the left (`side` = 1) or right (-1) of a path through places (T, 2) [m].

    Places that are less than `gap` [m] from the last text have none.
    """
    last = np.full(2, np.inf)
    for k, (time, point) in enumerate(zip(times, places, strict=True)):
        if np.linalg.norm(point - last) >= gap:
            x, y = places[min(k + 1, len(places) - 1)] - places[max(k - 1, 0)]
            x, y = (x, y) / np.hypot(x, y) if x or y else (1.0, 0.0)
            offset = (-15.0 * side * y, 13.0 * side * x)
            look: Look = {"textcoords": "offset points", "fontsize": 8.0, "color": style.INK}
            look |= {"ha": "center", "va": "center", "zorder": 9}
            halo = [withStroke(linewidth=2.0, foreground="white")]
            axes.annotate(f"{time:g} s", point, offset, path_effects=halo, **look)
            last = point


def entries(colours: ScalarMappable, *, by_speed: bool = False) -> list[Artist]:
    """Return the legend's entries for walls, moving obstacles, target, car and meeting point."""
    early = colours.get_cmap()(0.3)
    target = style.INK if by_speed else early
    mover = to_rgba(style.ORANGE) if by_speed else early
    look: Look = {"linestyle": "", "marker": "o"}
    return [
        Patch(facecolor=style.PALE, edgecolor=style.GREY, label="wall"),
        Patch(facecolor=(*mover[:3], 0.25), edgecolor=mover, label="mover"),
        Line2D([], [], color=style.INK, linestyle=(0, (4, 2)), label="path of the target"),
        Line2D(
            [], [], color=target, markersize=5.5, mec=style.INK, mew=0.6, label="target", **look
        ),
        Line2D([], [], color=early, linewidth=2.2, marker="s", markersize=8, label="car"),
        Line2D([], [], mfc="none", mec=style.INK, mew=1.8, markersize=11, label="meeting", **look),
    ]


def instants(end: float, most: int) -> np.ndarray:
    """Return at most `most` times [s] from 0 to `end`: multiples of 1, 2, 2.5 or 5 times 10^k."""
    steps = [mantissa * 10.0**power for power in range(-3, 9) for mantissa in (1.0, 2.0, 2.5, 5.0)]
    num, step = next((n, step) for step in steps if (n := int(end / step + 1e-6)) < most)
    return step * np.arange(num + 1)


def draw_map(axes: Axes, drive: SampledDrive) -> None:
    """Draw the walls, and set the axes to the bounds of the map."""
    # Filled parts cover their neighbours' edges, so that only the outline of each wall is visible.
    axes.add_collection(PolyCollection(drive.walls, zorder=0.9, ec=style.GREY, linewidth=1.6))
    axes.add_collection(PolyCollection(drive.walls, zorder=1, fc=style.PALE, linewidth=0.0))
    (left, low), (right, high) = drive.bounds
    axes.set(xlim=(left, right), ylim=(low, high), aspect="equal")
    axes.grid(visible=False)
    axes.spines[["top", "right"]].set_visible(True)


def draw_polygons(
    axes: Axes,
    polygons: list[np.ndarray],
    colour: Sequence[float] | np.ndarray,
    *,
    alpha: float = 0.25,
    zorder: float = 2,
) -> None:
    """Draw filled polygons of V corners (V, 2) [m] each; `alpha` is the opacity of the filling."""
    look: Look = {"facecolor": (*colour[:3], alpha), "edgecolor": colour, "zorder": zorder}
    axes.add_collection(PolyCollection(polygons, linewidth=1.0, **look))
