"""Figures in the report of many planned interceptions: cases from above, plans over time."""

from collections.abc import Callable

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from planner_jax.runs import style
from planner_jax.runs.manifest import Entries, Row
from planner_jax.runs.run_folder import RunRows
from planner_jax.sweep.figures import draw_upper_limit, look_of, write_verdicts
from planner_jax.task.intercept.drawing import (
    COLOURS,
    SampledDrive,
    draw_drive,
    entries,
    sample_motion,
)


def sample_drive(row: Row, setting: Entries, num: int) -> SampledDrive:
    """Sample the plan in a run's row at `num` evenly spaced times; `setting` has the car's size."""
    velocity = np.reshape(row["mover_velocity"], (-1, 2))[np.array(row["mover_present"], bool)]
    places = np.reshape(row["target_way"], (-1, 2))
    known = np.linspace(0.0, row["due_time"], len(places))
    movers = _polygons(row, "mover")
    length, width, behind = (setting[f"body_{x}"] for x in ("length", "width", "rear_overhang"))
    return SampledDrive(
        bounds=np.array([setting["lower"], setting["upper"]]),
        walls=_polygons(row, "wall"),
        movers_at=lambda time: [m + time * v for m, v in zip(movers, velocity, strict=True)],
        target_at=lambda times: np.stack([np.interp(times, known, x) for x in places.T], axis=-1),
        due=row["due_time"],
        size=(length, width, behind),
        failed=None if row["success"] else float(np.nan_to_num(row["failed_time"])),
        **sample_motion(row["start"], row["meeting_time"], row["speed"], row["curvature"], num),
    )


def _polygons(row: Row, kind: str) -> list[np.ndarray]:
    present = np.array(row[f"{kind}_present"], bool)
    return list(np.reshape(row[f"{kind}_corners"], (len(present), -1, 2))[present])


_TIME = "time since the start of the car [s]"
_SAMPLES = 241  # number of times at which a plan is sampled
# Numbers of panels of a figure, each for one case; of panels in a row; and of panels for failures.
_PANELS, _COLUMNS, _FAILURES = 6, 3, 2


def plane_figure(figure: Figure, run: RunRows) -> None:
    """Draw some cases of a run from above, one panel for each case."""
    setting = run.manifest["setting"]
    rows = choose_rows(run)
    drives = [sample_drive(row, setting, _SAMPLES) for row in rows]
    colours = ScalarMappable(Normalize(0.0, max(drive.due for drive in drives)), COLOURS)
    num_rows = -(-len(drives) // _COLUMNS)
    figure.set_size_inches(13.0, 0.7 + 4.0 * num_rows)
    panels = figure.subplots(num_rows, _COLUMNS, sharex=True, sharey=True, squeeze=False)
    for axes, row, drive in zip(panels.flat, rows, drives, strict=False):
        draw_drive(axes, drive, colours)
        axes.set_title(_title(row))
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


def _title(row: Row) -> str:
    if row["success"]:
        text = f"met at {row['meeting_time']:.1f} s, {1e3 * row['miss']:.2g} mm off"
    else:
        text = f"fails: {row['failed_limit']}"
    return f"Case {row['index']}, {text}"


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
        away = np.linalg.norm(drive.middle - drive.target_at(drive.time), axis=1)
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
