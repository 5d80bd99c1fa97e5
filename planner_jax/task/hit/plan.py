"""Plans of hits."""

from flax import struct
from jax import Array

from planner_jax.robot.quadrotor import QuadrotorPlan


@struct.dataclass
class Stroke:
    """The impact and the ball's flight after it. Time 0 is when planning starts."""

    time: Array  # () [s], of the impact
    ball_pos: Array  # (3,) [m], of the ball and of the racket's centre at the impact
    ball_vel: Array  # (3,) [m/s], just before the impact
    ball_vel_after: Array  # (3,) [m/s], just after the impact
    normal: Array  # (3,) unit normal of the racket
    flight_time: Array  # () [s], from the impact to the landing


@struct.dataclass
class HitPlan(QuadrotorPlan):
    """One plan, or a batch with a leading axis on every leaf. The trajectory ends at the impact."""

    stroke: Stroke
