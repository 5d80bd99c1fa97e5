"""The minimum-jerk primitive between two full states (paper 002, eqs 15-17; its ref. [9])."""

import jax.numpy as jnp
from jax import Array

from planner_jax.trajectory.polynomial import PiecewisePolynomial


def minimum_jerk(head_state: Array, tail_state: Array, duration: Array) -> PiecewisePolynomial:
    """The quintic of least integral |jerk|^2 between two states.

    Paper 002, eqs 16-17; the differences of eq. 17 must be taken from the coasting state,
    Delta p = p_T - p_0 - v_0 T - a_0 T^2 / 2 and so on (the print holds only from hover).

    Args:
        head_state: (3, 3) position, velocity, acceleration at the start.
        tail_state: (3, 3) the same at the end.
        duration: () T [s], > 0.

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


def mean_squared_jerk(primitive: PiecewisePolynomial) -> Array:
    """Cost (1/T) integral |jerk|^2 dt of a one-piece quintic (paper 002, eq. 15).

    With jerk = alpha t^2 / 2 + beta t + gamma this is
    gamma^2 + beta gamma T + beta^2 T^2/3 + alpha gamma T^2/3 + alpha beta T^3/4
    + alpha^2 T^4/20, summed over the axes.
    """
    t = primitive.durations[0]
    gamma = 6.0 * primitive.coeffs[0, 3]
    beta = 24.0 * primitive.coeffs[0, 4]
    alpha = 120.0 * primitive.coeffs[0, 5]
    return jnp.sum(
        gamma**2
        + beta * gamma * t
        + (beta**2 + alpha * gamma) * t**2 / 3.0
        + alpha * beta * t**3 / 4.0
        + alpha**2 * t**4 / 20.0
    )
