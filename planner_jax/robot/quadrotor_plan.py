"""Plans that a quadrotor flies, and what a controller wants to know of them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.core.protocol import Plan
from planner_jax.robot.quadrotor import body_z, flat_attitude, net_thrust, tilt_quaternion
from planner_jax.robot.setpoints import sampled_at_rate
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate, joined


@dataclasses.dataclass(frozen=True)
class QuadrotorSetpoints:
    """A plan at K equally spaced times; world frame, z up; body x forward, z along the thrust.

    Of a batch every array but `time` has a leading axis B, and is NaN past the end of each plan.
    """

    time: np.ndarray  # (K,) [s] since the plan began
    pos: np.ndarray  # (K, 3) [m], of the propeller plane's centre
    vel: np.ndarray  # (K, 3) [m/s]
    acc: np.ndarray  # (K, 3) [m/s^2]
    jerk: np.ndarray  # (K, 3) [m/s^3]
    quat_wxyz: np.ndarray  # (K, 4), body to world, at zero heading of the Hopf fibration
    body_rate: np.ndarray  # (K, 3) [rad/s], body frame
    thrust: np.ndarray  # (K,) [m/s^2], per unit mass


@struct.dataclass
class QuadrotorPlan(Plan):
    """A plan with the trajectory of a quadrotor's propeller plane."""

    trajectory: PiecewisePolynomial  # up to the last contact
    gravity: Array  # () [m/s^2], magnitude, for which it was planned
    # From there on to rest, where it was asked for.
    ending: PiecewisePolynomial | None = struct.field(default=None, kw_only=True)

    @property
    def whole(self) -> PiecewisePolynomial:
        """The trajectory and the ending in one, of a plan or of a batch."""
        return self.trajectory if self.ending is None else joined(self.trajectory, self.ending)

    def sample(self, rate: float) -> QuadrotorSetpoints:
        """The plan, or the batch, at a rate [Hz], from its beginning up to its end, at rest or not.

        Raises:
            ValueError: the rate is not positive.
        """
        path = jax.tree.map(np.asarray, self.whole)
        ends = np.sum(path.durations, axis=-1)
        time, setpoints = sampled_at_rate(
            rate,
            ends,
            (path, self.gravity),
            lambda leaves, time: _sampled(*leaves, time),
        )
        return QuadrotorSetpoints(time=time, **setpoints)


@jax.jit
def _sampled(path: PiecewisePolynomial, gravity: Array, time: Array) -> dict[str, Array]:
    """The setpoints of plans with leaves (B, ...) at times (K,)."""
    of_plan = jax.vmap(setpoint_at, in_axes=(None, None, 0))
    return jax.vmap(of_plan, in_axes=(0, 0, None))(path, gravity, time)


def setpoint_at(path: PiecewisePolynomial, gravity: Array, time: Array) -> dict[str, Array]:
    """One setpoint of one trajectory at a time () [s]: what `QuadrotorSetpoints` has but that."""
    pos, vel, acc, jerk = (evaluate(path, time, order) for order in range(4))
    return {
        "pos": pos,
        "vel": vel,
        "acc": acc,
        "jerk": jerk,
        "quat_wxyz": tilt_quaternion(body_z(acc, gravity)),
        "body_rate": flat_attitude(acc, jerk, gravity)[1],
        "thrust": jnp.sqrt(jnp.sum(net_thrust(acc, gravity) ** 2)),
    }
