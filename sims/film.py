"""Pictures of a flight: ball, quadrotor, plan and ghost images, without a display."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib import animation
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from planner_jax.sweep.figures.style import BLUE, GREEN, GREY, ORANGE, PURPLE
from sims.closed_loop import Record
from sims.model import World
from sims.vehicle import rotor_positions

BALL_COLOURS = (ORANGE, PURPLE, GREEN)
FORMATS = (".gif", ".mp4")
_FRAME = 2  # looks a frame
_GHOSTS = 6
_TURN = np.linspace(0.0, 2.0 * np.pi, 25)


class FilmError(ValueError):
    """A film that cannot be made, in one line."""


def require_film(path: Path) -> None:
    """Raise `FilmError` unless a film can be written here."""
    if path.suffix not in FORMATS:
        raise FilmError(f"video must end in {' or '.join(FORMATS)}, got {path.name!r}")
    if path.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise FilmError(f"video must end in .gif where ffmpeg is not installed, got {path.name!r}")


def _rotation(quat_wxyz: np.ndarray) -> np.ndarray:
    w, x, y, z = quat_wxyz
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _lines(world: World, qpos: np.ndarray) -> list[np.ndarray]:
    """Arms, and the rim of the tool, as lines (K, 3) in the world."""
    R, place = _rotation(qpos[3:7]), qpos[:3]
    arms = rotor_positions(world.vehicle)
    tool = world.tool
    rim = np.stack([np.cos(_TURN), np.sin(_TURN), 0.0 * _TURN], axis=1) * tool.radius
    rim[:, 2] = tool.height
    stick = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, tool.height]])
    return [place + part @ R.T for part in (arms[[0, 2]], arms[[1, 3]], rim, stick)]


class Scene:
    """One flight in a 3-D axes."""

    def __init__(self, figure: Figure, world: World, record: Record, after: Sequence[Any], title):
        """Draw what does not move.

        Args:
            figure: an empty one.
            world: of the flight.
            record: of ONE flight, leaves (K, ...).
            after: further ball paths (M, 3), such as that of a returned ball.
            title: of the picture.
        """
        self.world, self.qpos = world, np.asarray(record.physics.qpos)
        self.axes: Any = figure.add_subplot(projection="3d")
        balls = self.qpos[:, 7:].reshape(len(self.qpos), world.num_balls, 3)
        balls = np.where(np.abs(balls) < 20.0, balls, np.nan)
        self.balls = np.where(balls[:, :, 2:] > 0.0, balls, np.nan)
        wanted = np.asarray(record.wanted)
        self.axes.plot(*wanted.T, color=BLUE, lw=0.8, ls="--", label="plan")
        for path in after:
            self.axes.plot(*np.asarray(path).T, color=GREEN, lw=1.0, label="ball after the hit")
        self.trails = [
            self.axes.plot([], [], [], color=colour, lw=1.4, label=f"ball {k + 1}")[0]
            for k, colour in zip(
                range(world.num_balls), BALL_COLOURS * world.num_balls, strict=False
            )
        ]
        self.body = [self.axes.plot([], [], [], color=BLUE, lw=1.6)[0] for _ in range(4)]
        every = [wanted, self.balls.reshape(-1, 3), *map(np.asarray, after)]
        points = np.concatenate(every)
        low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
        low[2] = 0.0
        thin = np.maximum(2.0 - (high - low), 0.0)  # [m], so that flat flights keep their depth
        low, high = low - 0.2 - 0.5 * thin, high + 0.3 + 0.5 * thin
        self.axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(0.0, high[2]))
        self.axes.set_box_aspect(high - low)
        self.axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", title=title)
        self.axes.view_init(elev=14.0, azim=-65.0)
        self.axes.legend(loc="upper left", fontsize=8)

    def ghosts(self, last: int) -> None:
        """Faint images of the quadrotor at equal intervals up to a look."""
        for at in np.linspace(0, last, _GHOSTS).astype(int):
            for line in _lines(self.world, self.qpos[at]):
                self.axes.plot(*line.T, color=GREY, lw=0.8, alpha=0.7)

    def show(self, at: int) -> None:
        """The moving parts at a look."""
        for trail, path in zip(self.trails, np.moveaxis(self.balls[: at + 1], 1, 0), strict=True):
            trail.set_data_3d(*path.T)
        for line, part in zip(self.body, _lines(self.world, self.qpos[at]), strict=True):
            line.set_data_3d(*part.T)


def flight_of(record: Record, lane: int) -> Record:
    """The record of one flight of a batch."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[lane], record)


def draw_flight(
    path: Path, world: World, record: Record, until: float, title: str, after: Sequence[Any] = ()
) -> None:
    """Write a picture of one flight with ghost images up to a time [s]."""
    figure = Figure(figsize=(8.0, 6.0))
    FigureCanvasAgg(figure)
    scene = Scene(figure, world, record, after, title)
    last = int(np.argmin(np.abs(np.asarray(record.time) - until)))
    scene.ghosts(last)
    scene.show(last)
    _write(path, lambda scratch: figure.savefig(scratch, dpi=130, format="png"))


def film_flights(
    path: Path, world: World, records: Sequence[Record], titles: Sequence[str], after: Sequence[Any]
) -> None:
    """Write a film of some flights, one after the other; whole or not at all.

    Args:
        path: ends in .gif, or in .mp4 where ffmpeg is installed.
        world: of the flights.
        records: one a flight.
        titles: one a flight.
        after: further ball paths, a list a flight.

    Raises:
        FilmError: the file cannot be of that kind.
    """
    require_film(path)
    fps = 20
    kind = animation.PillowWriter if path.suffix == ".gif" else animation.FFMpegWriter

    def write(scratch: Path) -> None:
        figure = Figure(figsize=(6.4, 4.8), dpi=90)
        FigureCanvasAgg(figure)
        writer = kind(fps=fps)
        with writer.saving(figure, str(scratch), 90):
            for record, title, paths in zip(records, titles, after, strict=True):
                figure.clear()
                scene = Scene(figure, world, record, paths, title)
                for at in range(0, len(scene.qpos), _FRAME):
                    scene.show(at)
                    writer.grab_frame()

    _write(path, write)


def _write(path: Path, write: Any) -> None:
    """Let `write` fill a scratch file, and put it in place only once it is whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_name(f".{path.stem}.tmp{path.suffix}")
    try:
        write(scratch)
        os.replace(scratch, path)
    finally:
        scratch.unlink(missing_ok=True)
