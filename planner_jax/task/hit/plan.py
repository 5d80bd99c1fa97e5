"""What a hit planner returns."""

from flax import struct
from jax import Array

from planner_jax.trajectory.polynomial import PiecewisePolynomial


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
class HitPlan:
    """One plan, or a batch of them with a leading axis on every leaf."""

    trajectory: PiecewisePolynomial  # of the quadrotor's propeller plane, ends at the impact
    stroke: Stroke
    cost: Array  # (), the planner's own objective
    violation: Array  # (), largest relative excess over a limit that the planner saw; <= 0 is good
    iterations: Array  # () int32
    status: Array  # () int32, a `planner_jax.optimise.status.Status`
