"""The cost of a block's motion, a sum of squares, and its quadratic model for least squares."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.optimise.levenberg import Model
from planner_jax.robot import arm_dynamics, arm_motion
from planner_jax.robot.arm_clearance import clearances_and_slopes, num_of_obstacles
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.problem import terms
from planner_jax.task.block.problem.check import combine_excess, motion_of
from planner_jax.task.block.problem.flight import Flight

if TYPE_CHECKING:
    from planner_jax.task.block.default_planner import OnlineBlock

_HIGHEST = lax.Precision.HIGHEST


def build_model(planner: "OnlineBlock", point: Array, case: BlockCase, flight: Flight) -> Model:
    """Return the cost, a sum of squares, and its quadratic model by rates and time of contact.

    The residuals are the errors of the shield's contact with the ball, excesses over joint
    limits, distances below their margins, and joint accelerations.
    """
    steps, first, duration = planner.decode(case, point)
    pieces, dtype = planner.pieces, point.dtype
    joints = terms.joint_terms(case, steps, first, duration, planner.weights, 1.0 - planner.slack)
    shares = tuple(np.arange(1, planner.samples + 1) / planner.samples)
    angles = arm_motion.angles_at(case.angles, first, steps, shares)
    gaps, slopes_at = clearances_and_slopes(case.arm, case.scene, angles)
    gaps = lax.optimization_barrier(gaps)  # (R, S)
    is_of_scene = np.arange(gaps.shape[0]) < num_of_obstacles(case.arm, case.scene)
    margins = np.where(is_of_scene, planner.obstacle_margin, 1.3 * planner.margin)[:, None]
    near, worst = lax.top_k(jnp.max(margins - gaps, axis=0), planner.worst)
    slopes = slopes_at(worst)  # (R, n, W)
    short = jnp.maximum(margins - gaps[:, worst], 0.0) * planner.weights.clearance  # (R, W)
    active = jnp.where(short > 0.0, -planner.weights.clearance, 0.0)
    lifts, short = lax.optimization_barrier((slopes * active[:, None], short))
    grams = jnp.einsum("riw,rjw->wij", lifts, lifts, precision=_HIGHEST)
    pushes = jnp.einsum("riw,rw->wi", lifts, short, precision=_HIGHEST)
    grams, pushes = jnp.pad(grams, ((0, 0), (0, 1), (0, 1))), jnp.pad(pushes, ((0, 0), (0, 1)))
    contact = terms.contact_terms(case, flight, angles[-1], point[-1], planner.weights)
    rows, row_slopes, contact_excess = contact
    gram = jnp.matmul(row_slopes.T, row_slopes, precision=_HIGHEST)
    push = jnp.matmul(row_slopes.T, rows, precision=_HIGHEST)
    grams = jnp.concatenate([grams, gram[None]])
    pushes = jnp.concatenate([pushes, push[None]])
    weights = arm_motion.step_weights(pieces, shares)
    of_first, of_steps = (jnp.asarray(each, dtype) for each in weights)
    chosen = jnp.append(worst, planner.samples - 1)
    lift = of_steps[chosen]  # (W + 1, K)
    drift = of_first[chosen][:, None] * case.rates[None]  # (W + 1, n)
    gradient, curvature = terms.lift_to_unknowns(lift, drift, grams, pushes, joints)
    size = case.arm.num * pieces
    ends_free = jnp.where(case.ends_at_rest, 0.0, 1.0)
    free = jnp.ones(size + 1, dtype).at[size - case.arm.num : size].set(ends_free)
    too_near = near[0] - 0.3 * planner.margin
    cost = joints.cost + jnp.sum(rows**2) + jnp.sum(short**2)
    joint_excess = joints.excess
    if case.limits.torque is not None:
        (more, push, gram), torque_excess = _torque_terms(planner, case, point)
        cost, gradient, curvature = cost + more, gradient + push, curvature + gram
        joint_excess = jnp.maximum(joint_excess, torque_excess)
    return Model(
        cost=cost,
        gradient=gradient * free,
        curvature=curvature * free[:, None] * free[None],
        violation=combine_excess(joint_excess, contact_excess, too_near),
    )


def _torque_terms(
    planner: "OnlineBlock", case: BlockCase, point: Array
) -> tuple[tuple[Array, ...], Array]:
    """Return cost, gradient and curvature of excess torques at the knots, and their excess ().

    The derivatives are computed only if a torque exceeds its limit.
    """
    most = arm_dynamics.USED * jnp.asarray(case.limits.torque)
    sample = lambda point: arm_dynamics.sample_states(motion_of(planner, case, point), 0)  # noqa: E731

    def share(angles: Array, rates: Array, rises: Array) -> Array:
        return arm_dynamics.inverse_dynamics(case.arm, angles, rates, rises, case.gravity) / most

    def derive() -> tuple[Array, ...]:
        over = planner.weights.limits * jnp.maximum(jnp.abs(shares) - 1.0 + planner.slack, 0.0)
        sign = jnp.where(over > 0.0, planner.weights.limits * jnp.sign(shares), 0.0)
        by_state = jax.vmap(jax.jacfwd(share, (0, 1, 2)))(*states)  # each (S, n, n)
        lifts = zip(by_state, jax.jacfwd(sample)(point), strict=True)
        slopes = sum(jnp.einsum("sij,sju->siu", *pair, precision=_HIGHEST) for pair in lifts)
        slopes = (sign[:, :, None] * slopes).reshape(-1, num)
        push = jnp.matmul(over.reshape(-1), slopes, precision=_HIGHEST)
        return jnp.sum(over**2), push, jnp.matmul(slopes.T, slopes, precision=_HIGHEST)

    num, states = point.size, sample(point)
    shares = jax.vmap(share)(*states)
    none = [jnp.zeros(shape, point.dtype) for shape in ((), (num,), (num, num))]
    worst = jnp.max(jnp.abs(shares)) - 1.0
    return lax.cond(worst > -planner.slack, derive, lambda: tuple(none)), worst
