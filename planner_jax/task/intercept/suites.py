"""Named, seeded suites of interceptions on a map of 8 m x 8 m, and what is seen of their targets.

Paper 003 shows one map of its own (Section V) and gives no ranges. Those here and in
`planner_jax.task.intercept.spec` are this library's, and part of each suite's name: a change of a
range is another suite. All draws are uniform; the car is that of `case`.

| what | drawn from |
|---|---|
| start | x 0.8 m, y 1 to 7 m, heading 0, 0.5 m/s |
| target | 0.2 to 0.5 m/s in any direction; half of them turn, at 0.03 to 0.1 rad/s |
| meeting point | anywhere at least 0.3 m inside the map; in a maze behind its first wall |
| walls | 3 to 6 corners on a circle of 0.2 to 0.8 m anywhere on the map |
| movers | 4 to 6 corners on a circle of 0.2 to 0.4 m, 0.1 to 0.6 m/s (`storm`: 0.2 to 1 m/s) |

A mover's middle crosses the straight line from start to meeting point at 0.2 to 0.8 of the time,
in any direction, where a car that drives evenly along that line is just then.

A maze has walls of 0.2 m across the whole map, each with a gap of 0.7 to 1.1 m. Two arms of 0.5
to 0.8 m on the side of the start, 0.8 to 1.4 m apart, make a dead end of the place where the
straight line to the meeting point runs into a wall, or of the nearest one that leaves the gap
alone; walls less than 2.5 m from the map's edge have none, so that the start has room to turn.

A rush is what `hard` draws, with a tag of its own, and its target is to be met earlier than after
the 10 s that the rest is drawn for: 0.5 s after the first layer of the reach set of
`task.intercept.reach_time`, worked out in double precision. So its time differs from case
to case. A target that is not reached within 10 s is drawn anew, as is one at which something is
wrong at the new time.

Whether the target turns and how many walls and movers there are is drawn once a case; the rest is
drawn anew until `planner_jax.task.intercept.rejection` finds nothing wrong with it. World frame in
the plane, SI units.
"""

import dataclasses
import zlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.core.checks import floating
from planner_jax.core.protocol import lane
from planner_jax.core.registry import require_name
from planner_jax.plane.obstacles import Obstacles
from planner_jax.plane.target import PlanePath, TurningPath
from planner_jax.task.arguments import require_draw
from planner_jax.task.intercept.case import InterceptCase, case
from planner_jax.task.intercept.reach_time import earliest_arrival
from planner_jax.task.intercept.rejection import CAUSES, SIZE, TOP_SPEED, first_cause, moved
from planner_jax.task.intercept.spec import SUITES, Suite

START_X, START_SPEED = 0.8, 0.5  # [m], [m/s]
EDGE_ROOM = 0.3  # [m], from the meeting point to the edge of the map
THICKNESS = 0.2  # [m], of a maze's walls
_SHAPE = 9  # numbers that a polygon takes: radius, corners, rotation, and six angles


@dataclasses.dataclass(frozen=True)
class Drawn:
    """Cases of a suite, and how many draws they took."""

    cases: InterceptCase  # leaves with leading axis B
    draws: np.ndarray  # (B,) int, the accepted one included
    rejected: dict[str, np.ndarray]  # cause -> (B,) int, draws rejected for it first

    @property
    def acceptance(self) -> float:
        """Share of all draws that were accepted."""
        return len(self.draws) / int(self.draws.sum())


def draw_cases(
    suite: str, num: int, seed: int, first: int = 0, *, dtype: Any = jnp.float32
) -> InterceptCase:
    """A batch of cases of a suite, drawn in float64 and then cast.

    Args:
        suite: a key of `SUITES`.
        num: B, how many, >= 1.
        seed: >= 0. Case k of a suite and seed is always the same one.
        first: place of the first one, >= 0.
        dtype: of every floating leaf.

    Raises:
        ValueError: an argument is out of its range; one line.
    """
    return drawn(suite, num, seed, first, dtype=dtype).cases


def drawn(suite: str, num: int, seed: int, first: int = 0, *, dtype: Any = jnp.float32) -> Drawn:
    """The same cases, and how many draws of each were rejected, and why; see `draw_cases`."""
    require_name(SUITES, "suite", suite)
    own, randoms, dtype = SUITES[suite], generators(suite, num, seed, first), floating(dtype)
    accepted, draws, rejected = accepted_draws(own, randoms)
    return Drawn(cases=cases_of(accepted, dtype), draws=draws, rejected=rejected)


def generators(suite: str, num: int, seed: int, first: int) -> list[np.random.Generator]:
    """A generator of its own for every case, so that none depends on the others.

    Raises:
        ValueError: an argument is out of its range; one line.
    """
    require_draw(num, seed, first)
    tag = zlib.crc32(suite.encode())
    return [np.random.default_rng([seed, first + k, tag]) for k in range(num)]


def accepted_draws(
    own: Suite, randoms: list[np.random.Generator]
) -> tuple[dict[str, np.ndarray], np.ndarray, dict[str, np.ndarray]]:
    """Of every generator the first draw in which nothing is wrong.

    Returns:
        accepted: see `planner_jax.task.intercept.rejection`.
        draws: (B,) int, as of `Drawn`.
        rejected: likewise.
    """
    num = len(randoms)
    kinds = np.stack([random.random(3) for random in randoms])
    pending, draws = np.arange(num), np.zeros(num, int)
    rejected = np.zeros((len(CAUSES), num), int)
    accepted: dict[str, np.ndarray] = {}
    while len(pending):
        uniform = np.stack([randoms[k].random(_columns(own)) for k in pending])
        candidates = _candidates(own, kinds[pending], uniform)
        cause = first_cause(own, candidates)
        if own.spare is not None and (good := np.flatnonzero(cause == len(CAUSES))).size:
            some = _hurried(own, {name: leaf[good] for name, leaf in candidates.items()})
            cause[good] = first_cause(own, some)
            for name, leaf in some.items():
                candidates[name][good] = leaf
        draws[pending] += 1
        is_good = cause == len(CAUSES)
        rejected[cause[~is_good], pending[~is_good]] += 1
        for name, leaf in candidates.items():
            if name not in accepted:
                accepted[name] = np.zeros((num, *leaf.shape[1:]), leaf.dtype)
            accepted[name][pending[is_good]] = leaf[is_good]
        pending = pending[~is_good]
    return accepted, draws, dict(zip(CAUSES, rejected, strict=True))


def observe(
    cases: InterceptCase,
    seed: int,
    noise: float = 0.1,
    count: int = 15,
    interval: float = 1.0,
    first: int = 0,
    until: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """What was seen of the targets until the cars set out (paper 003, eq. 4), or longer.

    Args:
        cases: leaves with leading axis B.
        seed: >= 0. What is seen in case k is always the same.
        noise: [m], standard deviation on each axis.
        count: how many observations up to time 0, when the last of them is made.
        interval: [s], between two of them.
        first: place of the first case, >= 0.
        until: [s], how long the targets are still looked at after time 0, >= 0. What is seen
            before is the same for all.

    Returns:
        times: (L,) [s], L = count + floor(until / interval).
        positions: (B, L, 2) [m].

    Raises:
        ValueError: an argument is out of its range; one line.
    """
    given = {"count": (count, 1), "noise": (noise, 0), "first": (first, 0), "until": (until, 0)}
    for name, (value, least) in given.items():
        if not value >= least:
            raise ValueError(f"{name} must be >= {least}, got {value}")
    if not interval > 0.0:
        raise ValueError(f"interval must be > 0, got {interval}")
    times = interval * np.arange(1.0 - count, 1.0 + np.floor(until / interval + 1e-9))
    positions = np.asarray(_seen(cases.target, times.astype(cases.time.dtype)))
    tag = zlib.crc32(b"observations")
    errors = [
        np.random.default_rng([seed, first + k, tag]).standard_normal((len(times), 2))
        for k in range(len(positions))
    ]
    return times, positions + noise * np.stack(errors)


@jax.jit
def _seen(paths: PlanePath, times: Array) -> Array:
    """Positions (B, L, 2) [m] on paths with leading axis B at times (L,) [s]."""
    return jax.vmap(lambda path: jax.vmap(lambda time: path.at(time).pos)(times))(paths)


def _columns(suite: Suite) -> int:
    """How many numbers one draw takes."""
    return 7 + suite.wall_room[0] * (2 + _SHAPE) + suite.mover_room[0] * (3 + _SHAPE)


def _between(uniform: np.ndarray, low: Any, high: Any) -> np.ndarray:
    """Numbers of [0, 1) spread over an interval."""
    return low + uniform * (high - low)


def _whole(uniform: np.ndarray, fewest: int, most: int) -> np.ndarray:
    """Numbers of [0, 1) as whole ones from the fewest to the most."""
    return np.floor(_between(uniform, fewest, most + 1)).astype(int)


def _unit(angle: np.ndarray) -> np.ndarray:
    """Unit vectors (..., 2) at angles (...) [rad]."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _candidates(suite: Suite, kinds: np.ndarray, uniform: np.ndarray) -> dict[str, np.ndarray]:
    """One draw for each of B cases, leaves with leading axis B.

    Args:
        suite: what to draw.
        kinds: (B, 3), numbers that hold for all draws of a case.
        uniform: (B, `_columns(suite)`), those of this draw.
    """
    turning, count_walls = kinds[:, 0] < 0.5, _whole(kinds[:, 1], *suite.num_walls)
    count_movers = _whole(kinds[:, 2], *suite.num_movers)
    cuts = np.cumsum([7, suite.wall_room[0] * (2 + _SHAPE)])
    u, walls, movers = np.split(uniform, cuts, axis=1)
    start = np.stack([np.full(len(u), START_X), _between(u[:, 0], 1.0, SIZE - 1.0)], axis=1)
    meeting = anywhere(u[:, 1:3])
    walls = walls.reshape(len(u), suite.wall_room[0], 2 + _SHAPE)
    if suite.is_maze:
        across = _across(walls[:, :3, 0], count_walls)
        meeting[:, 0] = _between(u[:, 1], across[:, 0], SIZE - EDGE_ROOM)
        corners, present = _maze(walls, across, count_walls, start, meeting)
    else:
        corners = _between(walls[..., None, :2], 0.0, SIZE)
        corners = corners + _polygons(walls[..., 2:], (3, 6), (0.2, 0.8))
        present = np.arange(suite.wall_room[0]) < count_walls[:, None]
    target = target_to(meeting, suite.time, turning, u[:, 3:7])
    movers = movers.reshape(len(u), suite.mover_room[0], 3 + _SHAPE)
    when = suite.time * _between(movers[..., 2], 0.2, 0.8)
    way = (meeting - start)[:, None]
    crossing = start[:, None] + (when / suite.time)[..., None] * way
    velocity = _between(movers[..., 0], *suite.mover_speed)[..., None]
    velocity = velocity * _unit(2.0 * np.pi * movers[..., 1])
    middle = crossing - velocity * when[..., None]
    return {
        "start": start,
        "meeting": meeting,
        "time": np.full(len(u), suite.time),
        "reached": np.ones(len(u), bool),
        **target,
        "walls": corners,
        "walls present": present,
        "movers": middle[..., None, :] + _polygons(movers[..., 3:], (4, 6), (0.2, 0.4)),
        "movers present": np.arange(suite.mover_room[0]) < count_movers[:, None],
        "velocity": velocity,
    }


def anywhere(uniform: np.ndarray) -> np.ndarray:
    """Places (..., 2) [m] where targets may be met, from numbers of [0, 1)."""
    return _between(uniform, EDGE_ROOM, SIZE - EDGE_ROOM)


def target_to(
    meeting: np.ndarray, time: float, turning: np.ndarray, uniform: np.ndarray
) -> dict[str, np.ndarray]:
    """Targets that are at a place at a time, as draws have them.

    Args:
        meeting: (B, 2) [m], that place.
        time: [s].
        turning: (B,) bool, whether they turn.
        uniform: (B, 4), numbers of [0, 1).
    """
    side = np.where(uniform[:, 3] < 0.5, 1.0, -1.0)
    rate = np.where(turning, side * _between(uniform[:, 2], 0.03, 0.1), 0.0)
    angle, speed = 2.0 * np.pi * uniform[:, 0], _between(uniform[:, 1], 0.2, 0.5)
    pos = meeting - moved(angle, speed, rate, np.full(len(meeting), time))
    return {"pos": pos, "angle": angle, "speed": speed, "rate": rate}


def _hurried(suite: Suite, drawn: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same draws with an earlier meeting, and whether the reach set meets the target at all."""
    with jax.enable_x64(True):
        cases = jax.tree.map(np.asarray, cases_of(drawn, jnp.float64))
        num = len(drawn["time"])
        arrivals = np.array([float(_earliest(lane(cases, k))) for k in range(num)])
    reached = np.isfinite(arrivals)
    time = np.where(reached, arrivals + suite.spare, drawn["time"])
    way = moved(drawn["angle"], drawn["speed"], drawn["rate"], time)
    return {**drawn, "time": time, "reached": reached, "meeting": drawn["pos"] + way}


# One case at a time, so that what comes of it is no matter of the batch.
_earliest = jax.jit(earliest_arrival)


def _polygons(
    uniform: np.ndarray, corners: tuple[int, int], radius: tuple[float, float]
) -> np.ndarray:
    """Convex polygons (..., 6, 2) [m] around the origin from `_SHAPE` numbers each.

    Their corners lie on a circle, counter-clockwise; the last one is repeated.
    """
    size, num = _between(uniform[..., 0], *radius), _whole(uniform[..., 1], *corners)[..., None]
    place = np.minimum(np.arange(6), num - 1)
    shift = 0.6 * np.take_along_axis(uniform[..., 3:], place, axis=-1)
    angle = 2.0 * np.pi * (place + shift + uniform[..., 2, None]) / num
    return size[..., None, None] * _unit(angle)


def _across(uniform: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Where on the x axis (B, 3) [m] the walls across a maze stand, from a number each."""
    even = np.where((count == 2)[:, None], [2.9, 5.5, SIZE], [2.2, 4.1, 6.0])
    return even + _between(uniform, -0.2, 0.2)


def _maze(
    uniform: np.ndarray, across: np.ndarray, count: np.ndarray, start: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Corners (B, 12, 6, 2) [m] of a maze's polygons, and which of them there are, (B, 12).

    Args:
        uniform: (B, 12, M), of which the first three rows are used.
        across: (B, 3) [m], where the walls are.
        count: (B,), how many of them there are.
        start: (B, 2) [m].
        end: (B, 2) [m], the straight line to which runs into dead ends.
    """
    u = np.moveaxis(uniform[:, :3], 2, 0)
    gap, half = _between(u[1], 0.8, SIZE - 0.8), 0.5 * _between(u[2], 0.7, 1.1)
    length, mouth = _between(u[3], 0.5, 0.8), 0.5 * _between(u[4], 0.8, 1.4)
    outer = mouth + THICKNESS
    slope = (end[:, 1:] - start[:, 1:]) / (end[:, :1] - start[:, :1])
    line = start[:, 1:] + slope * (across - start[:, :1])
    # The line's place, or the nearest one on either side of the gap that is wide enough.
    below = np.where(gap - half >= 2.0 * outer, np.clip(line, outer, gap - half - outer), np.inf)
    fits = SIZE - gap - half >= 2.0 * outer
    above = np.where(fits, np.clip(line, gap + half + outer, SIZE - outer), np.inf)
    middle = np.where(np.abs(below - line) < np.abs(above - line), below, above)
    left, right = across - 0.5 * THICKNESS, across + 0.5 * THICKNESS
    zero, full = np.zeros_like(across), np.full_like(across, SIZE)
    boxes = [
        (left, zero, right, gap - half),
        (left, gap + half, right, full),
        (left - length, middle - outer, left, middle - mouth),
        (left - length, middle + mouth, left, middle + outer),
    ]
    stands = np.arange(3) < count[:, None]
    has_arms = stands & (across > 2.5)
    corners = np.concatenate([_boxes(*box) for box in boxes], axis=1)
    return corners, np.concatenate([stands, stands, has_arms, has_arms], axis=1)


def _boxes(left, low, right, high) -> np.ndarray:
    """Corners (B, N, 6, 2) of upright rectangles with sides (B, N); the last one is repeated."""
    x = np.stack([left, right, right, left, left, left], axis=-1)
    y = np.stack([low, low, high, high, high, high], axis=-1)
    return np.stack([x, y], axis=-1)


def path_of(drawn: dict[str, np.ndarray], dtype: Any) -> TurningPath:
    """The path of targets (...), as draws have them."""
    return TurningPath(
        pos=jnp.asarray(drawn["pos"], dtype),
        vel=jnp.asarray(drawn["speed"][..., None] * _unit(drawn["angle"]), dtype),
        turn_rate=jnp.asarray(drawn["rate"], dtype),
    )


def cases_of(drawn: dict[str, np.ndarray], dtype: Any) -> InterceptCase:
    """The cases of accepted draws."""

    def cast(value: np.ndarray) -> Array:
        return jnp.asarray(value, dtype)

    def group(kind: str, velocity: np.ndarray) -> Obstacles:
        present = drawn[f"{kind} present"]
        corners = np.where(present[..., None, None], drawn[kind], 0.0)
        centre = corners.mean(axis=2)
        return Obstacles(
            centre=cast(centre),
            corners=cast(corners - centre[:, :, None]),
            velocity=cast(np.where(present[..., None], velocity, 0.0)),
            present=jnp.asarray(present),
        )

    start = np.concatenate([drawn["start"], np.zeros((len(drawn["start"]), 1))], axis=1)
    return case(
        path_of(drawn, dtype),
        drawn["time"],
        start=start,
        initial_speed=START_SPEED,
        walls=group("walls", np.zeros(2)),
        movers=group("movers", drawn["velocity"]),
        upper=(SIZE, SIZE),
        speed=TOP_SPEED,
        dtype=dtype,
    )
