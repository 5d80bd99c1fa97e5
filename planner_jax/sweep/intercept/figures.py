"""Figures in the report of many planned interceptions: cases from above, plans over time."""

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from planner_jax.robot.car import knots_at, pose_at
from planner_jax.runs import style
from planner_jax.runs.manifest import Entries, Row
from planner_jax.runs.run_folder import RunRows
from planner_jax.runs.style import Look
from planner_jax.sweep.figures import draw_upper_limit, look_of, write_verdicts


@dataclasses.dataclass(frozen=True)
class SampledDrive:
    """The plan in a run's row: obstacles as polygons, and car and target sampled at K times."""

    row: Row
    setting: Entries  # entry `setting` of the manifest
    walls: list[np.ndarray]  # (V, 2) [m], V corners of each wall
    movers: list[np.ndarray]  # (V, 2) [m], V corners of each moving obstacle at time 0
    velocities: np.ndarray  # (N, 2) [m/s], velocities of N moving obstacles
    time: np.ndarray  # (K,) [s]
    pose: np.ndarray  # (K, 3), rear axle: x, y [m], heading [rad]
    middle: np.ndarray  # (K, 2) [m], middle of the car's body
    speed: np.ndarray  # (K,) [m/s]
    acceleration: np.ndarray  # (K,) [m/s^2], along the path
    curvature: np.ndarray  # (K,) [1/m]
    target: np.ndarray  # (K, 2) [m], predicted positions of the target

    def target_at(self, times: np.ndarray | float) -> np.ndarray:
        """Interpolate the predicted position [m] of the target at one or several times [s]."""
        places = np.reshape(self.row["target_way"], (-1, 2))
        known = np.linspace(0.0, self.row["due_time"], len(places))
        return np.stack([np.interp(times, known, places[:, k]) for k in range(2)], axis=-1)

    def pose_at(self, time: float) -> np.ndarray:
        """Interpolate the rear axle's pose (3,), x, y [m] and heading [rad], at one time [s]."""
        return np.array([np.interp(time, self.time, self.pose[:, k]) for k in range(3)])

    def footprint(self, pose: np.ndarray) -> np.ndarray:
        """Return the corners (4, 2) [m] of the car's body for a pose (3,) of its rear axle."""
        behind, half = -self.setting["body_rear_overhang"], 0.5 * self.setting["body_width"]
        ahead = behind + self.setting["body_length"]
        corners = np.array([(behind, -half), (ahead, -half), (ahead, half), (behind, half)])
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        return pose[:2] + corners @ np.array([[cos, sin], [-sin, cos]])


def sample_drive(row: Row, setting: Entries, num: int) -> SampledDrive:
    """Sample the plan in a run's row at `num` evenly spaced times; `setting` has the car's size."""
    names = ("start", "meeting_time", "speed", "curvature")
    numbers = [jnp.asarray(row[name], jnp.float32) for name in names]
    found = _sample(*numbers, jnp.linspace(0.0, 1.0, num))
    sampled = {name: np.array(leaf) for name, leaf in found.items()}
    direction = np.stack([np.cos(sampled["pose"][:, 2]), np.sin(sampled["pose"][:, 2])], axis=1)
    ahead = 0.5 * setting["body_length"] - setting["body_rear_overhang"]
    velocity = np.reshape(row["mover_velocity"], (-1, 2))
    drive = SampledDrive(
        row=row,
        setting=setting,
        walls=_polygons(row, "wall"),
        movers=_polygons(row, "mover"),
        velocities=velocity[np.array(row["mover_present"], bool)],
        middle=sampled["pose"][:, :2] + ahead * direction,
        target=np.zeros((num, 2)),
        **sampled,
    )
    return dataclasses.replace(drive, target=drive.target_at(drive.time))


def _polygons(row: Row, kind: str) -> list[np.ndarray]:
    present = np.array(row[f"{kind}_present"], bool)
    return list(np.reshape(row[f"{kind}_corners"], (len(present), -1, 2))[present])


@jax.jit
def _sample(
    start: Array, end: Array, speed: Array, curvature: Array, shares: Array
) -> dict[str, Array]:
    time = end * shares

    def at(time: Array) -> tuple[Array, ...]:
        return pose_at(start, end, speed, curvature, time), *knots_at(end, speed, curvature, time)

    pose, v, c, acceleration = jax.vmap(at)(time)
    return {"time": time, "pose": pose, "speed": v, "curvature": c, "acceleration": acceleration}


_TIME = "time since the start of the car [s]"
_SAMPLES = 241  # number of times at which a plan is sampled
# Numbers of panels of a figure, each for one case; of panels in a row; and of panels for failures.
_PANELS, _COLUMNS, _FAILURES = 6, 3, 2
# Greatest numbers of times at which a panel shows the car, and of polygons of moving obstacles.
_MOST_BODIES, _MOST_MOVERS = 6, 16
# The colour map Viridis without its light end, which is hard to see on white paper.
_COLOURS_OF_TIME = ListedColormap(colormaps["viridis"](np.linspace(0.0, 5.0 / 6.0, 256)))


def plane_figure(figure: Figure, run: RunRows) -> None:
    """Draw some cases of a run from above, one panel for each case."""
    setting = run.manifest["setting"]
    drives = [sample_drive(row, setting, _SAMPLES) for row in choose_rows(run)]
    latest = max(drive.row["due_time"] for drive in drives)
    colours = ScalarMappable(Normalize(0.0, latest), _COLOURS_OF_TIME)
    num_rows = -(-len(drives) // _COLUMNS)
    figure.set_size_inches(13.0, 0.7 + 4.0 * num_rows)
    panels = figure.subplots(num_rows, _COLUMNS, sharex=True, sharey=True, squeeze=False)
    for axes, drive in zip(panels.flat, drives, strict=False):
        draw_drive(axes, drive, colours)
    for axes in panels.flat[len(drives) :]:
        axes.axis("off")
    for axes in panels[-1]:
        axes.set_xlabel("x [m]")
    for axes in panels[:, 0]:
        axes.set_ylabel("y [m]")
    figure.colorbar(colours, ax=panels, label=_TIME, aspect=20 * num_rows)
    figure.legend(handles=entries(colours), loc="outside upper center", ncols=6)


def choose_rows(run: RunRows) -> list[Row]:
    """Return rows for the figure: case `manifest["example"]`, successes, at most two failures."""
    (_, example), rows = run.same_case()[0], run.sample()
    others = [row for row in rows if row["index"] != example["index"]]
    failures = [row for row in others if not row["success"]][:_FAILURES]
    good = [row for row in others if row["success"]]
    places = np.linspace(0, len(good) - 1, min(len(good), _PANELS - 1 - len(failures)))
    return [example, *(good[k] for k in places.astype(int)), *failures]


def draw_drive(axes: Axes, drive: SampledDrive, colours: ScalarMappable) -> None:
    """Draw car, target and moving obstacles from above; `colours` maps times [s] to colours."""
    row = drive.row
    draw_map(axes, drive.setting, drive.walls)
    end = float(np.nan_to_num(row["meeting_time"]))
    times = instants(end, _MOST_BODIES)
    for time in times[:: max(-(-len(times) * len(drive.movers) // _MOST_MOVERS), 1)]:
        moved = [m + time * v for m, v in zip(drive.movers, drive.velocities, strict=True)]
        draw_polygons(axes, moved, colours.to_rgba(time))
    for corners, velocity in zip(drive.movers, drive.velocities, strict=True):
        path = corners.mean(axis=0) + np.array([[0.0], [end]]) * velocity
        axes.plot(*path.T, color=style.GREY, linewidth=0.7, zorder=1.5)
    path = drive.target_at(np.linspace(0.0, row["due_time"], 101))
    axes.plot(*path.T, color=style.INK, linewidth=1.0, linestyle=(0, (4, 2)), zorder=3)
    for time in times:
        look = {"color": colours.to_rgba(time), "markersize": 5.5, "mec": style.INK, "mew": 0.6}
        axes.plot(*drive.target_at(time), "o", zorder=6, **look)
    parts = np.stack([drive.middle[:-1], drive.middle[1:]], axis=1)
    line = LineCollection(list(parts), cmap=colours.cmap, norm=colours.norm, linewidths=2.2)
    line.set(array=drive.time[:-1], zorder=4, capstyle="round")
    axes.add_collection(line)
    for time in times:
        body = [drive.footprint(drive.pose_at(time))]
        draw_polygons(axes, body, colours.to_rgba(time), alpha=0.55, zorder=5)
    look = {"marker": "o", "markersize": 13, "mfc": "none", "mew": 1.8, "zorder": 7}
    axes.plot(*drive.target_at(end), mec=style.INK if row["success"] else style.RED, **look)
    if row["success"]:
        text = f"met at {row['meeting_time']:.1f} s, {1e3 * row['miss']:.2g} mm off"
    else:
        text = f"fails: {row['failed_limit']}"
        moment = drive.pose_at(float(np.nan_to_num(row["failed_time"])))
        axes.plot(*moment[:2], "X", color=style.RED, markersize=10, mec="white", zorder=8)
    style.label(axes, "", "", f"Case {row['index']}, {text}")


def entries(colours: ScalarMappable) -> list[Artist]:
    """Return the legend's entries for walls, moving obstacles, target, car and meeting point."""
    early = colours.get_cmap()(0.3)
    look: Look = {"linestyle": "", "marker": "o"}
    return [
        Patch(facecolor=style.PALE, edgecolor=style.GREY, label="wall"),
        Patch(facecolor=(*early[:3], 0.25), edgecolor=early, label="mover"),
        Line2D([], [], color=style.INK, linestyle=(0, (4, 2)), label="path of the target"),
        Line2D([], [], color=early, markersize=5.5, mec=style.INK, mew=0.6, label="target", **look),
        Line2D([], [], color=early, linewidth=2.2, marker="s", markersize=8, label="car"),
        Line2D([], [], mfc="none", mec=style.INK, mew=1.8, markersize=11, label="meeting", **look),
    ]


def instants(end: float, most: int) -> np.ndarray:
    """Return at most `most` times [s] from 0 to `end`: multiples of 1, 2, 2.5 or 5 times 10^k."""
    steps = [mantissa * 10.0**power for power in range(-3, 9) for mantissa in (1.0, 2.0, 2.5, 5.0)]
    num, step = next((n, step) for step in steps if (n := int(end / step + 1e-6)) < most)
    return step * np.arange(num + 1)


def draw_map(axes: Axes, setting: Entries, walls: list[np.ndarray]) -> None:
    """Draw walls, each with corners (V, 2) [m], and set the axes to the bounds of the map."""
    look: Look = {"facecolor": style.PALE, "edgecolor": style.GREY, "linewidth": 0.8}
    axes.add_collection(PolyCollection(walls, zorder=1, **look))
    (left, low), (right, high) = setting["lower"], setting["upper"]
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


_lateral = lambda drive: np.abs(drive.speed**2 * drive.curvature)  # noqa: E731
_CURVE_SAMPLES = 801  # number of times at which a plan is sampled for curves over time
_LEAST_DISTANCE = 1e-3  # [m] lower end of the logarithmic axis, where smaller distances are drawn
# Panels of curves over time. Each has the name of a limit, the label of the panel's y axis, its
# title, and a function that computes the limited quantity from a sampled plan.
_CURVES: tuple[tuple[str, str, str, Callable[[SampledDrive], np.ndarray]], ...] = (
    ("speed", "v [m/s]", "Speed", lambda d: d.speed),
    ("acceleration", "|a| [m/s²]", "Acceleration along the path", lambda d: np.abs(d.acceleration)),
    ("lateral_acceleration", "|v² κ| [m/s²]", "Lateral acceleration", _lateral),
    ("curvature", "|κ| [1/m]", "Curvature", lambda d: np.abs(d.curvature)),
)


def motion_figure(figure: Figure, run: RunRows) -> None:
    """Draw several planners' plans for one case over time: distance, speed and curvature."""
    plans, setting = run.same_case(), run.manifest["setting"]
    panels = figure.subplots(2, 3, sharex=True)
    looks = [look_of(index, name, row) for index, (name, row) in enumerate(plans)]
    sampled = [sample_drive(row, setting, _CURVE_SAMPLES) for _, row in plans]
    drives = list(zip(sampled, looks, strict=True))[::-1]
    axes = panels[0, 0]
    for drive, look in drives:
        away = np.linalg.norm(drive.middle - drive.target, axis=1)
        axes.plot(drive.time, np.maximum(away, _LEAST_DISTANCE), **look)
    axes.set_yscale("log")
    axes.axhline(plans[0][1]["tolerance"], color=style.RED, linewidth=1.2, linestyle="--")
    style.label(axes, "", "distance [m]", "Body's middle to target (red: tolerance)")
    for axes, (limit, unit, title, values) in zip(panels.flat[1:5], _CURVES, strict=True):
        for drive, look in drives:
            axes.plot(drive.time, values(drive), **look)
        draw_upper_limit(axes, setting[limit])
        style.label(axes, "", unit, title)
    panels[0, 2].tick_params(labelbottom=True)
    for axes in (*panels[1, :2], panels[0, 2]):
        axes.set_xlabel(_TIME)
    write_verdicts(panels[1, 2], run, plans, _word)


def _word(row: Row) -> str:
    return (
        f"meets after {row['meeting_time']:.2f} s, {1e3 * row['miss']:.2g} mm off, "
        f"{row['rms_acceleration']:.3f} m/s² rms"
    )
