"""What a block planner returns."""

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.protocol import Status
from planner_jax.robot.arm_plan import ArmPlan
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.clearance import least_clearances
from planner_jax.trajectory.polynomial import PiecewisePolynomial


@struct.dataclass
class BlockPlan(ArmPlan):
    """One plan, or a batch of them with a leading axis on every leaf.

    The motion begins when the arm may start, at the case's `delay`, and the arm stays where it
    ends if it must be at rest there.
    """

    contact_time: Array  # () [s], when the shield meets the ball, since the ball was first seen


def no_plan(case: BlockCase, stay: PiecewisePolynomial) -> BlockPlan:
    """What is given back without a plan, of one case: a motion that is none, and no success."""
    none = jnp.full((), jnp.inf, case.angles.dtype)
    return BlockPlan(
        motion=stay,
        contact_time=case.delay + 1.0,
        cost=none,
        violation=none,
        iterations=jnp.zeros((), jnp.int32),
        status=jnp.full((), Status.INFEASIBLE, jnp.int32),
    )


def has_nan(case: BlockCase) -> Array:
    """Whether any number of a case is NaN, () bool."""
    leaves = [jnp.ravel(leaf) for leaf in map(jnp.asarray, jax.tree.leaves(case))]
    numbers = [leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.any(jnp.isnan(jnp.concatenate(numbers)))


def explained(case: BlockCase, comes: Array, status: Array) -> Array:
    """The status () int32 of a plan, or the one that says why there can be none.

    Args:
        case: one case. The status is NON_FINITE if it has a NaN, and BLOCKED if the arm touches
            something where it starts.
        comes: () bool, whether the ball gets into both boxes; OUT_OF_REACH if it does not.
        status: () int32, of the plan.
    """
    nearest = least_clearances(case.arm, case.scene, case.angles[None])[0]
    status = jnp.where(nearest < 0.0, Status.BLOCKED, status)
    status = jnp.where(comes, status, Status.OUT_OF_REACH)
    return jnp.where(has_nan(case), Status.NON_FINITE, status).astype(jnp.int32)
