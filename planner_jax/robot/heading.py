"""Headings of quadrotors: requests, and the heading over time within limits of yaw and body rate.

The attitude is  R_tilt R_z(psi) , with the shortest rotation R_tilt from upright to the thrust, and
the heading psi. The body rate is  R_z(-psi) omega_tilt + psi' e_3 . The heading does not move the
robot, so it is computed after the trajectory, which is planned at the heading of the start.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.ball.flight_table import NODES, SUBSTEPS, tabulate_flight
from planner_jax.ball.target import state_at
from planner_jax.core.arithmetic import Numbers, numpy_of, to_host
from planner_jax.core.checks import numeric, shape_of
from planner_jax.core.choices import require, require_one_of
from planner_jax.core.rules import POSITIVE, Field, Rule, Table
from planner_jax.robot.attitude import yaw_at
from planner_jax.robot.quadrotor import Air, add_drag, add_drag_rate, body_rate, thrust_in_air
from planner_jax.robot.rotor_thrusts import rotor_thrusts
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate, sample_pieces

MAX_YAW_RATE = 2.0  # [rad/s], default of cases with a heading
KNOTS, _FINE = 64, 8  # pieces of a heading, and intervals of each, at whose ends limits are tested
_LAG = 0.25  # [s], time constant with which the heading approaches the requested heading
_SHARE = 0.99  # fraction of the limit of the body rate, for peaks between the tested times
_SLOWER = (1.0, 0.5, 0.25, 0.0)  # factors on the yaw rate, until every rotor keeps its limits
_ROUNDING = 1e-4  # relative excess of a rotor's thrust that is no reason for a slower yaw
# What a heading may follow, and the horizontal speed [m/s] or distance [m] of the robot from the
# ball, from which on it does; below half of it, the heading is held.
_FOLLOWED = {"velocity": 0.5, "ball": 0.3}


def _is_rising(value: Numbers, part: PyTree) -> Numbers:
    return value > numpy_of(value).append(value[..., :1] - 1.0, value[..., :-1], axis=-1)


@struct.dataclass
class Heading:
    """A requested heading, or a batch: angles at times, or a direction that it follows."""

    rules: ClassVar[Table] = (
        Field("angles", ("H",)),
        Field("times", ("H",), Rule("rising", _is_rising)),
        Field("max_yaw_rate", (), POSITIVE),
        Field("start", (2,)),
    )

    angles: Array  # (H,) [rad], requested headings, between which the request is linear
    times: Array  # (H,) [s], of these headings
    max_yaw_rate: Array  # () [rad/s], greatest magnitude of the derivative of the heading
    start: Array  # (2,) [rad], [rad/s], the heading and its derivative at time 0
    follows: str = struct.field(pytree_node=False, default="angles")  # or "velocity", "ball"


def add_request(
    cases: PyTree, leaf: Callable[..., Array], heading: object, most: object, attitude: object
) -> PyTree:
    """Return cases with a requested heading and a greatest yaw rate `most`, arguments of `case`.

    At time 0 the heading equals the heading of the start's `attitude`. Without an attitude it
    equals the requested angle at time 0, or 0 if the heading follows a direction.
    """
    require(heading is not None, "max_yaw_rate", "left out without heading", most)
    follows, times, angles = "angles", np.arange(2.0), heading
    if isinstance(heading, str):
        require_one_of(_FOLLOWED, "heading", heading)
        follows, angles = heading, 0.0
    if isinstance(heading, tuple | list) and len(heading) == 2 and all(map(_has_axes, heading)):
        times, angles = heading[0], leaf("heading", heading[1], shape_of("heading", heading[0])[-1])
    else:
        angles = jnp.repeat(leaf("heading", angles)[..., None], 2, axis=-1)
    times = leaf("heading", times, shape_of("heading", times)[-1])
    quaternion = None if attitude is None else to_host(leaf("start_attitude", attitude, 4))
    xp = numpy_of(to_host(times), to_host(angles), quaternion)  # jax.numpy if one is traced
    first = xp.vectorize(xp.interp, signature="(),(n),(n)->()")(0.0, times, angles)
    if quaternion is not None:
        w, _, _, z = xp.moveaxis(quaternion, -1, 0)
        start = 2.0 * xp.arctan2(z, w)
        turns = xp.round((start - first) / (2.0 * np.pi))
        first, angles = start, angles + leaf("heading", 2.0 * np.pi * turns)[..., None]
    start = leaf("heading", xp.stack([first, 0.0 * first], axis=-1), 2)
    most = leaf("max_yaw_rate", MAX_YAW_RATE if most is None else most)
    return with_request(cases, Heading(angles, times, most, start, follows))


def _has_axes(value: object) -> bool:
    array = numeric(value)
    return array is not None and array.ndim > 0


def with_request(cases: PyTree, heading: Heading) -> PyTree:
    """Return cases with a requested heading, at whose start limited rotors keep their limits."""
    limits = cases.limits
    if limits.rotors is not None:
        rotors = dataclasses.replace(limits.rotors, heading=heading.start[..., 0])
        limits = dataclasses.replace(limits, rotors=rotors)
    return dataclasses.replace(cases, heading=heading, limits=limits)


def continue_heading(case: PyTree, previous: PyTree, elapsed: Numbers) -> PyTree:
    """Return a case whose heading starts as a plan `previous` is headed at `elapsed` [s]; pure."""
    heading = case.heading
    if heading is None or previous.heading is None:
        return case
    start, times = yaw_at(previous.heading, jnp.asarray(elapsed)), heading.times - elapsed
    return with_request(case, dataclasses.replace(heading, start=start, times=times))


def plan_heading(plan: PyTree, case: PyTree) -> PiecewisePolynomial:
    """Return the heading psi of a plan over time, in pieces of degree 2; pure.

    The heading approaches the request with a time constant of 0.25 s. Its derivative psi' keeps the
    limits  |psi'| <= max_yaw_rate , |psi''| <= max_yaw_rate / 0.25 s , and the limit of the body
    rate, which holds at a constant heading. Where a rotor would exceed its limits, the yaw is
    slower by the factor 1/2, 1/4 or 0 over the whole plan. The plan ends with psi' = 0.
    """
    path, limits, gravity = plan.whole, case.limits, case.gravity
    step = jnp.sum(path.durations) / KNOTS
    times = step * jnp.asarray(np.arange(KNOTS * _FINE + 1) / _FINE, step.dtype)
    orders = range(1, 4 if limits.rotors is None else 5)
    flown = [jax.vmap(lambda t, k=k: evaluate(path, t, k))(times) for k in orders]
    loads = _loads(limits.air, flown)
    x, y, twist = body_rate(loads[0], loads[1], gravity)
    square = (_SHARE * limits.body_rate) ** 2 - x * x - y * y
    spare = jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)
    # The interval of psi' at every knot; linear between knots, psi' is then within it at all times.
    within = np.arange(KNOTS)[:, None] * _FINE + np.arange(_FINE + 1)[None]
    room = jnp.stack([jnp.maximum(spare + twist, 0.0), jnp.maximum(spare - twist, 0.0)])
    room = jnp.min(room[:, within], axis=2)  # of -psi' and of psi', in each piece
    room = jnp.concatenate([jnp.minimum(room[:, 1:], room[:, :-1]), room[:, -1:]], axis=1)
    room = room.at[:, -1].set(0.0)  # so that the heading stays constant after the plan
    wanted = _requests(plan, case, path, times[::_FINE])
    if limits.rotors is None:
        return _turn(case.heading, step, wanted, room, 1.0)
    # The snap jumps between the pieces of the path, whose both ends are therefore tested too.
    joint, ends = sample_pieces(path, 1), jnp.cumsum(path.durations)
    at_joints = joint.vel, joint.acc, joint.jerk, joint.snap
    joint_times = jnp.stack([ends - path.durations, ends], axis=1).ravel()

    def greatest(flown: Sequence[Array], turn: PyTree) -> Array:
        (load, jerk, snap), rotors = _loads(limits.air, flown), limits.rotors
        pull = None
        if limits.air is not None:
            pull = thrust_in_air(limits.air, flown[0], load, gravity)
        thrusts = jnp.stack(rotor_thrusts(load, jerk, snap, gravity, rotors, pull, turn))
        beyond = jnp.maximum(thrusts - rotors.max_thrust, rotors.min_thrust - thrusts)
        return jnp.max(beyond) / rotors.max_thrust

    def excess(found: PiecewisePolynomial) -> Array:
        since, (start, rate, half) = times[None, : _FINE + 1], jnp.moveaxis(found.coeffs, 1, 0)
        turn = start + since * (rate + since * half), rate + 2.0 * since * half, 2.0 * half
        read = jax.vmap(lambda t: tuple(evaluate(found, t, k)[0] for k in range(3)))
        along = greatest([each[within] for each in flown], turn)
        return jnp.maximum(along, greatest(at_joints, read(joint_times)))

    tried = [_turn(case.heading, step, wanted, room, factor) for factor in _SLOWER]
    beyond = jnp.stack([excess(each) for each in tried])
    first = jnp.argmax(beyond <= jnp.maximum(beyond[-1], 0.0) + _ROUNDING)
    return jax.tree.map(lambda *leaves: jnp.stack(leaves)[first], *tried)


def _loads(air: Air | None, flown: Sequence[Array]) -> list[Array]:
    """Return the derivatives of the motion that needs the same attitude without drag and wind.

    `flown` has the velocity and its derivatives; the result has one entry less.
    """
    rates = map(functools.partial(add_drag_rate, air), flown[1:-1], flown[2:])
    return [add_drag(air, flown[0], flown[1]), *rates]


def _requests(
    plan: PyTree, case: PyTree, path: PiecewisePolynomial, times: Array
) -> tuple[Array, Array]:
    """Return the requested headings (K,) [rad] at K times [s], and their weights from 0 to 1."""
    heading, last = case.heading, jnp.sum(plan.trajectory.durations)
    if heading.follows == "angles":
        return jnp.interp(times, heading.times, heading.angles), jnp.ones_like(times)
    if heading.follows == "velocity":
        along = jax.vmap(lambda time: evaluate(path, time, 1))(times)
    else:
        times = jnp.minimum(times, last)  # after the last contact the request is held
        along = jax.vmap(_balls(plan, case))(times) - jax.vmap(lambda t: evaluate(path, t))(times)
    x, y = along[:, 0], along[:, 1]
    squared = x * x + y * y
    is_short = squared <= 1e-6
    size = jnp.sqrt(jnp.where(is_short, 1.0, squared)) / _FOLLOWED[heading.follows]
    weights = jnp.where(is_short, 0.0, jnp.clip(2.0 * size - 1.0, 0.0, 1.0))
    return jnp.arctan2(y, jnp.where(is_short, 1.0, x)), weights


def _balls(plan: PyTree, case: PyTree) -> Callable[[Array], Array]:
    """Return a function of time () [s]: the position (3,) [m] of the ball that is met next."""
    if "targets" not in vars(case):  # a hit
        end = plan.stroke.time
        if case.lift is None:
            path = tabulate_flight(case.ball, end, case.drag, case.gravity)
        else:
            from planner_jax.ball.spin import SpinningBall, tabulate_spin  # few balls have a spin

            ball = SpinningBall(case.ball.pos, case.ball.vel, case.drag, case.lift)
            air = dataclasses.replace(case.around, gravity=case.gravity)
            path = tabulate_spin(ball, end, air, NODES, SUBSTEPS)
        return lambda time: path.at(time).pos

    def at(time: Array) -> Array:
        target = plan.order[jnp.sum(time > plan.times[:-1])]
        return state_at(jax.tree.map(lambda leaf: leaf[target], case.targets), time).pos

    return at


def _turn(
    heading: Heading, step: Array, wanted: tuple[Array, Array], room: Array, factor: float
) -> PiecewisePolynomial:
    """Return the heading that follows requests with  -room[0] <= psi' <= room[1]  at the knots."""
    most = factor * heading.max_yaw_rate
    gain = 1.0 / jnp.maximum(_LAG, 2.0 * step)  # for longer steps the recursion would oscillate
    rise = most * gain * step
    # Limits that are not yet in force leave the time to brake.
    index = rise * jnp.asarray(np.arange(KNOTS), step.dtype)[None]
    room = lax.cummin(jnp.minimum(room, most) + index, axis=1, reverse=True) - index

    def nearest(turn: Array) -> Array:
        return turn if heading.follows == "angles" else jnp.arctan2(jnp.sin(turn), jnp.cos(turn))

    def advance(state: tuple[Array, ...], knot: tuple[Array, ...]) -> tuple[tuple, Array]:
        angle, rate, last, before = state
        request, weight, backward, forward = knot
        change = weight * nearest(request - last)
        last = last + change
        error = nearest(last - angle - step * rate)
        later = before * weight * change / step + factor * gain * error
        later = jnp.clip(jnp.clip(later, rate - rise, rate + rise), -backward, forward)
        coeffs = jnp.stack([angle, rate, 0.5 * (later - rate) / step])
        return (angle + 0.5 * step * (rate + later), later, last, weight), coeffs

    (requests, weights), (angle, rate) = wanted, heading.start
    state = angle, rate, angle + weights[0] * nearest(requests[0] - angle), weights[0]
    _, coeffs = lax.scan(advance, state, (requests[1:], weights[1:], *room))
    return PiecewisePolynomial(coeffs[..., None], jnp.broadcast_to(step, (KNOTS,)))


_of_batch = jax.jit(jax.vmap(plan_heading))


def plan_headings(plans: PyTree, cases: PyTree) -> PiecewisePolynomial:
    """Return the headings of a batch of plans over time, in NumPy arrays for such plans."""
    found = _of_batch(plans, cases)
    return jax.tree.map(np.asarray, found) if isinstance(plans.status, np.ndarray) else found
