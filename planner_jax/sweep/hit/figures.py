"""Figures in the report of many planned hits: the court, one case in space, plans over time."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from planner_jax.runs import style
from planner_jax.runs.manifest import Entries, Row
from planner_jax.runs.run_folder import RunRows
from planner_jax.runs.style import Look
from planner_jax.sweep.figures import DASHED, FORBIDDEN, Drawn, quadrotor_figure
from planner_jax.sweep.quadrotor import sample_motion
from planner_jax.task.hit import court
from planner_jax.task.hit.court import fly, landing

_SAMPLES = 48  # number of points of each drawn trajectory
_SHORTEST = 0.12  # least half height of a panel, divided by the panel's width
_FLOOR = "#F6F8FA"
_TARGET: Look = {"marker": "o", "mfc": "none", "mec": style.INK, "mew": 1.6}


def court_figure(figure: Figure, run: RunRows) -> None:
    """Draw about 60 cases of a run, also rejected plans, on the court in top and side view."""
    rows, setting = run.sample(), run.manifest["setting"]
    drag_after = run.manifest["parameters"]["drag_after_impact"]
    aside, top = court.HALF_WIDTH + 0.3, 6.4
    above, side = figure.subplots(2, 1, sharex=True, height_ratios=[2.0 * aside, top + 0.25])
    across = court.HALF_LENGTH + 0.6
    for axes, second, limits in ((above, 1, (-aside, aside)), (side, 2, (-0.25, top))):
        for row in rows:
            draw_case(axes, row, second, setting, drag_after)
        axes.set(aspect="equal", xlim=(-across, across), ylim=limits)
    _draw_floor(above)
    side.axhline(0.0, color=style.GREY, linewidth=1.5)
    side.axvline(0.0, color=style.INK, linewidth=1.2, linestyle=":", zorder=1)
    for x, y, _ in court.TARGETS:
        above.plot(x, y, markersize=11, zorder=6, **_TARGET)
        side.plot(x, 0.0, markersize=11, zorder=6, **_TARGET)
    num_failed = sum(not row["success"] for row in rows)
    title = f"From above: {len(rows)} cases" + (f", {num_failed} failed" if num_failed else "")
    style.label(above, "", "y [m]", title)
    style.label(side, "x [m], net at 0, opponent to the right", "z [m]", "From the side")
    entries = [
        Line2D([], [], color=style.ORANGE, label="served ball"),
        Line2D([], [], color=style.BLUE, linewidth=2, label="quadrotor"),
        Line2D([], [], color=style.INK, marker="o", markersize=4, linestyle="", label="impact"),
        Line2D([], [], color=style.GREEN, label="returned ball"),
        Line2D([], [], markersize=9, linestyle="", label="target", **_TARGET),
    ]
    if num_failed:
        look: Look = {"color": style.RED, "linestyle": "--", "marker": "X"}
        entries.append(Line2D([], [], label="failed: ball and plan", **look))
    figure.legend(handles=entries, loc="outside upper center", ncols=len(entries))


def ball_path(
    pos: np.ndarray, vel: np.ndarray, end: float, drag: float, gravity: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return N times [s] up to `end`, and positions (N, 3) [m] with quadratic `drag` [1/m]."""
    time = np.linspace(0.0, end, _SAMPLES)
    pos, vel = (np.tile(vector, (_SAMPLES, 1)) for vector in (pos, vel))
    return time, fly(pos, vel, time, drag, gravity)[0]


def draw_case(axes: Axes, row: Row, second: int, setting: Entries, drag_after: bool) -> None:
    """Draw the paths of ball and quadrotor in the plane of x and axis `second` (1: y, 2: z).

    `drag_after` is whether the drawn ball has drag after the impact.
    """
    good, gravity, drag = row["success"], setting["gravity"], setting["drag"]

    def line(path: np.ndarray, colour: str, width: float, alpha: float, dash: str = "-") -> None:
        look: Look = {"color": colour, "linewidth": width, "alpha": alpha}
        order = 4 if colour == style.RED else 3
        axes.plot(path[:, 0], path[:, second], linestyle=dash, zorder=order, **look)

    pos, vel = np.array(row["ball_pos"]), np.array(row["ball_vel"])
    end = row["contact_time"] if good else float(landing(pos, vel, drag, gravity)[0])
    _, serve = ball_path(pos, vel, end, drag, gravity)
    path = sample_motion(row["coeffs"], row["durations"], _SAMPLES).pos
    if not good:
        line(serve, style.RED, 1.0, 0.9, "--")
        line(path, style.RED, 1.3, 0.9)
        tip = path[-1, [0, second]]
        axes.plot(*tip, "X", color=style.RED, markersize=8, mec="white", zorder=6)
        return
    contact, after = np.array(row["contact_pos"]), np.array(row["ball_vel_after"])
    _, back = ball_path(contact, after, row["flight_time"], drag if drag_after else 0.0, gravity)
    line(serve, style.ORANGE, 0.8, 0.6)
    line(back, style.GREEN, 0.8, 0.6)
    line(path, style.BLUE, 1.3, 0.75)
    axes.plot(*contact[[0, second]], "o", color=style.INK, markersize=2.5, zorder=5)


def _draw_floor(axes: Axes) -> None:
    length, width, dead = court.HALF_LENGTH, court.HALF_WIDTH, court.DEAD_ZONE
    line: Look = {"color": style.GREY, "linewidth": 1.0, "zorder": 1}
    whole: Look = {"facecolor": _FLOOR, "edgecolor": style.GREY}
    axes.add_patch(Rectangle((-length, -width), 2 * length, 2 * width, **whole))
    zone: Look = {"facecolor": style.RED, "alpha": 0.12, "linewidth": 0.0}
    axes.add_patch(Rectangle((-dead, -width), 2 * dead, 2 * width, **zone))
    axes.axvline(0.0, color=style.INK, linewidth=1.6, zorder=1)
    paper = {"facecolor": _FLOOR, "edgecolor": "none", "alpha": 0.75, "pad": 1.0}
    look: Look = {"ha": "center", "va": "center", "zorder": 7, "bbox": paper}
    for sign in (-1.0, 1.0):
        for side in (-court.LANE_LINE, court.LANE_LINE):
            axes.plot([sign * dead, sign * length], [side] * 2, **line)
        axes.plot([sign * court.NEAR_LINE] * 2, [-court.LANE_LINE, court.LANE_LINE], **line)
        for letter, x, y in (("N", 1.0, 0.0), ("F", 4.7, 0.0), ("L", 4.7, 2.2), ("R", 4.7, -2.2)):
            axes.text(sign * x, y, letter, color=style.INK, **look)
    axes.grid(visible=False)


def path_figure(figure: Figure, run: RunRows) -> None:
    """Draw ball and quadrotor in case `manifest["example"]`, from above and from the side."""
    (_, row), setting = run.same_case()[0], run.manifest["setting"]
    drag_after = run.manifest["parameters"].get("drag_after_impact", False)
    above, side = figure.subplots(2, 1, sharex=True)
    for axes, second in ((above, 1), (side, 2)):
        draw_case(axes, row, second, setting, drag_after)
        for line in axes.lines:
            line.set(linewidth=2.0, alpha=1.0)
        axes.plot(row["start"][0], row["start"][second], "s", color=style.BLUE, markersize=5)
        axes.plot(row["target"][0], row["target"][second], zorder=6, markersize=11, **_TARGET)
        low, high = axes.get_ylim()
        wide = np.ptp(axes.get_xlim())
        # With equal scales, a flat path would give a panel too low to be read.
        middle, half = 0.5 * (low + high), max(0.5 * (high - low), _SHORTEST * wide)
        axes.set(ylim=(middle - half, middle + half), aspect="equal")
    side.axhline(0.0, color=style.GREY, linewidth=1.5)
    end = "success" if row["success"] else row["sentence"]
    style.label(above, "", "y [m]", f"From above ({end})")
    style.label(side, "x [m]", "z [m]", "From the side")
    colours = {"ball": style.ORANGE, "quadrotor": style.BLUE, "returned ball": style.GREEN}
    if not row["success"]:
        colours = {"ball, quadrotor": style.RED}
    entries = [Line2D([], [], color=colour, label=name) for name, colour in colours.items()]
    entries.append(Line2D([], [], linestyle="", label="target", **_TARGET))
    figure.legend(handles=entries, loc="outside upper center", ncols=len(entries))


_PANELS = ("speed", "acceleration", "body_rate", "thrust")


def motion_figure(figure: Figure, run: RunRows) -> None:
    """Draw planners' plans for one serve over time: heights, speeds, accelerations, thrusts."""
    quadrotor_figure(figure, run, _PANELS, _draw_heights, _word)


def _word(row: Row) -> str:
    return f"lands {1e3 * row['landing_error']:.2g} mm from the target"


def _draw_heights(axes: Axes, setting: Entries, plans: list[Drawn]) -> None:
    row, physics = plans[-1].row, (setting["drag"], setting["gravity"])
    pos, vel = np.array(row["ball_pos"]), np.array(row["ball_vel"])
    time, path = ball_path(pos, vel, float(landing(pos, vel, *physics)[0]), *physics)
    look: Look = {"color": style.INK, "linewidth": 1.2, "linestyle": ":"}
    axes.plot(time, path[:, 2], label="ball, if it is not hit", **look)
    axes.legend(loc="upper right", fontsize=8.5)
    for plan in plans:
        plan.draw(axes, lambda motion: motion.pos[:, 2])
        end = (plan.motion.time[-1], plan.motion.pos[-1, 2])
        axes.plot(*end, "o", color=plan.look["color"], markersize=5)
    axes.axhline(setting["min_height"], **DASHED)
    axes.axhspan(0.0, setting["min_height"], **FORBIDDEN)
    axes.set_ylim(bottom=0.0)
    style.label(axes, "", "height z [m]", "Propeller plane and ball")
