"""Serves to plan for: read from published trial files, or drawn from the law they follow."""

import dataclasses
import functools
import math
import os
import pkgutil
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.interpolate import RectBivariateSpline

from planner_jax.core.checks import numeric, require_scalar
from planner_jax.core.choices import require_scale
from planner_jax.core.errors import ArgumentError
from planner_jax.robot.quadrotor_model import PAPER_HITTER, QuadrotorModel
from planner_jax.task.arguments import require_draw
from planner_jax.task.hit import court
from planner_jax.task.hit.case import GRAVITY, HitCase, case
from planner_jax.task.hit.court import fly, landing
from planner_jax.task.hit.spec import DRAG, START

# The law of the published serves, fitted to them. Position and velocity are uniform, and those
# serves are kept that meet the following and land in the region asked for.
SERVE_HEIGHT = 2.0  # [m]
DEPTH = 4.5  # [m] from the net, where the far and side regions end for serves and landings
RISE_SPEED = (6.5, 8.73)  # [m/s], vertical speed at the serve
MIN_APPROACH_SPEED = 2.0  # [m/s], towards the net at the serve
MAX_FLIGHT_TIME = 1.8214  # [s], from the serve to the floor
# From F into the middle lane the serves never go to the right (their mirror images are left
# out); from N they go both ways.
ONE_SIDED = ("FN", "FF")

_ROUNDS = 128  # how often a block of generated serves goes through its scenarios
_STARTS = 1024  # how many uniform starts come from one random stream
_AIM_STEPS = 4
START_HEIGHT = 1.5  # [m], of uniform starts
_SERVE_STREAM, _START_STREAM = 0, 1


@dataclasses.dataclass(frozen=True, eq=False)
class Serves:
    """Balls served to the hitting half, world frame. `serves[rows]` picks rows as NumPy does."""

    position: np.ndarray  # (N, 3) [m]
    velocity: np.ndarray  # (N, 3) [m/s]
    target: np.ndarray  # (N, 3) [m], where the returned ball must land
    scenario: np.ndarray  # (N,) int, place in court.SCENARIOS
    index: np.ndarray  # (N,) int, place in the whole that these rows are part of
    # (N, 3) published outcome per court.PLANNERS: 1 planned, 0 failed, NaN not published.
    published: np.ndarray | None = None
    file: np.ndarray | None = None  # (N,) str, the first file that holds the serve
    line: np.ndarray | None = None  # (N,) int, line in that file, from 1

    def __len__(self) -> int:
        return len(self.scenario)

    def __getitem__(self, rows) -> "Serves":
        picked = {name: column[rows] for name, column in vars(self).items() if column is not None}
        return dataclasses.replace(self, **picked)


def read_serves(folder: str | os.PathLike) -> Serves:
    """Read the serves of published trial files  S_L_T_M.csv.

    S, L, T are serve, landing and target region (1 N, 2 F, 3 L, 4 R), M the planner (p Bat,
    l Bat-Lite, b Juggle). The files of one S_L_T hold the same serves in the same order; any of
    them may be missing. Other files of the folder are passed over.

    Returns:
        Row 1 of every scenario, then row 2 and so on, so that the first rows of the whole are a
        fair sample of the court. `published` has NaN for the files that are missing.

    Raises:
        ArgumentError: the folder is missing or holds no such file; or any row does not parse, is
            not finite, does not land in the hitting half, or differs between the files of a
            scenario; `value` has all of these rows.
    """
    trials = pkgutil.resolve_name("planner_jax.baselines.hit.published:read_trials")(folder)
    numbers = np.array([trial.numbers for trial in trials])
    return Serves(
        position=numbers[:, 0:3],
        velocity=numbers[:, 3:6],
        target=numbers[:, 9:12],
        scenario=np.array([trial.scenario for trial in trials]),
        index=np.arange(len(trials)),
        published=np.array([trial.solved for trial in trials]),
        file=np.array([trial.file for trial in trials]),
        line=np.array([trial.line for trial in trials]),
    )


def generate_serves(
    num: int, seed: int, scenarios: Sequence[str] | None = None, *, first: int = 0
) -> Serves:
    """Draw serves from the law of the published ones, the scenarios in equal shares.

    Each run of as many serves as there are scenarios has every scenario once, in random order.
    Serve k of a seed (and list of scenarios) is always the same serve.

    Position and velocity are uniform under the conditions at the head of this module. Drawing
    them so would waste 97 of 100 draws on other landing regions. Instead the landing point and
    the vertical speed are drawn uniformly, the horizontal velocity follows from them, and a draw
    is kept with a probability proportional to |d horizontal velocity / d landing point|.

    The scenarios are names out of court.SCENARIOS, by default all. The other arguments and the
    errors are those of `pj.hit.draw`.
    """
    names = court.SCENARIOS if scenarios is None else tuple(scenarios)
    require_draw(num, seed, first)
    unknown = [name for name in names if name not in court.SCENARIOS]
    if unknown or not names:
        rule = f"names out of {' '.join(court.SCENARIOS)}"
        raise ArgumentError("scenarios", rule, shown=repr(unknown[0]) if unknown else "none")
    places = np.array([court.SCENARIOS.index(name) for name in names])
    size = _ROUNDS * len(places)
    begin = first // size
    blocks = [_draw_block(places, seed, b) for b in range(begin, (first + num - 1) // size + 1)]
    scenario, position, velocity = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    return Serves(
        position=position,
        velocity=velocity,
        target=court.target_of(scenario),
        scenario=scenario,
        index=begin * size + np.arange(len(scenario)),
    )[first - begin * size :][:num]


def _random(seed: int, stream: int, block: int) -> np.random.Generator:
    """Return the generator of one block, which does not depend on earlier draws."""
    sequence = np.random.SeedSequence(seed, spawn_key=(stream, block))
    return np.random.Generator(np.random.Philox(sequence))


def _draw_block(places: np.ndarray, seed: int, block: int):
    """Scenario, position and velocity of _ROUNDS runs through the scenarios at `places`."""
    random = _random(seed, _SERVE_STREAM, block)
    scenario = random.permuted(np.tile(places, (_ROUNDS, 1)), axis=1).ravel()
    position, velocity = np.zeros((2, len(scenario), 3))
    pending = np.arange(len(scenario))
    while pending.size:
        drawn_position, drawn_velocity, kept = _draw(scenario[pending], random)
        position[pending[kept]] = drawn_position[kept]
        velocity[pending[kept]] = drawn_velocity[kept]
        pending = pending[~kept]
    return scenario, position, velocity


def _draw(scenario: np.ndarray, random: np.random.Generator):
    """One draw a scenario: position (N, 3), velocity (N, 3), and whether to keep it."""
    regions = court.scenario_regions(scenario)
    bounds = court.region_bounds(DEPTH)
    uniform = random.random((len(scenario), 6))

    def point_in(region, draw):
        low, high = bounds[region - 1, :, 0], bounds[region - 1, :, 1]
        return low + draw * (high - low)

    serve, land = point_in(regions[:, 0], uniform[:, :2]), point_in(regions[:, 1], uniform[:, 2:4])
    land[:, 0] *= -1.0
    rise = RISE_SPEED[0] + uniform[:, 4] * (RISE_SPEED[1] - RISE_SPEED[0])
    way = land - serve
    distance = np.linalg.norm(way, axis=1)
    aim = _aim_table()
    horizontal = way / distance[:, None] * aim.speed.ev(distance, rise)[:, None]

    position = np.column_stack([serve, np.full(len(serve), SERVE_HEIGHT)])
    velocity = np.column_stack([horizontal, rise])
    names = np.array([name[:2] for name in court.SCENARIOS])[scenario]
    kept = aim.time.ev(distance, rise) <= MAX_FLIGHT_TIME
    kept &= velocity[:, 0] <= -MIN_APPROACH_SPEED
    kept &= (velocity[:, 1] >= 0.0) | ~np.isin(names, ONE_SIDED)
    kept &= uniform[:, 5] * aim.max_density < aim.density.ev(distance, rise)
    return position, velocity, kept


class _AimTable(NamedTuple):
    """What a serve over a distance [m] with a vertical speed [m/s] needs, as smooth tables."""

    speed: RectBivariateSpline  # [m/s], horizontal
    density: RectBivariateSpline  # [1/s^2], |d horizontal velocity / d landing point|
    time: RectBivariateSpline  # [s], from the serve to the floor
    max_density: float


@functools.cache
def _aim_table() -> _AimTable:
    """Tables over every distance and vertical speed that a serve can have."""
    shortest, longest = 2.0 * court.DEAD_ZONE, math.hypot(2.0 * DEPTH, 2.0 * court.HALF_WIDTH)
    axes = np.linspace(shortest, longest, 40), np.linspace(*RISE_SPEED, 12)
    distance, rise = np.meshgrid(*axes, indexing="ij")
    speed, slope, time = _aim(distance, rise)
    # Along the way the landing point answers with 1/slope, across it with distance/speed.
    density = slope * speed / distance
    tables = (RectBivariateSpline(*axes, values) for values in (speed, density, time))
    return _AimTable(*tables, max_density=float(density.max()))


def _aim(distance: np.ndarray, rise: np.ndarray):
    """Return speed [m/s] that carries a serve over a distance, its slope [1/s] and the time [s]."""
    drag_free_time = (rise + np.sqrt(rise**2 + 2.0 * GRAVITY * SERVE_HEIGHT)) / GRAVITY
    speed = distance / drag_free_time * (1.0 + 0.5 * DRAG * distance)
    position = np.array([0.0, 0.0, SERVE_HEIGHT])
    slope, time = np.zeros_like(speed), np.zeros((2, *speed.shape))
    for _ in range(_AIM_STEPS):
        # The second ball is a little faster: its lead gives the slope.
        pair = np.stack([speed, speed * (1.0 + 1e-5)])
        velocity = np.stack([pair, np.zeros_like(pair), np.broadcast_to(rise, pair.shape)], axis=-1)
        time, point = landing(position, velocity, DRAG, GRAVITY)
        reach = point[..., 0]
        slope = (pair[1] - pair[0]) / (reach[1] - reach[0])
        speed = speed + slope * (distance - reach[0])
    return speed, slope, time[0]


def advance(serves: Serves, delay: float) -> Serves:
    """The same serves `delay` seconds later, flown with drag.

    Raises:
        ArgumentError: the delay is negative or not finite, or a ball is down by then.
    """
    if not 0.0 <= delay < math.inf:
        raise ArgumentError("delay", "finite and >= 0", delay)
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
    """Hover positions (N, 3) [m] spread evenly over the hitting half, at START_HEIGHT.

    The dead zone at the net is left out. A serve of given `index` has the same start whichever
    rows are asked for with it.
    """
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
    dtype=jnp.float32,
) -> HitCase:
    """Return a batch of cases, with the setting of [Yu2023bat], from N serves.

    The other arguments and the errors are those of `pj.hit.draw`; `seed` is for `uniform_starts`.
    """
    require_scalar("limit_scale", limit_scale)
    require_scalar("delay", delay)
    require_scale(limit_scale)
    if isinstance(start, str):
        if start != "uniform":
            raise ArgumentError("start", "three numbers or 'uniform'", start)
        if seed < 0:
            raise ArgumentError("seed", ">= 0", seed)
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
        dtype=dtype,
    )
    return dataclasses.replace(cases, limits=cases.limits.scaled(limit_scale, cases.gravity))
