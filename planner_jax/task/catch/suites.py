"""Named, seeded suites of catch cases: the throws and the simulations of [Yu2023catch].

The paper names its cases (Sections VII-A and VII-B, Table III) and gives none of the ranges
from which it draws them. Those below are this library's, chosen to be no easier than what the
paper says of its own, and part of each suite's name: a change of a range is another suite.

All draws are uniform. World frame, z up, SI units; planning begins at time 0 with the quadrotor
in hover at (0, 0, 1), within the limits of `case`.

Throws. The ball leaves a machine at (4, 0, 0.8) and lands in a rectangle around the origin.
Its velocity follows from landing point and flight time. It may be caught until it falls through
0.45 m, where an upright quadrotor at its least height of 0.25 m holds its net 0.2 m above.

| suite | drag [1/s] | landing [m x m] | flight [s] | planned after [s] |
|---|---|---|---|---|
| throws | 0.5 | 2 x 0.8 | 1.4 to 1.78 | 0.3 |
| hard | 0.5 | 4 x 3 | 1.4 to 1.78 | 0.5 |
| parabola1 | 0 | 2 x 0.8 | 1.4 to 2 | 0.3 |
| parabola2 | 0 | 2 x 0.8, each | 1.4 to 1.6; 1.7 to 2 | 0.3; 0 |

With drag, 1.78 s is the flight whose apex is at the hall's 4.2 m, less than the 1.9 s that the
paper allows; the shortest flight has an apex of 2.7 m, just under the 2.8 m above which the
paper first outputs a ball. At most 1.48 s are left before the ball is down, where the paper has
1.6 s; that its catches took less than 1.3 s is an outcome and not a bound here. Without drag
the paper allows any height and t < 2. The second ball of `parabola2` leaves when planning begins.

Others. Every target comes near the vertical axis through the origin, the quadrotor's, at a
height of 1 to 3.5 m, and no farther away than `reach` while it may be caught.

| suite | speed [m/s] | height [m] | may be caught [s] | reach [m] |
|---|---|---|---|---|
| harmonic2 | level 1 to 1.5, sinking up to 2.5 | 1 to 3.5 | 7 | 9 |
| triangle3 | level 1 to 1.5 | 1.5 to 2.5 | 6 | 7.3 |
| hexagon6 | level 1 to 1.5 | 1.5 to 2.5 | 10 | 11.3 |
| square4, pentagon5, heptagon7 | as hexagon6 | | | |

- harmonic2: height 2 to 2.5 m plus a swing of 0.6 to 1 m at 1.5 to 2.5 rad/s, any phase; each
  target drifts in a direction of its own, and after 2 to 5 s is within 1.5 m of the axis.
- triangle3: three targets at the corners of an equilateral triangle, 3 to 4 m from its centre,
  which is up to 0.5 m from the axis on either of e1, e2; each flies along a side of it, all at
  one speed and height, in directions 120 degrees apart. They stay an equilateral triangle, and
  are closest to each other, 1.5 to 2 m from the centre, after 1.7 to 3.5 s.
- hexagon6: six targets 1 to 1.5 m from the centre of a level hexagon, all at one velocity; the
  centre is up to 0.5 m from the axis on either of e1, e2 after 4 to 6 s.
- square4, pentagon5, heptagon7: the same with four, five and seven targets at the corners of a
  regular polygon.

The targets of triangle3, hexagon6 and the other polygons fly level. Three velocities 120 degrees
apart, as the paper has them, lie in one plane, and in the level one no target sinks, which would
ease its catch: the net must lean over by 60 degrees at least, 90 less theta_safe, at every catch.

Rushes. The targets of `triangle3` and `hexagon6`, each of which may be caught until a moment of
its own: in a random order the first until `first`, each other one `after` later, and every one up
to half of `spread` sooner or later. What can be caught first is often not what has to be.

| suite | targets of | first [s] | after [s] | spread [s] |
|---|---|---|---|---|
| rush3 | triangle3 | 2.35 | 0.9 | 0.5 |
| rush6 | hexagon6 | 3.8 | 0.9 | 0.6 |

Swarms. Light balls that sink at a constant speed, more of them than can be caught: any may be
left, and the score is how many are caught. Each begins within 6 m of the vertical axis through
the origin, at a height of 2 to 6 m, sinks at 0.4 to 2 m/s, drifts at up to 0.3 m/s, and may be
caught until it falls through 0.45 m. `swarm8` and `swarm12` have as many as their names say.
Where balls may be caught for long, what can be caught next is far from what should be.
"""

import dataclasses
import functools
import zlib
from collections.abc import Callable
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import PyTree

from planner_jax.ball.flight import BallState
from planner_jax.ball.target import BallPath, HarmonicPath, TargetPath
from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.checks import floating, require_scalar
from planner_jax.core.choices import require_scale
from planner_jax.core.errors import ArgumentError
from planner_jax.core.registry import suite_named
from planner_jax.robot.quadrotor_model import PAPER_CATCHER, QuadrotorModel
from planner_jax.task.arguments import require_draw
from planner_jax.task.catch.case import GRAVITY, CatchCase, case
from planner_jax.task.catch.spec import SUITES, TASK
from planner_jax.task.quadrotor import require_own_robot

LAUNCH = (4.0, 0.0, 0.8)  # [m], of every throw
CATCH_HEIGHT = 0.45  # [m], least height of a thrown ball at its catch
_BISECTIONS = 60
_PARALLEL = SUITES["hexagon6"].horizon  # [s], of all targets that fly in parallel


@dataclasses.dataclass(frozen=True)
class _Throw:
    """From which ranges a thrown ball is drawn."""

    land: tuple[float, float] = (1.0, 0.4)  # [m], half sides of the rectangle
    flight: tuple[float, float] = (1.4, 1.78)  # [s], from the launch to the ground
    delay: float = 0.3  # [s], from the launch to the planning
    drag: float = 0.5  # [1/s]


_THROWS = {
    "throws": (_Throw(),),
    "hard": (_Throw(land=(2.0, 1.5), delay=0.5),),
    "parabola1": (_Throw(flight=(1.4, 2.0), drag=0.0),),
    "parabola2": (
        _Throw(flight=(1.4, 1.6), drag=0.0),
        _Throw(flight=(1.7, 2.0), drag=0.0, delay=0.0),
    ),
}


def draw(
    num: int,
    suite: str | None = None,
    seed: int = 0,
    *,
    first: int = 0,
    limit_scale: float = 1.0,
    robot: QuadrotorModel = PAPER_CATCHER,
    num_targets: int | None = None,
    dtype: DTypeLike = jnp.float32,
) -> CatchCase:
    """Draw a batch of cases of a suite in float64, and cast it.

    Order and times are placeholders until a decision sets them. The arguments that are not in this
    list, and the errors, are those of `pj.hit.draw`.

    * `suite`: a key of `SUITES`, "throws" by default, or a suite that another package offers.
    * `limit_scale`: factor on the limits of speed and body rate, and on the difference between
      the limits of the thrust and the thrust of hover.
    * `robot`: with a net; suites of other packages have their own.
    * `num_targets`: N, number of targets in the shape, at least the suite's own; further targets
      are absent copies of the first.
    """
    suite = suite_named(suite, "throws")
    require_draw(num, seed, first)
    dtype = floating(dtype)
    require_scalar("limit_scale", limit_scale)
    require_scale(limit_scale)
    if suite not in SUITES:
        require_own_robot(robot, PAPER_CATCHER, suite)
        return TASK.other_suite(suite)(num, seed, first)
    own = SUITES[suite].num_targets
    size = own if num_targets is None else num_targets
    if size < own:
        raise ArgumentError("num_targets", f">= {own} for suite {suite!r}", size)
    random = np.random.default_rng([seed, zlib.crc32(suite.encode())])
    # One row a case: what stands in front is passed over.
    columns, make_targets = _PATHS[suite]
    random.bit_generator.advance(first * columns)  # type: ignore[attr-defined]
    targets, horizon = make_targets(random.random((num, columns)))
    # Which of the suite's targets has each place.
    place = np.where(np.arange(size) < own, np.arange(size), 0)
    cases = case(
        jax.tree.map(lambda leaf: jnp.asarray(leaf[:, place], dtype), targets),
        horizon[:, place],
        present=np.arange(size) < own,
        robot=robot,
        gravity=np.full(num, GRAVITY),
        optional=SUITES[suite].optional,
        dtype=dtype,
    )
    return dataclasses.replace(cases, limits=cases.limits.scaled(limit_scale, cases.gravity))


def draw_by_key(key: Array, num: int, suite: str) -> CatchCase:
    """Draw `num` cases of a suite of `SUITES` by a key of `jax.random`: pure, in float32."""
    columns, make_targets = _PATHS[suite]
    found = make_targets(jax.random.uniform(key, (num, columns)))
    targets, horizon = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), found)
    one = draw(1, suite)
    cases = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num, *leaf.shape[1:])), one)
    times = one.times / one.horizon[:, :1] * horizon[:, :1]
    return dataclasses.replace(cases, targets=targets, horizon=horizon, times=times)


def _module(array: PyTree) -> ModuleType:
    """What computes with an array: jax.numpy or NumPy."""
    return jnp if isinstance(array, jax.Array) else np


def _between(uniform: PyTree, low: float, high: float) -> PyTree:
    """PyTree of [0, 1) spread over an interval."""
    return low + uniform * (high - low)


def _unit(angle: PyTree) -> PyTree:
    """Level unit vectors (..., 3) at angles (...) [rad]."""
    xp = _module(angle)
    return xp.stack([xp.cos(angle), xp.sin(angle), xp.zeros_like(angle)], axis=-1)


# Throws.


def _throws(uniform: PyTree, throws: tuple[_Throw, ...]) -> tuple[BallPath, PyTree]:
    """Thrown balls from three numbers each, and when they fall through `CATCH_HEIGHT`."""
    xp = _module(uniform)
    drawn = [_throw(u, t) for u, t in zip(xp.split(uniform, len(throws), 1), throws, strict=True)]
    pos, vel, horizon = (xp.stack(column, axis=1) for column in zip(*drawn, strict=True))
    drag = np.broadcast_to([[t.drag] * 3 for t in throws], pos.shape)
    gravity = np.full(horizon.shape, GRAVITY)
    ball = BallState(pos=pos, vel=vel)
    return BallPath(ball, host_leaf(drag), host_leaf(gravity)), horizon


def _throw(uniform: PyTree, throw: _Throw) -> tuple[PyTree, PyTree, PyTree]:
    """Position (B, 3), velocity (B, 3) at the planning and horizon (B,) of one ball a row."""
    xp = _module(uniform)
    level = (2.0 * uniform[:, :2] - 1.0) * xp.asarray(throw.land)
    land = xp.concatenate([level, xp.zeros_like(level[:, :1])], axis=1)
    flight = _between(uniform[:, 2], *throw.flight)
    launch = np.broadcast_to(LAUNCH, land.shape)
    # The landing point is affine in the velocity at the launch.
    without, _ = _fly(launch, xp.zeros_like(land), flight, throw.drag)
    share, _ = _fly(xp.zeros_like(land), xp.ones_like(land), flight, throw.drag, gravity=0.0)
    delay = np.full(len(land), throw.delay)
    pos, vel = _fly(launch, (land - without) / share, delay, throw.drag)
    # A ball is above that height, or rises to it, until it falls through it.
    rise = xp.maximum(vel[:, 2], 0.0) / GRAVITY
    early, late = xp.minimum(0.5 * rise, flight - delay), flight - delay
    for _ in range(_BISECTIONS):
        middle = 0.5 * (early + late)
        above = _fly(pos, vel, middle, throw.drag)[0][:, 2] > CATCH_HEIGHT
        early, late = xp.where(above, middle, early), xp.where(above, late, middle)
    return pos, vel, early


def earliest_throw(name: str) -> tuple[BallState, float]:
    """The shortest throw of a suite of single throws, to the middle of where it throws.

    Returns:
        The ball when planning begins, NumPy leaves (3,) in float32, and its horizon [s].

    Raises:
        ValueError: no such suite.
    """
    if name not in _THROWS or len(_THROWS[name]) > 1:
        raise ArgumentError("suite", "one of single throws", name)
    middle_and_shortest = np.array([[0.5, 0.5, 0.0]])
    pos, vel, horizon = _throw(middle_and_shortest, _THROWS[name][0])
    pos, vel = (leaf[0].astype(np.float32) for leaf in (pos, vel))
    return BallState(pos=pos, vel=vel), float(horizon[0])


def _fly(pos, vel, time, drag: float, gravity: float = GRAVITY) -> tuple[PyTree, PyTree]:
    """Balls (B, 3) after `time` (B,) [s] with linear drag [1/s] [Yu2023catch, eq. 9]."""
    xp, t = _module(vel), time[:, None]
    pull = np.array([0.0, 0.0, -gravity])
    if drag == 0.0:
        return pos + vel * t + 0.5 * pull * t**2, vel + pull * t
    kept = -xp.expm1(-drag * t) / drag
    last = pull / drag  # the velocity at which drag carries the ball
    return pos + (vel - last) * kept + last * t, last + (vel - last) * xp.exp(-drag * t)


# Lines and swings.


def _lines(pos: PyTree, vel: PyTree) -> BallPath:
    """Targets that fly straight on from `pos` (B, N, 3) at `vel`."""
    ball = BallState(pos=pos, vel=vel)
    drag, gravity = host_leaf(np.zeros(pos.shape)), host_leaf(np.zeros(pos.shape[:2]))
    return BallPath(ball, drag=drag, gravity=gravity)


def _harmonic(uniform: PyTree) -> tuple[HarmonicPath, PyTree]:
    """Two swings from nine numbers each."""
    u = uniform.reshape(len(uniform), 2, 9)
    drift = _between(u[..., :1], 1.0, 1.5) * _unit(2.0 * np.pi * u[..., 1])
    xp, level = _module(u), _between(u[..., 2:3], 0.0, 1.5) * _unit(2.0 * np.pi * u[..., 3])
    near = xp.concatenate([level[..., :2], _between(u[..., 4:5], 2.0, 2.5)], axis=-1)
    swing = xp.concatenate([xp.zeros_like(u[..., :2]), _between(u[..., 5:6], 0.6, 1.0)], axis=-1)
    rate, phase = _between(u[..., 6], 1.5, 2.5), 2.0 * np.pi * u[..., 7]
    when = _between(u[..., 8:9], 2.0, 5.0)
    leaves: tuple[PyTree, ...] = (near - drift * when, drift, swing, rate, phase)
    return HarmonicPath(*leaves), np.full(when.shape[:2], SUITES["harmonic2"].horizon)


def _triangle(uniform: PyTree) -> tuple[BallPath, PyTree]:
    """Three targets on the sides of an equilateral triangle, from seven numbers."""
    xp, u = _module(uniform), uniform[:, :, None]
    centre = xp.concatenate([uniform[:, :2] - 0.5, _between(uniform[:, 2:3], 1.5, 2.5)], axis=1)
    corner = 2.0 * np.pi * (u[:, 3] + np.arange(3) / 3.0)
    radius, speed = _between(u[:, 4:5], 3.0, 4.0), _between(u[:, 5:6], 1.0, 1.5)
    side = np.pi / 6.0 * xp.where(u[:, 6] < 0.5, 1.0, -1.0)  # to the left or to the right
    targets = _lines(centre[:, None] + radius * _unit(corner), -speed * _unit(corner + side))
    return targets, np.full(corner.shape, SUITES["triangle3"].horizon)


def _polygon(uniform: PyTree, *, num: int) -> tuple[BallPath, PyTree]:
    """Targets in parallel at the corners of a regular polygon, from eight numbers."""
    xp, u = _module(uniform), uniform[:, :, None]
    near = xp.concatenate([uniform[:, :2] - 0.5, _between(uniform[:, 2:3], 1.5, 2.5)], axis=1)
    corner = 2.0 * np.pi * (u[:, 3] + np.arange(num) / num)
    radius, speed = _between(u[:, 4:5], 1.0, 1.5), _between(u[:, 5:6], 1.0, 1.5)
    vel = speed * _unit(2.0 * np.pi * u[:, 6])[:, 0:1]
    when = _between(u[:, 7:8], 4.0, 6.0)
    pos = near[:, None] + radius * _unit(corner) - vel * when
    targets = _lines(pos, xp.broadcast_to(vel, pos.shape))
    return targets, np.full(corner.shape, _PARALLEL)


def _rush(
    uniform: PyTree, *, of: Callable, num: int, first: float, after: float, spread: float
) -> tuple[BallPath, PyTree]:
    """Targets of another suite with horizons of their own, from two numbers more for each."""
    xp, own = _module(uniform), uniform[:, : -2 * num]
    order = xp.argsort(uniform[:, -2 * num : -num], axis=1)
    return of(own)[0], first + after * order + spread * (uniform[:, -num:] - 0.5)


def _swarm(uniform: PyTree, *, num: int) -> tuple[BallPath, PyTree]:
    """Balls that sink all around, from six numbers each."""
    xp, u = _module(uniform), uniform.reshape(len(uniform), num, 6)
    height, sinking = _between(u[..., 2:3], 2.0, 6.0), _between(u[..., 3:4], 0.4, 2.0)
    level = 6.0 * xp.sqrt(u[..., 1:2]) * _unit(2.0 * np.pi * u[..., 0])
    drift = _between(u[..., 4:5], 0.0, 0.3) * _unit(2.0 * np.pi * u[..., 5])
    pos = xp.concatenate([level[..., :2], height], axis=-1)
    vel = xp.concatenate([drift[..., :2], -sinking], axis=-1)
    return _lines(pos, vel), ((height - CATCH_HEIGHT) / sinking)[..., 0]


_hexagon = functools.partial(_polygon, num=6)

# Suite -> the number C of random numbers a case, and the function that makes of numbers (B, C) of
# [0, 1), NumPy or JAX, the targets, leaves (B, N, ...), and the horizons (B, N) [s].
_PATHS: dict[str, tuple[int, Callable[[PyTree], tuple[TargetPath, PyTree]]]] = {
    **{
        name: (3 * len(throws), functools.partial(_throws, throws=throws))
        for name, throws in _THROWS.items()
    },
    "harmonic2": (18, _harmonic),
    "triangle3": (7, _triangle),
    "hexagon6": (8, _hexagon),
    "square4": (8, functools.partial(_polygon, num=4)),
    "pentagon5": (8, functools.partial(_polygon, num=5)),
    "heptagon7": (8, functools.partial(_polygon, num=7)),
    "rush3": (
        7 + 6,
        functools.partial(_rush, of=_triangle, num=3, first=2.35, after=0.9, spread=0.5),
    ),
    "rush6": (
        8 + 12,
        functools.partial(_rush, of=_hexagon, num=6, first=3.8, after=0.9, spread=0.6),
    ),
    "swarm8": (8 * 6, functools.partial(_swarm, num=8)),
    "swarm12": (12 * 6, functools.partial(_swarm, num=12)),
}
