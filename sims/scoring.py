"""Did it meet the ball, and where does the ball land?

A tool is a disc on the body z axis. The event is the passage of the ball's centre through the
disc's plane from above, found between two steps by interpolation. A net has caught the ball
that passes within its radius; a racket hits it there, by the library's map.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.ball.flight import BallState, rk4_step
from planner_jax.ball.impact import racket_impact
from planner_jax.sims.control import robot_state, rotation
from planner_jax.sims.model import Physics, World, ball_states

_LANDING_STEPS, _LANDING_STEP = 150, 0.02  # [s], three seconds of flight


@struct.dataclass
class Contact:
    """The nearest passage of one ball so far, or that in which it was met; world frame."""

    met: Array  # () bool, within the radius
    time: Array  # () [s]
    offset: Array  # () [m], of the ball from the disc's centre; inf before any passage
    ball_pos: Array  # (3,) [m]
    ball_vel: Array  # (3,) [m/s]
    robot_pos: Array  # (3,) [m], of the propeller plane's centre
    tool_vel: Array  # (3,) [m/s], of the tool at the ball, rotation included
    normal: Array  # (3,) body z axis
    planned_time: Array  # () [s], of the plan that was flown then
    tracking: Array  # () [m], distance of the quadrotor from its plan


def no_contact(num_balls: int, dtype=jnp.float32) -> Contact:
    """Before any passage, leaves (N, ...)."""
    number, vector = jnp.zeros(num_balls, dtype), jnp.zeros((num_balls, 3), dtype)
    return Contact(
        met=jnp.zeros(num_balls, bool),
        time=number,
        offset=number + jnp.inf,
        ball_pos=vector,
        ball_vel=vector,
        robot_pos=vector,
        tool_vel=vector,
        normal=vector,
        planned_time=number,
        tracking=number,
    )


@struct.dataclass
class Moment:
    """What a passage is looked for in: tool and balls at one instant.

    Velocities are MuJoCo's, of half a step before.
    """

    robot_pos: Array  # (3,) [m]
    robot_vel: Array  # (3,) [m/s]
    rate: Array  # (3,) [rad/s], world frame
    normal: Array  # (3,)
    ball_pos: Array  # (N, 3) [m]
    ball_vel: Array  # (N, 3) [m/s]


def moment(world: World, physics: Physics) -> Moment:
    """Tool and balls in a simulated state."""
    state = robot_state(physics)
    R = rotation(state.quat_wxyz)
    pos, vel = ball_states(world, physics)
    return Moment(
        robot_pos=state.pos,
        robot_vel=state.vel,
        rate=jnp.sum(R * state.rate, axis=1),
        normal=R[:, 2],
        ball_pos=pos,
        ball_vel=vel,
    )


def passage(
    world: World, before: Moment, after: Moment, time: Array, planned: Array, reference: Array
) -> tuple[Array, Contact]:
    """Whether each ball passes the disc's plane from above within a step, and how.

    Args:
        world: with the tool and the time step.
        before: at `time`.
        after: one step later.
        time: () [s].
        planned: (N,) [s], when each ball is to be met.
        reference: (3,) [m], where the quadrotor is to be at `time`.

    Returns:
        (N,) bool, and contacts with leaves (N, ...).
    """

    def gap(at: Moment) -> Array:
        """Height (N,) [m] of the balls over the disc's plane."""
        return jnp.sum((at.ball_pos - at.robot_pos) * at.normal, axis=1) - world.tool.height

    start, end = gap(before), gap(after)
    passes = (start > 0.0) & (end <= 0.0)
    share = start / jnp.where(passes, start - end, 1.0)

    def at_share(share: Array) -> Moment:
        return jax.tree.map(lambda a, b: a + share[:, None] * (b - a), before, after)

    at, moving = at_share(share), at_share(share + 0.5)  # leaves (N, 3)
    normal = at.normal / jnp.sqrt(jnp.maximum(jnp.sum(at.normal**2, axis=1, keepdims=True), 1e-12))
    arm = at.ball_pos - at.robot_pos
    aside = arm - world.tool.height * normal
    offset = jnp.sqrt(jnp.sum(aside**2, axis=1))
    return passes, Contact(
        met=offset <= world.tool.radius,
        time=time + share * world.timestep,
        offset=offset,
        ball_pos=at.ball_pos,
        ball_vel=moving.ball_vel,
        robot_pos=at.robot_pos,
        tool_vel=moving.robot_vel + jnp.cross(moving.rate, arm),
        normal=normal,
        planned_time=planned,
        tracking=jnp.full_like(offset, jnp.sqrt(jnp.sum((before.robot_pos - reference) ** 2))),
    )


def nearest(contact: Contact, passes: Array, later: Contact) -> Contact:
    """The contact so far, or a later passage that is nearer, unless the ball is met already."""
    take = passes & ~contact.met & (later.offset < contact.offset)

    def pick(old: Array, new: Array) -> Array:
        return jnp.where(take.reshape(take.shape + (1,) * (old.ndim - 1)), new, old)

    return jax.tree.map(pick, contact, later)


def returned(contact: Contact, restitution: Array) -> BallState:
    """One ball just after the racket's impact, by the library's map (paper 002, eq. 3)."""
    vel = racket_impact(contact.ball_vel, contact.tool_vel, contact.normal, restitution)
    return BallState(pos=contact.ball_pos, vel=vel)


def landing_point(ball: BallState, drag: Array, gravity: Array) -> tuple[Array, Array]:
    """Where (3,) [m] one ball comes down to the ground, and when () [s] from now.

    The library's flight with quadratic drag, three seconds at most; NaN for one still in the
    air then.
    """
    step = jnp.full_like(drag, _LANDING_STEP)

    def advance(state: BallState, _: None) -> tuple[BallState, Array]:
        return rk4_step(state, step, drag, gravity), state.pos

    _, path = jax.lax.scan(advance, ball, None, length=_LANDING_STEPS + 1)
    falls = (path[:-1, 2] > 0.0) & (path[1:, 2] <= 0.0)
    first = jnp.argmax(falls)
    a, b = path[first], path[first + 1]
    share = a[2] / jnp.where(falls[first], a[2] - b[2], 1.0)
    point = jnp.where(falls[first], a + share * (b - a), jnp.nan)
    return point, jnp.where(falls[first], (first + share) * step, jnp.nan)
