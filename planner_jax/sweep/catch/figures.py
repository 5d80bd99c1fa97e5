"""Figures in the report of many planned catches: one plan in space, and plans over time."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from planner_jax.ball.flight import BallState
from planner_jax.ball.target import BallPath, HarmonicPath
from planner_jax.runs import style
from planner_jax.runs.manifest import Entries, Row
from planner_jax.runs.run_folder import RunRows
from planner_jax.runs.style import Look
from planner_jax.sweep.figures import DASHED, Drawn, quadrotor_figure
from planner_jax.sweep.quadrotor import SampledMotion, air_of, net_thrust, sample_motion


def target_paths(row: Row) -> BallPath | HarmonicPath:
    """Restore the paths of a case's N targets from a run's row; leaves are (N, ...)."""

    def leaf(name: str, *trailing: int) -> jax.Array:
        return jnp.asarray(np.reshape(row[name], (-1, *trailing)), jnp.float32)

    if row["swing_pos"] is None:
        ball = BallState(leaf("ball_pos", 3), leaf("ball_vel", 3))
        return BallPath(ball, leaf("drag", 3), leaf("ball_gravity"))
    vectors = {name: leaf(f"swing_{name}", 3) for name in ("pos", "vel", "amplitude")}
    return HarmonicPath(**vectors, rate=leaf("swing_rate"), phase=leaf("swing_phase"))


def target_positions(row: Row, times: np.ndarray) -> np.ndarray:
    """Return positions (N, K, 3) [m] of the N targets of a stored row at times (K,) [s]."""
    return np.asarray(_positions(target_paths(row), jnp.asarray(times, jnp.float32)))


@jax.jit
def _positions(paths: BallPath | HarmonicPath, times: jax.Array) -> jax.Array:
    return jax.vmap(lambda path: jax.vmap(lambda time: path.at(time).pos)(times))(paths)


class SampledCatch(NamedTuple):
    """The plan of a stored row, with net and N targets sampled at K times of the plan."""

    row: Row
    motion: SampledMotion
    axis: np.ndarray  # (K, 3) thrust direction
    centre: np.ndarray  # (K, 3) [m], centre of the hoop
    radius: float  # [m], radius of the hoop
    targets: np.ndarray  # (N, K, 3) [m]
    catches: np.ndarray  # (n,) indices, among the K times, of the n catches


def sample_catch(row: Row, motion: SampledMotion, setting: Entries) -> SampledCatch:
    """Sample net and targets at the times of `motion`; `setting` has net size and gravity."""
    thrust = net_thrust(motion, setting["gravity"])
    axis = thrust / np.maximum(np.linalg.norm(thrust, axis=1, keepdims=True), 1e-9)
    centre = motion.pos + setting["net_height"] * axis
    targets = target_positions(row, motion.time)
    times = np.array(row["catch_times"])[: int(np.sum(row["present"]))]
    catches = np.abs(motion.time[:, None] - times).argmin(axis=0)
    return SampledCatch(row, motion, axis, centre, setting["net_radius"], targets, catches)


def due_distance(plan: SampledCatch) -> np.ndarray:
    """Return the net's distance [m] from the next target over time; NaN right after a catch."""
    times, num = plan.motion.time, len(plan.catches)
    place = np.searchsorted(np.array(plan.row["catch_times"])[:num], times - 1e-6)
    due = np.array(plan.row["order"])[np.minimum(place, num - 1)]
    distance = np.linalg.norm(plan.targets[due, np.arange(len(times))] - plan.centre, axis=1)
    return np.where(np.diff(place, prepend=0) > 0, np.nan, distance)


_SAMPLES = 1601  # number of times at which a plan is sampled
_ROTORS = 0.165  # [m] half the diagonal distance between propellers, of the robot in [Yu2023catch]
# Half the side [m] of a close-up of a catch, and half the time [s] that the close-up shows.
_CLOSE, _AROUND = 0.5, 0.4
_TARGETS = (style.ORANGE, style.GREEN, style.PURPLE, style.SKY, "#8C564B", style.INK)


def flight_figure(figure: Figure, run: RunRows) -> None:
    """Draw case `manifest["example"]` from the side and from above, with close-ups of catches."""
    setting, (_, row) = run.manifest["setting"], run.same_case()[0]
    motion = sample_motion(row["coeffs"], row["durations"], _SAMPLES, air_of(setting))
    plan = sample_catch(row, motion, setting)
    ((left, right),) = figure.subfigures(1, 2, squeeze=False, width_ratios=[3.0, 1.6])
    low, high = _window(plan)
    views = left.subplots(2, 1, sharex=True, height_ratios=(high - low)[[2, 1]])
    for axes, second in zip(views, (2, 1), strict=True):
        _draw_view(axes, plan, second)
        axes.set(xlim=(low[0], high[0]), ylim=(low[second], high[second]), aspect="equal")
    views[0].axhline(setting["min_height"], color=style.RED, linewidth=1.2, linestyle="--")
    end = "success" if row["success"] else row["sentence"]
    style.label(views[0], "", "z [m]", f"Case {row['index']} from the side ({end})")
    style.label(views[1], "x [m]", "y [m]", "From above")
    num = len(plan.catches)
    panels = right.subplots(max(-(-num // 2), 2), 2 if num > 2 else 1).flat
    for index, (axes, at) in enumerate(zip(panels, plan.catches, strict=False)):
        _draw_view(axes, plan, 2, only=index)
        x, _, z = np.nan_to_num(plan.centre[at])
        axes.set(xlim=(x - _CLOSE, x + _CLOSE), ylim=(z - _CLOSE, z + _CLOSE), aspect="equal")
        axes.tick_params(labelsize=8)
        style.label(axes, "", "", f"Catch {index + 1}, {motion.time[at]:.2f} s")
    for axes in panels[num:]:
        axes.axis("off")
    entries = [
        Line2D([], [], color=style.BLUE, linewidth=2, label="quadrotor, rotors"),
        Line2D([], [], color=style.RED, label="net"),
        Line2D([], [], color=style.INK, marker="s", markersize=4, label="target from time 0"),
        Line2D([], [], color=style.INK, marker="o", linestyle="", label="catch"),
        Line2D([], [], color=style.INK, linestyle=":", label="target, if it is not caught"),
    ]
    figure.legend(handles=entries, loc="outside upper center", ncols=len(entries))


def _window(plan: SampledCatch) -> tuple[np.ndarray, np.ndarray]:
    caught = zip(plan.row["order"], plan.catches, strict=False)
    paths = [plan.targets[target][: at + 1] for target, at in caught]
    points = np.concatenate([plan.motion.pos, plan.centre, *paths])
    points = np.nan_to_num(points)  # a failed plan may contain NaN
    low, high = points.min(axis=0), points.max(axis=0)
    # Extend short sides of the drawn box to a quarter of its longest side, to keep panels legible.
    middle, half = 0.5 * (low + high), 0.5 * (high - low) + 2.0 * _ROTORS
    half = np.maximum(half, 0.25 * half.max())
    return middle - half, middle + half


def _draw_view(axes: Axes, plan: SampledCatch, second: int, only: int | None = None) -> None:
    where, catches, time = [0, second], plan.catches, plan.motion.time
    for index, at in enumerate(catches):
        if only not in (None, index):
            continue
        target = plan.row["order"][index]
        path, colour = plan.targets[target][:, where], _TARGETS[target % len(_TARGETS)]
        axes.plot(*path[: at + 1].T, color=colour, linewidth=1.6)
        axes.plot(*path[at:].T, color=colour, linewidth=1.0, linestyle=":", alpha=0.7)
        axes.plot(*path[0], "s", color=colour, markersize=4)
        axes.plot(*path[at], "o", color=colour, markersize=5, mec=style.INK, zorder=6)
    near = 0.0 * time if only is None else np.abs(time - time[catches[only]])
    axes.plot(*plan.motion.pos[near <= _AROUND][:, where].T, color=style.BLUE, lw=2.0, zorder=3)
    for at in (0, *catches) if only is None else (catches[only],):
        _draw_quadrotor(axes, plan, at, where, 0.35 if at == 0 else 1.0)


def _draw_quadrotor(axes: Axes, plan: SampledCatch, at: int, where: list, alpha: float) -> None:
    axis, centre, pos = plan.axis[at], plan.centre[at], plan.motion.pos[at]
    across = np.cross(axis, [0.0, 1.0, 0.0])
    across /= max(np.linalg.norm(across), 1e-9)
    turn = np.linspace(0.0, 2.0 * np.pi, 41)[:, None]
    circle = np.cos(turn) * across + np.sin(turn) * np.cross(axis, across)
    look: Look = {"alpha": alpha, "zorder": 5}
    axes.plot(*(centre + plan.radius * circle)[:, where].T, color=style.RED, linewidth=1.5, **look)
    axes.plot(*(pos + _ROTORS * circle)[:, where].T, color=style.BLUE, linewidth=1.2, **look)
    axes.plot(*np.stack([pos, centre])[:, where].T, color=style.GREY, linewidth=1.2, **look)


_PANELS = ("speed", "body_rate", "thrust", "jerk")
_LEAST_DISTANCE = 1e-3  # [m] lower end of the logarithmic axis, where smaller distances are drawn


def motion_figure(figure: Figure, run: RunRows) -> None:
    """Draw several planners' plans for one case over time: net distance, speed, thrust and jerk."""
    quadrotor_figure(figure, run, _PANELS, _draw_distances, _word)


def _draw_distances(axes: Axes, setting: Entries, plans: list[Drawn]) -> None:
    for plan in plans:
        away = due_distance(sample_catch(plan.row, plan.motion, setting))
        axes.plot(plan.motion.time, np.maximum(away, _LEAST_DISTANCE), **plan.look)
        caught = np.maximum(np.array(plan.row["net_distance"], float), _LEAST_DISTANCE)
        axes.plot(plan.row["catch_times"], caught, "o", color=plan.look["color"], markersize=5)
    axes.set_yscale("log")
    axes.axhline(setting["net_radius"], **DASHED)
    style.label(axes, "", "distance [m]", "Net to next target (red: net's radius)")


def _word(row: Row) -> str:
    num = row["num_caught"]
    farthest = 1e3 * max(row["net_distance"][:num])
    return f"{num} caught by {row['catch_times'][num - 1]:.2f} s, {farthest:.3g} mm off at most"
