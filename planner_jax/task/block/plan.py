"""The plan that a block planner returns."""

import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from planner_jax.core.protocol import Status, is_solved
from planner_jax.robot.arm import ArmPlan
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.clearance import least_clearances
from planner_jax.task.block.end_poses import EndPoses
from planner_jax.task.block.motion import polynomial


@struct.dataclass
class BlockPlan(ArmPlan):
    """One plan, or a batch with a leading axis on every leaf.

    The motion starts at the case's `delay`. If it must end at rest, the arm stays at its end.
    """

    contact_time: Array  # () [s], contact of shield and ball, since the ball was first seen


def make_empty_plan(case: BlockCase, pieces: int) -> BlockPlan:
    """Return an unsolved plan in which the arm stands for a second."""
    none = jnp.full((), jnp.inf, case.angles.dtype)
    still = jnp.zeros((pieces, 6), case.angles.dtype)
    second = jnp.ones((), case.angles.dtype)
    return BlockPlan(
        motion=polynomial(case.angles, still[0], still, second),
        contact_time=case.delay + second,
        cost=none,
        violation=none,
        iterations=jnp.zeros((), jnp.int32),
        status=jnp.full((), Status.INFEASIBLE, jnp.int32),
    )


def explain_status(case: BlockCase, poses: EndPoses, status: Array) -> Array:
    """Return the status () int32 of a plan; of an unsolved plan the status that explains why.

    OUT_OF_REACH: the ball does not enter both boxes, or the shield reaches it nowhere. BLOCKED: the
    arm touches something at the start.
    """

    def explain() -> Array:
        nearest = least_clearances(case.arm, case.scene, case.angles[None])[0]
        why = jnp.where(nearest < 0.0, Status.BLOCKED, status)
        is_reached = jnp.any(jnp.isfinite(poses.effort))
        return jnp.where(is_reached, why, Status.OUT_OF_REACH).astype(jnp.int32)

    # `cond` skips the check of a single case that is solved.
    return lax.cond(is_solved(status), lambda: status.astype(jnp.int32), explain)
