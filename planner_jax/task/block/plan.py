"""Plans of the task `block`: the motion of the arm and the time of contact with the ball."""

import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from planner_jax.core.protocol import Status, is_solved
from planner_jax.robot.arm import ArmPlan
from planner_jax.robot.arm_motion import polynomial
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.problem.end_poses import EndPoses
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate


@struct.dataclass
class BlockPlan(ArmPlan):
    """The plan of a block, or a batch of plans with a leading axis on every leaf.

    The motion starts at the case's `delay`. If the motion must end at rest, the arm then stays in
    the end pose and waits for the ball.

    Attributes:
        contact_time: () [s], time of the contact of shield and ball; time 0 is the ball's first
            observation.
    """

    contact_time: Array


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


def make_empty_plan(case: BlockCase, pieces: int) -> BlockPlan:
    """Return a plan with the status INFEASIBLE in which the arm stands still for 1 s."""
    none = jnp.full((), jnp.inf, case.angles.dtype)
    still = jnp.zeros((pieces, case.arm.num), case.angles.dtype)
    second = jnp.ones((), case.angles.dtype)
    return BlockPlan(
        motion=polynomial(case.angles, still[0], still, second),
        contact_time=case.delay + second,
        cost=none,
        violation=none,
        iterations=jnp.zeros((), jnp.int32),
        status=jnp.full((), Status.INFEASIBLE, jnp.int32),
    )


def explain_status(poses: EndPoses, status: Array) -> Array:
    """Return a plan's status () int32: OUT_OF_REACH if it is unsolved and no pose is reachable.

    `poses` are poses of the arm in which the shield meets the ball.
    """
    is_kept = is_solved(status) | jnp.any(jnp.isfinite(poses.effort))
    return jnp.where(is_kept, status, Status.OUT_OF_REACH).astype(jnp.int32)


def mark_blocked(case: BlockCase, status: Array) -> Array:
    """Return a plan's status (): BLOCKED if it is unsolved and the arm starts in a collision."""

    def check() -> Array:
        is_blocked = case.clearances(case.angles[None])[0] < 0.0
        return jnp.where(is_blocked, Status.BLOCKED, status).astype(jnp.int32)

    # For a single case, `cond` tests the initial pose for collisions only if the case is unsolved.
    return lax.cond(is_solved(status), lambda: status.astype(jnp.int32), check)
