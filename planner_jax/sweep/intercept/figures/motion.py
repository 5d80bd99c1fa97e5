"""One plan along its time against the limits, beside the other planners' for the same case."""

from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

from planner_jax.runs import style
from planner_jax.runs.manifest import Row
from planner_jax.sweep.figures.motion import draw_upper_limit, look_of, write_verdicts
from planner_jax.sweep.intercept.drive import SampledDrive, sampled_drive
from planner_jax.sweep.report import RunRows

_SAMPLES = 801
_LEAST_DISTANCE = 1e-3  # [m], of the logarithmic axis
# Limit, label of the axis, title, and what of a drive is held against it, (K,).
_PANELS: tuple[tuple[str, str, str, Callable[[SampledDrive], np.ndarray]], ...] = (
    ("speed", "v [m/s]", "Speed", lambda d: d.speed),
    ("acceleration", "|a| [m/s²]", "Acceleration along the way", lambda d: np.abs(d.acceleration)),
    (
        "lateral_acceleration",
        "|v² κ| [m/s²]",
        "Lateral acceleration",
        lambda d: np.abs(d.speed**2 * d.curvature),
    ),
    ("curvature", "|κ| [1/m]", "Curvature", lambda d: np.abs(d.curvature)),
)


def motion_figure(figure: Figure, run: RunRows) -> None:
    """Distance to the target, speed, accelerations and curvature of plans for the same case."""
    plans, setting = run.same_case(), run.manifest["setting"]
    panels = figure.subplots(2, 3, sharex=True)
    drives = [
        (sampled_drive(row, setting, _SAMPLES), look_of(place, name, row))
        for place, (name, row) in enumerate(plans)
    ][::-1]
    axes = panels[0, 0]
    for drive, look in drives:
        away = np.linalg.norm(drive.middle - drive.target, axis=1)
        axes.plot(drive.time, np.maximum(away, _LEAST_DISTANCE), **look)
    axes.set_yscale("log")
    axes.axhline(plans[0][1]["tolerance"], color=style.RED, linewidth=1.2, linestyle="--")
    style.label(axes, "", "distance [m]", "Body's middle to target (red: tolerance)")
    for axes, (limit, unit, title, values) in zip(panels.flat[1:5], _PANELS, strict=True):
        for drive, look in drives:
            axes.plot(drive.time, values(drive), **look)
        draw_upper_limit(axes, setting[limit])
        style.label(axes, "", unit, title)
    panels[0, 2].tick_params(labelbottom=True)
    for axes in (*panels[1, :2], panels[0, 2]):
        axes.set_xlabel("time since the car sets out [s]")
    write_verdicts(panels[1, 2], run, plans, _word)


def _word(row: Row) -> str:
    return (
        f"meets after {row['meeting_time']:.2f} s, {1e3 * row['miss']:.2g} mm off, "
        f"{row['rms_acceleration']:.3f} m/s² rms"
    )
