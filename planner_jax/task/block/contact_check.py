"""Where plans meet a ball that is not quite the one that they were made for.

A plan names the time at which its ball is met. The true ball comes to the shield a little earlier
or later, and a little beside. `as_met` names that time instead, so that the referee judges what
then happens. Robot base frame, z up, SI units.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from planner_jax.ball.flight import drag_free_flight
from planner_jax.robot.arm import shield_pose
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.end_poses import flight_of
from planner_jax.task.block.motion import cut
from planner_jax.task.block.plan import BlockPlan
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate

_SAMPLES = 256  # times at which ball and shield are looked at
_HALVINGS = 24  # of the time between two of them


def as_met(cases: BlockCase, plans: BlockPlan) -> BlockPlan:
    """The same motions up to where they meet the balls of these cases.

    An arm that is not to stand when it meets the ball brakes evenly after its motion, as fast as
    its limits allow, and is met on the way, or standing. Where the shield's plane is crossed
    several times, the time counts at which the ball is nearest to the shield's middle. A ball that
    never crosses it leaves the plan as it is, for the referee to refuse.

    Args:
        cases: a batch of B, with the true balls, and the delays that were planned with.
        plans: of them, for other balls; polynomials of degree 2 or more.

    Returns:
        Plans with one piece more, of no length if the arm is met before.
    """
    return _as_met(cases, plans)


def begun_late(cases: BlockCase, plans: BlockPlan, late: Any) -> BlockPlan:
    """The same motions begun later, up to where they meet their balls as `as_met` has it.

    Args:
        cases: a batch of B, of arms that stand.
        plans: of them.
        late: (B,) [s], by how much, >= 0. A plan of 0 keeps its motion and its contact.

    Returns:
        Plans with two pieces more.
    """
    return _begun_late(cases, plans, late)


@jax.jit
@jax.vmap
def _begun_late(case: BlockCase, plan: BlockPlan, late: Array) -> BlockPlan:
    motion = plan.motion
    still = jnp.zeros_like(motion.coeffs[:1]).at[0, 0].set(case.angles)
    waited = PiecewisePolynomial(
        coeffs=jnp.concatenate([still, motion.coeffs]),
        durations=jnp.concatenate([late[None], motion.durations]),
    )
    whole = braked(case, waited)
    in_time = dataclasses.replace(
        plan, motion=dataclasses.replace(whole, durations=whole.durations.at[-1].set(0.0))
    )
    met = _met(case, dataclasses.replace(plan, motion=waited))
    return jax.tree.map(lambda ours, theirs: jnp.where(late > 0.0, ours, theirs), met, in_time)


def _met(case: BlockCase, plan: BlockPlan) -> BlockPlan:
    motion = braked(case, plan.motion)

    def above(time: Array) -> tuple[Array, Array]:
        """Height () [m] of the ball over the shield's plane, and how far it is from the middle."""
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

    def halve(_: Any, between: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = between
        middle = 0.5 * (low + high)
        before = above(middle)[0] > 0.0
        return jnp.where(before, middle, low), jnp.where(before, high, middle)

    low, high = lax.fori_loop(0, _HALVINGS, halve, (times[nearest], times[nearest + 1]))
    time = jnp.where(jnp.any(crosses), 0.5 * (low + high), plan.contact_time)
    return dataclasses.replace(plan, motion=cut(motion, time - case.delay), contact_time=time)


_as_met = jax.jit(jax.vmap(_met))


def braked(case: BlockCase, motion: PiecewisePolynomial) -> PiecewisePolynomial:
    """A motion, and after it all joints slowing down evenly until they stand at the same time.

    An arm that has to end at rest does so already: the piece that is added is of no length.
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
