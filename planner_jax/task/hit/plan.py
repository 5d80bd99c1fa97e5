"""Plans of hits: the quadrotor's trajectory to the impact, and the impact of ball and racket."""

from flax import struct
from jax import Array

from planner_jax.robot.quadrotor import QuadrotorPlan


@struct.dataclass
class Stroke:
    """The impact of ball and racket, and the ball's flight after it. Planning starts at time 0."""

    time: Array  # () [s], of the impact
    ball_pos: Array  # (3,) [m], position of the ball and of the racket's centre at the impact
    ball_vel: Array  # (3,) [m/s], velocity of the ball just before the impact
    ball_vel_after: Array  # (3,) [m/s], velocity of the ball just after the impact
    normal: Array  # (3,) unit normal of the racket at the impact
    flight_time: Array  # () [s], from the impact to the landing


@struct.dataclass
class HitPlan(QuadrotorPlan):
    """The plan of a hit, which ends at the impact; or a batch: every leaf has a leading axis B."""

    stroke: Stroke
