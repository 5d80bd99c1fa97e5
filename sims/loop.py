"""The closed loop of a batch of flights, period by period: observe, estimate, replan, track, hit.

Three periods are nested. Each physics step is also a control step. An observation of the balls
follows after a fixed number of steps. A planning period is a fixed number of observations. A plan
uses the estimates at the start of its planning period and is flown from the period's end, so that
planning may take one period. Observations arrive late by a known latency, which the prediction
compensates.

The robot (`sims.robot.Robot`, in the world) defines its references and commands. The task's pilot
(`loop_state.Pilot`) defines what is planned and what counts as a contact with a ball. Both are
written for one flight; `fly_leg` batches them. Planning and physics of a period run concurrently.
Times count from the start of the first plan.
"""

import dataclasses
import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.ball.flight import BallState, fly
from planner_jax.core.compiled import QUICK_OPTIONS
from planner_jax.core.errors import ArgumentError
from planner_jax.host.threads import as_here
from planner_jax.sims import sensing as sight
from planner_jax.sims import state_filter as own
from planner_jax.sims.loop_state import FlightState, Loop, Outlook, Pilot, Record, RobotBelief
from planner_jax.sims.model import ball_states, ball_velocity, step
from planner_jax.sims.robot import Physics
from planner_jax.sims.scoring import moment, nearest
from planner_jax.sims.sensing import Estimate

_FEW = 1024  # largest batch for which compiling takes longer than the flights themselves


def track(
    loop: Loop,
    physics: Physics,
    reference: Any,
    noise: Array,
    drag: Array,
    belief: RobotBelief | None = None,
) -> tuple[Any, Physics]:
    """Simulate one physics step in which the robot tracks a reference (a planned state).

    Args:
        loop: settings of the closed loop.
        physics: state before the step.
        reference: the planned state.
        noise: standard normal errors of the robot's estimated state.
        drag: (N,), true drag coefficients K_D [1/m] of the balls.
        belief: the robot's estimate of its own state, if the loop has a `robot_filter`.

    Returns:
        The robot's estimated state before the step, and the physics after the step.

    Raises:
        ValueError: the loop has a `robot_filter`, but the flight has no belief.
    """
    world, robot = loop.world, loop.world.robot
    state = robot.state(physics)
    if loop.robot_filter is not None:
        if belief is None:
            raise ArgumentError("robot_filter", "None in this task", shown="sensors")
        state = own.estimate_state(belief, world.timestep)
    elif any(loop.sensing.robot_stds):
        state = robot.sense(state, noise, loop.sensing.robot_stds)
    return state, step(world, physics, robot.command(state, reference, world), drag)


def _fly_to_observation(loop: Loop, pilot: Pilot, flight: FlightState, drag: Array) -> FlightState:
    world, robot, dtype = loop.world, loop.world.robot, flight.time.dtype
    key, noise_key, look_key = jax.random.split(flight.key, 3)
    is_filtered, steps = flight.belief is not None, loop.steps_per_observation
    shape = (steps + 1, 2, 3) if is_filtered else robot.noise_shape
    noise = jax.random.normal(noise_key, shape, dtype)
    times = flight.time + world.timestep * jnp.arange(steps, dtype=dtype)
    references = robot.references(flight.plan, times - flight.began, world)
    planned = flight.began + pilot.times(flight.plan)
    last = jnp.max(jnp.where(flight.present, planned, -jnp.inf))

    def advance(carry: tuple, now: tuple) -> tuple[tuple, Any]:
        earlier, before, contact, worst, squared, tracked, belief = carry
        (reference, time, errors), measured = now, None
        physics = track(loop, earlier, reference, noise, drag, belief)[1]
        if belief is not None:
            belief, measured = own.advance_belief(loop, belief, earlier, physics, errors)
        after = moment(world, physics)
        passes, later = pilot.passage(world, before, after, time, planned, reference.pos)
        contact = nearest(contact, passes & flight.launched, later)
        counts = time <= last
        away = jnp.sum((before.robot_pos - reference.pos) ** 2)
        worst = jnp.where(counts, jnp.maximum(worst, away), worst)
        squared = squared + jnp.where(counts, away * world.timestep, 0.0)
        tracked = tracked + jnp.where(counts, world.timestep, 0.0)
        return (physics, after, contact, worst, squared, tracked, belief), measured

    before = moment(world, flight.physics)
    sums = (flight.worst_tracking**2, flight.squared_tracking, flight.tracked)
    first = (flight.physics, before, flight.contact, *sums, flight.belief)
    errors = noise[:-1] if is_filtered else None
    carry, measured = lax.scan(advance, first, (references, times, errors))
    physics, _, contact, worst, squared, tracked, belief = carry
    if belief is not None:
        belief = own.receive_pose(loop, belief, measured, robot.state(physics), noise[-1])
    shown = jnp.concatenate([flight.shown, ball_states(world, physics)[0][None]])
    seen = sight.observe(look_key, shown[0], loop.sensing)
    seen = jnp.where(flight.launched[:, None], seen, jnp.nan)
    return dataclasses.replace(
        flight,
        physics=physics,
        shown=shown[1:],
        estimates=_update_estimates(loop, flight.estimates, seen),
        contact=contact,
        worst_tracking=jnp.sqrt(worst),
        squared_tracking=squared,
        tracked=tracked,
        time=flight.time + 1.0 / loop.sensing.rate,
        key=key,
        belief=belief,
    )


def _update_estimates(loop: Loop, estimates: Estimate, seen: Array) -> Estimate:
    gravity = jnp.asarray(loop.world.gravity, seen.dtype)

    def one(estimate: Estimate, at: Array) -> Estimate:
        update = sight.update_estimate if loop.kalman else sight.update_unfiltered
        estimate = update(estimate, at, loop.sensing, gravity)
        return sight.with_drag(estimate, gravity) if loop.estimate_drag else estimate

    return jax.vmap(one)(estimates, seen)


def predict_balls(loop: Loop, estimates: Estimate, ahead: Any) -> BallState:
    """Return the states of N balls predicted for `ahead` [s] from now, leaves (N, 3)."""
    dtype = estimates.drag.dtype
    gravity = jnp.asarray(loop.world.gravity, dtype)
    span = jnp.asarray(ahead + loop.sensing.latency, dtype)
    return jax.vmap(lambda estimate: sight.predict(estimate, span, gravity))(estimates)


@functools.partial(jax.jit, static_argnames=("loop", "pilot"))
def _pose_problems(
    loop: Loop, pilot: Pilot, flights: FlightState, cases: Any
) -> tuple[Outlook, Any]:

    def one(flight: FlightState, case: Any) -> tuple[Outlook, Any]:
        when = flight.time + loop.period
        elapsed = when - flight.began
        outlook = Outlook(
            time=when,
            elapsed=elapsed,
            balls=predict_balls(loop, flight.estimates, loop.period),
            drag=flight.estimates.path_drag,
            present=flight.present & (pilot.times(flight.plan) > elapsed),
            head_state=loop.world.carrier.head_state(flight.plan, elapsed),
        )
        return outlook, pilot.pose_problem(case, flight.plan, outlook)

    return jax.vmap(one)(flights, cases)


@functools.partial(jax.jit, static_argnames=("pilot", "number"))
def _search_plans(pilot: Pilot, number: int, asked: Any) -> Any:
    return jax.vmap(pilot.searches[number])(asked)


@functools.partial(jax.jit, static_argnames=("loop", "pilot", "num_periods"))
def _fly(
    loop: Loop, pilot: Pilot, flights: FlightState, drag: Array, num_periods: int
) -> tuple[FlightState, Record | None]:

    def one(flight: FlightState, drag: Array) -> tuple[FlightState, Record | None]:
        def next_observation(flight: FlightState, _: None) -> tuple[FlightState, Record | None]:
            flight = _fly_to_observation(loop, pilot, flight, drag)
            return flight, _record(loop, pilot, flight, drag) if loop.record else None

        def next_period(flight: FlightState, _: None) -> tuple[FlightState, Record | None]:
            flight = dataclasses.replace(flight, earlier=flight.estimates)
            flight, record = lax.scan(
                next_observation, flight, None, length=loop.observations_per_plan
            )
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

    def one(flight: FlightState, outlook: Outlook, asked: Any, found: tuple) -> FlightState:
        plan, good = pilot.choose(asked, outlook, found)
        pick = lambda new, old: jnp.where(good, new, old)  # noqa: E731
        return dataclasses.replace(
            flight,
            plan=jax.tree.map(pick, plan, flight.plan),
            began=pick(flight.time, flight.began),
        )

    return jax.vmap(one)(flights, outlook, asked, found)


def _record(loop: Loop, pilot: Pilot, flight: FlightState, drag: Array) -> Record:
    world = loop.world
    horizon = flight.began + pilot.times(flight.plan) - flight.time
    now = moment(world, flight.physics)
    gravity = jnp.asarray(world.gravity, drag.dtype)

    def error(pos: Array, vel: Array, true_drag: Array, estimate: Estimate, ahead: Array) -> Array:
        truth = fly(BallState(pos, vel), ahead, true_drag, gravity, num_steps=12)[0]
        return sight.fly_on(estimate, ahead + loop.sensing.latency, gravity, 12).pos - truth.pos

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
    """Return whether planning and flying of a batch are separate compiled programs.

    Up to 1024 flights on a GPU use separate programs, which are compiled concurrently. This halves
    the compile time, which exceeds the run time, although the flights themselves run longer.
    """
    (device,) = flights.time.devices()
    return device.platform != "cpu" and len(flights.time) <= _FEW


def _next_period(
    loop: Loop, pilot: Pilot, flights: FlightState, cases: Any, drag: Array, begin: Callable
) -> tuple[FlightState, Any]:
    outlook, asked = _pose_problems(loop, pilot, flights, cases)
    found = [begin(_search_plans, pilot, number, asked) for number in range(len(pilot.searches))]
    flown_on = begin(_fly, loop, pilot, flights, drag, 1)
    flights, record = flown_on()
    return _with_plans(pilot, flights, outlook, asked, tuple(each() for each in found)), record


@functools.partial(
    jax.jit, static_argnames=("loop", "pilot", "most_periods"), compiler_options=QUICK_OPTIONS
)
def _fly_and_plan(
    loop: Loop,
    pilot: Pilot,
    flights: FlightState,
    cases: Any,
    drag: Array,
    num_periods: Array,
    most_periods: int,
) -> tuple[FlightState, Record | None]:
    begin = lambda part, *given: lambda: part(*given)  # noqa: E731

    def next_period(k: Array, carry: tuple) -> tuple[FlightState, Record | None]:
        flights, records = carry
        flights, record = _next_period(loop, pilot, flights, cases, drag, begin)
        put = lambda every, one: lax.dynamic_update_index_in_dim(every, one, k, 0)  # noqa: E731
        return flights, jax.tree.map(put, records, record)

    def empty(leaf: jax.ShapeDtypeStruct) -> Array:
        num, *shape = leaf.shape
        return jnp.zeros((most_periods, num, loop.observations_per_plan, *shape), leaf.dtype)

    one = jax.eval_shape(jax.vmap(functools.partial(_record, loop, pilot)), flights, drag)
    records = jax.tree.map(empty, one) if loop.record else None
    flights, records = lax.fori_loop(0, num_periods, next_period, (flights, records))
    flat = lambda leaf: jnp.moveaxis(leaf, 0, 1).reshape(len(drag), -1, *leaf.shape[3:])  # noqa: E731
    return flights, jax.tree.map(flat, records)


def fly_leg(
    loop: Loop,
    pilot: Pilot,
    flights: FlightState,
    cases: Any,
    drag: Array,
    *,
    num_periods: int,
    most_periods: int | None = None,
) -> tuple[FlightState, list[Record]]:
    """Simulate one leg, that is, some planning periods, of a batch of B flights of N balls.

    A large batch runs in one program. For a small batch on a GPU, planning and flying of a period
    are separate programs, which are compiled concurrently. Compiling then takes half as long, and
    running takes a third longer.

    Args:
        loop: settings that determine the programs.
        pilot: the task's part of the loop.
        flights: the flights at the start, leaves (B, ...).
        cases: cases of the task, leaves (B, ...); times count from the start of the first plan.
        drag: (B, N), true drag coefficients K_D [1/m].
        num_periods: number of planning periods.
        most_periods: greatest number of planning periods in any leg of the flights; by default
            `num_periods`. Legs with equal greatest numbers share one compiled program.

    Returns:
        The flights at the end, and with `loop.record` the records of all observations in order.
    """
    if loop.replan == 0.0:
        flights, record = _fly(loop, pilot, flights, drag, num_periods)
    elif not in_parts(flights):
        most = most_periods or num_periods
        flights, record = _fly_and_plan(loop, pilot, flights, cases, drag, num_periods, most)
        num = num_periods * loop.observations_per_plan
        record = jax.tree.map(lambda leaf: np.asarray(leaf)[:, :num], record)
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
    """Start to compile the programs of `fly_leg` in another thread.

    For up to 1024 flights on a GPU, planning and flying are separate programs, and only these are
    compiled ahead. The thread flies one period with plans of zeros, which compiles the programs.

    Args:
        loop: settings that determine the programs.
        pilot: the task's part of the loop.
        flights: B flights of N balls, leaves (B, ...), which may have no plans.
        cases: cases of `fly_leg`; only their shapes count, leaves may be `jax.ShapeDtypeStruct`.
        drag: (B, N), true drag coefficients K_D [1/m].

    Returns:
        A function that waits for the compilation, to be called before `fly_leg`.
    """
    if loop.replan == 0.0 or not in_parts(flights):
        return lambda: None
    # JAX compiles different programs for arrays that come from NumPy and for its own arrays. Plans
    # come from NumPy, so that the zeros must come from NumPy, too.
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
