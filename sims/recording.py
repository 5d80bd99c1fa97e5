"""Recordings of a run's first flights, from which they are drawn, filmed and replayed.

A recording is stored as the dataset `flights/` in the run folder, with one row per flight. Arrays
are stored as flat lists in SI units; the columns' metadata explain their order. Samples are equally
spaced in time. They start when the first ball leaves its machine, before the first plan, and end
when the last returned ball is on the ground.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from planner_jax.ball.flight import BallState
from planner_jax.core.errors import ArgumentError
from planner_jax.runs.columns import BOOL, LIST, VECTOR, RefereedBatch, leaves_of, rows_of
from planner_jax.runs.source import Chunk
from planner_jax.sims.loop_state import Flown
from planner_jax.sims.model import World
from planner_jax.sims.robot import Robot
from planner_jax.task.hit.court import fly, landing

FLIGHTS = "flights"  # name of the dataset in the run folder
_FAR = 20.0  # [m], distance beyond which a ball counts as not in flight
_LONGEST = 3.0  # [s], longest flight of a returned ball that is recorded


@dataclasses.dataclass(frozen=True)
class Recording:
    """F recorded flights of N balls at K samples each; NumPy arrays, world frame, z up.

    The robot has R joint positions. For a quadrotor these are the position of the propeller plane's
    centre [m] and the quaternion w x y z. A target that drives counts as a ball. Times count from
    the start of the first plan. A value is NaN if a ball is not in flight or never met, if the
    robot's simulation has ended, or if the flight has no target.
    """

    index: np.ndarray  # (F,), index of the flight in the run
    success: np.ndarray  # (F,) bool, whether the flight succeeded
    time: np.ndarray  # (F, K) [s], times of the samples
    robot: np.ndarray  # (F, K, R), joint positions of the robot
    wanted: np.ndarray  # (F, K, 3) [m], planned position of the robot; (F, K, Q, 3) of Q robots
    balls: np.ndarray  # (F, K, N, 3) [m], positions of the balls
    met: np.ndarray  # (F, N) [s], time of the contact with each ball
    contact: np.ndarray  # (F, N, 3) [m], position of the ball's centre at the contact
    target: np.ndarray  # (F, 3) [m], target of a returned ball
    # (F, K, M, 3) [m], path of the first ball as predicted at each sample, with M points; M is 0 if
    # predictions are not recorded.
    expected: np.ndarray

    def __len__(self) -> int:
        return len(self.index)

    def num_samples(self, flight: int) -> int:
        """Return the number of samples of a flight up to the last sample with a moving object."""
        there = np.isfinite(self.robot[flight]).all(axis=1)
        there |= np.isfinite(self.balls[flight]).all(axis=2).any(axis=1)
        return int(np.flatnonzero(there)[-1]) + 1

    def launch(self, flight: int) -> tuple[np.ndarray, float] | None:
        """Return launch position (3,) [m] and heading [rad] of the first ball; None if unknown."""
        path = self.balls[flight, :, 0]
        path = path[np.isfinite(path).all(axis=1)]
        if len(path) < 2:
            return None
        away = path[1] - path[0]
        return path[0], float(np.arctan2(away[1], away[0]))


class Frame(NamedTuple):
    """The positions of robot and balls at one sample of a recording."""

    time: float  # [s], time of the sample
    robot: np.ndarray  # (R,), joint positions of the robot
    wanted: np.ndarray  # (3,) [m], planned position of the robot
    balls: np.ndarray  # (N, 3) [m], positions; NaN for balls that are not in flight


@dataclasses.dataclass(frozen=True)
class Launches:
    """States of N balls of F flights, to compute the parts of their paths outside the simulation.

    MuJoCo simulates a ball only from the start of the plan for it to its contact with the robot.
    """

    balls: BallState  # leaves (F, N, 3), each at the start of the plan for it
    drag: Any  # (F, N), true drag coefficient K_D [1/m]
    begins: np.ndarray  # (N,) [s], start of the plan for each ball
    seen: float  # [s], how long a ball has been in flight at the start of its plan
    returned: BallState | None = None  # leaves (F, 3), the first ball just after its impact
    target: Any = None  # (F, 3) [m], where a returned ball should land


def frame(recording: Recording, robot: Robot, flight: int, sample: int) -> Frame:
    """Return the positions of robot and balls at a sample of a flight.

    After the end of its simulation the robot stays at its last position. A caught ball lies in the
    robot's net.

    Args:
        recording: the recorded flights of the run.
        robot: the robot that flew.
        flight: index of the flight in the recording.
        sample: index of the sample.

    Raises:
        ValueError: the recording has no such flight or sample.
    """
    for name, value, number in (
        ("flight", flight, len(recording)),
        ("sample", sample, recording.time.shape[1]),
    ):
        if not 0 <= value < number:
            raise ArgumentError(name, f">= 0 and < {number}", value)
    flown = np.isfinite(recording.robot[flight]).all(axis=1)
    at = min(sample, int(np.flatnonzero(flown)[-1]))
    pose = recording.robot[flight, at]
    balls, time = recording.balls[flight, sample].copy(), recording.time[flight, sample]
    held = robot.find_held_ball(pose)
    if np.isfinite(held).all():
        balls[time > _or_never(recording.met[flight])] = held
    return Frame(float(time), pose, recording.wanted[flight, at], balls)


def make_recording(
    world: World, flown: Flown, launches: Launches, *, index: np.ndarray, success: np.ndarray
) -> Recording:
    """Return the recording of F flights.

    The recording joins the balls' flights before the simulation, the simulated flights, and the
    flights of returned balls.

    Args:
        world: the simulated world.
        flown: F simulated flights with their records.
        launches: states of the balls before and after the simulation.
        index: (F,) indices of the flights in the run.
        success: (F,) bool, whether each flight succeeded.
    """
    record: Any = flown.record
    balls, drag, seen, returned = launches.balls, launches.drag, launches.seen, launches.returned
    steps, begins = np.asarray(record.time, float), np.asarray(launches.begins, float)
    apart = float(np.median(np.diff(steps[0])))
    number, samples = steps.shape
    met = np.where(flown.contact.met, flown.contact.time, np.nan)
    down = np.full((number, 1), np.nan)  # times at which returned balls reach the ground
    if returned is not None:
        away = landing(returned.pos, returned.vel, drag[:, 0], np.full(number, world.gravity))[0]
        down = met[:, :1] + np.minimum(np.nan_to_num(away, nan=_LONGEST), _LONGEST)[:, None]
    before = round((seen + steps[0, 0]) / apart)
    after = int(np.ceil((np.nanmax(np.append(down, steps[0, -1])) - steps[0, -1]) / apart - 1e-6))
    grid = steps[0, 0] + apart * np.arange(-before, samples + after)
    time = np.broadcast_to(grid, (number, grid.size))

    def extend(leaf: np.ndarray) -> np.ndarray:
        whole = np.full((number, grid.size, *leaf.shape[2:]), np.nan)
        whole[:, before : before + samples], whole[:, :before] = leaf, leaf[:, :1]
        return whole

    def flight_of(ball: BallState, span: np.ndarray, drag: np.ndarray) -> np.ndarray:
        pos, vel = (np.asarray(leaf, float)[:, None] for leaf in (ball.pos, ball.vel))
        return fly(pos, vel, span, drag[:, None], np.full(span.shape, world.gravity))[0]

    robot, simulated = np.split(
        np.asarray(record.physics.qpos, float), [world.robot.num_pos], axis=2
    )
    paths = extend(simulated.reshape(number, samples, -1, 3))
    own = time[:, :, None] - begins  # (F, K, N) [s], since each ball was planned for
    early = flight_of(balls, np.clip(own, -seen, 0.0), drag)
    paths = np.where((own < 0.5 * apart)[..., None], early, paths)
    gone = (own < -seen - 0.5 * apart) | (time[:, :, None] > _or_never(met)[:, None])
    with np.errstate(invalid="ignore"):
        paths[gone | (np.abs(paths).max(axis=3) > _FAR) | (paths[..., 2] < 0.0)] = np.nan
    if returned is not None:
        back = time > _or_never(met[:, :1])
        span = np.where(back, np.clip(time, None, down) - met[:, :1], 0.0)
        path = flight_of(returned, span, drag[:, 0])
        paths[:, :, 0] = np.where(back[..., None], path, paths[:, :, 0])
    contact = np.where(np.isfinite(met)[..., None], flown.contact.ball_pos, np.nan)
    no_target = np.full((number, 3), np.nan)
    return Recording(
        index=np.asarray(index),
        success=np.asarray(success),
        time=time,
        robot=extend(robot),
        wanted=extend(np.asarray(record.wanted, float)),
        balls=paths,
        met=met,
        contact=contact,
        target=no_target if launches.target is None else np.asarray(launches.target),
        expected=np.zeros((number, grid.size, 0, 3)),
    )


def _or_never(time: np.ndarray) -> np.ndarray:
    return np.nan_to_num(time, nan=np.inf)


_COLUMNS = leaves_of(
    "verdict",
    ("index", "", "index in the run", pa.int64()),
    ("success", "", "by the task's criterion", BOOL),
    ("time", "s", "of each sample", LIST),
    ("robot", "", "samples x R, flat; joint positions in MuJoCo's order, m and rad", LIST),
    ("wanted", "m", "samples x 3 for each robot, flat; planned position", LIST),
    ("balls", "m", "samples x balls x 3, flat; NaN where not in flight", LIST),
    ("met", "s", "time of the contact with each ball, NaN for never", LIST),
    ("contact", "m", "balls x 3, flat; position of each ball at its contact", LIST),
    ("target", "m", "of a returned ball, NaN for catches", VECTOR),
    ("expected", "m", "samples x points x 3, flat; predicted path of the ball or target", LIST),
)


def to_rows(recording: Recording) -> pa.Table:
    """Convert a recording to a table with one row per flight."""
    batch = RefereedBatch(Chunk(recording.index, None), None, recording)
    return rows_of(_COLUMNS, batch, "world, z up; times from the start of the first plan")


def read_recording(table: pa.Table) -> Recording:
    """Convert a table that `to_rows` returned back to a recording.

    Raises:
        ValueError: columns are missing, or their sizes do not fit each other.
    """
    wanted = {column.name: column.type for column in _COLUMNS}
    found = dict(zip(table.column_names, table.schema.types, strict=True))
    if found != wanted:
        odd = sorted(name for name in wanted | found if found.get(name) != wanted.get(name))
        raise ArgumentError(
            "columns", "the columns of a recording", shown=f"others for {', '.join(odd)}"
        )
    if not len(table):
        raise ArgumentError("flights", "one or more", shown="none")
    columns = {
        name: np.array(table[name].to_pylist(), None if name in ("index", "success") else float)
        for name in table.column_names
    }
    number, samples = columns["time"].shape
    for name in ("robot", "wanted"):
        columns[name] = columns[name].reshape(number, samples, -1)
    columns["balls"] = columns["balls"].reshape(number, samples, -1, 3)
    columns["contact"] = columns["contact"].reshape(number, -1, 3)
    points = columns["expected"].shape[1] // (3 * samples)
    columns["expected"] = columns["expected"].reshape(number, samples, points, 3)
    return Recording(**columns)
