"""Minimum-jerk trajectories between two given states [Yu2023bat, eqs 15-17]."""

import jax.numpy as jnp
from jax import Array

from planner_jax.trajectory.polynomial import PiecewisePolynomial


def minimum_jerk(head_state: Array, tail_state: Array, duration: Array) -> PiecewisePolynomial:
    """Return the quintic that minimises the integral of |jerk|^2 between two states.

    The coefficients are [Yu2023bat, eqs 16-17]. As printed, eq. 17 holds only if the motion starts
    from hovering: its Delta p is the end position minus the start position. Here the motion at
    constant initial acceleration is subtracted too: Delta p = p_T - p_0 - v_0 T - a_0 T^2 / 2, with
    position p, velocity v, acceleration a, and duration T; and similarly Delta v and Delta a.

    Args:
        head_state: (3, 3) position, velocity, acceleration at the start.
        tail_state: (3, 3) position, velocity, acceleration at the end.
        duration: () [s], > 0.

    Returns:
        One piece of degree 5.
    """
    t = duration
    p0, v0, a0 = head_state
    delta_p = tail_state[0] - p0 - v0 * t - 0.5 * a0 * t**2
    delta_v = tail_state[1] - v0 - a0 * t
    delta_a = tail_state[2] - a0
    alpha = (60.0 * t**2 * delta_a - 360.0 * t * delta_v + 720.0 * delta_p) / t**5
    beta = (-24.0 * t**3 * delta_a + 168.0 * t**2 * delta_v - 360.0 * t * delta_p) / t**5
    gamma = (3.0 * t**4 * delta_a - 24.0 * t**3 * delta_v + 60.0 * t**2 * delta_p) / t**5
    coeffs = jnp.stack([p0, v0, a0 / 2.0, gamma / 6.0, beta / 24.0, alpha / 120.0])
    return PiecewisePolynomial(coeffs=coeffs[None], durations=jnp.reshape(t, (1,)))


def primitive_cost(alpha: Array, beta: Array, gamma: Array, duration: Array) -> Array:
    """Return the mean squared jerk of a minimum-jerk polynomial, by axis [Yu2023catch, eq. 16].

    Args:
        alpha: (3,) [m/s^5], fifth derivative of the position.
        beta: (3,) [m/s^4], fourth derivative at the start.
        gamma: (3,) [m/s^3], third derivative at the start.
        duration: () T [s], > 0.

    Returns:
        (3,) [m^2/s^6]; the sum is the integral of |jerk|^2 divided by T.
    """
    t = duration
    later = beta**2 / 3.0 + alpha * gamma / 3.0 + alpha * beta * t / 4.0 + alpha**2 * t**2 / 20.0
    return gamma**2 + beta * gamma * t + later * t**2


def minimum_jerk_after_ramp(
    head_state: Array, tail_state: Array, duration: Array, ease: float
) -> PiecewisePolynomial:
    """Return a minimum-jerk polynomial after a ramp that brings the jerk to its initial jerk.

    A minimum-jerk polynomial alone starts with a jerk that a hovering quadrotor does not have, so
    that the body rate would jump. Here the jerk first changes linearly from the jerk of
    `head_state` to a value J during `ease`. The polynomial starts where this ramp ends. J is
    computed such that J equals the initial jerk of the polynomial; this is a linear equation.

    Args:
        head_state: (4, 3) position, velocity, acceleration, jerk at the start.
        tail_state: (3, 3) position, velocity, acceleration at the end.
        duration: () [s] > 0, of ramp and polynomial together.
        ease: [s] > 0, duration of the ramp, but at most half of `duration`.

    Returns:
        Two pieces of degree 5 with continuous jerk.
    """
    t = jnp.minimum(ease, 0.5 * duration)
    p0, v0, a0, j0 = head_state

    def primitive(jerk: Array) -> PiecewisePolynomial:
        ramp_end = jnp.stack(
            [
                p0 + v0 * t + a0 * t**2 / 2.0 + (3.0 * j0 + jerk) * t**3 / 24.0,
                v0 + a0 * t + (2.0 * j0 + jerk) * t**2 / 6.0,
                a0 + (j0 + jerk) * t / 2.0,
            ]
        )
        return minimum_jerk(ramp_end, tail_state, duration - t)

    def first_jerk(jerk: Array) -> Array:
        return 6.0 * primitive(jerk).coeffs[0, 3]

    constant = first_jerk(jnp.zeros_like(j0))
    # Derivative of `first_jerk` by its argument, in closed form. A finite difference would have a
    # large rounding error, since the difference is only a thousandth of the values of `first_jerk`.
    share = t / (duration - t)
    slope = -share * (4.5 + share * (6.0 + 2.5 * share))
    jerk = constant / (1.0 - slope)
    ramp = jnp.stack([p0, v0, a0 / 2.0, j0 / 6.0, (jerk - j0) / (24.0 * t), jnp.zeros_like(p0)])
    after = primitive(jerk)
    return PiecewisePolynomial(
        coeffs=jnp.concatenate([ramp[None], after.coeffs]),
        durations=jnp.concatenate([t[None], after.durations]),
    )
