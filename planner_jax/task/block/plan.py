"""What a block planner returns."""

import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.protocol import Status
from planner_jax.robot.arm_plan import ArmPlan
from planner_jax.task.block.case import BlockCase
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
