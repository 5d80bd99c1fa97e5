"""The planned states that a quadrotor tracks: a plan's trajectory, and then braking to hover.

World frame, z up; body rates in the body frame.
"""

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.robot.attitude import flat_attitude, yaw_at
from planner_jax.robot.quadrotor import Air, add_drag, add_drag_rate, net_thrust, thrust_in_air
from planner_jax.sims.model import World
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate

_BRAKING = 0.8  # [s], duration of the braking piece after the end of a plan
_LOWEST_REST = 0.5  # [m], least height of the position at standstill


@struct.dataclass
class Reference:
    """The planned motion at one instant, and additions to commands that compensate rotor lag."""

    pos: Array  # (3,) [m]
    vel: Array  # (3,) [m/s]
    acc: Array  # (3,) [m/s^2]
    jerk: Array  # (3,) [m/s^3]
    # () [m/s^2], addition to the commanded thrust per mass that compensates the rotors' lag.
    thrust_lead: Array
    angular_acc: Array  # (3,) [rad/s^2], body frame
    # (3,) [rad/s^2], addition to the angular acceleration that compensates the rotors' lag.
    torque_lead: Array
    # Acceleration (3,) [m/s^2] and jerk (3,) [m/s^3] that need the same thrust direction without
    # drag and wind; None without drag, where they are `acc` and `jerk`.
    load: Array | None = None
    load_jerk: Array | None = None
    yaw: Array | None = None  # (2,) [rad], [rad/s], heading and its derivative; None: 0


def with_rest(trajectory: PiecewisePolynomial) -> PiecewisePolynomial:
    """Return the trajectory with one more piece, which brakes to standstill after its end.

    The piece is the polynomial of degree 7 from the last state to standstill. It ends where a
    constant deceleration would stop the quadrotor, but at least half a metre above the ground.
    """
    coeffs = trajectory.coeffs
    missing = 8 - coeffs.shape[1]
    coeffs = jnp.pad(coeffs, ((0, 0), (0, missing), (0, 0)))
    # Plans of catches have pieces for every ball. The pieces of balls that are not caught come last
    # and have a duration of 0 s.
    last = jnp.max(jnp.where(trajectory.durations > 0.0, jnp.arange(coeffs.shape[0]), 0))
    piece = PiecewisePolynomial(coeffs[last][None], trajectory.durations[last][None])
    unit = jnp.asarray([_BRAKING**k for k in range(8)], coeffs.dtype)[:, None]
    factorials = jnp.asarray([1.0, 1.0, 2.0, 6.0], coeffs.dtype)[:, None]
    state = jnp.stack([evaluate(piece, piece.durations[0], k) for k in range(4)])
    low = state * unit[:4] / factorials
    rest = state[0] + 0.5 * _BRAKING * state[1]
    rest = rest.at[2].max(jnp.minimum(_LOWEST_REST, state[0, 2] + 1.0))
    powers = np.arange(8)
    rows = np.stack(
        [np.prod([powers - i for i in range(k)], axis=0) * np.ones(8) for k in range(4)]
    )
    wanted = jnp.zeros_like(state).at[0].set(rest)
    wanted -= jnp.matmul(
        jnp.asarray(rows[:, :4], coeffs.dtype), low, precision=lax.Precision.HIGHEST
    )
    inverse = jnp.asarray(np.linalg.inv(rows[:, 4:]), coeffs.dtype)
    high = jnp.matmul(inverse, wanted, precision=lax.Precision.HIGHEST)
    braking = jnp.concatenate([low, high]) / unit
    return PiecewisePolynomial(
        coeffs=jnp.concatenate([coeffs, braking[None]]),
        durations=jnp.append(trajectory.durations, jnp.asarray(_BRAKING, coeffs.dtype)),
    )


def reference_at(
    trajectory: PiecewisePolynomial,
    time: Array,
    lag: float,
    world: World,
    air: Air | None = None,
    heading: PiecewisePolynomial | None = None,
) -> Reference:
    """Return the planned motion at a time () [s], with additions to the planned commands.

    The additions compensate a first-order lag of the rotors with the time constant `lag` [s]. The
    commands balance the drag and wind that the plan knows as `air`, and follow its `heading`.
    """
    gravity = jnp.asarray(world.gravity, time.dtype)
    order = lambda k, at: evaluate(trajectory, at, k)  # noqa: E731
    pos, vel, acc, jerk = (order(k, time) for k in range(4))
    step = 2.0 * world.timestep
    # MuJoCo's Euler integrator is a leapfrog: a step's force acts around the start of the step. A
    # command changes the thrust gradually during the step, on average by half of the change.
    # Commands are therefore taken from the plan half a step ahead.
    ahead = time + 0.5 * world.timestep

    def flat(at: Array) -> tuple[Array, Array]:
        acc_then, jerk_then = order(2, at), order(3, at)
        turn = None if heading is None else yaw_at(heading, at)
        if air is None:
            size = jnp.sqrt(jnp.sum(net_thrust(acc_then, gravity) ** 2))
            return size, flat_attitude(acc_then, jerk_then, gravity, turn)[1]
        vel_then = order(1, at)
        load = add_drag(air, vel_then, acc_then)
        jerk_then = add_drag_rate(air, acc_then, jerk_then)
        size = thrust_in_air(air, vel_then, load, gravity)
        return size, flat_attitude(load, jerk_then, gravity, turn)[1]

    (less, before), (size, rate), (more, after) = (flat(ahead + k * step) for k in (-1, 0, 1))
    # To invert a first-order lag, `lag` times the rate of change is added to the desired value.
    growth = (more - less) / (2.0 * step)
    angular_acc = (after - before) / (2.0 * step)
    angular_jerk = (after - 2.0 * rate + before) / step**2
    load = add_drag(air, vel, acc)
    now = jnp.sqrt(jnp.sum(net_thrust(load, gravity) ** 2))
    return Reference(
        pos=pos,
        vel=vel,
        acc=acc,
        jerk=jerk,
        thrust_lead=size + lag * growth - now,
        angular_acc=angular_acc,
        torque_lead=lag * angular_jerk,
        load=None if air is None else load,
        load_jerk=None if air is None else add_drag_rate(air, acc, jerk),
        yaw=None if heading is None else yaw_at(heading, time),
    )
