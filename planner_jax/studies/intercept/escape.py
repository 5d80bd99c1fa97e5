"""Targets that react: they flee from the car, which plans against where they can go.

A target has a speed and a greatest turn rate. Five times a second it looks at the car, thinks of
one second in which it turns towards one of 16 headings while the car goes on straight, and sets out
for the heading that leaves it farthest from the car in the end. It stays 0.2 m inside of the map
and 0.2 m from walls: where the next step would take it closer it stands and turns. Movers do not
stop it. There is no noise: car and target know where the other one is.

The cases are those of a suite of `pj.intercept.draw`, with walls, movers and the car's start; the
target begins where and as the case's does.

| what | drawn from |
|---|---|
| target's speed | 0.3 to 0.7 of the car's greatest, 0.45 to 1.05 m/s |
| target's turn rate, the greatest | 0.5 to 2 rad/s |

It is captured where the middle of the car's body comes within 0.3 m of it in 15 s, by a car that
has touched nothing. World frame in the plane, SI units.
"""

import dataclasses
import functools
import zlib
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.core.protocol import is_solved
from planner_jax.optimise.levenberg import LevenbergConfig
from planner_jax.plane.distance_field import DistanceField, distance_field
from planner_jax.plane.target import SampledPath
from planner_jax.planning.plan import plan
from planner_jax.robot.car import pose_at
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.default_planner import SpacetimeIntercept
from planner_jax.task.intercept.plan import InterceptPlan
from planner_jax.task.intercept.searches import Search
from planner_jax.task.intercept.suites import draw_cases

# Of all rows; few ways and steps, since it plans five times a second.
PLANNER = SpacetimeIntercept(meet="early", searches=(Search(4, LevenbergConfig(20)),))

CAPTURE = 0.3  # [m], from the middle of the car's body to the target
HORIZON = 15.0  # [s], in which it is to be captured
STEP = 0.2  # [s], from one look of the target to the next, and from plan to plan
FINE = 10  # samples of the way in a step
AHEAD = 40  # steps that a plan looks ahead
ROOM = 0.2  # [m], that targets keep from walls and from the edge of the map
_LOOK = 5  # steps that the target thinks ahead
_HEADINGS = 16  # that it thinks of
_FIELD = 128  # places of the distance field along either side of the map
_REACTION = 20  # steps of a target's reaction to a plan that are looked at
_ROUNDS = 24  # of the search for the middle of a reach set
_HASTE = 0.1  # [m/s], what a second of the mean time weighs beside the worst miss
_TOLERANCE = 0.2  # [m], within which plans meet what they aim at
_GENTLE = 0.98  # share of the car's acceleration with which it brakes

Row = Literal["greedy", "reach", "informed"]
ROWS: tuple[Row, ...] = ("greedy", "reach", "informed")


@struct.dataclass
class Evader:
    """What a target can do, and where it may be."""

    speed: Array  # () [m/s], at which it goes where it goes
    turn_rate: Array  # () [rad/s], the greatest
    field: DistanceField  # from what it has to keep off
    lower: Array  # (2,) [m], corner of the map
    upper: Array  # (2,) [m]


@struct.dataclass
class Runner:
    """Where a target is."""

    pos: Array  # (2,) [m]
    heading: Array  # () [rad]


def draw_escapes(
    num: int, suite: str = "medium", seed: int = 0, first: int = 0
) -> tuple[InterceptCase, Evader, Runner]:
    """Cases of a suite with targets that flee, leaves with leading axis B.

    Args:
        num: B, how many, >= 1.
        suite: of the walls and movers.
        seed: >= 0. Case k of a suite and seed is always the same one.
        first: place of the first one, >= 0.

    Returns:
        The cases, whose own targets are those of the suite, with the time `HORIZON`; what their
        targets can do, and where these are at time 0.

    Raises:
        ValueError: an argument is out of its range, or there is no such suite.
    """
    cases = draw_cases(suite, num, seed, first)
    cases = dataclasses.replace(cases, time=jnp.full(num, HORIZON))
    tag = zlib.crc32(b"escape")
    randoms = [np.random.default_rng([seed, first + k, tag]) for k in range(num)]
    uniform = np.stack([random.random(2) for random in randoms]).astype(np.float32)
    evaders, runners = _drawn(cases, uniform)
    return cases, evaders, runners


@jax.jit
@jax.vmap
def _drawn(case: InterceptCase, uniform: Array) -> tuple[Evader, Runner]:
    """Targets from two numbers (B, 2) each that are even between 0 and 1."""
    speed = case.limits.speed * (0.3 + 0.4 * uniform[0])
    there = case.target.at(jnp.zeros_like(case.time))
    heading = jnp.arctan2(there.vel[1], there.vel[0])
    return evader_of(case, speed, 0.5 + 1.5 * uniform[1]), Runner(pos=there.pos, heading=heading)


def evader_of(case: InterceptCase, speed: Array, turn_rate: Array) -> Evader:
    """What a target of a speed () [m/s] and a turn rate () [rad/s] can do in a case."""
    spacing = jnp.max(case.upper - case.lower) / (_FIELD - 1)
    field = distance_field(case.walls, case.lower, spacing, _FIELD)
    return Evader(speed=speed, turn_rate=turn_rate, field=field, lower=case.lower, upper=case.upper)


def moved(evader: Evader, runner: Runner, goal: Array) -> Runner:
    """One step towards a heading [rad]; any number of runners, leaves (...)."""
    turn = jnp.mod(goal - runner.heading + jnp.pi, 2.0 * jnp.pi) - jnp.pi
    most = evader.turn_rate * STEP
    heading = runner.heading + jnp.clip(turn, -most, most)
    way = jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=-1)
    pos = runner.pos + evader.speed * STEP * way
    apart, _, _ = evader.field.near(pos[..., 0], pos[..., 1])
    inside = jnp.all((pos > evader.lower + ROOM) & (pos < evader.upper - ROOM), axis=-1)
    is_free = inside & (apart > ROOM)
    return Runner(pos=jnp.where(is_free[..., None], pos, runner.pos), heading=heading)


def manoeuvres(evader: Evader, runner: Runner, steps: int) -> Array:
    """Places (K, steps + 1, 2) [m] of a target that turns towards each of K headings.

    The first one is where it goes on straight. Where it may not go on it stands.

    Args:
        evader: what it can do.
        runner: where it is now.
        steps: how many are looked at, static.
    """
    goals = runner.heading + jnp.arange(_HEADINGS) * (2.0 * jnp.pi / _HEADINGS)
    begin = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (_HEADINGS, *leaf.shape)), runner)

    def step(each: Runner, _: Any) -> tuple[Runner, Array]:
        later = moved(evader, each, goals)
        return later, later.pos

    _, places = lax.scan(step, begin, None, steps)
    return jnp.concatenate([begin.pos[None], places]).swapaxes(0, 1)


def flee(evader: Evader, runner: Runner, car: Array, velocity: Array) -> Runner:
    """One step of a target that flees from a car at (2,) [m] of a velocity (2,) [m/s]."""
    ends = manoeuvres(evader, runner, _LOOK)[:, -1]
    away = jnp.sum((ends - car - velocity * (_LOOK * STEP)) ** 2, axis=-1)
    goal = runner.heading + jnp.argmax(away) * (2.0 * jnp.pi / _HEADINGS)
    return moved(evader, runner, goal)


def middle_of(places: Array) -> Array:
    """The point (2,) [m] whose greatest distance from places (K, 2) [m] is least.

    To a share 1 / 24 or so of that distance (Badoiu and Clarkson, SODA 2003).
    """

    def nearer(k: Array, point: Array) -> Array:
        farthest = places[jnp.argmax(jnp.sum((places - point) ** 2, axis=-1))]
        return point + (farthest - point) / (k + 2.0)

    return lax.fori_loop(0, _ROUNDS, nearer, places[0])


@struct.dataclass
class Pursuit:
    """Where one chase is; leaves of a batch have a leading axis B."""

    time: Array  # () [s]
    pose: Array  # (3,) [m, m, rad], of the car's rear axle
    speed: Array  # () [m/s]
    curvature: Array  # () [1/m]
    runner: Runner
    plan: InterceptPlan  # that is driven
    began: Array  # () [s], when it began; once it has ended, the car brakes


def driven(case: InterceptCase, chase: Pursuit, elapsed: Array) -> tuple[Array, Array]:
    """Speed [m/s] and curvature [1/m] of the car at times (...) [s] after now."""
    plan, num = chase.plan, chase.plan.speed.shape[0] - 1
    time = chase.time - chase.began + elapsed
    knots = plan.time * jnp.linspace(0.0, 1.0, num + 1)
    speed = jnp.interp(time, knots, plan.speed)
    slower = _GENTLE * case.limits.acceleration * jnp.maximum(time - plan.time, 0.0)
    return jnp.maximum(speed - slower, 0.0), jnp.interp(time, knots, plan.curvature)


def middle(case: InterceptCase, pose: Array) -> Array:
    """The middle (..., 2) [m] of the body at poses (..., 3) of the rear axle."""
    way = jnp.stack([jnp.cos(pose[..., 2]), jnp.sin(pose[..., 2])], axis=-1)
    return pose[..., :2] + case.body.middle * way


def stepped(
    case: InterceptCase, evader: Evader, chase: Pursuit
) -> tuple[Pursuit, tuple[Array, Array, Array]]:
    """One step of car and target.

    Returns:
        The chase after it; and at `FINE` times in the step, the last one at its end, the car's
        speed and curvature, (FINE,) each, and how far (FINE,) [m] the target is from its middle.
    """
    times = STEP * jnp.linspace(0.0, 1.0, FINE + 1)
    speed, curvature = driven(case, chase, times)
    poses = jax.vmap(lambda time: pose_at(chase.pose, jnp.asarray(STEP), speed, curvature, time))(
        times
    )
    heading = chase.pose[2]
    velocity = chase.speed * jnp.stack([jnp.cos(heading), jnp.sin(heading)])
    runner = flee(evader, chase.runner, middle(case, chase.pose), velocity)
    share = jnp.linspace(0.0, 1.0, FINE + 1)[1:, None]
    places = chase.runner.pos + share * (runner.pos - chase.runner.pos)
    apart = jnp.linalg.norm(middle(case, poses[1:]) - places, axis=-1)
    later = dataclasses.replace(
        chase,
        time=chase.time + STEP,
        pose=poses[-1],
        speed=speed[-1],
        curvature=curvature[-1],
        runner=runner,
    )
    return later, (speed[1:], curvature[1:], apart)


def reaction(case: InterceptCase, evader: Evader, chase: Pursuit) -> tuple[Array, Array]:
    """What a target does while the car goes on with its plan.

    Returns:
        Places (AHEAD + 1, 2) [m], a step apart, those after `_REACTION` steps the last of them;
        and () [s] until it is captured, or if it is not, the longest time and how near it was.
    """

    def step(now: Pursuit, _: Any) -> tuple[Pursuit, tuple[Array, Array]]:
        later, (_, _, apart) = stepped(case, evader, now)
        return later, (later.runner.pos, apart)

    _, (places, apart) = lax.scan(step, chase, None, _REACTION)
    apart = apart.reshape(-1)
    near = apart <= CAPTURE
    until = STEP / FINE * (1.0 + jnp.argmax(near))
    until = jnp.where(jnp.any(near), until, STEP * AHEAD + jnp.min(apart))
    last = jnp.broadcast_to(places[-1], (AHEAD - _REACTION, 2))
    return jnp.concatenate([chase.runner.pos[None], places, last]), until


def aims(row: Row, case: InterceptCase, evader: Evader, chase: Pursuit) -> Array:
    """Where the target may be taken to go, (N, AHEAD + 1, 2) [m], by what a row goes by; pure.

    Args:
        row: "greedy", straight on; "reach", also the middles of where it can be at any time, and
            where it is now; "informed", also its reaction to the plan that is driven. Static.
        case: one.
        evader: its target.
        chase: how far it is.
    """
    places = manoeuvres(evader, chase.runner, AHEAD)
    straight, middles = places[0], jax.vmap(middle_of, in_axes=1)(places)
    if row == "greedy":
        return straight[None]
    standing = jnp.broadcast_to(chase.runner.pos, straight.shape)
    if row == "reach":
        return jnp.stack([straight, middles, standing])
    return jnp.stack([straight, middles, standing, reaction(case, evader, chase)[0]])


def asked(case: InterceptCase, chase: Pursuit, places: Array) -> InterceptCase:
    """The case of a plan from now on, with a target at places (S, 2) [m], a step apart; pure."""
    limits, movers = case.limits, case.movers
    centre = movers.centre + chase.time * movers.velocity
    return dataclasses.replace(
        case,
        start=chase.pose,
        speed=jnp.clip(chase.speed, 0.0, limits.speed),
        curvature=jnp.clip(chase.curvature, -limits.curvature, limits.curvature),
        target=SampledPath(places=places, step=jnp.asarray(STEP)),
        time=jnp.asarray(AHEAD * STEP),
        tolerance=jnp.asarray(_TOLERANCE),
        movers=dataclasses.replace(movers, centre=centre),
    )


def renewed(
    row: Row, case: InterceptCase, evader: Evader, chase: Pursuit, plans: InterceptPlan
) -> Pursuit:
    """The chase with the best of new plans, leaves (N, ...), that keep every limit; pure.

    The plan that is driven stays where no new one is better: by how soon the target is captured in
    its `reaction`, or by the `worst_case` of what the row takes it to do.
    """
    places = manoeuvres(evader, chase.runner, AHEAD)[: 1 if row == "greedy" else None]

    def badness(each: Pursuit) -> Array:
        if row == "informed":
            return reaction(case, evader, each)[1]
        return worst_case(case, each, places)

    found = jax.vmap(lambda each: badness(_with(chase, each)))(plans)
    found = jnp.where(is_solved(plans.status), found, jnp.inf)
    best = jnp.argmin(found)
    new = _with(chase, jax.tree.map(lambda leaf: leaf[best], plans))
    is_better = found[best] < badness(chase)
    return jax.tree.map(lambda new, old: jnp.where(is_better, new, old), new, chase)


def _with(chase: Pursuit, plan: InterceptPlan) -> Pursuit:
    """The chase with a plan that begins now."""
    return dataclasses.replace(chase, plan=plan, began=chase.time)


def worst_case(case: InterceptCase, chase: Pursuit, places: Array) -> Array:
    """How far () [m] a plan misses a target in the worst case of what this can do; pure.

    That is the greatest over all manoeuvres of how far the car is from capturing it when it is
    nearest, and `_HASTE` times the mean time until a capture, which tells plans of equal worst
    cases apart.

    Args:
        case: one.
        chase: whose plan it is; at its end the car stands.
        places: (K, S + 1, 2) [m], of the manoeuvres, a step apart.
    """
    plan, steps = chase.plan, places.shape[1]
    elapsed = chase.time - chase.began + STEP * jnp.arange(steps)
    span = jnp.maximum(plan.time, 1e-3)
    poses = jax.vmap(lambda time: pose_at(plan.start, span, plan.speed, plan.curvature, time))(
        jnp.minimum(elapsed, plan.time)
    )
    apart = places - middle(case, poses)
    begin, way = apart[:, :-1], apart[:, 1:] - apart[:, :-1]
    square = jnp.sum(way**2, axis=-1)
    share = -jnp.sum(begin * way, axis=-1) / jnp.where(square > 0.0, square, 1.0)
    nearest = begin + jnp.clip(share, 0.0, 1.0)[..., None] * way
    miss = jnp.linalg.norm(nearest, axis=-1)  # (K, S), least in every step
    near = miss <= CAPTURE
    until = STEP * jnp.where(jnp.any(near, axis=1), 1.0 + jnp.argmax(near, axis=1), steps)
    worst = jnp.max(jnp.min(miss, axis=1))
    return jnp.maximum(worst - CAPTURE, 0.0) + _HASTE * jnp.mean(until)


def begun(case: InterceptCase, runner: Runner) -> Pursuit:
    """A chase at its begin; until there is a plan, the car brakes. Pure."""
    zero = jnp.zeros_like(case.time)
    knots = jnp.full(PLANNER.pieces + 1, 1.0, zero.dtype)
    nothing = InterceptPlan(
        cost=zero,
        violation=zero,
        iterations=jnp.zeros((), jnp.int32),
        status=jnp.zeros((), jnp.int32),
        start=case.start,
        time=zero,
        speed=case.speed * knots,
        curvature=case.curvature * knots,
        meeting=runner.pos,
    )
    return Pursuit(
        time=zero,
        pose=case.start,
        speed=case.speed,
        curvature=case.curvature,
        runner=runner,
        plan=nothing,
        began=zero,
    )


@dataclasses.dataclass(frozen=True)
class Pursued:
    """What came of B chases, on the host."""

    captured: np.ndarray  # (B,) [s], when the target was first near enough; inf if never
    speed: np.ndarray  # (B, S) [m/s], of the car, at equal times from 0 on
    curvature: np.ndarray  # (B, S) [1/m]
    places: np.ndarray  # (B, N, 2) [m], of the target, a step apart


def pursue(
    row: Row, cases: InterceptCase, evaders: Evader, runners: Runner, *, chunk: int | None = None
) -> Pursued:
    """Chase targets that flee, and plan anew at every step.

    Args:
        row: what the car goes by; see `aims`.
        cases: leaves (B, ...).
        evaders: of the targets.
        runners: where they are at time 0.
        chunk: cases that a device plans in one compiled call; see `pj.plan`.
    """
    now = _begun(cases, runners)
    batch = len(cases.time)
    captured = np.full(batch, np.inf)
    speeds, curvatures = [np.asarray(now.speed)[:, None]], [np.asarray(now.curvature)[:, None]]
    places = [np.asarray(now.runner.pos)]
    for number in range(round(HORIZON / STEP)):
        if np.isfinite(captured).all():
            break
        posed = jax.device_get(_posed(row, cases, evaders, now))
        plans = _planned(posed, np.flatnonzero(np.isinf(captured)), chunk)
        now, (speed, curvature, apart) = _onwards(row, cases, evaders, now, plans)
        near = np.asarray(apart) <= CAPTURE
        first = STEP * (number + (1.0 + near.argmax(axis=1)) / FINE)
        captured = np.where(near.any(axis=1), np.minimum(captured, first), captured)
        speeds.append(np.asarray(speed))
        curvatures.append(np.asarray(curvature))
        places.append(np.asarray(now.runner.pos))
    return Pursued(
        captured=captured,
        speed=np.concatenate(speeds, axis=1),
        curvature=np.concatenate(curvatures, axis=1),
        places=np.stack(places, axis=1),
    )


def _planned(posed: InterceptCase, lanes: np.ndarray, chunk: int | None) -> InterceptPlan:
    """Plans of cases (B, N) in NumPy arrays; those of other lanes than some are of no use."""
    batch, num = posed.time.shape
    flat = jax.tree.map(lambda leaf: leaf[lanes].reshape(-1, *leaf.shape[2:]), posed)
    found = plan(PLANNER, flat, chunk=chunk)
    places = np.minimum(np.searchsorted(lanes, np.arange(batch)), lanes.size - 1)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, num, *leaf.shape[1:])[places], found)


_begun = jax.jit(jax.vmap(begun))


@functools.partial(jax.jit, static_argnums=0)
def _posed(row: Row, cases: InterceptCase, evaders: Evader, now: Pursuit) -> InterceptCase:
    """The cases of all new plans, leaves (B, N, ...)."""

    def of_one(case: InterceptCase, evader: Evader, chase: Pursuit) -> InterceptCase:
        places = aims(row, case, evader, chase)
        return jax.vmap(lambda each: asked(case, chase, each))(places)

    return jax.vmap(of_one)(cases, evaders, now)


@functools.partial(jax.jit, static_argnums=0)
def _onwards(
    row: Row, cases: InterceptCase, evaders: Evader, now: Pursuit, plans: InterceptPlan
) -> tuple[Pursuit, tuple[Array, Array, Array]]:
    """A step with new plans, leaves (B, N, ...); see `stepped`."""

    def of_one(case: InterceptCase, evader: Evader, chase: Pursuit, plans: InterceptPlan) -> Any:
        return stepped(case, evader, renewed(row, case, evader, chase, plans))

    return jax.vmap(of_one)(cases, evaders, now, plans)
