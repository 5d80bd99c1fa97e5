"""The problem of `ExactCatch` with one ball in CasADi's symbols, after [Yu2023catch]."""

import math
from typing import Any

from planner_jax.benchmarks.ipopt_peer.program import Problem, across, ca, rate_squared
from planner_jax.core.protocol import FEASIBILITY_TOLERANCE

RIM = 0.9  # share of the net's radius that a planned catch may use

# What a program is told about a catch, and how many numbers that is; SI units.
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


def told(context: Any) -> dict[str, Any]:
    """The numbers of one context with one ball (NumPy leaves), by name."""
    case, path = context.case, context.targets
    found = {"ball_pos": path.ball.pos, "ball_vel": path.ball.vel}
    found |= {"ball_drag": path.drag, "ball_gravity": path.gravity, "horizon": context.horizon}
    for source in (case.net, case.limits, case):
        found |= {n: getattr(source, n) for n in SIZES.keys() - found.keys() if hasattr(source, n)}
    return found


def problem(planner: Any) -> Problem:
    """The problem of an `ExactCatch` for one ball."""
    return Problem(
        planner=planner,
        sizes=SIZES,
        num_natural=12,
        ends=lambda natural, told: ends(natural, told, planner.time_weight),
        limits=limits,
        factors=(2.0, 2.0, 2.0, 2.0, 1.0),
        impact_weight=planner.catch_weight,
    )


def ball_at(time: Any, told: dict) -> tuple[Any, Any]:
    """Position and velocity of a ball with linear drag on each axis [Yu2023catch, eq. 9]."""
    x = told["ball_drag"] * time
    small = ca.fabs(x) < 0.5
    near, far = ca.if_else(small, x, 0.0), ca.if_else(small, 1.0, x)
    series = sum((-near) ** k / float(math.factorial(k + 2)) for k in range(13))
    phi_2 = ca.if_else(small, series, (1.0 + ca.expm1(-far) / far) / far)
    phi_1 = 1.0 - x * phi_2
    fall = ca.vertcat(0.0, 0.0, -told["ball_gravity"])
    pos = told["ball_pos"] + told["ball_vel"] * time * phi_1 + fall * time**2 * phi_2
    return pos, told["ball_vel"] * ca.exp(-x) + fall * time * phi_1


def ends(natural: Any, told: dict, time_weight: float) -> tuple[Any, Any, list, Any]:
    """The catch that log T, place in the net, velocity, acceleration and jerk describe."""
    time, place = ca.exp(natural[0]), natural[1:3]
    pos, vel = ball_at(time, told)
    acc = natural[6:9]
    thrust = acc + ca.vertcat(0.0, 0.0, told["gravity"])
    axis = thrust / ca.norm_2(thrust)
    across_x, across_y = across(axis)
    place = place * RIM * told["radius"] / ca.sqrt(1.0 + ca.sumsqr(place))
    centre = pos - told["height"] * axis
    tail = ca.horzcat(
        centre - place[0] * across_x - place[1] * across_y,
        natural[3:6],
        acc,
        natural[9:12],
    ).T
    angle = ca.fmax(told["max_angle"], 1e-3)
    facing = -ca.dot(axis, vel) / ca.norm_2(vel)
    leaning = (ca.cos(angle) - facing) / (angle * ca.sin(angle))
    late = time / told["horizon"] - 1.0 + FEASIBILITY_TOLERANCE
    return tail, time, [leaning, late], time_weight * time


def limits(height: Any, vel: Any, acc: Any, jerk: Any, told: dict) -> list:
    """Squares of speed, body rate and thrust over their limits, less one, and the height."""
    squared = ca.sumsqr(acc + ca.vertcat(0.0, 0.0, told["gravity"]))
    return [
        ca.sumsqr(vel) / told["speed"] ** 2 - 1.0,
        rate_squared(acc, jerk, told["gravity"]) / told["body_rate"] ** 2 - 1.0,
        1.0 - squared / told["min_thrust"] ** 2,
        squared / told["max_thrust"] ** 2 - 1.0,
        told["min_height"] - height,
    ]
