"""Where a quadrotor can be by a time at best: what its limits rule out, whatever is planned."""

import jax.numpy as jnp
from jax import Array

from planner_jax.core.arithmetic import components
from planner_jax.robot.quadrotor import QuadrotorLimits

# By how much limits may be exceeded here, far more than in any plan that is solved: how closely
# peaks are looked at must not matter to a bound.
ALLOWED = 1.01
_SHORTEST = 1e-3  # [s], so that a limit which is infinite is not multiplied by zero


def greatest_speed(head_state: Array, limits: QuadrotorLimits) -> Array:
    """What the quadrotor never flies faster than, () [m/s]."""
    first = jnp.sqrt(jnp.sum(head_state[1] * head_state[1]))
    return jnp.maximum(ALLOWED * limits.speed, first)


def beyond_reach(
    places: Array, times: Array, head_state: Array, limits: QuadrotorLimits, gravity: Array
) -> Array:
    """How far places lie beyond all that a quadrotor can reach by certain times, (K,) [m].

    A bound from below: zero or less says nothing. By the time t the quadrotor is in each of

    - the ball around the start whose radius is the integral of the greatest speed, which rises
      with the greatest acceleration A up to its limit,
    - the ball of radius A t^2 / 2 around where the first velocity alone takes it,
    - the ball of radius T t^2 / 2 around where it falls freely, with the greatest thrust T,

    as far as there are such limits: the mean of accelerations lies in a ball that holds them all.

    Args:
        places: (K, 3) [m].
        times: (K,) [s], >= 0.
        head_state: (4, 3) of the quadrotor at time 0.
        limits: of the quadrotor.
        gravity: () [m/s^2], magnitude.
    """
    start, vel = head_state[0], head_state[1]
    x, y, z = (place - start[k] for k, place in enumerate(components(places)))
    half_square = 0.5 * jnp.maximum(times, _SHORTEST) ** 2
    thrust = _greatest_thrust(limits)
    acceleration = _greatest_acceleration(limits, thrust, gravity)
    first, most = jnp.sqrt(jnp.sum(vel * vel)), greatest_speed(head_state, limits)
    if acceleration is None:
        return _length(x, y, z) - most * times
    rise = (most - first) / acceleration
    hurried = first * times + acceleration * half_square
    reached = jnp.where(times < rise, hurried, most * times - 0.5 * (most - first) * rise)
    beyond = _length(x, y, z) - reached
    x, y, z = x - vel[0] * times, y - vel[1] * times, z - vel[2] * times
    beyond = jnp.maximum(beyond, _length(x, y, z) - acceleration * half_square)
    if thrust is None:
        return beyond
    return jnp.maximum(beyond, _length(x, y, z + gravity * half_square) - thrust * half_square)


def _greatest_thrust(limits: QuadrotorLimits) -> Array | None:
    """Of all rotors together, per unit mass, () [m/s^2]; None without a limit."""
    found = [] if limits.max_thrust is None else [limits.max_thrust]
    if limits.rotors is not None:
        found.append(4.0 * limits.rotors.max_thrust / limits.rotors.mass)
    return ALLOWED * jnp.min(jnp.stack(found)) if found else None


def _greatest_acceleration(
    limits: QuadrotorLimits, thrust: Array | None, gravity: Array
) -> Array | None:
    """() [m/s^2]; None without a limit."""
    found = [] if limits.acceleration is None else [ALLOWED * limits.acceleration]
    if thrust is not None:
        found.append(thrust + gravity)
    return jnp.min(jnp.stack(found)) if found else None


def _length(x: Array, y: Array, z: Array) -> Array:
    return jnp.sqrt(x * x + y * y + z * z)
