"""The problem of `ExactHit` in CasADi's symbols, from [Yu2023bat] and the planner's docstrings."""

from typing import Any

import numpy as np

from planner_jax.benchmarks.ipopt_peer.program import Problem, body_axes, ca, rate_squared

# Parameters of a hit, and their numbers of values; SI units.
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
    """Return the parameters of one context (NumPy leaves), by name."""
    case, path = context.case, context.path
    found = {"path_pos": path.pos, "path_vel": path.vel, "resolution": path.resolution}
    for source in (case, case.limits, case.hit_limits):
        found |= {n: getattr(source, n) for n in SIZES if hasattr(source, n)}
    return found


def make_problem(planner: Any) -> Problem:
    """Return the problem of an `ExactHit`."""
    nodes = planner.num_table_nodes
    return Problem(
        planner=planner,
        sizes=SIZES | {"path_pos": 3 * nodes, "path_vel": 3 * nodes},
        num_natural=8,
        ends=lambda natural, params: ends(natural, params, nodes),
        limits=limits,
        factors=(2.0, 2.0, 2.0, 1.0),
        impact_weight=planner.impact_weight,
    )


def keys_kernel(distance: Any) -> Any:
    """Return Keys' kernel with a = -1/2 at a distance in nodes [Yu2023bat, eq. 10b]."""
    u = ca.fabs(distance)
    near = (1.5 * u - 2.5) * u * u + 1.0
    far = ((-0.5 * u + 2.5) * u - 4.0) * u + 2.0
    return ca.if_else(u < 1.0, near, ca.if_else(u < 2.0, far, 0.0))


def ball_at(time: Any, params: dict, nodes: int) -> tuple[Any, Any]:
    """Interpolate position and velocity of the incoming ball [Yu2023bat, eqs 8 to 10]."""
    inside = ca.fmin(ca.fmax(time, 0.0), params["resolution"] * (nodes - 3))
    place = inside / params["resolution"] + 1.0
    weights = keys_kernel(place - ca.DM(np.arange(nodes)))
    vel = ca.reshape(params["path_vel"], 3, nodes) @ weights
    return ca.reshape(params["path_pos"], 3, nodes) @ weights + vel * (time - inside), vel


def ends(natural: Any, params: dict, nodes: int) -> tuple[Any, Any, list, Any]:
    """Return the end of a hit.

    The variables are log T, log t_post, log thrust, two tangential speeds and jerk. Returns tail
    state, duration, excesses and cost, as `Problem.ends`.
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
    """Return squares of speed, acceleration, body rate over their limits, less one; and height."""
    return [
        ca.sumsqr(vel) / params["speed"] ** 2 - 1.0,
        ca.sumsqr(acc) / params["acceleration"] ** 2 - 1.0,
        rate_squared(acc, jerk, params["gravity"]) / params["body_rate"] ** 2 - 1.0,
        params["min_height"] - height,
    ]
