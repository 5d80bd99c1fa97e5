"""What a hit planner returns."""

from flax import struct
from jax import Array

from planner_jax.robot.quadrotor import QuadrotorPlan


@struct.dataclass
class Stroke:
    """The impact, and the ball's flight after it. Times from the start of planning."""

    time: Array  # () [s], of the impact
    ball_pos: Array  # (3,) [m], where ball and racket centre meet
    ball_vel: Array  # (3,) [m/s], just before
    ball_vel_after: Array  # (3,) [m/s], just after
    normal: Array  # (3,) unit normal of the racket
    flight_time: Array  # () [s], from the impact to the landing


@struct.dataclass
class HitPlan(QuadrotorPlan):
    """One plan, or a batch of them with a leading axis on every leaf; ends at the impact."""

    stroke: Stroke
