"""What a catch planner returns."""

import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.robot.quadrotor import QuadrotorPlan
from planner_jax.task.catch.case import CatchChoice


@struct.dataclass
class CatchPlan(QuadrotorPlan):
    """One plan, or a batch of them with a leading axis on every leaf.

    The trajectory has N * M pieces, M up to each catch. Where fewer than N targets are
    present, the last pieces have no duration and stay where the last catch was made.
    """

    order: Array  # (N,) int32, which target is caught first, second, ...
    decided_times: Array  # (N,) [s], of the catches in that order, as the decision had them
    times: Array  # (N,) [s], of the catches in that order; other targets repeat the last

    @property
    def num_taken(self) -> Array:
        """How many targets the plan catches, (...)."""
        return jnp.sum(self._rises, axis=-1)

    @property
    def _rises(self) -> Array:
        """Which of the catches, in their order, are planned, (..., N) bool."""
        times = jnp.asarray(self.times)
        return jnp.diff(times, prepend=jnp.zeros_like(times[..., :1]), axis=-1) > 0.0

    @property
    def choice(self) -> CatchChoice:
        """What was decided."""
        order = jnp.asarray(self.order)
        taken = jnp.take_along_axis(self._rises, jnp.argsort(order, axis=-1), axis=-1)
        return CatchChoice(order=self.order, times=self.decided_times, taken=taken)
