"""Serves for hits, drawn at random like those published with [Yu2023bat]."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.interpolate import RectBivariateSpline

from planner_jax.core.checks import numeric, require_kind, require_scalar
from planner_jax.core.choices import STARTS, require, require_scale
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.robot.quadrotor_model import PAPER_HITTER, QuadrotorModel
from planner_jax.task.arguments import require_draw
from planner_jax.task.hit import court
from planner_jax.task.hit.case import HitCase, case
from planner_jax.task.hit.court import fly, landing
from planner_jax.task.hit.spec import DRAG, START

# [m/s^2]; `DRAG` was fitted to landing points with this gravity. [Yu2023bat] states neither number.
GRAVITY = 9.8
# The distribution of serves, fitted to the serves of [Yu2023bat]: position and velocity are uniform
# under the conditions below, and the ball must land in the landing region of its scenario.
SERVE_HEIGHT = 2.0  # [m], height of the ball at the serve
DEPTH = 4.5  # [m] from the net, end of the far and side regions for serves and landing points
RISE_SPEED = (6.5, 8.73)  # [m/s], range of the vertical speed of a serve
MIN_APPROACH_SPEED = 2.0  # [m/s], least speed of a serve towards the net
MAX_FLIGHT_TIME = 1.8214  # [s], greatest time from the serve to the floor
ONE_SIDED = ("FN", "FF")  # serve and landing regions of serves that never fly to the right

START_HEIGHT = 1.5  # [m], height of random hover positions
_ROUNDS = 128  # number of serves of each scenario in a block, which has its own random generator
_STARTS = 1024  # number of random hover positions that one random generator draws
_AIM_STEPS = 4  # iterations of Newton's method for the speed of a serve
_SERVE_STREAM, _START_STREAM = 0, 1  # keys of independent random generators for a seed


@dataclasses.dataclass(frozen=True, eq=False)
class Serves:
    """N balls served to the quadrotor, in the world frame. `serves[rows]` selects some of them."""

    position: np.ndarray  # (N, 3) [m]
    velocity: np.ndarray  # (N, 3) [m/s]
    target: np.ndarray  # (N, 3) [m], required landing point of the returned ball
    scenario: np.ndarray  # (N,) int, index in court.SCENARIOS
    index: np.ndarray  # (N,) int, number of the serve in its suite or in the trial files
    # (N, 3) published result of each of court.PLANNERS: 1 solved, 0 failed, NaN not published.
    published: np.ndarray | None = None
    file: np.ndarray | None = None  # (N,) str, the first file that holds the serve
    line: np.ndarray | None = None  # (N,) int, line in that file, from 1

    def __len__(self) -> int:
        return len(self.scenario)

    def __getitem__(self, rows) -> "Serves":
        columns = {name: column[rows] for name, column in vars(self).items() if column is not None}
        return dataclasses.replace(self, **columns)


def generate_serves(
    num: int, seed: int, scenarios: Sequence[str] | None = None, *, first: int = 0
) -> Serves:
    """Draw random serves, distributed like the serves of [Yu2023bat], equally many per scenario.

    A scenario is a set of regions for serve, landing and target. Serves come in groups that contain
    each scenario once, in random order. The result has the serves number `first` to `first` + `num`
    - 1 of the `seed`. The ranges are constants of this module, such as `SERVE_HEIGHT`. Landing
    point p and vertical speed are drawn uniformly. To make the horizontal velocity v uniform, a
    draw is accepted with a probability proportional to |det (dv / dp)|.

    The `scenarios` are names in court.SCENARIOS, by default all.
    """
    require_draw(num, seed, first)
    num, first = int(num), int(first)  # small integers of NumPy would overflow
    if not isinstance(scenarios, Sequence | None):
        raise ArgumentTypeError("scenarios", "a sequence of names", scenarios)
    names = court.SCENARIOS if scenarios is None else tuple(scenarios)
    unknown = [name for name in names if name not in court.SCENARIOS]
    if unknown or not names:
        rule = f"names out of {' '.join(court.SCENARIOS)}"
        raise ArgumentError("scenarios", rule, shown=repr(unknown[0]) if unknown else "none")
    chosen = np.array([court.SCENARIOS.index(name) for name in names])
    size = _ROUNDS * len(chosen)
    begin = first // size
    blocks = [_draw_block(chosen, seed, b) for b in range(begin, (first + num - 1) // size + 1)]
    scenario, position, velocity = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    return Serves(
        position=position,
        velocity=velocity,
        target=court.target_of(scenario),
        scenario=scenario,
        index=begin * size + np.arange(len(scenario)),
    )[first - begin * size :][:num]


def _random(seed: int, stream: int, block: int) -> np.random.Generator:
    sequence = np.random.SeedSequence(seed, spawn_key=(stream, block))
    return np.random.Generator(np.random.Philox(sequence))


def _draw_block(chosen: np.ndarray, seed: int, block: int):
    random = _random(seed, _SERVE_STREAM, block)
    scenario = random.permuted(np.tile(chosen, (_ROUNDS, 1)), axis=1).ravel()
    states = np.zeros((2, len(scenario), 3))
    pending = np.arange(len(scenario))
    while pending.size:
        draws, accepted = _draw(scenario[pending], random)
        states[:, pending[accepted]] = draws[:, accepted]
        pending = pending[~accepted]
    return scenario, *states


def _draw(scenario: np.ndarray, random: np.random.Generator):
    regions = court.scenario_regions(scenario)
    bounds = court.region_bounds(DEPTH)
    uniform = random.random((len(scenario), 6))

    def point_in(region, draw):
        low, high = bounds[region - 1, :, 0], bounds[region - 1, :, 1]
        return low + draw * (high - low)

    serve, land = point_in(regions[:, 0], uniform[:, :2]), point_in(regions[:, 1], uniform[:, 2:4])
    land[:, 0] *= -1.0
    rise = RISE_SPEED[0] + uniform[:, 4] * (RISE_SPEED[1] - RISE_SPEED[0])
    line = land - serve
    distance = np.linalg.norm(line, axis=1)
    aim = _aim_table()
    horizontal = line / distance[:, None] * aim.speed.ev(distance, rise)[:, None]

    position = np.column_stack([serve, np.full(len(serve), SERVE_HEIGHT)])
    velocity = np.column_stack([horizontal, rise])
    names = np.array([name[:2] for name in court.SCENARIOS])[scenario]
    accepted = aim.time.ev(distance, rise) <= MAX_FLIGHT_TIME
    accepted &= velocity[:, 0] <= -MIN_APPROACH_SPEED
    accepted &= (velocity[:, 1] >= 0.0) | ~np.isin(names, ONE_SIDED)
    accepted &= uniform[:, 5] * aim.max_density < aim.density.ev(distance, rise)
    return np.stack([position, velocity]), accepted


class _AimTable(NamedTuple):
    speed: RectBivariateSpline  # [m/s], horizontal speed that reaches the distance
    density: RectBivariateSpline  # [1/s^2], |d horizontal velocity / d landing point|
    time: RectBivariateSpline  # [s], from the serve to the floor
    max_density: float  # [1/s^2], greatest density in the table


@functools.cache
def _aim_table() -> _AimTable:
    shortest, longest = 2.0 * court.DEAD_ZONE, math.hypot(2.0 * DEPTH, 2.0 * court.HALF_WIDTH)
    axes = np.linspace(shortest, longest, 40), np.linspace(*RISE_SPEED, 12)
    distance, rise = np.meshgrid(*axes, indexing="ij")
    speed, slope, time = _aim(distance, rise)
    # The determinant of d(horizontal velocity) / d(landing point) is a product of two derivatives:
    # `slope` along the line to the landing point, and speed / distance across the line.
    density = slope * speed / distance
    tables = (RectBivariateSpline(*axes, values) for values in (speed, density, time))
    return _AimTable(*tables, max_density=float(density.max()))


def _aim(distance: np.ndarray, rise: np.ndarray):
    drag_free_time = (rise + np.sqrt(rise**2 + 2.0 * GRAVITY * SERVE_HEIGHT)) / GRAVITY
    speed = distance / drag_free_time * (1.0 + 0.5 * DRAG * distance)
    position = np.array([0.0, 0.0, SERVE_HEIGHT])
    slope, time = np.zeros_like(speed), np.zeros((2, *speed.shape))
    for _ in range(_AIM_STEPS):
        pair = np.stack([speed, speed * (1.0 + 1e-5)])
        velocity = np.stack([pair, np.zeros_like(pair), np.broadcast_to(rise, pair.shape)], axis=-1)
        time, point = landing(position, velocity, DRAG, GRAVITY)
        reach = point[..., 0]
        slope = (pair[1] - pair[0]) / (reach[1] - reach[0])
        speed = speed + slope * (distance - reach[0])
    return speed, slope, time[0]


def advance(serves: Serves, delay: float) -> Serves:
    """Return serves after `delay` [s] of flight; raise `ArgumentError` if a ball lands earlier."""
    require(0.0 <= delay < math.inf, "delay", "finite and >= 0", delay)
    time, _ = landing(serves.position, serves.velocity, DRAG, GRAVITY)
    if (down := time <= delay).any():
        first = int(np.argmax(down))
        flight = f"{time[first]:.3f} s for serve {serves.index[first]}"
        raise ArgumentError("delay", f"shorter than each serve's flight, {flight}", delay)
    position, velocity = fly(
        serves.position, serves.velocity, np.full(len(serves), delay), DRAG, GRAVITY
    )
    return dataclasses.replace(serves, position=position, velocity=velocity)


def uniform_starts(index: np.ndarray, seed: int) -> np.ndarray:
    """Return random hover positions (N, 3) [m] in the half court, one for each serve's index."""
    starts = np.empty((len(index), 3))
    for block in np.unique(index // _STARTS):
        rows = index // _STARTS == block
        draw = _random(seed, _START_STREAM, int(block)).random((_STARTS, 2))[index[rows] % _STARTS]
        starts[rows, 0] = -court.DEAD_ZONE - draw[:, 0] * (court.HALF_LENGTH - court.DEAD_ZONE)
        starts[rows, 1] = (2.0 * draw[:, 1] - 1.0) * court.HALF_WIDTH
    starts[:, 2] = START_HEIGHT
    return starts


def to_cases(
    serves: Serves,
    *,
    start: Sequence[float] | str = START,
    seed: int = 0,
    delay: float = 0.0,
    limit_scale: float = 1.0,
    robot: QuadrotorModel = PAPER_HITTER,
    wind: Sequence[float] | None = None,
    starts: str = STARTS[0],
    dtype=jnp.float32,
) -> HitCase:
    """Make a batch of hits to plan from serves, by default with the numbers of [Yu2023bat].

    `start` (3,) [m] is the hover position of the quadrotor `robot`. If it is "uniform", positions
    in the quadrotor's half court are drawn with `seed`. When planning starts, the balls have flown
    for `delay` [s]. `limit_scale` multiplies the limits of speed, acceleration and body rate.
    `wind` (3,) [m/s] is the velocity of the air, for a robot with drag. `starts` is as in `draw`.
    """
    require_kind("serves", serves, Serves)
    require_scalar("limit_scale", limit_scale)
    require_scalar("delay", delay)
    require_scale(limit_scale)
    if isinstance(start, str):
        require(start == "uniform", "start", "three numbers or 'uniform'", start)
        require(seed >= 0, "seed", ">= 0", seed)
        head = uniform_starts(serves.index, seed)
    else:
        head = numeric(start)
        if head is None or head.shape != (3,) or not np.isfinite(head).all():
            raise ArgumentError("start", "three finite numbers or 'uniform'", start)
    late = advance(serves, delay) if delay != 0.0 else serves
    cases = case(
        late.position,
        late.velocity,
        late.target,
        robot=robot,
        start=head,
        drag=DRAG,
        gravity=GRAVITY,
        wind=wind,
        dtype=dtype,
    )
    cases = dataclasses.replace(cases, limits=cases.limits.scale(limit_scale, cases.gravity))
    if starts == STARTS[0]:
        return cases
    from planner_jax.task.starts import draw_states  # few draws need it

    return draw_states(starts, cases, "hit", seed, serves.index)
