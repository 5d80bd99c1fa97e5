"""The problem of `HitProblem`, written with CasADi for IPOPT [Yu2023bat].

`benchmarks.ipopt` loads this module by its name.
"""

from typing import Any

import jax
import numpy as np

from planner_jax.ball.prediction import predict_path
from planner_jax.benchmarks.ipopt_peer.program import Problem, body_axes, ca, rate_squared

NODES = 48  # number of states in the table of the ball's path
# Name of each number of a case that IPOPT's problem of a hit contains, in SI units -> its number of
# values (3 for a vector).
SIZES = {
    "gravity": 1,
    "speed": 1,
    "acceleration": 1,
    "body_rate": 1,
    "min_height": 1,
    "head_state": 12,
    "target": 3,
    "restitution": 1,
    "racket_height": 1,
    "hitting_speed": 3,
    "min_apex": 1,
    "max_apex": 1,
    "resolution": 1,
}


def read_params(context: Any) -> dict[str, Any]:
    """Return the numbers of one case that IPOPT's problem needs, by name.

    `context` is the result of the planner's `prepare` for the case, with NumPy leaves. It contains
    the case and a table of the ball's path.
    """
    case, end = context.case, context.path.times[-1]
    path = predict_path(case.ball, end, case.drag, case.gravity, num_nodes=NODES)
    path = jax.tree.map(np.asarray, path)
    found = {"path_pos": path.pos, "path_vel": path.vel, "resolution": path.resolution}
    for source in (case, case.limits, case.hit_limits):
        found |= {n: getattr(source, n) for n in SIZES if hasattr(source, n)}
    return found


def make_problem(ours: Any) -> Problem:
    """Define for IPOPT the problem that `HitProblem` states, with the same settings."""
    return Problem(
        ours=ours,
        sizes=SIZES | {"path_pos": 3 * NODES, "path_vel": 3 * NODES},
        num_natural=8,
        ends=lambda natural, params: ends(natural, params, NODES),
        limits=limits,
        factors=(2.0, 2.0, 2.0, 1.0),
        impact_weight=ours.impact_weight,
    )


def keys_kernel(distance: Any) -> Any:
    """Return the weight of a table node in cubic convolution by Keys [Yu2023bat, eq. 10b].

    The kernel's parameter is a = -1/2. `distance` is from the node to the interpolated point, in
    units of the node spacing.
    """
    u = ca.fabs(distance)
    near = (1.5 * u - 2.5) * u * u + 1.0
    far = ((-0.5 * u + 2.5) * u - 4.0) * u + 2.0
    return ca.if_else(u < 1.0, near, ca.if_else(u < 2.0, far, 0.0))


def ball_at(time: Any, params: dict, nodes: int) -> tuple[Any, Any]:
    """Interpolate position and velocity of the incoming ball at a time [Yu2023bat, eqs 8 to 10].

    `params` has a table of the ball's path with `nodes` entries at equal time steps, the first of
    them before time 0.
    """
    inside = ca.fmin(ca.fmax(time, 0.0), params["resolution"] * (nodes - 3))
    place = inside / params["resolution"] + 1.0
    weights = keys_kernel(place - ca.DM(np.arange(nodes)))
    vel = ca.reshape(params["path_vel"], 3, nodes) @ weights
    return ca.reshape(params["path_pos"], 3, nodes) @ weights + vel * (time - inside), vel


def ends(natural: Any, params: dict, nodes: int) -> tuple[Any, Any, list, Any]:
    """Compute the end of a trajectory at which the ball is hit, from the end's variables.

    The variables `natural` are the logarithms of the duration, of the ball's flight time after the
    impact and of the thrust, two speeds of the racket in its plane, and the jerk (3). `params` has
    the numbers of the case by name, `nodes` is the length of its table of the ball's path. Returns
    position to jerk at the end (4, 3), the duration [s], the relative excesses over the limits of
    the hit, and the cost, which is zero.
    """
    time, flight, thrust = (ca.exp(natural[k]) for k in range(3))
    gravity, up = params["gravity"], ca.DM([0.0, 0.0, 1.0])
    pos, before = ball_at(time, params, nodes)
    after = (params["target"] - pos) / flight + 0.5 * gravity * flight * up
    change = after - before
    normal = change / ca.norm_2(change)
    beta = params["restitution"]
    speed = ca.dot((beta * before + after) / (1.0 + beta), normal)
    across_x, across_y = body_axes(normal)
    tail = ca.horzcat(
        pos - params["racket_height"] * normal,
        speed * normal + natural[3] * across_x + natural[4] * across_y,
        thrust * normal - gravity * up,
        natural[5:8],
    ).T
    apex = pos[2] + ca.fmax(after[2], 0.0) ** 2 / (2.0 * gravity)
    hitting = (tail[1, :].T / params["hitting_speed"]) ** 2 - 1.0
    excess = [1.0 - apex / params["min_apex"], apex / params["max_apex"] - 1.0]
    return tail, time, [*excess, *ca.vertsplit(hitting)], ca.SX(0.0)


def limits(height: Any, vel: Any, acc: Any, jerk: Any, params: dict) -> list:
    """Return the excesses over the limits at one sample of the trajectory.

    For speed, acceleration and body rate the excess is the squared ratio to the limit, minus one.
    The excess of the height is in metres.
    """
    return [
        ca.sumsqr(vel) / params["speed"] ** 2 - 1.0,
        ca.sumsqr(acc) / params["acceleration"] ** 2 - 1.0,
        rate_squared(acc, jerk, params["gravity"]) / params["body_rate"] ** 2 - 1.0,
        params["min_height"] - height,
    ]
