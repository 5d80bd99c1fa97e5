"""From any state to rest: what a quadrotor flies when there is nothing left to catch."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.core.protocol import FEASIBILITY_TOLERANCE
from planner_jax.cost.quadrotor import flight_excess, relative_excess
from planner_jax.robot.quadrotor import QuadrotorLimits
from planner_jax.trajectory.polynomial import PiecewisePolynomial, sample_pieces

_DURATIONS = np.geomspace(0.2, 4.0, 24)  # [s], of the ways to rest that are tried
_NODES = 120  # at which each is held against the limits
# Velocity, acceleration and jerk of the powers 4 to 6 after a unit of time.
_AT_END = np.array([[4.0, 5.0, 6.0], [12.0, 20.0, 30.0], [24.0, 60.0, 120.0]])


@struct.dataclass
class Braking:
    """One polynomial from a state to rest."""

    coeffs: Array  # (8, 3), ascending powers of the time [s]; the last one is zero
    duration: Array  # () [s]
    possible: Array  # () bool, whether it keeps all limits


def braking(state: Array, gravity: Array, limits: QuadrotorLimits) -> Braking:
    """The way to rest that is soonest over, of those with least snap for their duration; pure.

    Where the quadrotor comes to rest is free, so each is of degree six. Where none of the durations
    that are tried keeps the limits, `possible` says so, and the way is that which exceeds them
    least.

    Args:
        state: (4, 3), position to jerk.
        gravity: () [m/s^2].
        limits: of the quadrotor.
    """
    pos, vel, acc, jerk = state

    def to_rest(duration: Array) -> tuple[Array, Array]:
        t = duration
        low = jnp.stack([pos, vel, acc / 2.0, jerk / 6.0])
        # Powers 4 to 6 take velocity, acceleration and jerk to zero.
        left = jnp.stack([vel + (acc + jerk * t / 2.0) * t, (acc + jerk * t) * t, jerk * t**2])
        powers = t ** jnp.arange(3.0, 6.0, dtype=t.dtype)
        high = jnp.linalg.solve(jnp.asarray(_AT_END, t.dtype), -left) / powers[:, None]
        zero = jnp.zeros_like(high[:1])
        coeffs = jnp.concatenate([low, high, zero])
        motion = sample_pieces(PiecewisePolynomial(coeffs[None], t[None]), _NODES)
        excess = flight_excess(motion, gravity, limits)
        return coeffs, jnp.max(jnp.stack(relative_excess(limits, excess)))

    durations = jnp.asarray(_DURATIONS, state.dtype)
    coeffs, worst = jax.vmap(to_rest)(durations)
    kept = worst <= FEASIBILITY_TOLERANCE
    first = jnp.where(jnp.any(kept), jnp.argmax(kept), jnp.argmin(worst))
    return Braking(coeffs=coeffs[first], duration=durations[first], possible=jnp.any(kept))
