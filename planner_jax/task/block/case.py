"""Cases of the task `block`: a thrown ball, and an arm that has to block it with its shield."""

import functools
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from numpy.typing import ArrayLike, DTypeLike

from planner_jax.ball.flight import BallState
from planner_jax.core import GRAVITY, rules
from planner_jax.core.checks import floating, require_kind, require_switch, shape_of
from planner_jax.core.choices import require
from planner_jax.core.registry import require_name
from planner_jax.core.rules import Field, Table, require_sound
from planner_jax.robot import arm_scene
from planner_jax.robot.arm import REGIMES, Arm, ArmLimits
from planner_jax.robot.arm_clearance import least_clearances
from planner_jax.robot.arm_file import describe_arm as describe_arm
from planner_jax.robot.arm_file import irb1600
from planner_jax.robot.arm_file import read_arm as read_arm
from planner_jax.robot.arm_scene import Scene, paper_scene
from planner_jax.robot.arm_scene import make_scene as make_scene
from planner_jax.robot.arm_scene_file import read_scene as read_scene
from planner_jax.robot.arm_shield import Shield as Shield
from planner_jax.task.arguments import array_of, batch_of, repeat_leaves

_TOLERANCE = 1e-3  # [rad], by which a joint may start beyond its range; as in the referee
_IN_RANGE = rules.Rule(
    ">= arm.lower and <= arm.upper",
    lambda value, case: (
        (value >= case.arm.lower - _TOLERANCE) & (value <= case.arm.upper + _TOLERANCE)
    ),
)
# Shapes and ranges that `pj.require_sound` checks for the arrays of a `BlockCase`.
RULES: Table = (
    Field("ball.pos", (3,)),
    Field("ball.vel", (3,)),
    Field("gravity", (), rules.POSITIVE),
    Field("ball_radius", (), rules.NOT_NEGATIVE),
    Field("delay", (), rules.NOT_NEGATIVE),
    Field("angles", ("J",), _IN_RANGE),
    Field("rates", ("J",)),
    Field("arm.lower", ("J",), rules.below("arm.upper")),
    Field("arm.upper", ("J",)),
    Field("arm.mass", ("J",), rules.POSITIVE),
    Field("arm.capsule_radius", ("C",), rules.NOT_NEGATIVE),
    Field("arm.shield_half", (2,), rules.POSITIVE),
    Field("arm.shield_corners", ("S", 2)),
    Field("limits.velocity", ("J",), rules.POSITIVE),
    Field("limits.acceleration", ("J",), rules.POSITIVE),
    *(Field(f"{of}limits.torque", ("J",), rules.POSITIVE_OR_NONE) for of in ("", "arm.")),
    Field("ends_at_rest", (), kind=np.bool_),
    Field("offset", (), rules.POSITIVE),
    Field("tilt", (), rules.within(0.0, np.pi, "in [0, pi]")),
    Field("scene.inner.lower", (3,), rules.at_most("scene.inner.upper")),
    Field("scene.inner.upper", (3,)),
    Field("scene.outer.lower", (3,), rules.below("scene.outer.upper")),
    Field("scene.outer.upper", (3,)),
    Field("scene.inner.lower", (3,), rules.at_least("scene.outer.lower")),
    Field("scene.inner.upper", (3,), rules.at_most("scene.outer.upper")),
    *arm_scene.RULES,
)
# Tolerances of a contact: greatest distance [m] of the ball from the shield's middle, and greatest
# angle [rad] between the shield's normal and the reversed velocity of the ball.
STRICT = (0.002, np.deg2rad(0.5))
WIDE = (0.1, np.deg2rad(30.0))
ANYWHERE = (0.25, np.deg2rad(90.0))  # the offset is at least the distance of the shield's corners


@struct.dataclass
class BlockCase:
    """One case, or a batch: an arm has to block a thrown ball with its shield.

    Every number is a leaf of the pytree; plans can be differentiated by it. Robot base frame, z up,
    SI units. Time 0 is the first observation of the ball.

    Attributes:
        ball: position and velocity of the ball at time 0; the ball flies without drag.
        gravity: () [m/s^2], magnitude of gravity.
        ball_radius: () [m], radius of the ball; the shield meets the ball's nearest point.
        delay: () [s], time at which the arm may start to move.
        angles: (n,) [rad], joint angles at the time `delay`.
        rates: (n,) [rad/s], joint rates at the time `delay`.
        arm: kinematics, bodies and shield of the arm.
        limits: limits of the joints.
        ends_at_rest: () bool, whether the arm must be at rest at the contact.
        offset: () [m], greatest distance of the ball from the shield's middle at the contact.
        tilt: () [rad], greatest angle between the shield's normal and the reversed velocity of the
            ball.
        scene: obstacles, and the boxes to protect and to block in.
    """

    rules: ClassVar[Table] = RULES

    ball: BallState
    gravity: Array
    ball_radius: Array
    delay: Array
    angles: Array
    rates: Array
    arm: Arm
    limits: ArmLimits
    ends_at_rest: Array
    offset: Array
    tilt: Array
    scene: Scene

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the batch: () for one case, (B,) for a batch of B cases."""
        return np.shape(self.gravity)

    def clearances(self, angles: Array) -> Array:
        """Return the arm's least distances (N,) [m] from obstacles in N poses at angles (N, n)."""
        return least_clearances(self.arm, self.scene, angles)


def case(
    ball_pos: ArrayLike,
    ball_vel: ArrayLike,
    *,
    delay: ArrayLike = 0.0,
    regime: str | None = None,
    limits: ArmLimits | None = None,
    wide: bool = False,
    anywhere: bool = False,
    scene: Scene | None = None,
    arm: Arm | None = None,
    angles: ArrayLike | None = None,
    rates: ArrayLike = 0.0,
    gravity: ArrayLike = GRAVITY,
    ball_radius: ArrayLike = 0.0,
    dtype: DTypeLike = jnp.float32,
) -> BlockCase:
    """Make one case of a ball to block, or a batch, by default in the scene of [Natarajan2024].

    Args:
        ball_pos: (3,) [m], position of the ball at time 0, or (B, 3) for a batch of B cases.
        ball_vel: (3,) or (B, 3) [m/s], velocity of the ball at time 0.
        delay: () or (B,) [s], time at which the arm may start to move, >= 0. Delay, angles, rates,
            gravity and radius are one value for all cases, or one value for each case.
        regime: joint limits of an IRB 1600, and whether the motion ends at rest; a key of
            `planner_jax.robot.arm.REGIMES`. "R1": limits in the code of [Natarajan2024], any
            velocity at the end. "R2", the default: speeds of the robot's data sheet and
            30 rad/s^2, at rest at the end. "R3": limits of "R1", at rest at the end. A regime is
            not allowed for another arm, whose motions end at rest.
        limits: greatest joint rates, accelerations and torques, without batch axes; by default the
            limits of the regime, or else the limits of the arm.
        wide: whether the ball may meet the shield up to 0.1 m from its middle and tilted by up to
            30 degrees, instead of 2 mm and half a degree.
        anywhere: whether the ball may meet the shield anywhere and at any angle. This suits motions
            that were planned for another ball.
        scene: protected body and obstacles, without batch axes, for example of `make_scene`; by
            default the scene of [Natarajan2024].
        arm: without batch axes; by default an IRB 1600 with a shield.
        angles: (n,) [rad], joint angles at the start; by default those at which the arm waits.
        rates: (n,) [rad/s], joint rates at the start.
        gravity: [m/s^2], magnitude, > 0.
        ball_radius: [m], >= 0. The shield's face meets the ball one radius before its centre, and
            the ball must not come nearer to the protected body than its radius. The point of
            contact must be within the shield's outline, which neither shrinks nor grows.
        dtype: type of every floating leaf.

    Raises:
        ValueError: the regime is unknown, a shape is wrong, or a number breaks a rule.
        TypeError: an argument has a wrong type.
    """
    require_switch("wide", wide)
    require_switch("anywhere", anywhere)
    scene = paper_scene() if scene is None else scene
    require_kind("scene", scene, Scene)
    arm = irb1600() if arm is None else arm
    require_kind("arm", arm, Arm)
    rule = "one with a capsule around at least one link"
    require(max(arm.capsule_link, default=-1) >= 0, "arm", rule, shown="none")
    has_shield = bool(np.all(np.asarray(arm.shield_half) > 0.0))
    require(has_shield, "arm", "one with a shield; pass shield= to read_arm", shown="none")
    own, ends_at_rest = arm.limits, True
    if regime is not None:
        require_name(REGIMES, "regime", regime)
        is_known = np.array_equal(arm.limits.velocity, REGIMES["R2"].limits.velocity)
        require(is_known, "regime", "left out for an arm with limits of its own", regime)
        own, ends_at_rest = REGIMES[regime].limits, REGIMES[regime].ends_at_rest
    limits = own if limits is None else limits
    require_kind("limits", limits, ArmLimits)
    angles = arm.home if angles is None else angles
    num = arm.num
    rates = np.full(num, rates) if shape_of("rates", rates) == () else rates
    vectors = {"ball_pos": (ball_pos, 3), "ball_vel": (ball_vel, 3), "angles": (angles, num)}
    shapes = [batch_of(name, *given) for name, given in vectors.items()]
    numbers = {"delay": delay, "gravity": gravity, "ball_radius": ball_radius}
    shapes += [shape_of(*number) for number in numbers.items()]
    batch, dtype = max(shapes, key=len), floating(dtype)

    leaf = functools.partial(array_of, batch=batch, dtype=dtype)

    repeat = functools.partial(repeat_leaves, batch=batch, dtype=dtype)
    offset, tilt = ANYWHERE if anywhere else WIDE if wide else STRICT
    if anywhere:
        offset = max(offset, float(np.max(np.linalg.norm(arm.shield_corners, axis=1))))
    cases = BlockCase(
        ball=BallState(pos=leaf("ball_pos", ball_pos, 3), vel=leaf("ball_vel", ball_vel, 3)),
        **{name: leaf(name, number) for name, number in numbers.items()},
        angles=leaf("angles", angles, num),
        rates=leaf("rates", rates, num),
        arm=repeat(arm),
        limits=repeat(limits),
        ends_at_rest=jnp.broadcast_to(jnp.asarray(ends_at_rest), batch),
        offset=leaf("offset", offset),
        tilt=leaf("tilt", tilt),
        scene=repeat(scene),
    )
    require_sound(cases, {"ball.pos": "ball_pos", "ball.vel": "ball_vel"})
    return cases
