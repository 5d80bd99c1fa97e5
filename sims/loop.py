"""A batch of flights, period by period: observe, estimate, plan anew, track, meet.

Three periods are nested. A physics step is a control step; every look at the balls ends a row
of these; a plan is made at the start of a row of looks, for the moment at which that row ends
and from what was known at its start, and takes effect there. So a plan may take as long as one
period to compute. The known latency is made up for by flying the estimate on.

The robot (`sims.robot.Robot`, in the world) says how it is tracked and commanded, the task's
pilot what is planned and what counts as meeting a ball. Both are written for one flight; `fly_leg`
has them carried out for a batch. Plans and physics of a period do not wait for each other. Times
count from the first plan.
"""

import dataclasses
import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.ball.flight import BallState, fly
from planner_jax.host.threads import as_here
from planner_jax.sims import sensing as sight
from planner_jax.sims.model import World, ball_states, ball_velocity, step
from planner_jax.sims.noise import Sensing, require_whole
from planner_jax.sims.robot import Physics
from planner_jax.sims.scoring import Contact, moment, nearest
from planner_jax.sims.sensing import Estimate

_FEW = 1024  # flights at once, for which compilation takes longer than all else


@struct.dataclass
class Outlook:
    """What a plan is made of: the moment from which it is to be flown, as expected."""

    time: Array  # () [s]
    elapsed: Array  # () [s], since the plan flown until then began
    balls: BallState  # leaves (N, 3), where they are believed to be then
    drag: Array  # (N,) K_D [1/m], believed
    present: Array  # (N,) bool, which are in flight and not yet met
    head_state: Array  # of the robot, (4, 3) for a quadrotor


class Pilot(Protocol):
    """A task's part of the loop: a frozen dataclass, static under jit."""

    def asked(self, case: Any, plan: Any, outlook: Outlook) -> Any:
        """What is to be planned anew, while a plan is flown."""
        ...

    @property
    def searches(self) -> tuple[Callable[[Any], Any], ...]:
        """Each makes a plan of what is asked; none waits for another."""
        ...

    def chosen(self, asked: Any, outlook: Outlook, found: tuple[Any, ...]) -> tuple[Any, Array]:
        """One of the plans that the searches found; and () bool, whether to fly it."""
        ...

    def times(self, plan: Any) -> Array:
        """When each ball is to be met (N,) [s] since the plan began, in the balls' order."""
        ...

    def plan_shapes(self, cases: Any) -> Any:
        """What plans (B, ...) of cases (B, ...) look like, leaves `jax.ShapeDtypeStruct`."""
        ...

    @property
    def passage(self) -> Callable[..., tuple[Array, Contact]]:
        """What says which balls are met or missed within a step, like `scoring.passage`."""
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
    kalman: bool = True  # filter of what is seen of the balls
    estimate_drag: bool = True  # from the energy that a ball loses
    record: bool = False  # path and prediction errors, look by look

    def __post_init__(self) -> None:
        sensing, control_rate = self.sensing, 1.0 / self.world.timestep
        rule = f"a divisor of {control_rate:g} Hz"
        require_whole(control_rate / sensing.rate, "rate", rule, sensing.rate)
        rule = f"a multiple of the looks' {1.0 / sensing.rate:g} s"
        require_whole(sensing.latency * sensing.rate, "latency", rule, sensing.latency)
        sensing.looks_per_plan(self.replan)

    @property
    def steps_per_look(self) -> int:
        """Physics steps from look to look."""
        return round(1.0 / (self.sensing.rate * self.world.timestep))

    @property
    def looks_per_plan(self) -> int:
        """Looks from plan to plan; one where nothing is planned anew."""
        return self.sensing.looks_per_plan(self.replan)

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


@struct.dataclass
class FlightState:
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
    worst_tracking: Array  # () [m], of the robot from its plan, up to the last contact
    squared_tracking: Array  # () [m^2 s]
    tracked: Array  # () [s]
    time: Array  # () [s]
    key: Array


@struct.dataclass
class Record:
    """One look of a flight."""

    time: Array  # () [s]
    physics: Physics
    wanted: Array  # (3,) [m], where the robot is to be
    horizon: Array  # (N,) [s], until each ball is to be met
    error: Array  # (N, 3) [m], of the prediction for then


def _fly_look(loop: Loop, pilot: Pilot, flight: FlightState, drag: Array) -> FlightState:
    """Physics and control from one look to the next, and what that look says."""
    world, robot, dtype = loop.world, loop.world.robot, flight.time.dtype
    key, noise_key, look_key = jax.random.split(flight.key, 3)
    noise = jax.random.normal(noise_key, robot.noise_shape, dtype)
    times = flight.time + world.timestep * jnp.arange(loop.steps_per_look, dtype=dtype)
    references = robot.references(flight.plan, times - flight.began, world)
    planned = flight.began + pilot.times(flight.plan)
    last = jnp.max(jnp.where(flight.present, planned, -jnp.inf))

    def advance(carry: tuple, now: tuple) -> tuple[tuple, None]:
        physics, before, contact, worst, squared, tracked = carry
        reference, time = now
        state = robot.state(physics)
        if any(loop.sensing.robot_stds):
            state = robot.sensed(state, noise, loop.sensing.robot_stds)
        command = robot.command(state, reference, world)
        physics = step(world, physics, command, drag)
        after = moment(world, physics)
        passes, later = pilot.passage(world, before, after, time, planned, reference.pos)
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


@functools.partial(jax.jit, static_argnames=("loop", "pilot"))
def _asked(loop: Loop, pilot: Pilot, flights: FlightState, cases: Any) -> tuple[Outlook, Any]:
    """What is to be planned for the end of this period (B, ...), and what is then expected."""

    def one(flight: FlightState, case: Any) -> tuple[Outlook, Any]:
        when = flight.time + loop.period
        elapsed = when - flight.began
        outlook = Outlook(
            time=when,
            elapsed=elapsed,
            balls=expected(loop, flight.estimates, loop.period),
            drag=flight.estimates.drag,
            present=flight.present & (pilot.times(flight.plan) > elapsed),
            head_state=loop.world.carrier.head_state(flight.plan, elapsed),
        )
        return outlook, pilot.asked(case, flight.plan, outlook)

    return jax.vmap(one)(flights, cases)


@functools.partial(jax.jit, static_argnames=("pilot", "number"))
def _found(pilot: Pilot, number: int, asked: Any) -> Any:
    """The plans (B, ...) of one of the pilot's searches."""
    return jax.vmap(pilot.searches[number])(asked)


@functools.partial(jax.jit, static_argnames=("loop", "pilot", "num_periods"))
def _fly(
    loop: Loop, pilot: Pilot, flights: FlightState, drag: Array, num_periods: int
) -> tuple[FlightState, Record | None]:
    """Flights (B, ...) some periods on, by the plans that they have; records (B, K, ...)."""

    def one(flight: FlightState, drag: Array) -> tuple[FlightState, Record | None]:
        def next_look(flight: FlightState, _: None) -> tuple[FlightState, Record | None]:
            flight = _fly_look(loop, pilot, flight, drag)
            return flight, _recorded(loop, pilot, flight, drag) if loop.record else None

        def next_period(flight: FlightState, _: None) -> tuple[FlightState, Record | None]:
            flight = dataclasses.replace(flight, earlier=flight.estimates)
            flight, record = lax.scan(next_look, flight, None, length=loop.looks_per_plan)
            gone = pilot.times(flight.plan) <= flight.time - flight.began
            return dataclasses.replace(flight, present=flight.present & ~gone), record

        flight, record = lax.scan(next_period, flight, None, length=num_periods)
        flat = lambda leaf: leaf.reshape(-1, *leaf.shape[2:])  # noqa: E731
        return flight, jax.tree.map(flat, record)

    return jax.vmap(one)(flights, drag)


@functools.partial(jax.jit, static_argnames="pilot")
def _with_plans(
    pilot: Pilot, flights: FlightState, outlook: Outlook, asked: Any, found: tuple[Any, ...]
) -> FlightState:
    """Flights (B, ...) at the end of a period, with what was found for it where that is good."""

    def one(flight: FlightState, outlook: Outlook, asked: Any, found: tuple) -> FlightState:
        plan, good = pilot.chosen(asked, outlook, found)
        pick = lambda new, old: jnp.where(good, new, old)  # noqa: E731
        return dataclasses.replace(
            flight,
            plan=jax.tree.map(pick, plan, flight.plan),
            began=pick(flight.time, flight.began),
        )

    return jax.vmap(one)(flights, outlook, asked, found)


def _recorded(loop: Loop, pilot: Pilot, flight: FlightState, drag: Array) -> Record:
    """Where everything is, and how wrong the balls' predictions are."""
    world = loop.world
    horizon = flight.began + pilot.times(flight.plan) - flight.time
    now = moment(world, flight.physics)
    gravity = jnp.asarray(world.gravity, drag.dtype)

    def error(pos: Array, vel: Array, true_drag: Array, estimate: Estimate, ahead: Array) -> Array:
        truth = fly(BallState(pos, vel), ahead, true_drag, gravity, num_steps=12)[0]
        ball, late = estimate.belief.ball, ahead + loop.sensing.latency
        return fly(ball, late, estimate.drag, gravity, num_steps=12)[0].pos - truth.pos

    return Record(
        time=flight.time,
        physics=flight.physics,
        wanted=world.carrier.head_state(flight.plan, flight.time - flight.began)[0],
        horizon=horizon,
        error=jax.vmap(error)(
            now.ball_pos, ball_velocity(world, now.ball_vel, drag), drag, flight.estimates, horizon
        ),
    )


def in_parts(flights: FlightState) -> bool:
    """Whether each part of a period is a program of its own."""
    (device,) = flights.time.devices()
    return device.platform != "cpu" and len(flights.time) <= _FEW


def _next_period(
    loop: Loop, pilot: Pilot, flights: FlightState, cases: Any, drag: Array, begin: Callable
) -> tuple[FlightState, Any]:
    """Flights (B, ...) one period on, with plans that were made meanwhile, and their records.

    Args:
        loop: of the flights.
        pilot: of the task.
        flights: at the start of the period.
        cases: of the task, leaves (B, ...).
        drag: (B, N) K_D [1/m].
        begin: begins a part of the period with what it is given, and returns what waits for it.
    """
    outlook, asked = _asked(loop, pilot, flights, cases)
    found = [begin(_found, pilot, number, asked) for number in range(len(pilot.searches))]
    flown_on = begin(_fly, loop, pilot, flights, drag, 1)
    flights, record = flown_on()
    return _with_plans(pilot, flights, outlook, asked, tuple(each() for each in found)), record


@functools.partial(jax.jit, static_argnames=("loop", "pilot", "num_periods"))
def _fly_and_plan(
    loop: Loop, pilot: Pilot, flights: FlightState, cases: Any, drag: Array, num_periods: int
) -> tuple[FlightState, Record | None]:
    """As `_fly`, with plans made anew, in one program."""
    begin = lambda part, *given: lambda: part(*given)  # noqa: E731

    def next_period(flights: FlightState, _: None) -> tuple[FlightState, Record | None]:
        return _next_period(loop, pilot, flights, cases, drag, begin)

    flights, record = lax.scan(next_period, flights, None, length=num_periods)
    flat = lambda leaf: jnp.moveaxis(leaf, 0, 1).reshape(len(drag), -1, *leaf.shape[3:])  # noqa: E731
    return flights, jax.tree.map(flat, record)


def fly_leg(
    loop: Loop, pilot: Pilot, flights: FlightState, cases: Any, drag: Array, *, num_periods: int
) -> tuple[FlightState, list[Record]]:
    """A batch of flights for some periods.

    Many are flown in one program. Of few on a GPU each part of a period is a program of its own,
    since these take half as long to compile, if at the same time, and a third longer to carry out.

    Args:
        loop: what shapes the programs.
        pilot: of the task.
        flights: at the start of the leg, leaves (B, ...).
        cases: of the task, leaves (B, ...); their times count like the flights'.
        drag: (B, N) K_D [1/m], the true one.
        num_periods: how many.

    Returns:
        The flights at the end, and with `loop.record` the looks, leaves (B, K, ...), one behind
        another.
    """
    if loop.replan == 0.0:
        flights, record = _fly(loop, pilot, flights, drag, num_periods)
    elif not in_parts(flights):
        flights, record = _fly_and_plan(loop, pilot, flights, cases, drag, num_periods)
    else:
        with ThreadPoolExecutor() as pool:
            begin = lambda part, *given: pool.submit(as_here(part), *given).result  # noqa: E731
            records = []
            for _ in range(num_periods):
                flights, record = _next_period(loop, pilot, flights, cases, drag, begin)
                records.append(record)
        return flights, records if loop.record else []
    return flights, [record] if loop.record else []


def begin_compiling(
    loop: Loop, pilot: Pilot, flights: FlightState, cases: Any, drag: Array
) -> Callable[[], Any]:
    """Have the programs of a leg compiled by another thread, while something else is done.

    Only where each part of a period is a program of its own; elsewhere nothing is begun. For the
    programs to be those of `fly_leg`, one period is flown by plans that are nothing but zeros.

    Args:
        loop: what shapes the programs.
        pilot: of the task.
        flights: leaves (B, ...), which may be without plans.
        cases: as for `fly_leg`; only their shapes count, leaves may be `jax.ShapeDtypeStruct`.
        drag: (B, N) K_D [1/m].

    Returns:
        What waits for its end, to be called before `fly_leg`.
    """
    if loop.replan == 0.0 or not in_parts(flights):
        return lambda: None
    # By way of the host, as plans are that are made there.
    zeros = functools.partial(
        jax.tree.map, lambda leaf: jnp.asarray(np.zeros(leaf.shape, leaf.dtype))
    )

    def fly_one_period() -> None:
        begun = dataclasses.replace(flights, plan=zeros(pilot.plan_shapes(cases)))
        fly_leg(loop, pilot, begun, zeros(cases), drag, num_periods=1)

    pool = ThreadPoolExecutor(1)
    compiled = pool.submit(as_here(fly_one_period))
    pool.shutdown(wait=False)
    return compiled.result


@dataclasses.dataclass(frozen=True)
class Flown:
    """What came of a batch of flights, on the host; leaves with a leading axis B."""

    contact: Contact  # leaves (B, N, ...)
    plan: Any  # the last one
    began: np.ndarray  # (B,) [s], when that began
    tracking: np.ndarray  # (B, 2) [m], root mean square and worst, up to the last contact planned
    record: Record | None  # leaves (B, K, ...)


def flown(flights: FlightState, records: list[Record]) -> Flown:
    """Of flights (B, ...) at their end, and what was recorded of them, in order."""
    there, records = jax.device_get((dataclasses.replace(flights, key=None), records))
    joined = functools.partial(jax.tree.map, lambda *leaves: np.concatenate(leaves, axis=1))
    mean = np.sqrt(there.squared_tracking / np.maximum(there.tracked, 1e-6))
    return Flown(
        contact=there.contact,
        plan=there.plan,
        began=there.began,
        tracking=np.stack([mean, there.worst_tracking], axis=1),
        record=joined(*records) if records else None,
    )
