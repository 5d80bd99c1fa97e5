"""One plan along its own way against time, with what the movers block of it (paper 003, Fig. 4)."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from planner_jax.baselines.intercept.path import path_of_drive
from planner_jax.baselines.intercept.path_then_speed import SpeedStep, ramp_and_cruise
from planner_jax.baselines.intercept.projection import overlap
from planner_jax.baselines.intercept.speed import SPEED_PLANNERS, plan_speed
from planner_jax.core.protocol import is_solved
from planner_jax.robot.car import knots_at
from planner_jax.runs import style
from planner_jax.sweep.figures.motion import DASHED
from planner_jax.sweep.intercept.drive import case_of
from planner_jax.sweep.report import RunRows
from planner_jax.task.intercept.case import InterceptCase

_POINTS, _SAMPLES = 129, 401  # of the way as planners of paths have it, and of a curve
_BLOCKED = "#E9C46A"
_KEPT_FREE: dict[str, Any] = {"facecolor": "none", "edgecolor": style.INK, "linestyle": ":"}
_STEPS = {
    "trapezoid": "trapezoids, as in lattice",
    "em": "speed step of the EM planner",
    "constant": "constant speed after a ramp",
}
_COLOURS = {"trapezoid": style.GREEN, "em": style.PURPLE, "constant": style.GREY}


@dataclasses.dataclass(frozen=True)
class _Curve:
    """Station, speed and acceleration over time, (K,) each."""

    label: str
    look: dict[str, Any]
    time: np.ndarray  # [s]
    station: np.ndarray  # [m]
    speed: np.ndarray  # [m/s]
    acceleration: np.ndarray  # [m/s^2]


def station_time_figure(figure: Figure, run: RunRows) -> None:
    """The run's example: its station, speed and acceleration, and others' along the same way."""
    setting, (name, row) = run.manifest["setting"], run.same_case()[0]
    speed, curvature = (jnp.asarray(row[each], jnp.float32) for each in ("speed", "curvature"))
    end = jnp.asarray(row["meeting_time"], jnp.float32)
    found = jax.tree.map(np.array, _along(case_of(row, setting), end, speed, curvature))
    curves = _curves(name, row, found)
    panels = figure.subplot_mosaic("SSV\nSSA")
    axes = panels["S"]
    _draw_blocked(axes, found)
    for curve in curves:
        axes.plot(curve.time, curve.station, **curve.look)
        panels["V"].plot(curve.time, curve.speed, **curve.look)
        panels["A"].plot(curve.time, curve.acceleration, **curve.look)
    horizon, length = float(np.nan_to_num(end, nan=1.0)), np.nan_to_num(found["length"], nan=1.0)
    axes.plot(horizon, length, "o", color=style.INK, mfc="white", markersize=8, zorder=6)
    axes.set(xlim=(0.0, 1.02 * horizon), ylim=(0.0, 1.04 * float(length)))
    words = "time since the car sets out [s]"
    title = f"Case {row['index']}: station against time along the way of the plan"
    style.label(axes, words, "station of the rear axle [m]", title)
    panels["V"].axhline(setting["speed"], **DASHED)
    for sign in (-1.0, 1.0):
        panels["A"].axhline(sign * setting["acceleration"], **DASHED)
    panels["V"].set(xlim=axes.get_xlim(), ylim=(0.0, 1.1 * setting["speed"]))
    most = 1.15 * setting["acceleration"]
    panels["A"].set(xlim=axes.get_xlim(), ylim=(-most, most))
    style.label(panels["V"], "", "v [m/s]", "Speed (red: limit)")
    style.label(panels["A"], words, "a [m/s²]", "Acceleration along the way (red: limits)")
    panels["V"].tick_params(labelbottom=False)
    entries: list[Any] = [
        Patch(facecolor=_BLOCKED, label="a mover is on the way"),
        Patch(label="kept free by speed steps", **_KEPT_FREE),
        Line2D([], [], color=style.INK, mfc="white", marker="o", linestyle="", label="meeting"),
    ]
    figure.legend(handles=entries, loc="outside upper left", ncols=len(entries))
    lines = [Line2D([], [], label=curve.label, **curve.look) for curve in curves[::-1]]
    figure.legend(handles=lines, loc="outside lower left", ncols=2)


def _curves(name: str, row: dict[str, Any], found: dict[str, Any]) -> list[_Curve]:
    """The steps' curves, and the plan's own at last; without points where none was found."""
    own: dict[str, Any] = {"color": style.PLANNER_COLOURS.get(name, style.INK), "linewidth": 2.4}
    looks = {"plan": (f"plan of {name}", own | {"zorder": 5})}
    for step, words in _STEPS.items():
        dashed = {"color": _COLOURS[step], "linewidth": 1.5, "linestyle": "--", "zorder": 4}
        looks[step] = (words, dashed)
    made = []
    for step, (words, look) in reversed(looks.items()):
        values = dict(found[step])
        is_found, rms = values.pop("found"), values.pop("rms")
        curve = _Curve(f"{words}: {rms:.3f} m/s² rms", look, found["time"], **values)
        if not is_found:
            nowhere = np.full_like(curve.time, np.nan)
            curve = _Curve(f"{words}: finds nothing", look, nowhere, nowhere, nowhere, nowhere)
        elif _hits(curve, found):
            curve = dataclasses.replace(curve, label=f"{curve.label}, hits a mover")
        made.append(curve)
    return made


def _hits(curve: _Curve, found: dict[str, Any]) -> bool:
    """Whether a curve runs through what is blocked, at its samples."""
    length = max(float(np.nan_to_num(found["length"])), 1e-6)
    share = np.clip(np.nan_to_num(curve.station) / length, 0.0, 1.0)
    k = np.round(share * (_POINTS - 1)).astype(int)
    inside = (found["begin"][:, k] < curve.time) & (curve.time < found["finish"][:, k])
    return bool(inside.any())


def _draw_blocked(axes: Axes, found: dict[str, Any]) -> None:
    """What the movers block of the way, and the quadrangles that cover it."""
    station = np.linspace(0.0, 1.0, _POINTS) * found["length"]
    latest = 2.0 * found["time"][-1]
    for begin, finish in zip(found["begin"], found["finish"], strict=True):
        ends = np.clip([begin, finish], -latest, latest)
        blocked: dict[str, Any] = {"where": begin < finish, "color": _BLOCKED, "linewidth": 0.0}
        axes.fill_betweenx(station, *ends, zorder=1, **blocked)
    cover = found["cover"]
    start, end = cover.start, cover.end
    sides = [(start, cover.lower[:, 0]), (end, cover.lower[:, 1])]
    sides += [(end, cover.upper[:, 1]), (start, cover.upper[:, 0])]
    quadrangles = np.stack([np.stack(side, axis=1) for side in sides], axis=1)[cover.present]
    axes.add_collection(PolyCollection(list(quadrangles), linewidth=0.9, zorder=2, **_KEPT_FREE))


@jax.jit
def _along(case: InterceptCase, end: Array, speed: Array, curvature: Array) -> dict[str, Any]:
    """What a drive's way is blocked by, and speeds along it: those of the drive, and of steps."""
    path = path_of_drive(case.start, end, speed, curvature, _POINTS)
    step = SpeedStep()
    problem = step.problem(dataclasses.replace(case, time=end), path)
    begin, finish = overlap(path, case.movers, case.body, jnp.zeros_like(end), 0.0)
    time = end * jnp.linspace(0.0, 1.0, _SAMPLES)
    v, _, a = jax.vmap(lambda at: knots_at(end, speed, curvature, at))(time)
    moved = 0.5 * (v[1:] + v[:-1]) * (end / (_SAMPLES - 1))
    always = jnp.ones((), bool)
    found: dict[str, Any] = {
        "plan": {
            "station": jnp.concatenate([jnp.zeros(1), jnp.cumsum(moved)]),
            "speed": v,
            "acceleration": a,
            "found": always,
        }
    }
    for name in ("trapezoid", "em"):
        planner = dataclasses.replace(SPEED_PLANNERS[name], pieces=20)
        plan = plan_speed(problem, dataclasses.replace(planner, samples=planner.samples and 5))
        station, v, a = (plan.curve.at(time, order) for order in range(3))
        found[name] = {
            "station": station,
            "speed": v,
            "acceleration": a,
            "found": is_solved(plan.status),
        }
    station, v = ramp_and_cruise(problem, time)
    a: Any = jnp.gradient(v)
    a = a * ((_SAMPLES - 1) / end)
    found["constant"] = {"station": station, "speed": v, "acceleration": a, "found": always}
    for curve in found.values():
        curve["rms"] = jnp.sqrt(jnp.mean(curve["acceleration"] ** 2))
    # Of a ramp that samples are too far apart for.
    change = jnp.abs(v[-1] - v[0])
    found["constant"]["rms"] = jnp.sqrt(problem.acceleration_limit * change / end)
    rest = {"time": time, "length": path.length, "begin": begin, "finish": finish}
    return {**found, **rest, "cover": problem.blocked}
