"""Plans of catches: the quadrotor's trajectory, and the order and times of the catches."""

import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.robot.quadrotor import QuadrotorPlan
from planner_jax.task.catch.case import CatchChoice


@struct.dataclass
class CatchPlan(QuadrotorPlan):
    """The plan of up to N catches, or a batch of plans with a leading axis on every leaf.

    The trajectory has M pieces to each of N catches. If fewer than N targets are caught, the last
    pieces have zero duration and stay at the position of the last catch.

    Attributes:
        order: (N,) int32, indices of the targets in the order of catching.
        decided_times: (N,) [s], times of the catches in that order before the optimisation.
        times: (N,) [s], times of the catches in that order; a time is repeated if nothing is
            caught.
    """

    order: Array
    decided_times: Array
    times: Array

    @property
    def num_taken(self) -> Array:
        """Number of targets that the plan catches: (), or (B,) for a batch of B plans."""
        return jnp.sum(self._is_catch, axis=-1)

    @property
    def _is_catch(self) -> Array:
        """Whether the target at each of the N positions of `order` is caught, (..., N) bool."""
        times = jnp.asarray(self.times)
        return jnp.diff(times, prepend=jnp.zeros_like(times[..., :1]), axis=-1) > 0.0

    @property
    def choice(self) -> CatchChoice:
        """Order of the targets, guessed times of their catches, and which targets are caught."""
        order = jnp.asarray(self.order)
        taken = jnp.take_along_axis(self._is_catch, jnp.argsort(order, axis=-1), axis=-1)
        return CatchChoice(order=self.order, times=self.decided_times, taken=taken)
