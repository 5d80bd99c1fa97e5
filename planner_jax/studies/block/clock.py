"""Planning by the clock: a motion that is planned too late starts later."""

import dataclasses
from typing import ClassVar

import jax
import numpy as np
from flax import struct
from jax import Array

from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.planner import Drive, Planner
from planner_jax.runs.timing import measure_plans
from planner_jax.studies.block.contact_check import delay_motion
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan


@struct.dataclass
class TimedPlan(BlockPlan):
    """A plan with the time that planning took."""

    planning_time: Array  # () [s]


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class CountedPlanner(Planner[BlockCase, TimedPlan]):
    """Planner of one case after another that counts its own planning time.

    A motion starts later by the time that planning exceeds `allowed`.
    """

    case_type: ClassVar[type] = BlockCase
    planner: Planner
    allowed: float  # [s] of planning, included in the delay

    def plan_by(self, drive: Drive, cases: BlockCase) -> TimedPlan:
        """Return plans of a batch, up to the contact with the ball."""
        plans, spent = measure_plans(self.planner, cases)
        late = np.maximum(spent - self.allowed, 0.0).astype(cases.delay.dtype)
        met = delay_motion(cases, plans, late)
        return jax.tree.map(np.asarray, TimedPlan(**vars(met), planning_time=host_leaf(spent)))
