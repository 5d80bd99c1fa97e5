"""Pictures and films of simulated flights by matplotlib: robot, planned path and balls."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import animation
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from planner_jax.core.errors import ArgumentError
from planner_jax.host.files import replacing
from planner_jax.runs.style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PALE,
    PURPLE,
    RED,
    SKY,
    Look,
)
from planner_jax.sims.recording import Recording, frame
from planner_jax.sims.robot import Solid, rotation
from planner_jax.sims.scenery import FLAT, Part, Prism, machine_parts, outlines, part_solid
from planner_jax.sims.task import FlightTask

BALL_COLOURS = (ORANGE, PURPLE, GREEN)
FORMATS = (".gif", ".mp4")
_FRAME = 2  # number of recorded samples from one frame of a film to the next
_STAR: Look = {"marker": "*", "ls": "", "ms": 13, "color": RED, "mec": "white", "zorder": 9}
_GHOSTS, _APART = 7, 0.45  # greatest number of ghost images, and their spacing on the path [m]


def require_film(path: Path) -> None:
    """Raise `ArgumentError` unless this machine can write films of the path's suffix."""
    if path.suffix not in FORMATS:
        raise ArgumentError("video", " or ".join(FORMATS), path.name, verb="end in")
    if path.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise ArgumentError("video", ".gif where ffmpeg is not installed", path.name, verb="end in")


class Scene:
    """A drawing of one recorded flight in matplotlib's 3-D axes."""

    def __init__(
        self,
        figure: Figure,
        task: FlightTask,
        recording: Recording,
        flight: int,
    ):
        """Draw all parts that do not move.

        Args:
            figure: an empty figure.
            task: the task of the run.
            recording: the recorded flights of the run.
            flight: index of the flight in the recording.
        """
        world = task.world()
        self.world, self.recording, self.flight = world, recording, flight
        self.num_samples = recording.num_samples(flight)
        self.times, self.met = recording.time[flight], recording.met[flight]
        balls, met = recording.balls[flight], np.nan_to_num(self.met, nan=np.inf)
        after = self.times[:, None] > met
        self.balls = np.where(after[..., None], np.nan, balls)
        self.back = np.where(after[:, :1], balls[:, 0], np.nan)  # trajectory of the returned ball
        self.axes: Any = figure.add_subplot(projection="3d")
        wanted = self.plan_path()
        for k, path in enumerate(np.moveaxis(wanted, 1, 0)):
            label = "_" if k else "plan"
            self.axes.plot(*path.T, color=INK, lw=1.0, ls="--", label=label)
        self.moving: list[Any] = []
        number, thing = balls.shape[1], task.THING
        colours = [BALL_COLOURS[k % len(BALL_COLOURS)] for k in range(number)]
        names = [thing] if number == 1 else [f"{thing} {k + 1}" for k in range(number)]
        self.trails = [
            self.axes.plot([], [], [], color=colour, lw=1.6, label=name)[0]
            for colour, name in zip(colours, names, strict=True)
        ]
        self.dots = [self.axes.plot([], [], [], "o", ms=5, color=colour)[0] for colour in colours]
        self.returned = None
        if np.isfinite(self.back).any():
            self.returned = self.axes.plot([], [], [], color=GREEN, lw=1.6, label="returned ball")[
                0
            ]
        self.predictions = []
        if recording.expected.shape[2]:
            style = {"color": RED, "lw": 1.0, "ls": ":", "label": f"predicted {thing}"}
            self.predictions = self.axes.plot([], [], [], **style)
        prisms = task.surroundings(int(recording.index[flight]))
        standing = [prism for prism in prisms if not any(prism.velocity)]
        self.movers = [prism for prism in prisms if any(prism.velocity)]
        flat = [part for part in world.scenery if part.size[2] <= FLAT]
        solid = [part for part in world.scenery if part.size[2] > FLAT] + self._machine()
        patches = [outlines(part)[1] for part in flat]
        edges = [line for part in solid for line in outlines(part)]
        edges += [line for prism in standing for line in prism.outlines(0.0)]
        if task.BOUNDS is None:
            moved = world.robot.place(recording.robot[flight, : self.num_samples])
            moved, planned = moved.reshape(-1, 3), wanted.reshape(-1, 3)
            points = np.concatenate([planned, moved, balls.reshape(-1, 3), *edges, *patches])
            low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
            thin = np.maximum(1.6 - (high - low), 0.0)  # [m], padding of axes with a short range
            low, high = low - 0.2 - 0.5 * thin, high + 0.2 + 0.5 * thin
            low[2] = 0.0
        else:
            low, high = map(np.array, task.BOUNDS)
            balls = self._within(low, high)
        self.axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        self.axes.set_box_aspect(high - low, zoom=1.15)
        title = task.title(recording, flight)
        self.axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", title=title)
        ticks = np.ceil(5.0 * (high - low) / (high - low).max()).astype(int)
        for axis, most in zip(
            (self.axes.xaxis, self.axes.yaxis, self.axes.zaxis), ticks, strict=True
        ):
            axis.set_major_locator(MaxNLocator(most, steps=[1, 2, 5, 10], prune="both"))
            axis.pane.set_facecolor("white")
            axis.labelpad = 6.0
        for path in (*np.moveaxis(wanted, 1, 0), *np.moveaxis(balls, 1, 0)):
            self.axes.plot(path[:, 0], path[:, 1], 0.0, color=PALE, lw=1.0, zorder=0)
        for line in edges:
            self.axes.plot(*line.T, color=GREY, lw=0.8, zorder=1)
        for part, patch in zip(flat, patches, strict=True):
            style = {"facecolor": part.colour, "edgecolor": GREY, "linewidth": 0.5, "alpha": 0.4}
            self.axes.add_collection3d(Poly3DCollection([patch], zorder=0, **style))
        for prism in standing:
            self._fill(prism, 0.0)
        for part in solid:
            if part.opacity < 1.0:
                self._add_solid(part_solid(part), part.colour, part.opacity)
        self.axes.view_init(*task.VIEW)
        figure.legend(loc="upper left", fontsize=9, frameon=False)

    def _within(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        balls = self.recording.balls[self.flight]
        inside = ((balls >= low) & (balls <= high)).all(axis=2, keepdims=True)
        self.balls = np.where(inside, self.balls, np.nan)
        self.back = np.where(inside[:, 0], self.back, np.nan)
        return np.where(inside, balls, np.nan)

    def _fill(self, prism: Prism, time: float) -> list[Any]:
        top = prism.outlines(time)[1]
        style = {"facecolor": prism.colour, "edgecolor": GREY, "linewidth": 0.5, "alpha": 0.6}
        return [self.axes.add_collection3d(Poly3DCollection([top], **style))]

    def _add_solid(self, solid: Solid, colour: str, opacity: float, shade: bool = False) -> Any:
        faces = solid.corners[solid.triangles]
        style = {"facecolors": colour, "edgecolors": colour, "linewidth": 0.0}
        style |= {"alpha": opacity, "shade": shade}
        return self.axes.add_collection3d(Poly3DCollection(faces, **style))

    def plan_path(self) -> np.ndarray:
        """Return planned positions (K, N, 3) [m] of N robots, up to the last contact."""
        wanted = self.recording.wanted[self.flight, : self.find_last_contact() + 1]
        wanted = wanted.reshape(len(wanted), -1, 3)
        return wanted[np.isfinite(wanted).all(axis=(1, 2))]

    def find_last_contact(self) -> int:
        """Return the index of the first sample after the last contact of a ball with the robot.

        If the flight has no contact, this is the last sample with a moving object.
        """
        end = np.nanmax(np.append(self.met, -np.inf))
        at = int(np.searchsorted(self.times, end)) if np.isfinite(end) else self.num_samples
        return min(at, self.num_samples - 1)

    def _machine(self) -> list[Part]:
        launch = self.recording.launch(self.flight)
        return machine_parts(*launch) if launch and self.world.mouth else []

    def robot(self, at: int, alpha: float = 1.0) -> list[Any]:
        """Draw the robot at sample `at` with opacity `alpha`; return the matplotlib artists."""
        robot = self.world.robot
        pose = frame(self.recording, robot, self.flight, at).robot
        drawn: list[Any] = []
        for shape, (place, quat) in zip(robot.shapes(), robot.places(pose), strict=True):
            R = rotation(quat, np)
            lines = [place + line @ R.T for line in shape.lines]
            for corners, triangles in shape.solids:
                solid = Solid(place + corners @ R.T, triangles)
                colour = SKY if shape.tool else shape.colour
                drawn.append(self._add_solid(solid, colour, alpha, shade=True))
            drawn += [self.axes.plot(*line.T, color=BLUE, lw=1.4, alpha=alpha)[0] for line in lines]
            if shape.tool:
                style = {"facecolor": SKY, "edgecolor": "none", "alpha": 0.5 * alpha}
                drawn.append(self.axes.add_collection3d(Poly3DCollection([lines[-1]], **style)))
        return drawn

    def ghosts(self, last: int) -> None:
        """Draw robot and balls at several times in one picture, up to the sample `last`.

        The images are equally far apart along the robot's path; later images are more opaque.
        """
        path = self.world.robot.place(self.recording.robot[self.flight, : last + 1])
        path = path[np.isfinite(path).all(axis=1)]
        distance = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
        number = int(np.clip(distance[-1] / _APART, 1, _GHOSTS))
        for share in np.arange(number) / number:
            at = int(np.searchsorted(distance, share * distance[-1]))
            self.robot(at, 0.15 + 0.4 * share)
            for ball, trail in zip(self.balls[at], self.trails, strict=True):
                self.axes.plot(*ball[:, None], ".", ms=7, color=trail.get_color())

    def contacts(self, label: str) -> None:
        """Draw a star at each contact of ball and tool, and a cross at the ball's target point.

        `label` is the name of a contact in the legend, such as "hit".
        """
        target = self.recording.target[self.flight]
        if np.isfinite(target).all():
            self.axes.plot(*target[:, None], "X", ms=10, color=INK, label="target")
        for place in self.recording.contact[self.flight]:
            if np.isfinite(place).all():
                self.axes.plot(*place[:, None], label=label, **_STAR)
                label = "_"
        self.axes.figure.legends.clear()
        self.axes.figure.legend(loc="upper left", fontsize=9, frameon=False)

    def show(self, at: int, back: int | None = None) -> None:
        """Draw robot, balls, moving obstacles and earlier contacts at the sample with index `at`.

        The drawn path of a ball that the racket has returned ends at the sample `back`, by default
        at `at`; a picture shows the whole path up to the ground.
        """
        for trail, path in zip(self.trails, np.moveaxis(self.balls[: at + 1], 1, 0), strict=True):
            trail.set_data_3d(*path.T)
        for k, dot in enumerate(self.dots):
            is_back = k == 0 and np.isfinite(self.back[at]).all()
            dot.set_data_3d(*(self.back if is_back else self.balls[:, k])[at, :, None])
        if self.returned is not None:
            self.returned.set_data_3d(*self.back[: (at if back is None else back) + 1].T)
        for part in self.moving:
            part.remove()
        self.moving = self.robot(at)
        for prism in self.movers:
            self.moving += self._fill(prism, float(self.times[at]))
        for place in self.recording.contact[self.flight][self.met <= self.times[at]]:
            self.moving += self.axes.plot(*place[:, None], **_STAR)
        for line in self.predictions:
            line.set_data_3d(*self.recording.expected[self.flight, at].T)


def draw_flight(path: Path, task: FlightTask, recording: Recording, flight: int) -> None:
    """Write a picture of one flight, in which robot and balls also appear at earlier times.

    Args:
        path: path of the picture, which ends in .png.
        task: the task of the run.
        recording: the recorded flights of the run.
        flight: index of the flight in the recording.
    """
    figure = Figure(figsize=(7.6, 6.0))
    FigureCanvasAgg(figure)
    scene = Scene(figure, task, recording, flight)
    figure.subplots_adjust(left=0.0, right=0.96, bottom=0.04, top=0.95)
    scene.ghosts(scene.find_last_contact())
    scene.show(scene.find_last_contact(), scene.num_samples - 1)
    scene.contacts(task.CONTACT)
    _write(path, lambda scratch: figure.savefig(scratch, dpi=110, format="png"))


def film_flights(path: Path, task: FlightTask, recording: Recording, num: int) -> None:
    """Write a film of the first `num` flights of a recording, one after the other.

    If writing is interrupted, no file remains.

    Args:
        path: path of the film, which ends in .gif, or in .mp4 where ffmpeg is installed.
        task: the task of the run.
        recording: the recorded flights of the run.
        num: number of flights in the film.

    Raises:
        ArgumentError: this machine cannot write a film in the file's format.
    """
    require_film(path)
    fps = 20
    kind = animation.PillowWriter if path.suffix == ".gif" else animation.FFMpegWriter

    def write(scratch: Path) -> None:
        figure = Figure(figsize=(6.4, 4.8), dpi=90)
        FigureCanvasAgg(figure)
        writer = kind(fps=fps)
        with writer.saving(figure, str(scratch), 90):
            for flight in range(num):
                figure.clear()
                scene = Scene(figure, task, recording, flight)
                outcome, last = scene.axes.get_title(), scene.find_last_contact()
                name, _, _ = outcome.partition(",")
                for at in range(0, scene.num_samples, _FRAME):
                    scene.axes.set_title(outcome if at >= last else name)
                    scene.show(at)
                    writer.grab_frame()

    _write(path, write)


def _write(path: Path, write: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as scratch:
        write(scratch)
