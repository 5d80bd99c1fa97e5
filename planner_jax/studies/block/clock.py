"""Planning in measured time: a motion whose planning takes too long starts later.

The setting `planning_budget` of a sweep, that is a run over many cases, uses this module.
"""

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
    """A motion of an arm that blocks a ball, and the time that the planner took to find it."""

    planning_time: Array  # () [s], time of planning without compilation


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class CountedPlanner(Planner[BlockCase, TimedPlan]):
    """A planner that plans cases one after another by another planner, and measures each time.

    If planning a case takes longer than `allowed`, its motion starts later by the difference.
    """

    case_type: ClassVar[type] = BlockCase
    planner: Planner
    allowed: float  # [s] planning time that the delay of every case already contains

    def plan_by(self, drive: Drive, cases: BlockCase) -> TimedPlan:
        """Plan cases one by one; delay motions by planning time above `allowed`; ignore `drive`."""
        plans, spent = measure_plans(self.planner, cases)
        late = np.maximum(spent - self.allowed, 0.0).astype(cases.delay.dtype)
        met = delay_motion(cases, plans, late)
        return jax.tree.map(np.asarray, TimedPlan(**vars(met), planning_time=host_leaf(spent)))
