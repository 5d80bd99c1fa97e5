"""One flight in one compiled scan: observe, estimate, plan anew, track, meet.

Three periods are nested. A physics step is a control step; every look at the balls ends a row
of these; a plan is made at the start of a row of looks, for the moment at which that row ends
and from what was known at its start, and takes effect there. So a plan may take as long as one
period to compute. The known latency is made up for by flying the estimate on.

Written for one flight; `fly_leg` makes a batch of it. Times count from the first plan.
"""

import dataclasses
import functools
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.ball.flight import BallState
from planner_jax.sims import sensing as sight
from planner_jax.sims.control import Gains, control, reference_at, robot_state
from planner_jax.sims.model import Physics, World, ball_states, ball_velocity, step
from planner_jax.sims.scoring import Contact, moment, nearest, passage
from planner_jax.sims.sensing import Estimate, Sensing, sensed_robot
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate, total_duration

_BRAKING = 0.8  # [s] from the end of a plan to rest
_LOWEST_REST = 0.5  # [m]


@struct.dataclass
class Outlook:
    """What a plan is made of: the moment from which it is to be flown, as expected."""

    time: Array  # () [s]
    elapsed: Array  # () [s], since the plan flown until then began
    balls: BallState  # leaves (N, 3), where they are believed to be then
    drag: Array  # (N,) K_D [1/m], believed
    present: Array  # (N,) bool, which are in flight and not yet met
    head_state: Array  # (4, 3) of the quadrotor


class Pilot(Protocol):
    """A task's part of the loop: a frozen dataclass, static under jit."""

    def plan_anew(self, scenario: Any, plan: Any, outlook: Outlook) -> tuple[Any, Array]:
        """A plan from the one that is flown; and () bool, whether to fly it."""
        ...

    def times(self, plan: Any) -> Array:
        """When each ball is to be met (N,) [s] since the plan began, in the balls' order."""
        ...


@dataclasses.dataclass(frozen=True)
class Loop:
    """Everything that shapes a flight's program; static under jit.

    Raises:
        ValueError: a period is not a whole number of the next shorter one.
    """

    world: World
    sensing: Sensing = Sensing()
    replan: float = 0.0  # [Hz]; 0 flies the first plan
    gains: Gains = Gains()
    kalman: bool = True  # filter of what is seen of the balls
    estimate_drag: bool = True  # from the energy that a ball loses
    record: bool = False  # path and prediction errors, look by look

    def __post_init__(self) -> None:
        if not self.replan >= 0.0:
            raise ValueError(f"replan must be >= 0, got {self.replan}")
        sensing = self.sensing
        control_rate = 1.0 / self.world.timestep
        whole(
            control_rate / sensing.rate, "rate", f"a divisor of {control_rate:g} Hz", sensing.rate
        )
        whole(
            sensing.latency * sensing.rate,
            "latency",
            f"a multiple of the looks' {1.0 / sensing.rate:g} s",
            sensing.latency,
        )
        if self.replan > 0.0:
            rule = f"a divisor of the looks' {sensing.rate:g} Hz"
            whole(sensing.rate / self.replan, "replan", rule, self.replan)

    @property
    def steps_per_look(self) -> int:
        """Physics steps from look to look."""
        return round(1.0 / (self.sensing.rate * self.world.timestep))

    @property
    def looks_per_plan(self) -> int:
        """Looks from plan to plan; one where nothing is planned anew."""
        return round(self.sensing.rate / self.replan) if self.replan > 0.0 else 1

    @property
    def period(self) -> float:
        """[s] from plan to plan."""
        return self.looks_per_plan / self.sensing.rate

    @property
    def late_looks(self) -> int:
        """How many looks old is what a look shows."""
        return round(self.sensing.latency * self.sensing.rate)

    def num_periods(self, duration: float) -> int:
        """How many periods cover a duration [s]."""
        return int(np.ceil(duration / self.period - 1e-6))


def whole(ratio: float, name: str, rule: str, value: float) -> None:
    """Raise unless a ratio is a whole number."""
    if abs(ratio - round(ratio)) > 1e-6 or (ratio > 0.0 and round(ratio) == 0):
        raise ValueError(f"{name} must be {rule}, got {value:g}")


@struct.dataclass
class Flight:
    """Everything that changes during a flight."""

    physics: Physics
    shown: Array  # (L, N, 3) [m], true positions of the balls that looks are still to show
    estimates: Estimate  # leaves (N, ...)
    earlier: Estimate  # those of one planning period ago
    launched: Array  # (N,) bool
    present: Array  # (N,) bool, planned for and not yet met by plan
    plan: Any
    began: Array  # () [s], when the plan began
    contact: Contact  # leaves (N, ...)
    worst_tracking: Array  # () [m], of the quadrotor from its plan, up to the last contact
    squared_tracking: Array  # () [m^2 s]
    tracked: Array  # () [s]
    time: Array  # () [s]
    key: Array


@struct.dataclass
class Record:
    """One look of a flight."""

    time: Array  # () [s]
    physics: Physics
    wanted: Array  # (3,) [m], where the quadrotor is to be
    horizon: Array  # (N,) [s], until each ball is to be met
    error: Array  # (N, 3) [m], of the prediction for then


def with_rest(trajectory: PiecewisePolynomial) -> PiecewisePolynomial:
    """The trajectory with one more piece that comes to rest, so that it goes on after its end.

    The piece is the polynomial of degree 7 from the last state to rest at the end of an even
    braking, no lower than half a metre.
    """
    coeffs = trajectory.coeffs
    missing = 8 - coeffs.shape[1]
    coeffs = jnp.pad(coeffs, ((0, 0), (0, missing), (0, 0)))
    # Pieces of balls that are not there come last and last no time.
    last = jnp.max(jnp.where(trajectory.durations > 0.0, jnp.arange(coeffs.shape[0]), 0))
    piece = PiecewisePolynomial(coeffs[last][None], trajectory.durations[last][None])
    unit = jnp.asarray([_BRAKING**k for k in range(8)], coeffs.dtype)[:, None]
    factorials = jnp.asarray([1.0, 1.0, 2.0, 6.0], coeffs.dtype)[:, None]
    state = jnp.stack([evaluate(piece, piece.durations[0], k) for k in range(4)])
    low = state * unit[:4] / factorials
    rest = state[0] + 0.5 * _BRAKING * state[1]
    rest = rest.at[2].max(jnp.minimum(_LOWEST_REST, state[0, 2] + 1.0))
    powers = np.arange(8)
    rows = np.stack(
        [np.prod([powers - i for i in range(k)], axis=0) * np.ones(8) for k in range(4)]
    )
    wanted = jnp.zeros_like(state).at[0].set(rest)
    wanted -= jnp.matmul(
        jnp.asarray(rows[:, :4], coeffs.dtype), low, precision=lax.Precision.HIGHEST
    )
    inverse = jnp.asarray(np.linalg.inv(rows[:, 4:]), coeffs.dtype)
    high = jnp.matmul(inverse, wanted, precision=lax.Precision.HIGHEST)
    braking = jnp.concatenate([low, high]) / unit
    return PiecewisePolynomial(
        coeffs=jnp.concatenate([coeffs, braking[None]]),
        durations=jnp.append(trajectory.durations, jnp.asarray(_BRAKING, coeffs.dtype)),
    )


def state_at(trajectory: PiecewisePolynomial, time: Array) -> Array:
    """Position to jerk (4, 3) at a time () [s]; at rest once the end is passed."""
    time = jnp.minimum(time, total_duration(trajectory))
    return jnp.stack([evaluate(trajectory, time, k) for k in range(4)])


def _fly_look(loop: Loop, pilot: Pilot, flight: Flight, drag: Array) -> Flight:
    """Physics and control from one look to the next, and what that look says."""
    world, dtype = loop.world, flight.time.dtype
    key, noise_key, look_key = jax.random.split(flight.key, 3)
    noise = jax.random.normal(noise_key, (4, 3), dtype)
    path = with_rest(flight.plan.trajectory)
    end = total_duration(path)
    times = flight.time + world.timestep * jnp.arange(loop.steps_per_look, dtype=dtype)
    local = jnp.minimum(times - flight.began, end - 2.0 * world.vehicle.rotor_lag)
    references = jax.vmap(lambda t: reference_at(path, t, world))(local)
    planned = flight.began + pilot.times(flight.plan)
    last = jnp.max(jnp.where(flight.present, planned, -jnp.inf))

    def advance(carry: tuple, now: tuple) -> tuple[tuple, None]:
        physics, before, contact, worst, squared, tracked = carry
        reference, time = now
        state = robot_state(physics)
        if any(loop.sensing.robot_stds):
            state = sensed_robot(state, noise, loop.sensing)
        rotors = control(state, reference, loop.gains, world)
        physics = step(world, physics, rotors, drag)
        after = moment(world, physics)
        passes, later = passage(world, before, after, time, planned, reference.pos)
        contact = nearest(contact, passes & flight.launched, later)
        counts = time <= last
        away = jnp.sum((before.robot_pos - reference.pos) ** 2)
        worst = jnp.where(counts, jnp.maximum(worst, away), worst)
        squared = squared + jnp.where(counts, away * world.timestep, 0.0)
        tracked = tracked + jnp.where(counts, world.timestep, 0.0)
        return (physics, after, contact, worst, squared, tracked), None

    before = moment(world, flight.physics)
    sums = (flight.worst_tracking**2, flight.squared_tracking, flight.tracked)
    carry, _ = lax.scan(
        advance, (flight.physics, before, flight.contact, *sums), (references, times)
    )
    physics, _, contact, worst, squared, tracked = carry
    shown = jnp.concatenate([flight.shown, ball_states(world, physics)[0][None]])
    seen = sight.observed(look_key, shown[0], loop.sensing)
    seen = jnp.where(flight.launched[:, None], seen, jnp.nan)
    return dataclasses.replace(
        flight,
        physics=physics,
        shown=shown[1:],
        estimates=_looked(loop, flight.estimates, seen),
        contact=contact,
        worst_tracking=jnp.sqrt(worst),
        squared_tracking=squared,
        tracked=tracked,
        time=flight.time + 1.0 / loop.sensing.rate,
        key=key,
    )


def _looked(loop: Loop, estimates: Estimate, seen: Array) -> Estimate:
    """The estimates (N, ...) after one look (N, 3)."""
    gravity = jnp.asarray(loop.world.gravity, seen.dtype)

    def one(estimate: Estimate, at: Array) -> Estimate:
        looked = sight.look if loop.kalman else sight.look_unfiltered
        estimate = looked(estimate, at, loop.sensing, gravity)
        return sight.with_drag(estimate, gravity) if loop.estimate_drag else estimate

    return jax.vmap(one)(estimates, seen)


def expected(loop: Loop, estimates: Estimate, ahead: Any) -> BallState:
    """The balls `ahead` [s] from now, as they are believed, leaves (N, 3)."""
    dtype = estimates.drag.dtype
    gravity = jnp.asarray(loop.world.gravity, dtype)
    span = jnp.asarray(ahead + loop.sensing.latency, dtype)
    return jax.vmap(lambda estimate: sight.predicted(estimate, span, gravity))(estimates)


def _planned_anew(loop: Loop, pilot: Pilot, flight: Flight, scenario: Any) -> tuple[Any, Array]:
    """The plan for the end of this period, and whether to fly it."""
    when = flight.time + loop.period
    elapsed = when - flight.began
    outlook = Outlook(
        time=when,
        elapsed=elapsed,
        balls=expected(loop, flight.estimates, loop.period),
        drag=flight.estimates.drag,
        present=flight.present & (pilot.times(flight.plan) > elapsed),
        head_state=state_at(with_rest(flight.plan.trajectory), elapsed),
    )
    return pilot.plan_anew(scenario, flight.plan, outlook)


def _fly_period(
    loop: Loop, pilot: Pilot, scenario: Any, drag: Array, flight: Flight
) -> tuple[Flight, Record | None]:
    """One period: a plan for its end, and the looks until then."""

    def next_look(flight: Flight, _: None) -> tuple[Flight, Record | None]:
        flight = _fly_look(loop, pilot, flight, drag)
        return flight, _recorded(loop, pilot, flight, drag) if loop.record else None

    began, plan = flight.began, flight.plan
    good = None
    if loop.replan > 0.0:
        found, good = _planned_anew(loop, pilot, flight, scenario)
    flight = dataclasses.replace(flight, earlier=flight.estimates)
    flight, record = lax.scan(next_look, flight, None, length=loop.looks_per_plan)
    gone = pilot.times(plan) <= flight.time - began
    flight = dataclasses.replace(flight, present=flight.present & ~gone)
    if good is not None:
        pick = lambda new, old: jnp.where(good, new, old)  # noqa: E731
        flight = dataclasses.replace(
            flight, plan=jax.tree.map(pick, found, plan), began=pick(flight.time, began)
        )
    return flight, record


def _recorded(loop: Loop, pilot: Pilot, flight: Flight, drag: Array) -> Record:
    """Where everything is, and how wrong the balls' predictions are."""
    world = loop.world
    path = with_rest(flight.plan.trajectory)
    horizon = flight.began + pilot.times(flight.plan) - flight.time
    now = moment(world, flight.physics)
    gravity = jnp.asarray(world.gravity, drag.dtype)

    def error(pos: Array, vel: Array, true_drag: Array, estimate: Estimate, ahead: Array) -> Array:
        truth = BallState(pos=pos, vel=vel)
        truth = sight.fly(truth, ahead, true_drag, gravity, num_steps=12)[0]
        believed = sight.fly(
            estimate.belief.ball,
            ahead + loop.sensing.latency,
            estimate.drag,
            gravity,
            num_steps=12,
        )[0]
        return believed.pos - truth.pos

    return Record(
        time=flight.time,
        physics=flight.physics,
        wanted=state_at(path, flight.time - flight.began)[0],
        horizon=horizon,
        error=jax.vmap(error)(
            now.ball_pos, ball_velocity(world, now.ball_vel, drag), drag, flight.estimates, horizon
        ),
    )


@functools.partial(jax.jit, static_argnames=("loop", "pilot", "num_periods"))
def fly_leg(
    loop: Loop,
    pilot: Pilot,
    flight: Flight,
    scenario: Any,
    drag: Array,
    *,
    num_periods: int,
) -> tuple[Flight, Record | None]:
    """A batch of flights for some periods.

    Args:
        loop: what shapes the program.
        pilot: of the task.
        flight: at the start of the leg, leaves (B, ...).
        scenario: of the task, leaves (B, ...); its times count like the flight's.
        drag: (B, N) K_D [1/m], the true one.
        num_periods: how many (static).

    Returns:
        The flights at the end, and with `loop.record` a `Record` of every look, leaves
        (B, K, ...).
    """

    def one(flight: Flight, scenario: Any, drag: Array) -> tuple[Flight, Record | None]:
        period = functools.partial(_fly_period, loop, pilot, scenario, drag)
        flight, record = lax.scan(lambda state, _: period(state), flight, None, length=num_periods)
        flat = lambda leaf: leaf.reshape(-1, *leaf.shape[2:])  # noqa: E731
        return flight, jax.tree.map(flat, record)

    return jax.vmap(one)(flight, scenario, drag)


@dataclasses.dataclass(frozen=True)
class Flown:
    """What came of a batch of flights, on the host; leaves with a leading axis B."""

    contact: Contact  # leaves (B, N, ...)
    plan: Any  # the last one
    began: np.ndarray  # (B,) [s], when that began
    tracking: np.ndarray  # (B, 2) [m], root mean square and worst, up to the last contact planned
    record: Record | None  # leaves (B, K, ...)


def flown(flight: Flight, records: list[Record | None]) -> Flown:
    """Of flights (B, ...) at their end, and the records of their legs."""
    there, records = jax.device_get((dataclasses.replace(flight, key=None), records))
    mean = np.sqrt(there.squared_tracking / np.maximum(there.tracked, 1e-6))
    return Flown(
        contact=there.contact,
        plan=there.plan,
        began=there.began,
        tracking=np.stack([mean, there.worst_tracking], axis=1),
        record=jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *records),
    )
