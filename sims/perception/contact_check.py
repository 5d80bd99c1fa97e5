"""True contacts of motions that were planned for an estimated ball.

A plan contains the time at which the estimated ball meets the shield. The true ball arrives at a
slightly different time and point. `end_at_contact` computes the true time, so that the referee
judges the true contact. Positions are in the robot's base frame with z up, in SI units.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array, lax

from planner_jax.ball.flight import drag_free_flight
from planner_jax.robot.arm import shield_pose
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan, append_braking
from planner_jax.task.block.problem.flight import flight_of
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate

_SAMPLES = 256  # number of times at which the positions of ball and shield are compared
_HALVINGS = 24  # number of bisections between two sampled times, to find the time of the contact


def end_at_contact(cases: BlockCase, plans: BlockPlan) -> BlockPlan:
    """Return the plans cut at their contacts with the true balls.

    A motion that ends with a velocity is followed by braking with constant deceleration, as fast as
    the limits allow. The contact may happen while the arm brakes or after it has stopped. If a ball
    crosses the shield's plane several times, the crossing nearest to the shield's centre is the
    contact. If a ball never crosses the plane, the planned contact time is kept, and the referee
    rejects the plan.

    Args:
        cases: a batch of B cases with the true balls. Their `delay` is the start of the motions.
        plans: plans for estimated balls of these cases; polynomials of degree 2 or more.

    Returns:
        Plans with one more piece for braking, of zero duration if the contact is before braking.
    """
    return _end_each_at_contact(cases, plans)


def _find_contact(case: BlockCase, plan: BlockPlan) -> BlockPlan:
    motion = append_braking(case, plan.motion)

    def above(time: Array) -> tuple[Array, Array]:
        ends = jnp.sum(motion.durations)
        angles = evaluate(motion, jnp.clip(time - case.delay, 0.0, ends))
        rotation, middle = shield_pose(case.arm, angles)
        away = drag_free_flight(case.ball, time, case.gravity).pos - middle
        return jnp.sum(rotation[:, 0] * away), jnp.sum(away**2)

    latest = jnp.maximum(flight_of(case).latest, case.delay)
    times = case.delay + (latest - case.delay) * jnp.linspace(0.0, 1.0, _SAMPLES)
    height, away = jax.vmap(above)(times)
    crosses = (height[:-1] > 0.0) & (height[1:] <= 0.0)
    nearest = jnp.argmin(jnp.where(crosses, away[1:], jnp.inf))

    def halve(_: Array, between: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = between
        middle = 0.5 * (low + high)
        before = above(middle)[0] > 0.0
        return jnp.where(before, middle, low), jnp.where(before, high, middle)

    low, high = lax.fori_loop(0, _HALVINGS, halve, (times[nearest], times[nearest + 1]))
    time = jnp.where(jnp.any(crosses), 0.5 * (low + high), plan.contact_time)
    return dataclasses.replace(plan, motion=_cut(motion, time - case.delay), contact_time=time)


_end_each_at_contact = jax.jit(jax.vmap(_find_contact))


def _cut(motion: PiecewisePolynomial, time: Array) -> PiecewisePolynomial:
    """Cut a motion at a time () [s] after its start; later pieces get zero duration."""
    starts = jnp.cumsum(motion.durations) - motion.durations
    last = jnp.minimum(time, jnp.sum(motion.durations))
    end = jnp.stack([evaluate(motion, last), evaluate(motion, last, 1)])
    rest = jnp.zeros_like(motion.coeffs[0]).at[:2].set(end)
    return PiecewisePolynomial(
        coeffs=jnp.where((starts >= time)[:, None, None], rest, motion.coeffs),
        durations=jnp.clip(time - starts, 0.0, motion.durations),
    )
