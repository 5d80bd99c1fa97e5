"""Cases of the task `hit`: the incoming ball, the hovering quadrotor, the target and the limits."""

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import PyTree

from planner_jax.ball.flight import BallState
from planner_jax.ball.flight_table import is_resolved
from planner_jax.core import GRAVITY, rules
from planner_jax.core.arithmetic import Numbers, numpy_of, to_host
from planner_jax.core.checks import floating
from planner_jax.core.origin import NEAR, Located, find_origin, move
from planner_jax.core.rules import Field, Rule, Table, require_sound
from planner_jax.cost.extras import Extra, for_batch
from planner_jax.robot.quadrotor import QuadrotorLimits
from planner_jax.robot.quadrotor_model import PAPER_HITTER, RACKET, QuadrotorModel
from planner_jax.task import quadrotor
from planner_jax.task.arguments import array_of, batch_of
from planner_jax.task.hit.spec import DRAG, START

if TYPE_CHECKING:
    from planner_jax.robot.heading import Heading


def _is_resolved(drag: Numbers, case: PyTree) -> Numbers:
    """Return where a table of the ball's flight is right to 0.1 mm."""
    with np.errstate(all="ignore"):
        turn = 0.0 if case.lift is None else numpy_of(drag).sqrt((case.lift**2).sum(axis=-1))
        return is_resolved(case.ball, drag, case.gravity, turn)


# Shapes and ranges that `pj.require_sound` checks for the arrays of a `HitCase`.
RULES: Table = (
    Field("ball.pos", (3,)),
    Field("ball.vel", (3,)),
    Field("head_state", (4, 3), NEAR),
    Field("origin", (2,)),
    Field("target", (3,)),
    Field("drag", (), rules.NOT_NEGATIVE),
    Field("drag", (), Rule("less for a flight as long and fast as this ball's", _is_resolved)),
    Field("lift", (3,)),
    Field("gravity", (), rules.POSITIVE),
    Field("restitution", (), rules.within(0.0, 1.0, "in [0, 1]")),
    Field("racket_height", ()),
    Field("racket_radius", (), rules.POSITIVE),
    *quadrotor.FLIGHT_RULES,
    Field("limits.min_height", (), rules.NOT_NEGATIVE),
    Field("hit_limits.hitting_speed", (3,), rules.POSITIVE),
    Field("hit_limits.min_apex", (), rules.NOT_NEGATIVE),
    Field("hit_limits.min_apex", (), rules.below("hit_limits.max_apex")),
    Field("hit_limits.max_apex", ()),
)
_ARGUMENTS = {
    **quadrotor.ARGUMENTS,
    **{f"ball.{name}": f"ball_{name}" for name in ("pos", "vel")},
    **{f"hit_limits.{name}": name for name in ("hitting_speed", "min_apex", "max_apex")},
}


@struct.dataclass
class HitLimits:
    """Limits on speed at impact and on the returned ball's apex [Yu2023bat, eqs 18f and 18g].

    Attributes:
        hitting_speed: (3,) [m/s], greatest speed of the quadrotor at the impact on each world axis.
        min_apex: () [m], least height of the apex of the returned ball.
        max_apex: () [m], greatest height of the apex of the returned ball.
    """

    hitting_speed: Array
    min_apex: Array
    max_apex: Array


@struct.dataclass
class RacketCase(Located):
    """The fields that cases of hits and of rallies share. Every number is a leaf of the pytree.

    Time 0 is when planning starts. Positions are relative to `origin`.

    Attributes:
        ball: position and velocity of the ball at time 0.
        head_state: (4, 3) position [m], velocity, acceleration and jerk of the quadrotor at time 0.
        drag: () [1/m], coefficient K_D of the ball's quadratic drag.
        gravity: () [m/s^2], magnitude of gravity.
        restitution: () coefficient of restitution beta of the racket.
        racket_height: () [m], height of the racket's centre above the propeller plane.
        limits: limits of the quadrotor's motion.
        hit_limits: limits at the impact and on the returned ball.
        extras: the user's further constraints and costs.
        racket_radius: () [m], radius of the racket; None: the contact's offset is not limited.
        heading: requested heading of the quadrotor; None: 0.
        lift: (3,) [1/s], lift vector of the ball; None: the ball has no spin.
        around: wind, and friction of ball and racket, as `Surroundings`.
    """

    positions: ClassVar[dict] = {"ball": (), "head_state": (0,)}

    ball: BallState
    head_state: Array
    drag: Array
    gravity: Array
    restitution: Array
    racket_height: Array
    limits: QuadrotorLimits
    hit_limits: HitLimits
    extras: tuple[Extra, ...] = ()
    racket_radius: Array | None = None
    heading: "Heading | None" = None
    lift: Array | None = None
    around: PyTree = None

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the batch: () for one case, (B,) for a batch of B cases."""
        return np.shape(self.drag)


@struct.dataclass
class HitCase(RacketCase):
    """One hit to plan, or a batch: a quadrotor has to hit a ball to a target with a racket.

    Attributes:
        target: (3,) [m], landing point of the returned ball.
    """

    rules: ClassVar[Table] = RULES
    target: Array = struct.field(kw_only=True)


def case(
    ball_pos,
    ball_vel,
    target,
    *,
    robot: QuadrotorModel = PAPER_HITTER,
    start=START,
    start_velocity=(0.0, 0.0, 0.0),
    start_acceleration=(0.0, 0.0, 0.0),
    start_attitude=None,
    heading=None,
    max_yaw_rate=None,
    drag=DRAG,
    spin=None,
    ball=None,
    ball_radius=0.02,
    gravity=GRAVITY,
    restitution=None,
    racket_height=None,
    racket_radius=None,
    speed=None,
    acceleration=None,
    min_thrust=None,
    max_thrust=None,
    body_rate=None,
    min_height=None,
    hitting_speed=(4.0, 3.0, 4.0),
    min_apex=2.2,
    max_apex=6.2,
    rotor_drag=None,
    wind=None,
    extras: Sequence[Extra] = (),
    origin=None,
    dtype=jnp.float32,
) -> HitCase:
    """Make one case of a hit, or a batch; defaults are the numbers of [Yu2023bat, Section VI-A].

    Inside compiled functions every number may be a traced array. Values are then not checked: an
    invalid one leads to the status `BAD_INPUT` of the plan. Shapes and types are checked, and a
    traced `start` has the origin (0, 0) by default.

    Args:
        ball_pos: (..., 3) [m], position of the ball at time 0, above the ground at z = 0.
        ball_vel: (..., 3) [m/s], velocity of the ball at time 0.
        target: (..., 3) [m], required landing point of the returned ball.
        robot: quadrotor with a racket. It supplies the numbers of arguments that are None.
        start: (3,) or (..., 3) [m], position of the quadrotor at time 0.
        start_velocity: (3,) or (..., 3) [m/s], its velocity at time 0.
        start_acceleration: (3,) or (..., 3) [m/s^2], its acceleration at time 0.
        start_attitude: (4,) or (..., 4), quaternion w x y z from body to world at time 0, instead
            of the acceleration, for a thrust equal to the weight. Its heading is the heading at
            time 0 if a `heading` is requested.
        heading: requested heading of the quadrotor: an angle [rad], or one for each case; a pair of
            times (..., H) [s] and angles (..., H) [rad], linear in between; "velocity", along the
            horizontal velocity; or "ball", towards the ball until the impact. None: 0.
        max_yaw_rate: [rad/s], greatest derivative of a requested heading, by default 2.
        drag: [1/m], coefficient K_D of quadratic drag. The drag and every following number is one
            value for all cases, or one value for each case.
        spin: (3,) or (..., 3) [rad/s], spin of the ball at time 0, in world axes. With a spin the
            racket has friction, and flights before and after the impact have drag and lift.
        ball: a `pj.ball.Ball` with friction, grip, and reach; by default of table tennis.
        ball_radius: [m], for a ball with spin.
        gravity: [m/s^2], magnitude.
        restitution: coefficient of restitution beta of the racket.
        racket_height: [m], height of the racket's centre above the propeller plane.
        racket_radius: [m]. The ball must meet the racket within 0.9 times this radius.
        speed: [m/s], greatest speed of the quadrotor.
        acceleration: [m/s^2], greatest acceleration.
        min_thrust: [m/s^2], least thrust per unit mass.
        max_thrust: [m/s^2], greatest thrust per unit mass.
        body_rate: [rad/s], greatest body rate.
        min_height: [m], least height of the propeller plane.
        rotor_drag: [1/s], linear drag of the quadrotor per unit mass: one number, or two numbers
            (..., 2) across and along the thrust; by default the robot's, or none.
        wind: (3,) or (..., 3) [m/s], velocity of the air; it acts by the drag, and on balls that
            have a `spin`.
        hitting_speed: (3,) [m/s], greatest speed of the quadrotor at the impact on each axis.
        min_apex: [m], least apex of the returned ball.
        max_apex: [m], greatest apex of the returned ball.
        extras: further constraints and costs such as `pj.KeepOut`. Their leaves have the batch's
            axes, or no batch axes if all cases share them.
        origin: (2,) x, y [m], world position that is subtracted from all positions in float64, by
            default the multiple of 100 m next to the first start. Positions that are passed in
            float64 are thus exact anywhere. Extras whose class has no `positions` are not moved.
        dtype: type of every floating leaf.

    Returns:
        A case whose leaves have the batch shape of `ball_pos`.

    Raises:
        CaseError: a number breaks a rule, such as a limit that is not positive.
        ValueError: an argument has a wrong shape.
        TypeError: an argument does not hold numbers, or `dtype` is not a floating type.
    """
    dtype, batch = floating(dtype), batch_of("ball_pos", ball_pos, 3)
    tool = quadrotor.require_tool(robot, RACKET)
    shift = find_origin(start, origin, batch, dtype)
    near = functools.partial(move, by=None if shift is None else -shift, dtype=dtype)

    leaf = functools.partial(array_of, batch=batch, dtype=dtype)
    motion = start_velocity, start_acceleration, start_attitude
    limits = {"speed": speed, "body_rate": body_rate, "min_height": min_height}
    limits |= {"min_thrust": min_thrust, "max_thrust": max_thrust, "acceleration": acceleration}
    racket_height = tool.height if racket_height is None else racket_height
    racket_radius = tool.radius if racket_radius is None else racket_radius
    cases = HitCase(
        ball=BallState(
            pos=leaf("ball_pos", near("ball_pos", ball_pos), 3), vel=leaf("ball_vel", ball_vel, 3)
        ),
        head_state=quadrotor.start_state(near("start", start), motion, gravity, batch, dtype),
        target=leaf("target", near("target", target), 3),
        drag=leaf("drag", drag),
        gravity=leaf("gravity", gravity),
        restitution=leaf("restitution", tool.restitution if restitution is None else restitution),
        racket_height=leaf("racket_height", racket_height),
        limits=quadrotor.limits_of(robot, leaf, (rotor_drag, wind), **limits),
        hit_limits=HitLimits(
            hitting_speed=leaf("hitting_speed", hitting_speed, 3),
            min_apex=leaf("min_apex", min_apex),
            max_apex=leaf("max_apex", max_apex),
        ),
        extras=for_batch(near("extras", extras, is_strict=origin is None), batch, dtype),
        racket_radius=leaf("racket_radius", racket_radius),
        origin=None if shift is None else leaf("origin", shift, 2),
    )
    cases = quadrotor.add_heading(cases, leaf, heading, max_yaw_rate, start_attitude)
    if spin is not None:
        from planner_jax.task.hit.spin import with_spin  # few balls have a known spin

        cases = with_spin(cases, spin, ball_radius, ball, (0.0, 0.0, 0.0) if wind is None else wind)
    require_sound(cases, _ARGUMENTS)
    cases, height = quadrotor.check_start(cases), to_host(cases.ball.pos)[..., 2]
    return rules.require_or_mark(cases, "ball_pos", height, height >= 0.0, "at a height >= 0 m")
