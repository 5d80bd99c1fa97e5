"""Plans that an arm carries out: piecewise polynomials of its joint angles."""

import dataclasses

import jax
import numpy as np
from flax import struct
from jax import Array

from planner_jax.core.protocol import Plan
from planner_jax.robot.setpoints import sampled_at_rate
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate


@dataclasses.dataclass(frozen=True)
class ArmSetpoints:
    """A plan at K equally spaced times; of a batch every array but `time` has a leading axis B.

    Entries past the end of a plan are NaN.
    """

    time: np.ndarray  # (K,) [s] since the plan began
    angles: np.ndarray  # (K, 6) [rad], of the joints
    rates: np.ndarray  # (K, 6) [rad/s]
    accelerations: np.ndarray  # (K, 6) [rad/s^2]


@struct.dataclass
class ArmPlan(Plan):
    """A plan with the motion of an arm's joints, coefficients (M, D + 1, 6) in [rad]."""

    motion: PiecewisePolynomial

    def sample(self, rate: float) -> ArmSetpoints:
        """The plan, or the batch, at a rate [Hz], from its beginning up to its end.

        Raises:
            ValueError: the rate is not positive.
        """
        ends = np.sum(np.asarray(self.motion.durations), axis=-1)
        times, setpoints = sampled_at_rate(rate, ends, self.motion, _sampled)
        return ArmSetpoints(time=times, **setpoints)


@jax.jit
def _sampled(motion: PiecewisePolynomial, times: Array) -> dict[str, Array]:
    """The setpoints of plans with leaves (B, ...) at times (K,)."""

    def at(motion: PiecewisePolynomial, time: Array) -> dict[str, Array]:
        names = ("angles", "rates", "accelerations")
        return {name: evaluate(motion, time, order) for order, name in enumerate(names)}

    of_plan = jax.vmap(at, in_axes=(None, 0))
    return jax.vmap(of_plan, in_axes=(0, None))(motion, times)
