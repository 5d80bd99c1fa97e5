"""Joint motions of an arm whose rates are linear in time between equidistant knots.

A motion has K pieces. Its parameters are the steps (K, n) [rad]: the joint rates at the ends of the
pieces, multiplied by the duration. The angles then do not depend on the duration. They are
quadratic in time between knots. Rates have their extremes at knots, and accelerations are constant
between knots, so that checks at the knots suffice for the limits of both.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.robot.arm_dynamics import stretch
from planner_jax.task.block.case import BlockCase
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate

_HIGHEST = lax.Precision.HIGHEST


@dataclasses.dataclass(frozen=True)
class Weights:
    """Weights of the residuals whose squares the search for an arm's motion minimises."""

    meeting: float = 100.0  # [1/m], of the ball's distances from the shield's plane and middle
    tilt: float = 30.0  # [1/rad], of the shield's tilt against the ball's path
    limits: float = 30.0  # of relative excesses over the joints' limits
    clearance: float = 100.0  # [1/m], of distances below the required distance from obstacles
    effort: float = 0.1  # of joint accelerations divided by their limits


@functools.cache
def step_weights(pieces: int, shares: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return weights of a motion's parameters in sums that are the angles turned up to N times.

    The parameters are a joint's rates, multiplied by the duration, at the start and at the ends of
    K = `pieces` pieces. The times are `shares`, from 0 to 1, of the duration.

    Returns:
        first: (N,), weights of the parameter at the start.
        steps: (N, K), weights of the parameters at the ends of the pieces.
    """
    position = np.asarray(shares)[:, None] * pieces
    knots = np.arange(pieces + 1)
    # Integrals of the knots' hat functions (1 at a knot, 0 at others) from the start to `position`.
    left, right = np.clip(position - knots + 1.0, 0.0, 1.0), np.clip(position - knots, 0.0, 1.0)
    weights = 0.5 * left**2 + right - 0.5 * right**2
    weights[:, 0] -= 0.5
    weights /= pieces
    return weights[:, 0], weights[:, 1:]


def angles_at(start: Array, first: Array, steps: Array, shares: tuple[float, ...]) -> Array:
    """Return the joint angles (N, n) [rad] of a motion at N times: `shares` of its duration.

    The motion has K pieces and the initial angles `start` (n,) [rad]. The initial rates are `first`
    (n,), and the rates after each piece `steps` (K, n), both multiplied by the duration [rad].
    """
    of_first, of_steps = step_weights(steps.shape[0], shares)
    turned = jnp.matmul(jnp.asarray(of_steps, steps.dtype), steps, precision=lax.Precision.HIGHEST)
    return start[None] + jnp.asarray(of_first, steps.dtype)[:, None] * first[None] + turned


class JointTerms(NamedTuple):
    """Cost of joint limits and accelerations, a sum of squared residuals r, with derivatives.

    J is the Jacobian of one joint's residuals by K + 1 variables: the joint's rates at the ends of
    K pieces of the motion, multiplied by the duration, and the time of contact.
    """

    cost: Array  # (), r . r, summed over the joints
    gradient: Array  # (n, K + 1), J^T r
    curvature: Array  # (n, K + 1, K + 1), J^T J
    excess: Array  # (), largest relative excess over a limit
    load: Array  # (), root mean square of accelerations divided by their limits


def joint_terms(
    case: BlockCase, steps: Array, first: Array, duration: Array, weights: Weights, most: float
) -> JointTerms:
    """Compute the cost of the joints' limits and accelerations, with its derivatives.

    The joint rates at the start are `first` (n,) [rad], and at the ends of K pieces `steps` (K, n)
    [rad], both multiplied by the motion's `duration` () [s]. Rates, accelerations and angles are
    penalised above `most` times their limits.
    """
    pieces, dtype = steps.shape[0], steps.dtype
    knots = tuple(np.arange(1, pieces + 1) / pieces)
    of_first, of_steps = (jnp.asarray(each, dtype) for each in step_weights(pieces, knots))
    rise = jnp.asarray(np.eye(pieces) - np.eye(pieces, k=-1), dtype)
    rates = steps / duration
    accelerations = (steps - jnp.concatenate([first[None], steps[:-1]])) * (pieces / duration**2)
    angles = angles_at(case.angles, first, steps, knots)
    middle = 0.5 * (case.arm.upper + case.arm.lower)
    half = 0.5 * (case.arm.upper - case.arm.lower)

    def row(
        value: Array, by_steps: Array, by_time: Array, slope: float | Array
    ) -> tuple[Array, Array]:
        slopes = jnp.concatenate([by_steps, by_time.T[:, :, None]], axis=2)
        return value.T, slopes * jnp.broadcast_to(slope, value.shape).T[:, :, None]

    def hinge(share: Array, by_steps: Array, by_time: Array) -> tuple[Array, Array]:
        over = weights.limits * jnp.maximum(jnp.abs(share) - most, 0.0)
        sign = weights.limits * jnp.sign(share) * (over > 0.0).astype(over.dtype)
        return row(over, by_steps, by_time, sign)

    of_rate = jnp.eye(pieces, dtype=dtype)[None] / (duration * case.limits.velocity[:, None, None])
    rate_shares = rates / case.limits.velocity[None]
    of_rise = rise[None] * (pieces / duration**2 / case.limits.acceleration[:, None, None])
    rise_shares = accelerations / case.limits.acceleration[None]
    of_start = jnp.zeros_like(rise_shares).at[0].set(first * pieces / duration**2)
    by_time = (-2.0 * rise_shares - of_start / case.limits.acceleration[None]) / duration
    angle_shares = (angles - middle[None]) / half[None]
    of_angle = of_steps[None] / half[:, None, None]
    effort = weights.effort
    parts = [
        hinge(rate_shares, of_rate, -rate_shares / duration),
        hinge(rise_shares, of_rise, by_time),
        hinge(angle_shares, of_angle, of_first[:, None] * case.rates[None] / half[None]),
        row(effort * rise_shares, of_rise, by_time, effort),
    ]
    values = jnp.concatenate([value for value, _ in parts], axis=1)
    slopes = jnp.concatenate([slope for _, slope in parts], axis=1)
    excess = [jnp.max(jnp.abs(each)) for each in (rate_shares, rise_shares, angle_shares)]
    return JointTerms(
        jnp.sum(values**2),
        jnp.einsum("irk,ir->ik", slopes, values, precision=lax.Precision.HIGHEST),
        jnp.einsum("irk,irl->ikl", slopes, slopes, precision=lax.Precision.HIGHEST),
        jnp.max(jnp.stack(excess)) - 1.0,
        jnp.sqrt(jnp.maximum(jnp.mean(rise_shares**2), 1e-12)),
    )


def bump_steps(height: Array, pieces: int) -> Array:
    """Return offsets (K, n) [rad] of a motion's parameters that add a detour to its joint angles.

    The detour height sin^2(pi s), with time s as a fraction of the duration, reaches `height` (n,)
    [rad] at half of the duration and ends at zero. The offsets are its rates at the ends of the
    K = `pieces` pieces, multiplied by the duration: pi height sin(2 pi s).
    """
    knots = np.arange(1, pieces + 1) / pieces
    return jnp.asarray(np.pi * np.sin(2.0 * np.pi * knots), height.dtype)[:, None] * height[None]


def polynomial(start: Array, first: Array, steps: Array, duration: Array) -> PiecewisePolynomial:
    """Convert a motion of `duration` [s] to K polynomial pieces of degree 2.

    The joint angles start at `start` (n,) [rad]. The joint rates at the start are `first` (n,), and
    at the ends of the pieces `steps` (K, n), both multiplied by the duration [rad].
    """
    pieces = steps.shape[0]
    step = duration / pieces
    rates = jnp.concatenate([first[None], steps]) / jnp.maximum(duration, 1e-9)
    rise = (rates[1:] - rates[:-1]) / jnp.maximum(step, 1e-9)
    turned = step * 0.5 * (rates[1:] + rates[:-1])
    angles = start[None] + jnp.cumsum(turned, axis=0) - turned
    return PiecewisePolynomial(
        coeffs=jnp.stack([angles, rates[:-1], 0.5 * rise], axis=1),
        durations=jnp.broadcast_to(step, (pieces,)),
    )


def speed_up(
    motion: PiecewisePolynomial, velocity: Array, acceleration: Array
) -> tuple[PiecewisePolynomial, Array]:
    """Shorten the duration of a motion along its path until a joint reaches one of its limits.

    The motion is piecewise quadratic, from rest to rest; the limits are (n,) [rad/s], [rad/s^2].

    Returns:
        motion: the motion with the same path and the shorter duration.
        pace: () in (0, 1], new duration divided by the old duration.
    """
    rates = motion.coeffs[:, 1] / velocity[None]
    rises = 2.0 * motion.coeffs[:, 2] / acceleration[None]
    pace = jnp.maximum(jnp.max(jnp.abs(rates)), jnp.sqrt(jnp.max(jnp.abs(rises))))
    pace = jnp.clip(pace, 1e-3, 1.0)
    return stretch(motion, pace), pace


def least_times(
    away: Array, rate: Array, velocity: Array, acceleration: Array, ends_at_rest: Array | bool
) -> tuple[Array, Array]:
    """Return the least times (n,) [s] in which each joint alone turns by `away` (n,) [rad].

    A joint starts with the rate (n,) [rad/s], and may end at rest. The motion has the greatest
    acceleration, then the greatest rate, and then the greatest deceleration. The second result is
    the duration (n,) of the acceleration.
    """
    stop = jnp.where(ends_at_rest, 0.5 * rate * jnp.abs(rate) / acceleration, 0.0)
    sign = jnp.where(away >= stop, 1.0, -1.0)
    away, rate = sign * away, sign * rate
    halves = jnp.where(ends_at_rest, 2.0, 1.0)
    # Rate at which the joint stops to accelerate: it reaches `away` at rest, or with this rate.
    square = (2.0 * acceleration * away + rate**2) / halves
    moves = square > 0.0  # the root has a finite slope at standstill
    peak = jnp.minimum(jnp.where(moves, jnp.sqrt(jnp.where(moves, square, 1.0)), 0.0), velocity)
    turned = (halves * peak**2 - rate**2) / (2.0 * acceleration)
    cruise = jnp.maximum(away - turned, 0.0) / jnp.maximum(peak, 1e-9)
    return (halves * peak - rate) / acceleration + cruise, (peak - rate) / acceleration


def append_braking(case: BlockCase, motion: PiecewisePolynomial) -> PiecewisePolynomial:
    """Append a piece in which all joints brake uniformly and stop at the same time.

    The piece lasts 0 s if the case requires that the motion itself ends at rest.
    """
    end = jnp.sum(motion.durations)
    angles, rates = evaluate(motion, end), evaluate(motion, end, 1)
    duration = jnp.max(jnp.abs(rates) / case.limits.acceleration)
    duration = jnp.where(case.ends_at_rest, 0.0, duration)
    slowing = -0.5 * rates / jnp.where(duration > 0.0, duration, 1.0)
    piece = jnp.zeros_like(motion.coeffs[:1]).at[0, :3].set(jnp.stack([angles, rates, slowing]))
    return PiecewisePolynomial(
        coeffs=jnp.concatenate([motion.coeffs, piece]),
        durations=jnp.append(motion.durations, duration),
    )


@functools.cache
def profiles(pieces: int, ends_at_rest: bool) -> np.ndarray:
    """Return P speed profiles (P, K), which turn a joint by 1 rad from standstill.

    A profile has the joint's rates at the ends of K = `pieces` pieces, times the duration [rad].

    The rate rises linearly, is then constant and, with `ends_at_rest`, falls linearly to zero. The
    ramps last 1 to K / 2 pieces, or 1 to K pieces without `ends_at_rest`. In the last profile the
    rate is a parabola, whose mean square acceleration is least.
    """
    knots = np.arange(1, pieces + 1)
    shapes = []
    for ramp in range(1, (pieces // 2 if ends_at_rest else pieces) + 1):
        shape = np.minimum(knots / ramp, 1.0)
        shapes.append(np.minimum(shape, (pieces - knots) / ramp) if ends_at_rest else shape)
    shapes.append(knots * ((1 if ends_at_rest else 2) * pieces - knots))
    means = [np.sum(shape) - 0.5 * shape[-1] for shape in shapes]
    return np.array([shape * pieces / mean for shape, mean in zip(shapes, means, strict=True)])


def lift_to_unknowns(
    lift: Array, drift: Array, grams: Array, pushes: Array, joints: JointTerms
) -> tuple[Array, Array]:
    """Return J^T r and J^T J, where J is the Jacobian of all residuals r by all unknowns.

    The unknowns are the rates of each of the n joints after K pieces of the motion, multiplied by
    its duration, and the time of contact.

    Args:
        lift: (W, K), derivatives of a joint's angle at W samples by the K unknowns of the joint.
        drift: (W, n), derivatives of the joint angles at the samples by the time of contact.
        grams: (W, n + 1, n + 1), J^T J of the residuals at each sample, here with the Jacobian J by
            the n joint angles and the time.
        pushes: (W, n + 1), J^T r of the residuals at each sample, with the same J.
        joints: terms of the joints' limits and accelerations.
    """
    num = drift.shape[1]
    grams_q, grams_t = grams[:, :num, :num], grams[:, :num, num]
    moved = jnp.einsum("wij,wj->wi", grams_q, drift, precision=_HIGHEST) + grams_t
    time_stiffness = jnp.sum(grams[:, num, num] + jnp.sum(drift * (moved + grams_t), axis=1))
    time_push = jnp.sum(pushes[:, num] + jnp.sum(drift * pushes[:, :num], axis=1))
    stiffness = jnp.einsum("wk,wl,wij->kilj", lift, lift, grams_q, precision=_HIGHEST)
    coupling = jnp.einsum("wk,wi->ki", lift, moved, precision=_HIGHEST)
    steps_push = jnp.einsum("wk,wi->ki", lift, pushes[:, :num], precision=_HIGHEST)
    each = jnp.eye(num, dtype=lift.dtype)
    of_each = joints.curvature[:, :-1, :-1]
    stiffness += jnp.einsum("ikl,ij->kilj", of_each, each, precision=_HIGHEST)
    coupling += joints.curvature[:, :-1, -1].T
    steps_push += joints.gradient[:, :-1].T
    time_push += jnp.sum(joints.gradient[:, -1])
    time_stiffness += jnp.sum(joints.curvature[:, -1, -1])
    size = num * lift.shape[1]
    curvature = jnp.zeros((size + 1, size + 1), lift.dtype)
    curvature = curvature.at[:size, :size].set(stiffness.reshape(size, size))
    curvature = curvature.at[:size, size].set(coupling.reshape(-1))
    curvature = curvature.at[size, :size].set(coupling.reshape(-1))
    curvature = curvature.at[size, size].set(time_stiffness)
    return jnp.append(steps_push.reshape(-1), time_push), curvature
