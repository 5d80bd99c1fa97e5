"""Motions of an arm from standstill to standstill, with joint rates that are linear between knots.

A motion is fastest if at every time some joint turns at its greatest rate or acceleration. Motions
without obstacles have a closed form. Other motions have K pieces of equal durations. Their unknowns
are the joint rates at the K - 1 inner knots, multiplied by the duration. The path then does not
depend on the duration, and its least duration follows from the limits.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.optimise.levenberg import Model
from planner_jax.robot.arm import ArmLimits
from planner_jax.task.block.clearance import clearances_and_slopes
from planner_jax.task.block.motion import step_weights
from planner_jax.task.reach.case import ReachCase
from planner_jax.trajectory.polynomial import PiecewisePolynomial

_HIGHEST = lax.Precision.HIGHEST
_DURATION, _CLEARANCE, _RANGE = 0.1, 100.0, 30.0  # weights of residuals; clearance [1/m]
_MARGIN = 0.01  # [m], distance of bodies at which residuals aim, if start and goal have more


def join_knots(start: Array, times: Array, rates: Array) -> PiecewisePolynomial:
    """Return the motion with joint rates (M + 1, n) [rad/s] at times (M + 1,) [s], from `start`."""
    durations = jnp.maximum(jnp.diff(times), 0.0)  # rounding errors may exchange equal times
    turned = 0.5 * durations[:, None] * (rates[1:] + rates[:-1])
    angles = start[None] + jnp.cumsum(turned, axis=0) - turned
    rise = jnp.diff(rates, axis=0) / jnp.where(durations > 0.0, durations, jnp.inf)[:, None]
    return PiecewisePolynomial(jnp.stack([angles, rates[:-1], 0.5 * rise], axis=1), durations)


def pad_knots(times: Array, rates: Array, pieces: int) -> tuple[Array, Array]:
    """Repeat the last knot, so that a motion has as many pieces as `pieces`."""
    missing = pieces + 1 - times.shape[0]
    return jnp.pad(times, (0, missing), mode="edge"), jnp.pad(rates, ((0, missing), (0, 0)))


def _ramp(distance: Array, velocity: Array, acceleration: Array) -> tuple[Array, Array]:
    """Return the durations [s] of a trapezoid of speed over a distance, and of its ramps."""
    ramp = jnp.minimum(velocity / acceleration, jnp.sqrt(distance / acceleration))
    cruise = distance / jnp.maximum(acceleration * ramp, 1e-12) - ramp
    return 2.0 * ramp + jnp.maximum(cruise, 0.0), ramp


def quickest_knots(start: Array, goal: Array, limits: ArmLimits) -> tuple[Array, Array]:
    """Return the knots of the motion in which every joint takes the time of the slowest joint.

    No motion to the goal is shorter. A joint accelerates at its limit, turns at a constant rate,
    and brakes at its limit. The motion has 2 n + 1 pieces.

    Returns:
        times: (2 n + 2,) [s].
        rates: (2 n + 2, n) [rad/s].
    """
    turn, most = goal - start, limits.acceleration
    size = jnp.abs(turn)
    total = jnp.max(_ramp(size, limits.velocity, most)[0])
    speed = most * total
    speed = 0.5 * (speed - jnp.sqrt(jnp.maximum(speed**2 - 4.0 * most * size, 0.0)))
    speed = jnp.minimum(speed, limits.velocity)
    ramps = speed / most
    times = jnp.sort(jnp.concatenate([jnp.zeros(1, turn.dtype), ramps, total - ramps, total[None]]))
    rise = most[None] * jnp.minimum(times, total - times)[:, None]
    return times, jnp.sign(turn)[None] * jnp.minimum(jnp.maximum(rise, 0.0), speed[None])


def straight_knots(points: Array, limits: ArmLimits) -> tuple[Array, Array]:
    """Return the knots of a motion along straight joint motions that stops at every point.

    Between points (N, n) [rad] the motion has 3 pieces, as short as the limits allow.

    Returns:
        times: (3 N - 2,) [s].
        rates: (3 N - 2, n) [rad/s].
    """
    turn = jnp.diff(points, axis=0)
    size = jnp.maximum(jnp.abs(turn), 1e-9)
    speed, rise = (
        jnp.min(limit[None] / size, axis=1) for limit in (limits.velocity, limits.acceleration)
    )
    total, ramp = _ramp(jnp.ones_like(speed), speed, rise)
    moves = jnp.max(jnp.abs(turn), axis=1) > 0.0
    total, ramp = jnp.where(moves, total, 0.0), jnp.where(moves, ramp, 0.0)
    begin = jnp.cumsum(total) - total
    times = jnp.stack([begin + ramp, begin + total - ramp, begin + total], axis=1).reshape(-1)
    fast = turn / jnp.where(moves, total - ramp, 1.0)[:, None]
    rates = jnp.stack([fast, fast, jnp.zeros_like(fast)], axis=1).reshape(-1, points.shape[1])
    zero = jnp.zeros((1, points.shape[1]), points.dtype)
    return jnp.append(jnp.zeros(1, times.dtype), times), jnp.concatenate([zero, rates])


def end_at(steps: Array, turn: Array) -> Array:
    """Return unknowns (K - 1, n), shifted alike so that the motion turns the joints by `turn`."""
    num = steps.shape[0]
    return steps + ((num + 1) * turn - jnp.sum(steps, axis=0))[None] / num


def least_duration(steps: Array, limits: ArmLimits) -> Array:
    """Return the least duration () [s] of the motion with the unknowns (K - 1, n)."""
    rates = jnp.max(jnp.abs(steps) / limits.velocity[None])
    change = jnp.diff(jnp.pad(steps, ((1, 1), (0, 0))), axis=0) * (steps.shape[0] + 1)
    return jnp.maximum(rates, jnp.sqrt(jnp.max(jnp.abs(change) / limits.acceleration[None])))


def steps_knots(steps: Array, limits: ArmLimits) -> tuple[Array, Array]:
    """Return times (K + 1,) and rates (K + 1, n) of the motion with the unknowns (K - 1, n)."""
    duration = jnp.maximum(least_duration(steps, limits) * (1.0 + 1e-5), 1e-6)
    shares = np.linspace(0.0, 1.0, steps.shape[0] + 2)
    return jnp.asarray(shares, steps.dtype) * duration, jnp.pad(steps, ((1, 1), (0, 0))) / duration


def steps_along(points: Array, limits: ArmLimits, pieces: int) -> Array:
    """Return the unknowns (K - 1, n) of a motion near a path through points (N, n) [rad]."""
    slow = jnp.max(jnp.abs(jnp.diff(points, axis=0)) / limits.velocity[None], axis=1)
    passed = jnp.append(0.0, jnp.cumsum(slow)) + 1e-6 * jnp.arange(
        points.shape[0], dtype=slow.dtype
    )
    time = (np.arange(pieces) + 0.5) / pieces
    ramp = 0.15  # fraction of the duration in which the motion speeds up, and in which it brakes
    share = np.where(time < ramp, 0.5 * time**2 / ramp, time - 0.5 * ramp)
    share = np.where(time > 1.0 - ramp, 1.0 - ramp - 0.5 * (1.0 - time) ** 2 / ramp, share)
    at = jnp.asarray(share / (1.0 - ramp), points.dtype) * passed[-1]
    angles = jnp.stack([jnp.interp(at, passed, joint) for joint in points.T], axis=1)
    return end_at(pieces * jnp.diff(angles, axis=0), points[-1] - points[0])


def make_model(
    case: ReachCase, turn: Array, ends: Array, duration: Array, power: Array, sizes: tuple[int, ...]
) -> Callable[[Array], Model]:
    """Return the function that evaluates the cost of unknowns and its quadratic model.

    The cost is the sum of powers of the joints' rates and accelerations relative to limits, of
    squared distances below a margin, and of squared angles beyond limits. The greater the power,
    the more the fastest motion has the least cost.

    Args:
        case: the case.
        turn: (n,) [rad], from the start to the goal.
        ends: (R,) [m], least distance of each pair of bodies at the start and at the goal.
        duration: () [s], at which rates and accelerations are compared with their limits.
        power: () of the relative accelerations.
        sizes: numbers of pieces K, of samples at which distances are computed, and of samples with
            the least distances at which derivatives are computed.
    """
    pieces, num_samples, num_worst = sizes
    shares = tuple(np.arange(1, num_samples) / num_samples)
    weights = step_weights(pieces, shares)[1][:, :-1]
    lift_of = jnp.asarray(weights, turn.dtype)  # (S, K - 1)
    change = np.eye(pieces, pieces - 1) - np.eye(pieces, pieces - 1, k=-1)
    change = jnp.asarray(change * pieces, turn.dtype)
    middle = 0.5 * (case.arm.upper + case.arm.lower)
    half = 0.5 * (case.arm.upper - case.arm.lower)
    size, num = pieces - 1, turn.shape[0]
    margin = jnp.clip(0.7 * ends, 0.0, _MARGIN)[:, None]

    def powers(share: Array, exponent: Array, slope: Array) -> tuple[Array, Array, Array]:
        """Return the sum of squares of |share|^exponent, and its halved derivatives."""
        low = jnp.abs(share) ** (exponent - 1.0)
        first = exponent * low * slope
        value = low * share
        return (
            _DURATION**2 * jnp.sum(value**2),
            _DURATION**2 * value * first,
            (_DURATION * first) ** 2,
        )

    def evaluate(point: Array) -> Model:
        steps = end_at(point.reshape(size, num), turn)
        to_rise = 1.0 / (case.limits.acceleration * duration**2)
        to_rate = 1.0 / (case.limits.velocity * duration)
        rises = jnp.matmul(change, steps, precision=_HIGHEST) * to_rise[None]
        cost_a, push_a, bend_a = powers(rises, power, to_rise[None])
        cost_v, push_v, bend_v = powers(steps * to_rate[None], 2.0 * power, to_rate[None])
        angles = case.angles[None] + jnp.matmul(lift_of, steps, precision=_HIGHEST)
        beyond = (angles - middle[None]) / half[None]
        over = jnp.maximum(jnp.abs(beyond) - 0.995, 0.0)
        push_q = _RANGE**2 * over * jnp.sign(beyond) / half[None]
        bend_q = _RANGE**2 * (over > 0.0).astype(over.dtype) / half[None] ** 2
        gradient = jnp.matmul(change.T, push_a, precision=_HIGHEST) + push_v
        gradient += jnp.matmul(lift_of.T, push_q, precision=_HIGHEST)
        own = jnp.einsum("sk,sl,si->kli", change, change, bend_a, precision=_HIGHEST)
        own += jnp.einsum("sk,sl,si->kli", lift_of, lift_of, bend_q, precision=_HIGHEST)
        own += jnp.eye(size, dtype=own.dtype)[:, :, None] * bend_v[:, None]

        gaps, slopes_at = clearances_and_slopes(case.arm, case.scene, angles)
        gaps = lax.optimization_barrier(gaps)  # (R, S - 1)
        lack = margin - gaps
        worst = lax.top_k(jnp.max(lack, axis=0), num_worst)[1]
        short = jnp.maximum(lack[:, worst], 0.0) * _CLEARANCE
        lifts = slopes_at(worst) * jnp.where(short > 0.0, -_CLEARANCE, 0.0)[:, None]
        lifts, short = lax.optimization_barrier((lifts, short))
        grams = jnp.einsum("riw,rjw->wij", lifts, lifts, precision=_HIGHEST)
        pushes = jnp.einsum("riw,rw->wi", lifts, short, precision=_HIGHEST)
        lift = lift_of[worst]
        gradient += jnp.matmul(lift.T, pushes, precision=_HIGHEST)
        curvature = jnp.einsum("wk,wl,wij->kilj", lift, lift, grams, precision=_HIGHEST)
        each = jnp.eye(num, dtype=own.dtype)
        curvature += jnp.einsum("kli,ij->kilj", own, each, precision=_HIGHEST)
        # The unknowns are shifted so that the motion ends at the goal: project both derivatives.
        gradient -= jnp.mean(gradient, axis=0, keepdims=True)
        curvature -= jnp.mean(curvature, axis=0, keepdims=True)
        curvature -= jnp.mean(curvature, axis=2, keepdims=True)
        return Model(
            cost=cost_a + cost_v + (_RANGE**2) * jnp.sum(over**2) + jnp.sum(short**2),
            gradient=gradient.reshape(-1),
            curvature=curvature.reshape(size * num, size * num),
            violation=jnp.max(lack - 0.7 * margin) * _CLEARANCE,
        )

    return evaluate
