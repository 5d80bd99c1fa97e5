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
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from planner_jax.sweep.figures.style import BLUE, GREEN, INK, ORANGE, PALE, PURPLE, RED, SKY
from sims.closed_loop import Record
from sims.model import World
from sims.vehicle import rotor_positions

BALL_COLOURS = (ORANGE, PURPLE, GREEN)
FORMATS = (".gif", ".mp4")
_FRAME = 2  # looks a frame
_GHOSTS, _APART = 7, 0.45  # at most; [m] of way from one to the next
_ROTOR = 0.06  # [m], radius
_FAR = 20.0  # [m], where balls wait that are not in flight
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
    """Arms, rotors, stick and rim of the tool, as lines (K, 3) in the world."""
    R, place = _rotation(qpos[3:7]), qpos[:3]
    arms = rotor_positions(world.vehicle)
    tool = world.tool
    circle = np.stack([np.cos(_TURN), np.sin(_TURN), 0.0 * _TURN], axis=1)
    top = np.array([0.0, 0.0, tool.height])
    parts = [arms[[0, 2]], arms[[1, 3]], np.stack([0.0 * top, top])]
    parts += [arm + _ROTOR * circle for arm in arms]
    parts.append(top + tool.radius * circle)  # last: it is filled
    return [place + part @ R.T for part in parts]


class Scene:
    """One flight in a 3-D axes."""

    def __init__(
        self,
        figure: Figure,
        world: World,
        record: Record,
        met: Sequence[float],
        after: Sequence[Any],
        title: str,
        view: tuple[float, float] = (14.0, -65.0),
    ):
        """Draw what does not move.

        Args:
            figure: an empty one.
            world: of the flight.
            record: of ONE flight, leaves (K, ...).
            met: (N,) [s], when each ball was met, NaN for never; it is not shown after that.
            after: further ball paths (M, 3), such as that of a returned ball.
            title: of the picture.
            view: elevation and azimuth of the eye [degree].
        """
        self.world, self.qpos = world, np.asarray(record.physics.qpos)
        self.times, self.met = np.asarray(record.time), np.asarray(met, float)
        self.axes: Any = figure.add_subplot(projection="3d")
        balls = self.qpos[:, 7:].reshape(len(self.qpos), world.num_balls, 3)
        gone = (np.abs(balls).max(axis=2) > _FAR) | (balls[:, :, 2] < 0.0)
        gone |= self.times[:, None] > np.nan_to_num(self.met, nan=np.inf)
        self.balls = np.where(gone[:, :, None], np.nan, balls)
        last = int(np.searchsorted(self.times, np.nanmax(np.append(self.met, 0.0))))
        last = last if last else len(self.times)
        wanted = np.asarray(record.wanted)[: last + 1]
        plan = self.axes.plot(*wanted.T, color=INK, lw=1.0, ls="--", label="plan")
        self.moving = plan[:0]
        colours = [BALL_COLOURS[k % len(BALL_COLOURS)] for k in range(world.num_balls)]
        names = ["ball"] if len(colours) == 1 else [f"ball {k + 1}" for k in range(len(colours))]
        self.trails = [
            self.axes.plot([], [], [], color=colour, lw=1.6, label=name)[0]
            for colour, name in zip(colours, names, strict=True)
        ]
        self.after = [
            self.axes.plot(*np.asarray(path).T, color=GREEN, lw=1.6, label="returned ball")[0]
            for path in after
        ]
        every = [wanted, self.balls.reshape(-1, 3), *map(np.asarray, after)]
        points = np.concatenate(every)
        low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
        thin = np.maximum(1.6 - (high - low), 0.0)  # [m], so that flat flights keep their depth
        low, high = low - 0.2 - 0.5 * thin, high + 0.2 + 0.5 * thin
        low[2] = max(low[2] - 0.3, 0.0)
        self.axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        self.axes.set_box_aspect(high - low, zoom=1.0)
        self.axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", title=title)
        for axis in (self.axes.xaxis, self.axes.yaxis, self.axes.zaxis):
            axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10], prune="both"))
            axis.pane.set_facecolor("white")
            axis.labelpad = 6.0
        for path in (wanted, *np.moveaxis(self.balls, 1, 0), *map(np.asarray, after)):
            self.axes.plot(path[:, 0], path[:, 1], low[2], color=PALE, lw=1.0, zorder=0)
        self.axes.view_init(*view)
        self.axes.legend(loc="upper left", fontsize=9, frameon=False)

    def quadrotor(self, at: int, alpha: float = 1.0) -> list[Any]:
        """The quadrotor at a look, and what it was drawn with."""
        *frame, rim = _lines(self.world, self.qpos[at])
        drawn = [
            self.axes.plot(*line.T, color=BLUE, lw=1.4, alpha=alpha)[0] for line in (*frame, rim)
        ]
        disc = Poly3DCollection([rim], facecolor=SKY, edgecolor="none", alpha=0.5 * alpha)
        return [*drawn, self.axes.add_collection3d(disc)]

    def ghosts(self, last: int) -> None:
        """Images of the quadrotor and the balls at equal intervals up to a look, ever firmer."""
        path = self.qpos[: last + 1, :3]
        way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
        number = int(np.clip(way[-1] / _APART, 1, _GHOSTS))
        for share in np.arange(number) / number:
            at = int(np.searchsorted(way, share * way[-1]))
            self.quadrotor(at, 0.15 + 0.4 * share)
            for ball, trail in zip(self.balls[at], self.trails, strict=True):
                self.axes.plot(*ball[:, None], ".", ms=7, color=trail.get_color())

    def contacts(self, label: str) -> None:
        """A star where each ball was met."""
        for k, time in enumerate(self.met):
            if np.isfinite(time):
                at = int(np.searchsorted(self.times, time)) - 1
                place = self.balls[max(at, 0), k][:, None]
                self.axes.plot(*place, "*", ms=13, color=RED, mec="white", label=label, zorder=9)
                label = "_"
        self.axes.legend(loc="upper left", fontsize=9, frameon=False)

    def show(self, at: int) -> None:
        """The moving parts at a look."""
        for trail, path in zip(self.trails, np.moveaxis(self.balls[: at + 1], 1, 0), strict=True):
            trail.set_data_3d(*path.T)
        for path in self.after:
            path.set_visible(bool(self.times[at] >= self.met[0]))
        for part in self.moving:
            part.remove()
        self.moving = self.quadrotor(at)


def flight_of(record: Record, lane: int) -> Record:
    """The record of one flight of a batch."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[lane], record)


def draw_flight(
    path: Path,
    world: World,
    record: Record,
    met: Sequence[float],
    title: str,
    after: Sequence[Any] = (),
    *,
    view: tuple[float, float] = (14.0, -65.0),
    target: Any = None,
) -> None:
    """Write a picture of one flight with ghost images.

    Args:
        path: ends in .png.
        world: of the flight.
        record: of ONE flight, leaves (K, ...).
        met: (N,) [s], when each ball was met, NaN for never.
        title: of the picture.
        after: further ball paths (M, 3).
        view: elevation and azimuth of the eye [degree].
        target: (3,) [m], where a returned ball is to land.
    """
    figure = Figure(figsize=(7.6, 6.0))
    FigureCanvasAgg(figure)
    scene = Scene(figure, world, record, met, after, title, view)
    figure.subplots_adjust(left=0.0, right=0.96, bottom=0.04, top=0.95)
    times, end = np.asarray(record.time), np.nanmax(np.append(met, 0.0))
    last = int(np.searchsorted(times, end)) if end > 0.0 else len(times) - 1
    last = min(last, len(times) - 1)
    scene.ghosts(last)
    scene.show(last)
    if target is not None:
        scene.axes.plot(*np.asarray(target)[:, None], "X", ms=10, color=INK, label="target")
    scene.contacts("caught" if world.tool.kind == "net" else "hit")
    _write(path, lambda scratch: figure.savefig(scratch, dpi=110, format="png"))


def film_flights(
    path: Path,
    world: World,
    records: Sequence[Record],
    met: Any,
    titles: Sequence[str],
    after: Sequence[Any],
) -> None:
    """Write a film of some flights, one after the other; whole or not at all.

    Args:
        path: ends in .gif, or in .mp4 where ffmpeg is installed.
        world: of the flights.
        records: one a flight.
        met: (F, N) [s], a row a flight, when its balls were met, NaN for never.
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
            for record, times, title, paths in zip(records, met, titles, after, strict=True):
                figure.clear()
                scene = Scene(figure, world, record, times, paths, title)
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
