"""Named, seeded suites of catch cases: the throws and the simulations of [Yu2023catch].

`docs/suites.md` states the ranges of all suites. World frame, z up, SI units.
"""

import dataclasses
import zlib
from collections.abc import Callable, Sequence
from functools import partial
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import PyTree

from planner_jax.ball.flight import BallState
from planner_jax.ball.target import BallPath, HarmonicPath, TargetPath
from planner_jax.core import GRAVITY
from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.checks import floating, require_scalar
from planner_jax.core.choices import (
    STARTS,
    require,
    require_one_of,
    require_scale,
    require_size,
)
from planner_jax.core.registry import suite_named
from planner_jax.robot.quadrotor_model import PAPER_CATCHER, QuadrotorModel
from planner_jax.task.arguments import require_draw
from planner_jax.task.catch.case import CatchCase, case
from planner_jax.task.catch.spec import SUITES, TASK
from planner_jax.task.quadrotor import require_own_robot

LAUNCH = (4.0, 0.0, 0.8)  # [m], launch point of every throw
CATCH_HEIGHT = 0.45  # [m], least height of a thrown ball at its catch
_BISECTIONS = 60  # iterations of the bisection for the time at which a ball is at `CATCH_HEIGHT`
_PARALLEL = SUITES["hexagon6"].horizon  # [s], latest time of a catch of targets on polygons


@dataclasses.dataclass(frozen=True)
class _Throw:
    land: tuple[float, float] = (1.0, 0.4)  # [m], half sides of the landing rectangle
    flight: tuple[float, float] = (1.4, 1.78)  # [s], from the launch to the ground
    delay: float = 0.3  # [s], from the launch to time 0
    drag: float = 0.5  # [1/s], coefficient of linear drag


_THROWS = {
    "throws": (_Throw(),),
    "hard": (_Throw(land=(2.0, 1.5), delay=0.5),),
    "parabola1": (_Throw(flight=(1.4, 2.0), drag=0.0),),
    "parabola2": (
        _Throw(flight=(1.4, 1.6), drag=0.0),
        _Throw(flight=(1.7, 2.0), drag=0.0, delay=0.0),
    ),
}
# [Yu2023catch, Section VII-A] states the machine, the landing rectangle, the longest flight, the
# height of the hall, and the rules of when planning starts.
_PAPER_THROW = _Throw(flight=(1.4, 1.9))
_CEILING, _FLOWN, _PLANNED_ABOVE = 4.2, 2.0, 2.8  # [m]: apex, distance and height of a ball
_LONGEST_LEFT = 1.6  # [s], greatest time from the plan to the landing
_DRAWS = 12  # throws that are drawn for a case; three of four are valid


def draw(
    num: int,
    suite: str | None = None,
    seed: int = 0,
    *,
    first: int = 0,
    limit_scale: float = 1.0,
    robot: QuadrotorModel = PAPER_CATCHER,
    wind: Sequence[float] | None = None,
    num_targets: int | None = None,
    starts: str = STARTS[0],
    dtype: DTypeLike = jnp.float32,
) -> CatchCase:
    """Draw a batch of random catch cases in float64, and cast them to `dtype`.

    Case k of a suite and `seed` is always the same; the batch has `num` cases from k = `first` >= 0
    on. `ValueError` is raised for an unknown suite or a number out of its range.

    * `suite`: "throws" (thrown balls) by default; `planner_jax.task.catch.spec.SUITES` describes
      all suites. Suites of other packages are also accepted.
    * `limit_scale`: factor on the limits of speed and body rate, and on the differences between
      the limits of the thrust and the thrust of hover.
    * `robot`: quadrotor with a net. Suites of other packages define their own robot.
    * `wind`: (3,) [m/s], velocity of the air, for a robot with drag.
    * `num_targets`: number N of targets, at least the suite's. Additional targets are absent.
    * `starts`: state of the robot at time 0: "hover" at one point, or "random", in the ranges of
      `task.starts.with_states`.
    """
    suite = suite_named(suite, "throws")
    require_draw(num, seed, first)
    dtype = floating(dtype)
    require_scalar("limit_scale", limit_scale)
    require_scale(limit_scale)
    if suite not in SUITES:
        require_own_robot(robot, PAPER_CATCHER, suite, wind)
        require(starts == STARTS[0], "starts", f"left out with suite {suite!r}", starts)
        return TASK.other_suite(suite)(num, seed, first)
    own = SUITES[suite].num_targets
    size = own if num_targets is None else num_targets
    require_size("num_targets", size)
    require(size >= own, "num_targets", f">= {own} for suite {suite!r}", size)
    random = np.random.default_rng([seed, zlib.crc32(suite.encode())])
    # Each case uses `columns` random numbers: skip the numbers of the cases before `first`.
    columns, make_targets = _PATHS[suite]
    random.bit_generator.advance(first * columns)  # type: ignore[attr-defined]
    targets, horizon = make_targets(random.random((num, columns)))
    place = np.where(np.arange(size) < own, np.arange(size), 0)  # index into the suite's targets
    cases = case(
        jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf[:, place], dtype), dtype), targets),
        horizon[:, place],
        present=np.arange(size) < own,
        robot=robot,
        wind=wind,
        gravity=np.full(num, GRAVITY),
        optional=SUITES[suite].optional,
        dtype=dtype,
    )
    cases = dataclasses.replace(cases, limits=cases.limits.scale(limit_scale, cases.gravity))
    if starts == STARTS[0]:
        return cases
    from planner_jax.task.starts import draw_states  # few draws need it

    return draw_states(starts, cases, suite, seed, range(first, first + num))


def draw_by_key(key: Array, num: int, suite: str, starts: str = STARTS[0]) -> CatchCase:
    """Draw `num` cases of a suite with a key of `jax.random`; may be called inside `jax.jit`.

    `starts` is "hover" or "random", as for `draw`.
    """
    require_one_of(STARTS, "starts", starts)
    columns, make_targets = _PATHS[suite]
    paths = make_targets(jax.random.uniform(key, (num, columns)))
    targets, horizon = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), paths)
    one = draw(1, suite)
    cases = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num, *leaf.shape[1:])), one)
    times = one.times / one.horizon[:, :1] * horizon[:, :1]
    cases = dataclasses.replace(cases, targets=targets, horizon=horizon, times=times)
    if starts == STARTS[0]:
        return cases
    from planner_jax.task.starts import NUM, with_states  # few draws need it

    return with_states(cases, jax.random.uniform(jax.random.fold_in(key, 1), (num, NUM)))


def _module(array: PyTree) -> ModuleType:
    return jnp if isinstance(array, jax.Array) else np


def _between(uniform: PyTree, low: float, high: float) -> PyTree:
    return low + uniform * (high - low)


def _unit(angle: PyTree) -> PyTree:
    xp = _module(angle)
    return xp.stack([xp.cos(angle), xp.sin(angle), xp.zeros_like(angle)], axis=-1)


def _throws(uniform: PyTree, throws: tuple[_Throw, ...]) -> tuple[BallPath, PyTree]:
    xp = _module(uniform)
    drawn = [_throw(u, t) for u, t in zip(xp.split(uniform, len(throws), 1), throws, strict=True)]
    pos, vel, horizon = (xp.stack(column, axis=1) for column in zip(*drawn, strict=True))
    drag = np.broadcast_to([[t.drag] * 3 for t in throws], pos.shape)
    gravity = np.full(horizon.shape, GRAVITY)
    return BallPath(BallState(pos=pos, vel=vel), host_leaf(drag), host_leaf(gravity)), horizon


def _throw(uniform: PyTree, throw: _Throw) -> tuple[PyTree, PyTree, PyTree]:
    vel, flight = _launch(uniform, throw)
    return _await(vel, flight, np.full(len(flight), throw.delay), throw.drag)


def _paper_throws(uniform: PyTree) -> tuple[BallPath, PyTree]:
    """Return throws that follow the rules of [Yu2023catch, Section VII-A] for the first ball.

    Planning starts when the ball has flown 2 m and is above 2.8 m. Of `_DRAWS` throws, the first
    one is returned that does so before its apex, whose apex is at most 4.2 m high, and that lands
    at most 1.6 s after planning starts.
    """
    xp, throw = _module(uniform), _PAPER_THROW
    vel, flight = _launch(uniform.reshape(-1, 3), throw)
    launch = np.broadcast_to(LAUNCH, vel.shape)
    top = xp.log1p(throw.drag / GRAVITY * vel[:, 2]) / throw.drag  # when the ball is at its apex

    def has_come(time: PyTree) -> PyTree:
        pos, _ = _fly(launch, vel, time, throw.drag)
        far = xp.sum((pos - launch) ** 2, axis=1) >= _FLOWN**2
        return far & (pos[:, 2] >= _PLANNED_ABOVE)

    early, late = xp.zeros_like(top), top
    for _ in range(_BISECTIONS):
        middle = 0.5 * (early + late)
        come = has_come(middle)
        early, late = xp.where(come, early, middle), xp.where(come, middle, late)
    low = _fly(launch, vel, top, throw.drag)[0][:, 2] <= _CEILING
    good = has_come(late) & low & (flight - late <= _LONGEST_LEFT)
    first = xp.argmax(good.reshape(-1, _DRAWS), axis=1) + _DRAWS * np.arange(len(uniform))
    chosen = _await(vel[first], flight[first], late[first], throw.drag)
    pos, vel, horizon = (each[:, None] for each in chosen)
    drag, gravity = np.full(pos.shape, throw.drag), np.full(horizon.shape, GRAVITY)
    return BallPath(BallState(pos=pos, vel=vel), host_leaf(drag), host_leaf(gravity)), horizon


def _launch(uniform: PyTree, throw: _Throw) -> tuple[PyTree, PyTree]:
    """Return launch velocities (B, 3) [m/s] and flight times (B,) [s] of random throws."""
    xp = _module(uniform)
    level = (2.0 * uniform[:, :2] - 1.0) * xp.asarray(throw.land)
    land = xp.concatenate([level, xp.zeros_like(level[:, :1])], axis=1)
    flight = _between(uniform[:, 2], *throw.flight)
    launch = np.broadcast_to(LAUNCH, land.shape)
    # The landing point is an affine function of the launch velocity: solve for the velocity.
    without, _ = _fly(launch, xp.zeros_like(land), flight, throw.drag)
    share, _ = _fly(xp.zeros_like(land), xp.ones_like(land), flight, throw.drag, gravity=0.0)
    return (land - without) / share, flight


def _await(
    vel: PyTree, flight: PyTree, delay: PyTree, drag: float
) -> tuple[PyTree, PyTree, PyTree]:
    """Return balls a time `delay` after their launch, and the latest times of their catches."""
    xp = _module(vel)
    pos, vel = _fly(np.broadcast_to(LAUNCH, vel.shape), vel, delay, drag)
    # Bisection for the latest time of a catch, at which the ball falls below `CATCH_HEIGHT`.
    rise = xp.maximum(vel[:, 2], 0.0) / GRAVITY
    early, late = xp.minimum(0.5 * rise, flight - delay), flight - delay
    for _ in range(_BISECTIONS):
        middle = 0.5 * (early + late)
        above = _fly(pos, vel, middle, drag)[0][:, 2] > CATCH_HEIGHT
        early, late = xp.where(above, middle, early), xp.where(above, late, middle)
    return pos, vel, early


def earliest_throw(name: str) -> tuple[BallState, float]:
    """Return the throw of a suite with the least flight time to the centre of its landing area.

    The result is the ball at time 0, with NumPy arrays (3,) in float32, and the horizon [s].

    Raises:
        ValueError: the suite does not have exactly one thrown ball a case.
    """
    require(len(_THROWS.get(name, ())) == 1, "suite", "one of single throws", name)
    middle_and_shortest = np.array([[0.5, 0.5, 0.0]])
    pos, vel, horizon = _throw(middle_and_shortest, _THROWS[name][0])
    pos, vel = (leaf[0].astype(np.float32) for leaf in (pos, vel))
    return BallState(pos=pos, vel=vel), float(horizon[0])


def _fly(pos, vel, time, drag: float, gravity: float = GRAVITY) -> tuple[PyTree, PyTree]:
    """Return balls' positions and velocities after a time; drag is linear [Yu2023catch, eq. 9a]."""
    xp, t = _module(vel), time[:, None]
    pull = np.array([0.0, 0.0, -gravity])
    if drag == 0.0:
        return pos + vel * t + 0.5 * pull * t**2, vel + pull * t
    decayed = -xp.expm1(-drag * t) / drag
    terminal = pull / drag  # terminal velocity
    vel = vel - terminal
    return pos + vel * decayed + terminal * t, terminal + vel * xp.exp(-drag * t)


def _lines(pos: PyTree, vel: PyTree) -> BallPath:
    ball = BallState(pos=pos, vel=vel)
    drag, gravity = host_leaf(np.zeros(pos.shape)), host_leaf(np.zeros(pos.shape[:2]))
    return BallPath(ball, drag=drag, gravity=gravity)


def _harmonic(
    uniform: PyTree,
    *,
    speed: tuple[float, float] = (1.0, 1.5),
    amplitude: tuple[float, float] = (0.6, 1.0),
    turn: float = 2.0 * np.pi,
) -> tuple[HarmonicPath, PyTree]:
    u = uniform.reshape(len(uniform), 2, 9)
    drift = _between(u[..., :1], *speed) * _unit(2.0 * np.pi * u[..., 1])
    xp, level = _module(u), _between(u[..., 2:3], 0.0, 1.5) * _unit(2.0 * np.pi * u[..., 3])
    near = xp.concatenate([level[..., :2], _between(u[..., 4:5], 2.0, 2.5)], axis=-1)
    swing = xp.concatenate([xp.zeros_like(u[..., :2]), _between(u[..., 5:6], *amplitude)], axis=-1)
    rate, phase = _between(u[..., 6], 1.5, 2.5), turn * u[..., 7]
    when = _between(u[..., 8:9], 2.0, 5.0)
    leaves: tuple[PyTree, ...] = (near - drift * when, drift, swing, rate, phase)
    return HarmonicPath(*leaves), np.full(when.shape[:2], SUITES["harmonic2"].horizon)


def _triangle(uniform: PyTree) -> tuple[BallPath, PyTree]:
    xp, u = _module(uniform), uniform[:, :, None]
    centre = xp.concatenate([uniform[:, :2] - 0.5, _between(uniform[:, 2:3], 1.5, 2.5)], axis=1)
    corner = 2.0 * np.pi * (u[:, 3] + np.arange(3) / 3.0)
    radius, speed = _between(u[:, 4:5], 3.0, 4.0), _between(u[:, 5:6], 1.0, 1.5)
    side = np.pi / 6.0 * xp.where(u[:, 6] < 0.5, 1.0, -1.0)  # the sign is the sense of rotation
    targets = _lines(centre[:, None] + radius * _unit(corner), -speed * _unit(corner + side))
    return targets, np.full(corner.shape, SUITES["triangle3"].horizon)


def _polygon(uniform: PyTree, *, num: int) -> tuple[BallPath, PyTree]:
    xp, u = _module(uniform), uniform[:, :, None]
    near = xp.concatenate([uniform[:, :2] - 0.5, _between(uniform[:, 2:3], 1.5, 2.5)], axis=1)
    corner = 2.0 * np.pi * (u[:, 3] + np.arange(num) / num)
    radius, speed = _between(u[:, 4:5], 1.0, 1.5), _between(u[:, 5:6], 1.0, 1.5)
    vel = speed * _unit(2.0 * np.pi * u[:, 6])[:, 0:1]
    pos = near[:, None] + radius * _unit(corner) - vel * _between(u[:, 7:8], 4.0, 6.0)
    return _lines(pos, xp.broadcast_to(vel, pos.shape)), np.full(corner.shape, _PARALLEL)


def _rush(
    uniform: PyTree, *, of: Callable, num: int, first: float, after: float, spread: float
) -> tuple[BallPath, PyTree]:
    xp, own = _module(uniform), uniform[:, : -2 * num]
    order = xp.argsort(uniform[:, -2 * num : -num], axis=1)
    return of(own)[0], first + after * order + spread * (uniform[:, -num:] - 0.5)


def _swarm(uniform: PyTree, *, num: int) -> tuple[BallPath, PyTree]:
    xp, u = _module(uniform), uniform.reshape(len(uniform), num, 6)
    height, sinking = _between(u[..., 2:3], 2.0, 6.0), _between(u[..., 3:4], 0.4, 2.0)
    level = 6.0 * xp.sqrt(u[..., 1:2]) * _unit(2.0 * np.pi * u[..., 0])
    drift = _between(u[..., 4:5], 0.0, 0.3) * _unit(2.0 * np.pi * u[..., 5])
    pos = xp.concatenate([level[..., :2], height], axis=-1)
    vel = xp.concatenate([drift[..., :2], -sinking], axis=-1)
    return _lines(pos, vel), ((height - CATCH_HEIGHT) / sinking)[..., 0]


_hexagon = partial(_polygon, num=6)

# Suite -> (C, function). A case takes C random numbers. The function maps uniform random numbers
# (B, C) of [0, 1), NumPy or JAX, to targets, leaves (B, N, ...), and horizons (B, N) [s].
_PATHS: dict[str, tuple[int, Callable[[PyTree], tuple[TargetPath, PyTree]]]] = {
    **{
        name: (3 * len(throws), partial(_throws, throws=throws)) for name, throws in _THROWS.items()
    },
    "paper-throws": (3 * _DRAWS, _paper_throws),
    "harmonic2": (18, _harmonic),
    "paper-harmonic2": (
        18,
        partial(_harmonic, speed=(0.0, 0.0), amplitude=(1.0, 1.0), turn=0.0),
    ),
    "triangle3": (7, _triangle),
    "hexagon6": (8, _hexagon),
    "square4": (8, partial(_polygon, num=4)),
    "pentagon5": (8, partial(_polygon, num=5)),
    "heptagon7": (8, partial(_polygon, num=7)),
    "rush3": (7 + 6, partial(_rush, of=_triangle, num=3, first=2.35, after=0.9, spread=0.5)),
    "rush6": (8 + 12, partial(_rush, of=_hexagon, num=6, first=3.8, after=0.9, spread=0.6)),
    "swarm8": (8 * 6, partial(_swarm, num=8)),
    "swarm12": (12 * 6, partial(_swarm, num=12)),
}
