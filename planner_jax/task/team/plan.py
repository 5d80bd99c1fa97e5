"""Plans of teams: one plan of catches for each robot."""

import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.core.protocol import Plan
from planner_jax.task.catch.plan import CatchPlan


@struct.dataclass
class TeamPlan(Plan):
    """The plans of N robots that share M targets, or a batch of such plans.

    Every robot's plan ends with a recovery trajectory, after which the robot stands still. The cost
    is the sum of the robots' costs.

    Attributes:
        robots: plans of the N robots, with leaves that have a leading axis N.
    """

    robots: CatchPlan

    @property
    def taken(self) -> Array:
        """Which robot catches which target, (N, M) bool; (B, N, M) for a batch of B plans."""
        return self.robots.choice.taken

    @property
    def num_taken(self) -> Array:
        """Number of targets that the robots catch together: (), or (B,) for a batch."""
        return jnp.sum(self.robots.num_taken, axis=-1)
