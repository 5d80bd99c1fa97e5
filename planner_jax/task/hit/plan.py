"""Plans of hits: the quadrotor's trajectory to the impact, and the impact of ball and racket."""

from flax import struct
from jax import Array

from planner_jax.robot.quadrotor import QuadrotorPlan


@struct.dataclass
class Stroke:
    """The impact of ball and racket, and the ball's flight after it. Planning starts at time 0.

    Attributes:
        time: () [s], time of the impact.
        ball_pos: (3,) [m], position of the ball and of the racket's centre at the impact.
        ball_vel: (3,) [m/s], velocity of the ball just before the impact.
        ball_vel_after: (3,) [m/s], velocity of the ball just after the impact.
        normal: (3,) unit normal of the racket at the impact.
        flight_time: () [s], time from the impact to the landing.
    """

    time: Array
    ball_pos: Array
    ball_vel: Array
    ball_vel_after: Array
    normal: Array
    flight_time: Array


@struct.dataclass
class HitPlan(QuadrotorPlan):
    """The plan of a hit, which ends at the impact; or a batch: every leaf has a leading axis B.

    Attributes:
        stroke: the impact, and the ball's flight after it.
    """

    stroke: Stroke
