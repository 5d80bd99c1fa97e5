"""Drag coefficient K_D of a ball from the energy that it loses [Yu2023bat, eqs 6 and 7].

World frame, z up, SI units. Functions take one ball; use `jax.vmap` for many.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.ball.flight import BallState


def specific_energy(ball: BallState, gravity: Array) -> Array:
    """Return a ball's energy per unit mass,  |v|^2 / 2 + g z  [m^2/s^2], at speed |v| and height z.

    Here g > 0 is the magnitude of gravity. Drag changes this energy by -K_D |v|^3 per second
    [Yu2023bat, eq. 6]. Above eq. 6 the paper adds the product of position and gravity vector
    instead of g z. With that sign, energy would change in a flight without drag.
    """
    return 0.5 * jnp.sum(ball.vel**2) + gravity * ball.pos[2]


@struct.dataclass
class RlsState:
    """The least-squares estimate of a number x from measurements  y = h x + noise.

    The factor h of each measurement is known, and the noise has unit variance.

    Attributes:
        estimate: () estimate of x.
        variance: () variance of the estimate; at first, the variance that is assumed without
            measurements.
    """

    estimate: Array
    variance: Array


def rls_update(state: RlsState, regressor: Array, measurement: Array) -> RlsState:
    """Update a recursive least-squares estimate with one more measurement.

    Args:
        state: the estimate so far.
        regressor: (), known factor h; the measurement is h times the estimated number plus noise.
        measurement: (); if it is not finite, the estimate does not change.
    """
    usable = jnp.isfinite(measurement)
    y = jnp.where(usable, measurement, 0.0)
    # From variance P, regressor h and gain K, textbooks compute the variance (1 - K h) P. The
    # equal formula P / (1 + h^2 P) is used here, since it has no rounding error of a difference.
    variance = state.variance / (1.0 + regressor**2 * state.variance)
    error = y - regressor * state.estimate
    after = RlsState(estimate=state.estimate + variance * regressor * error, variance=variance)
    return jax.tree.map(lambda new, old: jnp.where(usable, new, old), after, state)


def measure_drag(before: BallState, after: BallState, step: Array, gravity: Array) -> Array:
    """Return a measurement () [1/m] of K_D from two states of a ball [Yu2023bat, eq. 7].

    It is the lost energy divided by the time and by the cube of the mean speed. Its relative error
    is of second order in `step`. The measurement is NaN for a ball at standstill.

    Args:
        before: leaves (3,), estimated state of the ball.
        after: leaves (3,), estimated state `step` later.
        step: () [s] > 0, time between the two states.
        gravity: () [m/s^2], magnitude.
    """
    squares = jnp.stack([jnp.sum(before.vel**2), jnp.sum(after.vel**2)])
    moves = squares > 0.0
    speed = 0.5 * jnp.sum(jnp.where(moves, jnp.sqrt(jnp.where(moves, squares, 1.0)), 0.0))
    flies = speed > 0.0
    cube = jnp.where(flies, speed, 1.0) ** 3
    lost = specific_energy(before, gravity) - specific_energy(after, gravity)
    return jnp.where(flies, lost / (step * cube), jnp.nan)


def drag_by_rls(
    state: RlsState, before: BallState, after: BallState, step: Array, gravity: Array
) -> RlsState:
    """Update the estimate of K_D [1/m] with the energy lost between two states of a ball.

    The measurements of `measure_drag` enter with the regressor 1, as below [Yu2023bat, eq. 7], and
    have unit variance. From a prior of great variance the estimate is therefore their mean. The
    arguments are the arguments of `measure_drag`; states with NaN do not change the estimate.
    """
    one = jnp.ones_like(state.estimate)
    return rls_update(state, one, measure_drag(before, after, step, gravity))
