"""What a block planner returns."""

import dataclasses
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.planning.plan import plan
from planner_jax.protocol import Status, lane
from planner_jax.robot.arm_plan import ArmPlan
from planner_jax.task.block.case import BlockCase
from planner_jax.trajectory.polynomial import PiecewisePolynomial

TreeT = TypeVar("TreeT")


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


def plans_where(planner: Any, cases: BlockCase, wanted: np.ndarray) -> BlockPlan:
    """Plans of those of B cases that are wanted (B,), at least one; the others are unsolved.

    NumPy leaves (B, ...), as those of the cases have to be.
    """
    plans = plan(planner, lane(cases, np.flatnonzero(wanted)))
    places = np.maximum(np.cumsum(wanted) - 1, 0)
    plans = jax.tree.map(lambda leaf: np.asarray(leaf)[places], plans)
    status: Any = np.where(wanted, plans.status, Status.INFEASIBLE).astype(np.int32)
    return dataclasses.replace(plans, status=status)


def chosen(better: np.ndarray, one: TreeT, other: TreeT) -> TreeT:
    """Of two batches the entries of the first one where that is better (B,), else the second's."""
    return jax.tree.map(
        lambda a, b: np.where(better.reshape(-1, *(1,) * (np.ndim(a) - 1)), a, b), one, other
    )
