"""Named, seeded suites of interceptions on a map of 8 m x 8 m.

`docs/suites.md` and `planner_jax.task.intercept.spec` state the ranges of all suites. SI units.

In this module, the draws of B cases are a dictionary of arrays:

| key | shape | content |
|---|---|---|
| start, meeting | (B, 2) | [m], rear axle's middle at time 0; target at the meeting |
| time, reached | (B,) | [s], of the meeting; bool, whether the car can be there by then |
| pos, angle, speed, rate | (B, 2), (B,) | [m], [rad], [m/s], [rad/s]: the target at time 0 |
| walls, movers | (B, N, V, 2) | [m], V corners of N polygons at time 0, counter-clockwise |
| walls present, movers present | (B, N) | bool, whether each obstacle exists |
| velocity | (B, N, 2) | [m/s], of the movers, that is the moving obstacles |
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from scipy import ndimage

from planner_jax.core.checks import floating
from planner_jax.core.protocol import take
from planner_jax.core.registry import require_name
from planner_jax.plane.obstacles import Obstacles
from planner_jax.plane.target import ControlledPath, LaterPath, PlanePath, TurningPath
from planner_jax.task.arguments import make_generators
from planner_jax.task.intercept.case import InterceptCase, case
from planner_jax.task.intercept.searches import earliest_arrival
from planner_jax.task.intercept.spec import SUITES, Suite

SIZE = 8.0  # [m], side of the map
TOP_SPEED = 1.5  # [m/s], greatest speed of the car
BODY_MIDDLE = 0.15  # [m], distance of the body's middle ahead of the rear axle
START_ROOM = 0.35  # [m], least distance of the body's middle at the start from walls and movers
MEETING_ROOM = 0.4  # [m], least distance of the meeting point from walls and movers
TARGET_ROOM = 0.05  # [m], least distance of the target's path from walls
BODY_ROOM = 0.13  # [m], least distance of the body's middle from walls: half the body's width
_STEP = 0.1  # [s], between two positions of a target that are tested
_CONTROLLED = 14  # [s], time before time 0 from which control inputs change a target's velocity
_CELL = 0.1  # [m], side of a cell of the grid on which `_is_separated` searches a path
START_X, START_SPEED = 0.8, 0.5  # [m], [m/s], of the car at time 0
EDGE_ROOM = 0.3  # [m], least distance of the meeting point from the edge of the map
THICKNESS = 0.2  # [m], of a maze's walls
_SHAPE = 9  # random numbers for a polygon: radius, number of corners, rotation, six angles

Draws = dict[str, np.ndarray]  # arrays by key, as in the table of the module's docstring


@dataclasses.dataclass(frozen=True)
class Drawn:
    """B random cases of a suite, and how many candidates were drawn and rejected for each case."""

    cases: InterceptCase  # leaves with leading axis B
    draws: np.ndarray  # (B,) int, number of candidates, including the accepted candidate
    rejected: dict[str, np.ndarray]  # cause of rejection -> (B,) int, number of candidates


def draw_with_counts(
    suite: str, num: int, seed: int, first: int = 0, *, dtype: DTypeLike = jnp.float32
) -> Drawn:
    """Draw a batch of cases in float64, cast it to `dtype`, and count the rejected candidates.

    `suite` is a key of `SUITES`. The batch has its cases number `first` to `first` + `num` - 1.
    """
    require_name(SUITES, "suite", suite)
    spec, randoms, dtype = SUITES[suite], make_generators(suite, num, seed, first), floating(dtype)
    accepted, counts, rejected = draw_accepted(spec, randoms)
    cases = cases_of(accepted, dtype)
    if any(spec.control):
        target = _controlled_path(spec, accepted, dtype)
        cases = dataclasses.replace(cases, target=target)
    return Drawn(cases=cases, draws=counts, rejected=rejected)


def draw_accepted(
    spec: Suite, randoms: list[np.random.Generator]
) -> tuple[Draws, np.ndarray, dict[str, np.ndarray]]:
    """Draw candidates for each case from its random generator until one is accepted.

    Returns:
        accepted: the accepted candidates of B cases, as arrays with leading axis B.
        counts: (B,) int, number of candidates for each case.
        rejected: cause of rejection -> (B,) int, number of candidates that it rejected.
    """
    num = len(randoms)
    kinds = np.stack([random.random(3) for random in randoms])
    pending, counts = np.arange(num), np.zeros(num, int)
    rejected = np.zeros((len(CAUSES), num), int)
    accepted: Draws = {}
    while len(pending):
        uniform = np.stack([randoms[k].random(_count_numbers(spec)) for k in pending])
        candidates = _candidates(spec, kinds[pending], uniform)
        cause = first_cause(spec, candidates)
        if spec.spare is not None and (good := np.flatnonzero(cause == len(CAUSES))).size:
            some = _shorten_time(spec, {name: leaf[good] for name, leaf in candidates.items()})
            cause[good] = first_cause(spec, some)
            for name, leaf in some.items():
                candidates[name][good] = leaf
        counts[pending] += 1
        is_good = cause == len(CAUSES)
        rejected[cause[~is_good], pending[~is_good]] += 1
        for name, leaf in candidates.items():
            stored = accepted.setdefault(name, np.zeros((num, *leaf.shape[1:]), leaf.dtype))
            stored[pending[is_good]] = leaf[is_good]
        pending = pending[~is_good]
    return accepted, counts, dict(zip(CAUSES, rejected, strict=True))


def _count_numbers(suite: Suite) -> int:
    return 7 + suite.wall_room[0] * (2 + _SHAPE) + suite.mover_room[0] * (3 + _SHAPE)


def _between(uniform: np.ndarray, low: float | np.ndarray, high: float) -> np.ndarray:
    return low + uniform * (high - low)


def _integer(uniform: np.ndarray, fewest: int, most: int) -> np.ndarray:
    return np.floor(_between(uniform, fewest, most + 1)).astype(int)


def _unit(angle: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _candidates(suite: Suite, kinds: np.ndarray, uniform: np.ndarray) -> Draws:
    turning = (kinds[:, 0] < 0.5) & (not any(suite.control))
    count_walls = _integer(kinds[:, 1], *suite.num_walls)
    count_movers = _integer(kinds[:, 2], *suite.num_movers)
    u, walls, movers = np.split(uniform, np.cumsum([7, suite.wall_room[0] * (2 + _SHAPE)]), axis=1)
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
        if suite.wall_boxes:
            corners[:, : len(suite.wall_boxes)] = _boxes(*np.transpose(suite.wall_boxes))
        present = np.arange(suite.wall_room[0]) < count_walls[:, None]
    target = target_to(meeting, suite.time, turning, u[:, 3:7])
    movers = movers.reshape(len(u), suite.mover_room[0], 3 + _SHAPE)
    when = suite.time * _between(movers[..., 2], 0.2, 0.8)
    crossing = start[:, None] + (when / suite.time)[..., None] * (meeting - start)[:, None]
    velocity = _between(movers[..., 0], *suite.mover_speed)[..., None]
    velocity = velocity * _unit(2.0 * np.pi * movers[..., 1])
    middle = crossing - velocity * when[..., None]
    moving = middle[..., None, :] + _polygons(movers[..., 3:], (4, 6), (0.2, 0.4))
    if suite.mover_boxes:
        *sides, velocity_x, velocity_y = np.transpose(suite.mover_boxes)
        moving[:, : len(velocity_x)] = _boxes(*sides)
        velocity[:, : len(velocity_x)] = np.stack([velocity_x, velocity_y], axis=-1)
    return {
        "start": start,
        "meeting": meeting,
        "time": np.full(len(u), suite.time),
        "reached": np.ones(len(u), bool),
        **target,
        "walls": corners,
        "walls present": present,
        "movers": moving,
        "movers present": np.arange(suite.mover_room[0]) < count_movers[:, None],
        "velocity": velocity,
    }


def anywhere(uniform: np.ndarray) -> np.ndarray:
    """Map uniform random numbers (..., 2) of [0, 1) to meeting points [m] on the map."""
    return _between(uniform, EDGE_ROOM, SIZE - EDGE_ROOM)


def target_to(meeting: np.ndarray, time: float, turning: np.ndarray, uniform: np.ndarray) -> Draws:
    """Return B random targets that are at the points `meeting` (B, 2) [m] at the time `time` [s].

    Targets drive in a circle where `turning` (B,) is true, else straight. The random numbers
    `uniform` (B, 4) of [0, 1) determine heading, speed, turn rate, and the side of the turn.
    """
    side = np.where(uniform[:, 3] < 0.5, 1.0, -1.0)
    rate = np.where(turning, side * _between(uniform[:, 2], 0.03, 0.1), 0.0)
    angle, speed = 2.0 * np.pi * uniform[:, 0], _between(uniform[:, 1], 0.2, 0.5)
    pos = meeting - _displace(angle, speed, rate, np.full(len(meeting), time))
    return {"pos": pos, "angle": angle, "speed": speed, "rate": rate}


def _shorten_time(suite: Suite, draws: Draws) -> Draws:
    with jax.enable_x64(True):
        cases = jax.tree.map(np.asarray, cases_of(draws, jnp.float64))
        num = len(draws["time"])
        arrivals = np.array([float(_earliest(take(cases, k))) for k in range(num)])
    reached = np.isfinite(arrivals)
    time = np.where(reached, arrivals + suite.spare, draws["time"])
    moved = _displace(draws["angle"], draws["speed"], draws["rate"], time)
    return {**draws, "time": time, "reached": reached, "meeting": draws["pos"] + moved}


_earliest = jax.jit(earliest_arrival)


def _polygons(
    uniform: np.ndarray, corners: tuple[int, int], radius: tuple[float, float]
) -> np.ndarray:
    size, num = _between(uniform[..., 0], *radius), _integer(uniform[..., 1], *corners)[..., None]
    index = np.minimum(np.arange(6), num - 1)
    shift = 0.6 * np.take_along_axis(uniform[..., 3:], index, axis=-1)
    angle = 2.0 * np.pi * (index + shift + uniform[..., 2, None]) / num
    return size[..., None, None] * _unit(angle)


def _across(uniform: np.ndarray, count: np.ndarray) -> np.ndarray:
    even = np.where((count == 2)[:, None], [2.9, 5.5, SIZE], [2.2, 4.1, 6.0])
    return even + _between(uniform, -0.2, 0.2)


def _maze(
    uniform: np.ndarray, across: np.ndarray, count: np.ndarray, start: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    u = np.moveaxis(uniform[:, :3], 2, 0)
    gap, half = _between(u[1], 0.8, SIZE - 0.8), 0.5 * _between(u[2], 0.7, 1.1)
    length, mouth = _between(u[3], 0.5, 0.8), 0.5 * _between(u[4], 0.8, 1.4)
    outer = mouth + THICKNESS
    slope = (end[:, 1:] - start[:, 1:]) / (end[:, :1] - start[:, :1])
    line = start[:, 1:] + slope * (across - start[:, :1])
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
    x = np.stack([left, right, right, left, left, left], axis=-1)
    return np.stack([x, np.stack([low, low, high, high, high, high], axis=-1)], axis=-1)


def path_of(draws: Draws, dtype: DTypeLike) -> TurningPath:
    """Return the paths of targets from their position, angle, speed and turn rate in `draws`."""
    velocity = draws["speed"][..., None] * _unit(draws["angle"])
    parts = (np.asarray(part, dtype) for part in (draws["pos"], velocity, draws["rate"]))
    return TurningPath(*(jnp.asarray(part, dtype) for part in parts))


def _controlled_path(suite: Suite, draws: Draws, dtype: DTypeLike) -> PlanePath:
    """Return the paths of targets whose velocity changes each second, from 14 s before time 0.

    The mean velocity up to the meeting is the velocity in `draws`.
    """
    control, before = np.array(suite.control), _CONTROLLED
    vel = draws["speed"][:, None] * _unit(draws["angle"])
    vel = vel - control * (_ramps(suite.time) / suite.time + before)
    pos = draws["pos"] - before * vel - control * _ramps(before)
    controls = np.tile(control, (len(pos), before + int(suite.time), 1))
    leaves = np.concatenate([pos, vel], axis=1), controls, np.ones(len(pos))
    path = ControlledPath(*(jnp.asarray(leaf.astype(dtype), dtype) for leaf in leaves))
    return LaterPath(path, jnp.asarray(np.full(len(pos), before, dtype), dtype))


def _ramps(time: np.ndarray | float) -> np.ndarray:
    """Return the sum of max(time - k, 0) over the whole numbers k > 0, in [s]."""
    whole = np.floor(time)
    return whole * time - 0.5 * whole * (whole + 1.0)


def cases_of(draws: Draws, dtype: DTypeLike) -> InterceptCase:
    """Make cases from the arrays `draws` of random starts, targets, times and obstacles."""

    def group(kind: str, velocity: np.ndarray) -> Obstacles:
        present = draws[f"{kind} present"]
        corners = np.where(present[..., None, None], draws[kind], 0.0)
        centre = corners.mean(axis=2)
        none = jnp.asarray(np.zeros(present.shape, dtype), dtype)
        return Obstacles(
            centre=jnp.asarray(centre.astype(dtype), dtype),
            corners=jnp.asarray((corners - centre[:, :, None]).astype(dtype), dtype),
            velocity=jnp.asarray(np.where(present[..., None], velocity, 0.0).astype(dtype), dtype),
            present=jnp.asarray(present, bool),
            radius=none,
            growth=none,
        )

    start = np.concatenate([draws["start"], np.zeros((len(draws["start"]), 1))], axis=1)
    return case(
        path_of(draws, dtype),
        draws["time"],
        start=start,
        initial_speed=START_SPEED,
        walls=group("walls", np.zeros(2)),
        movers=group("movers", draws["velocity"]),
        upper=(SIZE, SIZE),
        speed=TOP_SPEED,
        dtype=dtype,
    )


def _displace(angle, speed, rate, time) -> np.ndarray:
    half = 0.5 * rate * time
    direction, chord = angle + half, speed * time * np.sinc(half / np.pi)
    return np.stack([chord * np.cos(direction), chord * np.sin(direction)], axis=-1)


def _path(suite: Suite, draws: Draws) -> np.ndarray:
    times = np.linspace(0.0, draws["time"], round(suite.time / _STEP) + 1, axis=1)
    angle, speed, rate = (draws[name][:, None] for name in ("angle", "speed", "rate"))
    ramps = _ramps(times) - times * _ramps(suite.time) / suite.time
    bend = ramps[..., None] * np.array(suite.control)
    return draws["pos"][:, None] + _displace(angle, speed, rate, times) + bend


def _is_off_map(suite: Suite, draws: Draws) -> np.ndarray:
    return np.abs(_path(suite, draws) - 0.5 * SIZE).max(axis=(1, 2)) > 0.5 * SIZE


def _middle(draws: Draws) -> np.ndarray:
    return draws["start"] + [BODY_MIDDLE, 0.0]


def _is_too_far(_: Suite, draws: Draws) -> np.ndarray:
    return np.linalg.norm(draws["meeting"] - _middle(draws), axis=1) > TOP_SPEED * draws["time"]


def _gap(
    draws: Draws, kind: str, points: np.ndarray, times: float | np.ndarray = 0.0
) -> np.ndarray:
    corners, points = draws[kind], points if points.ndim == 3 else points[:, None]
    if kind == "movers":
        times = np.broadcast_to(times, len(points))[:, None, None, None]
        corners = corners + times * draws["velocity"][:, :, None]
    least = np.full(len(points), np.inf)
    for k in range(corners.shape[1]):
        present = draws[f"{kind} present"][:, k]
        far = _distance(points[present], corners[present, None, k])
        least[present] = np.minimum(least[present], far.min(axis=1))
    return least


def _distance(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    edge = np.roll(corners, -1, axis=-2) - corners
    away = points[..., None, :] - corners
    square = np.maximum((edge**2).sum(axis=-1), 1e-12)
    share = np.clip((away * edge).sum(axis=-1) / square, 0.0, 1.0)
    left_of = edge[..., 0] * away[..., 1] - edge[..., 1] * away[..., 0] >= 0.0
    gap = ((away - share[..., None] * edge) ** 2).sum(axis=-1).min(axis=-1)
    return np.where(left_of.all(axis=-1), 0.0, np.sqrt(gap))


def _is_separated(_: Suite, draws: Draws) -> np.ndarray:
    count = round(SIZE / _CELL)
    middles = (np.arange(count) + 0.5) * _CELL
    separated = np.zeros(len(draws["start"]), bool)
    for k, ends in enumerate(np.stack([_middle(draws), draws["meeting"]], axis=1)):
        free = np.ones((count, count), bool)
        for corners in draws["walls"][k][draws["walls present"][k]]:
            lowest = (corners.min(axis=0) - BODY_ROOM) / _CELL - 0.5
            highest = (corners.max(axis=0) + BODY_ROOM) / _CELL - 0.5
            first = np.clip(np.ceil(lowest), 0, count).astype(int)
            last = np.clip(np.floor(highest), -1, count - 1).astype(int) + 1
            box = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
            points = np.stack(np.meshgrid(middles[box[0]], middles[box[1]], indexing="ij"), axis=2)
            free[box] &= _distance(points, corners) > BODY_ROOM
        parts = np.zeros(free.shape, np.int32)
        ndimage.label(free, np.ones((3, 3)), output=parts)
        first_part, last_part = parts[tuple((ends / _CELL).astype(int).T)]
        separated[k] = first_part != last_part
    return separated


# Maps each cause for which a candidate is rejected to a function, which returns whether the cause
# applies to each of B candidates, (B,) bool. The causes are tested in this order.
_APPLIES: dict[str, Callable[[Suite, Draws], np.ndarray]] = {
    "target off the map": _is_off_map,
    "start near a wall": lambda _, draws: _gap(draws, "walls", _middle(draws)) < START_ROOM,
    "meeting near a wall": lambda _, draws: _gap(draws, "walls", draws["meeting"]) < MEETING_ROOM,
    "target through a wall": lambda suite, draws: (
        _gap(draws, "walls", _path(suite, draws)) < TARGET_ROOM
    ),
    "mover at the start": lambda _, draws: _gap(draws, "movers", _middle(draws)) < START_ROOM,
    "mover at the meeting": lambda _, draws: (
        _gap(draws, "movers", draws["meeting"], draws["time"]) < MEETING_ROOM
    ),
    "too far": _is_too_far,
    "no way": _is_separated,
    "out of reach": lambda _, draws: ~draws["reached"],
}
CAUSES = tuple(_APPLIES)


def first_cause(suite: Suite, draws: Draws) -> np.ndarray:
    """Return for B candidates the index in CAUSES of the cause of rejection, (B,) int.

    The index is len(CAUSES) if the candidate is accepted. The first of several causes counts.
    """
    cause = np.full(len(draws["start"]), len(CAUSES))
    alive = np.arange(len(cause))
    for index, applies in enumerate(_APPLIES.values()):
        rejected = applies(suite, {name: leaf[alive] for name, leaf in draws.items()})
        cause[alive[rejected]] = index
        alive = alive[~rejected]
    return cause
