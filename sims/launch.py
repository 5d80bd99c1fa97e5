"""The start of a flight: a robot at standstill, launched balls, and first observations of them.

A ball is already in flight when the plan for it starts: it is first observed for 2 m of its path
[Yu2023catch, Section VII-A]. This first part of the flight is not simulated in MuJoCo. It is
integrated backwards from the ball's state at the start of the plan.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.ball.flight import BallState, fly
from planner_jax.core.compiled import QUICK_OPTIONS
from planner_jax.core.errors import ArgumentError
from planner_jax.robot.attitude import turn_quaternion
from planner_jax.robot.heading import Heading
from planner_jax.sims import sensing as sight
from planner_jax.sims.loop_state import FlightState, Loop
from planner_jax.sims.model import at_rest, place_balls
from planner_jax.sims.scoring import no_contact
from planner_jax.sims.sensing import Estimate
from planner_jax.sims.state_filter import first_belief


def flight_keys(seed: int, index: np.ndarray) -> Array:
    """Return random keys (B,) of B flights, from a seed and their indices (B,) in the run.

    A flight's key does not depend on the batch to which the flight belongs.
    """
    return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(jax.random.key(seed), jnp.asarray(index))


@functools.partial(jax.jit, static_argnames="loop")
def ready(loop: Loop, starts: Array, keys: Array) -> FlightState:
    """Return flights in which the robots stand still and no ball has been launched.

    Args:
        loop: settings of the loop, with the world.
        starts: (B, 3) [m], positions of the robots of B flights.
        keys: (B,) random keys of the noise.
    """
    number = loop.world.num_balls

    def one(start: Array, key: Array) -> FlightState:
        zero, nothing = jnp.zeros(()), jnp.zeros(number, bool)
        unknown = jnp.zeros((number, 3)), jnp.full(number, 0.1, zero.dtype)
        begin = functools.partial(sight.first_estimate, observer=loop.observer)
        estimates = jax.vmap(begin)(*unknown)
        return FlightState(
            physics=at_rest(loop.world, start),
            shown=jnp.zeros((loop.late_observations, number, 3)),
            estimates=estimates,
            earlier=estimates,
            launched=nothing,
            present=nothing,
            plan=None,
            began=zero,
            contact=no_contact(number),
            worst_tracking=zero,
            squared_tracking=zero,
            tracked=zero,
            time=zero,
            key=key,
        )

    return jax.vmap(one)(starts, keys)


def turn_robots(flights: FlightState, heading: Heading | None) -> FlightState:
    """Return flights of B quadrotors at standstill, at the headings at which their cases start."""
    if heading is None:
        return flights
    qpos = flights.physics.qpos
    quat = jax.vmap(turn_quaternion)(qpos[:, 3:7], heading.start[:, 0])
    physics = dataclasses.replace(flights.physics, qpos=qpos.at[:, 3:7].set(quat))
    return dataclasses.replace(flights, physics=physics)


@functools.partial(jax.jit, static_argnames="loop")
def begin_filters(loop: Loop, flights: FlightState) -> FlightState:
    """Return flights of B robots at standstill with first beliefs, if the loop has a filter."""
    if loop.robot_filter is None:
        return flights

    def one(flight: FlightState) -> FlightState:
        key, own_key = jax.random.split(flight.key)
        belief = first_belief(loop, loop.world.robot.state(flight.physics), own_key)
        return dataclasses.replace(flight, key=key, belief=belief)

    return jax.vmap(one)(flights)


def launch_ball(
    loop: Loop,
    flights: FlightState,
    balls: BallState,
    drag: Array,
    believed: Array,
    *,
    ball: int,
    seen: float,
) -> FlightState:
    """Return the flights after one more ball has been launched.

    Args:
        loop: settings of the flights' loop.
        flights: states of the B flights, leaves (B, ...).
        balls: leaves (B, N, 3), states of the N balls, each at the start of the plan for it.
        drag: (B, N), true drag coefficient K_D [1/m].
        believed: (B, N), initial estimate of K_D [1/m].
        ball: index of the launched ball among the N balls.
        seen: [s], how long the ball has already been in flight (static).
    """
    without = dataclasses.replace(flights, plan=None)  # the launch does not change the plans
    after = _launch_ball(loop, without, balls, drag, believed, ball, seen)
    return dataclasses.replace(after, plan=flights.plan)


@functools.partial(jax.jit, static_argnames=("loop", "seen"), compiler_options=QUICK_OPTIONS)
def _launch_ball(
    loop: Loop,
    flights: FlightState,
    balls: BallState,
    drag: Array,
    believed: Array,
    ball: Array,
    seen: float,
) -> FlightState:
    def one(flight: FlightState, balls: BallState, drag: Array, believed: Array) -> FlightState:
        key, look_key = jax.random.split(flight.key)
        own = jax.tree.map(lambda leaf: leaf[ball], balls)
        shown, earlier, now = watch_ball(loop, own, drag[ball], believed[ball], look_key, seen)
        which = jnp.arange(drag.size) == ball
        put = lambda all_balls, one_ball: all_balls.at[ball].set(one_ball)  # noqa: E731
        return dataclasses.replace(
            flight,
            physics=place_balls(loop.world, flight.physics, balls, drag, which),
            shown=flight.shown.at[:, ball].set(shown),
            estimates=jax.tree.map(put, flight.estimates, now),
            earlier=jax.tree.map(put, flight.earlier, earlier),
            launched=flight.launched | which,
            key=key,
        )

    return jax.vmap(one)(flights, balls, drag, believed)


@functools.partial(jax.jit, static_argnames=("loop", "ahead"))
def await_ball(
    loop: Loop, flights: FlightState, coming: BallState, believed: Array, *, ball: int, ahead: float
) -> FlightState:
    """Return the flights with a guessed estimate of one more ball, which is not yet observed.

    The estimate is the guessed flight of the ball, integrated backwards from the start of the plan
    for this ball.

    Args:
        loop: settings of the flights' loop.
        flights: states of the B flights, leaves (B, ...).
        coming: leaves (3,), guessed state of the ball at the start of the plan for it.
        believed: (B, N), initial estimate of the drag coefficients K_D [1/m].
        ball: index of the awaited ball among the N balls.
        ahead: [s], time until the plan for the ball starts (static).
    """
    gravity = jnp.asarray(loop.world.gravity, believed.dtype)

    def guess(before: float, drag: Array) -> Estimate:
        ago = jnp.asarray(-ahead - loop.sensing.latency - before, drag.dtype)
        there = fly(coming, ago, drag, gravity, num_steps=16)[0]
        estimate = sight.first_estimate(there.pos, drag, loop.observer, there.vel)
        return sight.anchor_energy(estimate, gravity)

    def one(flight: FlightState, believed: Array) -> FlightState:
        put = lambda all_balls, one_ball: all_balls.at[ball].set(one_ball)  # noqa: E731
        now, earlier = (guess(before, believed[ball]) for before in (0.0, loop.period))
        return dataclasses.replace(
            flight,
            estimates=jax.tree.map(put, flight.estimates, now),
            earlier=jax.tree.map(put, flight.earlier, earlier),
        )

    return jax.vmap(one)(flights, believed)


def watch_ball(
    loop: Loop, ball: BallState, drag: Array, believed: Array, key: Array, duration: float
) -> tuple[Array, Estimate, Estimate]:
    """Simulate the observations of one ball before the start of the plan for this ball.

    Args:
        loop: settings of the loop, with sensing and planning period.
        ball: true state at the start of the plan.
        drag: (), true drag coefficient K_D [1/m].
        believed: (), initial estimate of K_D [1/m].
        key: random key of the observation noise.
        duration: [s], how long the ball has been in flight at the start of the plan (static).

    Returns:
        The last true positions (L, 3) [m], which are observed later because of the latency of L
            observation periods; and the estimates one planning period before the plan's start, and
            at its start.
    """
    sensing, dtype = loop.sensing, drag.dtype
    gravity = jnp.asarray(loop.world.gravity, dtype)
    num = int(round(duration * sensing.rate)) + 1
    ages = (num - 1 - np.arange(num)) / sensing.rate
    place = lambda age: fly(ball, -age, drag, gravity, num_steps=16)[0].pos  # noqa: E731
    path = jax.vmap(place)(jnp.asarray(ages, dtype))
    observed, shown = path[: num - loop.late_observations], path[num - loop.late_observations :]
    keys = jax.random.split(key, observed.shape[0])
    seen = jax.vmap(lambda k, at: sight.observe(k, at[None], sensing)[0])(keys, observed)

    update = sight.update_estimate if loop.kalman else sight.update_unfiltered

    def advance(estimate: Estimate, at: Array) -> tuple[Estimate, Estimate]:
        after = update(estimate, at, sensing, gravity)
        return after, after

    first = sight.first_estimate(observed[0], believed, loop.observer)
    now, history = lax.scan(advance, first, seen)
    earlier = jax.tree.map(lambda leaf: leaf[-1 - loop.observations_per_plan], history)
    return shown, earlier, sight.anchor_energy(now, gravity)


def require_world(loop: Loop, kind: str, num_balls: int, **planned: Any) -> None:
    """Raise `ValueError` unless the simulated world has the tool and the numbers that plans assume.

    Args:
        loop: settings of the loop, with the world.
        kind: required tool, "net" or "racket".
        num_balls: required number of balls of a flight.
        planned: values, one per case of the plans, of `gravity`, `net_height`, `net_radius`,
            `racket_height` or `racket_radius`; only the passed values are compared.
    """
    world, tool = loop.world, loop.world.carrier.tool
    if tool.kind != kind:
        raise ArgumentError("world", f"a {kind}", verb="carry", shown=f"a {tool.kind}")
    if world.num_balls != num_balls:
        raise ArgumentError("world", f"{num_balls} balls", world.num_balls, verb="have")
    flown = {"gravity": world.gravity}
    flown |= {f"{kind}_height": tool.height, f"{kind}_radius": tool.radius}
    for name, values in planned.items():
        apart = ~np.isclose(values, flown[name], rtol=1e-5, atol=0.0)
        if apart.any():
            value = np.asarray(values)[apart][0]
            raise ArgumentError(
                name,
                "the same in plan and flown world",
                shown=f"{value:g} in the plan's case and {flown[name]:g} in the world",
            )


def require_plan(plan: Any, kind: type, head_state: Any) -> None:
    """Raise `ValueError` unless plans belong to the task and start at the robots' positions.

    Args:
        plan: plans of B flights, with a trajectory, leaves (B, ...).
        kind: class of the task's plans.
        head_state: (B, 4, 3), states of the robots at the start; the first rows are positions.
    """
    if not isinstance(plan, kind):
        raise ArgumentError("plan", f"a {kind.__name__}", shown=f"a {type(plan).__name__}")
    begin = np.asarray(plan.trajectory.coeffs)[:, 0, 0]
    place = np.asarray(head_state)[:, 0]
    if begin.shape != place.shape:
        raise ArgumentError("plan", f"of {len(place)} flights", len(begin))
    away = np.linalg.norm(begin - place, axis=1)
    if away.size and not np.nanmax(away) < 0.01:
        lane = int(np.nanargmax(away))
        shown = f"{away[lane]:.2f} m from there in flight {lane}"
        raise ArgumentError("plan", "where its robot is", verb="begin", shown=shown)
