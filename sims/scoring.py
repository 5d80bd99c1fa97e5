"""Detection of contacts between a robot's tool and the balls, in every physics step.

The tool is a disc on the z axis of the body that carries it. A contact is the passage of the ball's
centre through the disc's plane from above; its time is interpolated between two steps. A ball that
passes within the disc's radius is caught by a net, or hit by a racket.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.sims.model import World, ball_states
from planner_jax.sims.robot import Physics


@struct.dataclass
class Contact:
    """One ball's contact with the tool (a disc), or its nearest passage of the disc's plane."""

    met: Array  # () bool, whether the passage is within the disc's radius
    time: Array  # () [s], time of the passage
    offset: Array  # () [m], distance of the ball from the disc's centre; inf before any passage
    ball_pos: Array  # (3,) [m], position of the ball at the passage
    ball_vel: Array  # (3,) [m/s], velocity of the ball at the passage
    robot_pos: Array  # (3,) [m], position of the body with the tool
    tool_vel: Array  # (3,) [m/s], velocity of the tool at the ball, rotation included
    normal: Array  # (3,), unit z axis of the body with the tool
    planned_time: Array  # () [s], contact time of the plan that was active at the passage
    tracking: Array  # () [m], distance of the robot from its plan at the passage


def no_contact(num_balls: int, dtype=jnp.float32) -> Contact:
    """Return the contacts of N balls that have not passed the tool's plane, leaves (N, ...)."""
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
    """Positions and velocities of N balls and of the body with the tool at one instant.

    Velocities are MuJoCo's stored velocities, which belong to half a step earlier.
    """

    robot_pos: Array  # (3,) [m], position of the body with the tool
    robot_vel: Array  # (3,) [m/s], velocity of this body
    rate: Array  # (3,) [rad/s], angular velocity of this body, world frame
    normal: Array  # (3,), unit z axis of this body
    ball_pos: Array  # (N, 3) [m], positions of the N balls
    ball_vel: Array  # (N, 3) [m/s], velocities of the N balls


def moment(world: World, physics: Physics) -> Moment:
    """Return positions and velocities of tool and balls in a simulated state."""
    motion = world.carrier.tool_motion(world.robot.state(physics))
    return Moment(*motion, *ball_states(world, physics))


def passage(
    world: World, before: Moment, after: Moment, time: Array, planned: Array, reference: Array
) -> tuple[Array, Contact]:
    """Return which of N balls pass the plane of the tool (a disc) from above within a step.

    Args:
        world: the world, with the tool and the time step.
        before: tool and balls at `time`.
        after: tool and balls one step later.
        time: () [s], start of the step.
        planned: (N,) [s], planned contact times of the balls, which are copied to the result.
        reference: (3,) [m], planned position of the robot at `time`, for its tracking error.

    Returns:
        (N,) bool, whether each ball passes, and the passages (N, ...), valid for balls that pass.
    """

    def gap(at: Moment) -> Array:
        height = jnp.sum((at.ball_pos - at.robot_pos[None]) * at.normal[None], axis=1)
        return height - world.carrier.tool.height

    start, end = gap(before), gap(after)
    passes = (start > 0.0) & (end <= 0.0)
    share = start / jnp.where(passes, start - end, 1.0)

    def at_share(share: Array) -> Moment:
        def blend(a: Array, b: Array) -> Array:
            return a.reshape(-1, 3) + share[:, None] * (b - a).reshape(-1, 3)

        return jax.tree.map(blend, before, after)

    at, moving = at_share(share), at_share(share + 0.5)  # leaves (N, 3), states at two times
    normal = at.normal / jnp.sqrt(jnp.maximum(jnp.sum(at.normal**2, axis=1, keepdims=True), 1e-12))
    arm = at.ball_pos - at.robot_pos
    aside = arm - world.carrier.tool.height * normal
    offset = jnp.sqrt(jnp.sum(aside**2, axis=1))
    return passes, Contact(
        met=offset <= world.carrier.tool.radius,
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
    """Return each ball's contact so far, or a later passage that is nearer to the tool's centre.

    `passes` marks the balls with a later passage. A ball that has met the tool keeps its contact.
    """
    take = passes & ~contact.met & (later.offset < contact.offset)

    def pick(old: Array, new: Array) -> Array:
        return jnp.where(take.reshape(take.shape + (1,) * (old.ndim - 1)), new, old)

    return jax.tree.map(pick, contact, later)


def racket_impact(ball_vel: Array, racket_vel: Array, normal: Array, restitution: Array) -> Array:
    """Return a ball's velocity v+ (3,) [m/s] after its bounce from a racket.

    v+ = v- - (1 + beta) ((v- - u) . z) z, so that the tangential velocity is unchanged. [Yu2023bat,
    eq. 3] prints (1 - beta), but its beta is the coefficient of restitution, which needs the plus.

    Args:
        ball_vel: v- (3,) [m/s], velocity of the ball before the bounce.
        racket_vel: u (3,) [m/s], velocity of the racket.
        normal: z (3,), unit normal of the racket.
        restitution: beta (), coefficient of restitution, 0 to 1.
    """
    return ball_vel - (1.0 + restitution) * jnp.sum((ball_vel - racket_vel) * normal) * normal
