"""The problem of `CatchProblem` with one ball, written with CasADi for IPOPT [Yu2023catch].

`benchmarks.ipopt` loads this module by its name.
"""

import math
from typing import Any

from planner_jax.benchmarks.ipopt_peer.program import Problem, body_axes, ca, rate_squared
from planner_jax.core.protocol import FEASIBILITY_TOLERANCE

RIM = 0.9  # Greatest distance of a planned catch from the net's centre, over the net's radius.

# Name of each number of a case that IPOPT's problem of a catch contains, in SI units -> its number
# of values (3 for a vector).
SIZES = {
    "gravity": 1,
    "speed": 1,
    "body_rate": 1,
    "min_thrust": 1,
    "max_thrust": 1,
    "min_height": 1,
    "head_state": 12,
    "height": 1,
    "radius": 1,
    "max_angle": 1,
    "horizon": 1,
    "ball_pos": 3,
    "ball_vel": 3,
    "ball_drag": 3,
    "ball_gravity": 1,
}


def read_params(context: Any) -> dict[str, Any]:
    """Return the numbers of one case that IPOPT's problem needs, by name.

    `context` is the result of the planner's `prepare` for a case with one ball, with NumPy leaves.
    It contains the case.
    """
    case, path = context.case, context.targets
    found = {"ball_pos": path.ball.pos, "ball_vel": path.ball.vel}
    found |= {"ball_drag": path.drag, "ball_gravity": path.gravity, "horizon": context.horizon}
    for source in (case.net, case.limits, case):
        found |= {n: getattr(source, n) for n in SIZES.keys() - found.keys() if hasattr(source, n)}
    return found


def make_problem(ours: Any) -> Problem:
    """Define for IPOPT the problem that `CatchProblem` states for one ball."""
    return Problem(
        ours=ours,
        sizes=SIZES,
        num_natural=12,
        ends=lambda natural, params: ends(natural, params, ours.time_weight),
        limits=limits,
        factors=(2.0, 2.0, 2.0, 2.0, 1.0),
        impact_weight=ours.catch_weight,
    )


def ball_at(time: Any, params: dict) -> tuple[Any, Any]:
    """Return a ball's position and velocity at a time, with linear drag [Yu2023catch, eq. 9].

    If the product of drag coefficient and time is small, a power series replaces the closed form,
    which would be inaccurate.
    """
    x = params["ball_drag"] * time
    small = ca.fabs(x) < 0.5
    near, far = ca.if_else(small, x, 0.0), ca.if_else(small, 1.0, x)
    series = sum((-near) ** k / float(math.factorial(k + 2)) for k in range(13))
    phi_2 = ca.if_else(small, series, (1.0 + ca.expm1(-far) / far) / far)
    phi_1 = 1.0 - x * phi_2
    fall = ca.vertcat(0.0, 0.0, -params["ball_gravity"])
    pos = params["ball_pos"] + params["ball_vel"] * time * phi_1 + fall * time**2 * phi_2
    return pos, params["ball_vel"] * ca.exp(-x) + fall * time * phi_1


def ends(natural: Any, params: dict, time_weight: float) -> tuple[Any, Any, list, Any]:
    """Compute the end of a trajectory at which the ball is caught, from the end's variables.

    The variables `natural` are the logarithm of the duration, the ball's position in the net (2),
    and velocity, acceleration and jerk of the quadrotor (3 each). `params` has the numbers of the
    case by name. Returns position to jerk at the end (4, 3), the duration [s], the relative
    excesses over the limits of the catch, and the cost.
    """
    time, place = ca.exp(natural[0]), natural[1:3]
    pos, vel = ball_at(time, params)
    acc = natural[6:9]
    thrust = acc + ca.vertcat(0.0, 0.0, params["gravity"])
    axis = thrust / ca.norm_2(thrust)
    across_x, across_y = body_axes(axis)
    place = place * RIM * params["radius"] / ca.sqrt(1.0 + ca.sumsqr(place))
    centre = pos - params["height"] * axis
    tail = ca.horzcat(
        centre - place[0] * across_x - place[1] * across_y,
        natural[3:6],
        acc,
        natural[9:12],
    ).T
    angle = ca.fmax(params["max_angle"], 1e-3)
    facing = -ca.dot(axis, vel) / ca.norm_2(vel)
    leaning = (ca.cos(angle) - facing) / (angle * ca.sin(angle))
    late = time / params["horizon"] - 1.0 + FEASIBILITY_TOLERANCE
    return tail, time, [leaning, late], time_weight * time


def limits(height: Any, vel: Any, acc: Any, jerk: Any, params: dict) -> list:
    """Return the excesses over the limits at one sample of the trajectory.

    For speed, body rate and thrust the excess is the squared ratio to the limit, minus one, with
    the opposite sign for the least thrust. The excess of the height is in metres.
    """
    squared = ca.sumsqr(acc + ca.vertcat(0.0, 0.0, params["gravity"]))
    return [
        ca.sumsqr(vel) / params["speed"] ** 2 - 1.0,
        rate_squared(acc, jerk, params["gravity"]) / params["body_rate"] ** 2 - 1.0,
        1.0 - squared / params["min_thrust"] ** 2,
        squared / params["max_thrust"] ** 2 - 1.0,
        params["min_height"] - height,
    ]
