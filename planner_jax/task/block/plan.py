"""The plan that a block planner returns."""

import jax
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
    """One plan, or a batch of them with a leading axis on every leaf.

    The motion begins when the arm may start, at the case's `delay`, and the arm stays where it
    ends if it must be at rest there.
    """

    contact_time: Array  # () [s], when the shield meets the ball, since the ball was first seen


def make_empty_plan(case: BlockCase, pieces: int) -> BlockPlan:
    """Return the plan of a case without a solution: not solved, standing for a second."""
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


def has_nan(case: BlockCase) -> Array:
    """Return whether any number of a case is NaN, () bool."""
    leaves = [jnp.ravel(leaf) for leaf in map(jnp.asarray, jax.tree.leaves(case))]
    numbers = [leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.any(jnp.isnan(jnp.concatenate(numbers)))


def explain_status(case: BlockCase, poses: EndPoses, status: Array) -> Array:
    """Return the status () int32 of a plan, or the status that explains why there is none.

    Without a plan the status is NON_FINITE if the case has a NaN; OUT_OF_REACH if the ball does not
    get into both boxes, or the shield nowhere to it; and BLOCKED if the arm touches something where
    it starts.
    """

    def reason() -> Array:
        nearest = least_clearances(case.arm, case.scene, case.angles[None])[0]
        why = jnp.where(nearest < 0.0, Status.BLOCKED, status)
        why = jnp.where(jnp.any(jnp.isfinite(poses.effort)), why, Status.OUT_OF_REACH)
        return jnp.where(has_nan(case), Status.NON_FINITE, why).astype(jnp.int32)

    # One ball that is solved does not wait for it.
    return lax.cond(is_solved(status), lambda: status.astype(jnp.int32), reason)
