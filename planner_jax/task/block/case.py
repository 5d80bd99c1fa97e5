"""One thrown ball, and the arm that is to block it."""

from typing import ClassVar, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from numpy.typing import ArrayLike, DTypeLike

from planner_jax.ball.flight import BallState
from planner_jax.core.checks import floating, require_kind, require_switch, shape_of
from planner_jax.core.registry import require_name
from planner_jax.core.rules import (
    NOT_NEGATIVE,
    POSITIVE,
    Field,
    Table,
    below,
    require_sound,
    within,
)
from planner_jax.robot.arm import REGIMES, Arm, ArmLimits
from planner_jax.robot.arm_mjcf import irb1600
from planner_jax.task.arguments import array_of, batch_of
from planner_jax.task.block.clearance import least_clearances
from planner_jax.task.block.scene import Scene, paper_scene

# What the numbers of a case must be.
RULES: Table = (
    Field("ball.pos", (3,)),
    Field("ball.vel", (3,)),
    Field("gravity", (), POSITIVE),
    Field("delay", (), NOT_NEGATIVE),
    Field("angles", (6,)),
    Field("rates", (6,)),
    Field("arm.lower", (6,), below("arm.upper")),
    Field("arm.upper", (6,)),
    Field("arm.mass", (6,), POSITIVE),
    Field("arm.capsule_radius", ("C",), NOT_NEGATIVE),
    Field("arm.shield_half", (), POSITIVE),
    Field("limits.velocity", (6,), POSITIVE),
    Field("limits.acceleration", (6,), POSITIVE),
    Field("ends_at_rest", (), kind=np.bool_),
    Field("offset", (), POSITIVE),
    Field("tilt", (), within(0.0, np.pi, "in [0, pi]")),
    Field("scene.inner.lower", (3,), below("scene.inner.upper")),
    Field("scene.inner.upper", (3,)),
    Field("scene.outer.lower", (3,), below("scene.outer.upper")),
    Field("scene.outer.upper", (3,)),
    Field("scene.pole", (2,)),
    Field("scene.pole_radius", (), NOT_NEGATIVE),
    Field("scene.has_pole", (), kind=np.bool_),
    Field("scene.floor", ()),
    Field("scene.beam_ends", ("N", 2, 3)),
    Field("scene.beam_radius", ("N",), NOT_NEGATIVE),
)


TreeT = TypeVar("TreeT")
# How exactly a ball is to be met: greatest distance from the middle of the shield [m], and greatest
# angle [rad] between the shield's normal and the way that the ball comes from.
STRICT = (0.002, np.deg2rad(0.5))
WIDE = (0.1, np.deg2rad(30.0))
ANYWHERE = (0.25, np.deg2rad(90.0))  # beyond the shield's corners: on its face


@struct.dataclass
class BlockCase:
    """One case. Every number is a leaf: batch it, randomise it, differentiate by it.

    Robot base frame, z up, SI units. Times count from the moment at which the ball is first seen.
    """

    rules: ClassVar[Table] = RULES

    ball: BallState  # when it is first seen; it falls freely
    gravity: Array  # () [m/s^2], magnitude
    delay: Array  # () [s], until the arm may start
    angles: Array  # (6,) [rad], of the arm until then
    rates: Array  # (6,) [rad/s], of the joints then
    arm: Arm
    limits: ArmLimits
    ends_at_rest: Array  # () bool, whether the arm must stand when it meets the ball
    offset: Array  # () [m], greatest distance of the ball from the shield's middle then
    tilt: Array  # () [rad], greatest angle between the shield's normal and the ball's way
    scene: Scene

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """() for one case, (B,) for a batch."""
        return np.shape(self.gravity)

    def clearances(self, angles: Array) -> Array:
        """Return the least distance (N,) [m] of the arm in poses (N, 6) from its obstacles."""
        return least_clearances(self.arm, self.scene, angles)


def case(
    ball_pos: ArrayLike,
    ball_vel: ArrayLike,
    *,
    delay: ArrayLike = 0.0,
    regime: str = "R2",
    wide: bool = False,
    anywhere: bool = False,
    scene: Scene | None = None,
    arm: Arm | None = None,
    angles: ArrayLike | None = None,
    rates: ArrayLike = 0.0,
    gravity: ArrayLike = 9.81,
    dtype: DTypeLike = jnp.float32,
) -> BlockCase:
    """Return a case of a ball to block, or a batch, by default in the scene of [Natarajan2024].

    Args:
        ball_pos: (3,) or (B, 3) [m], where the ball is first seen.
        ball_vel: (3,) or (B, 3) [m/s].
        delay: () or (B,) [s], until the arm may start, >= 0. Delay, angles, rates and gravity are
            one value, or one value a case.
        regime: a key of `planner_jax.robot.arm.REGIMES`: "R1", the limits that the paper's
            authors plan with, end velocity free; "R2", the data sheet's speeds and 30 rad/s^2,
            from rest to rest; "R3", R1's limits from rest to rest.
        wide: whether the ball may be 0.1 m off the shield's middle and 30 degrees off straight
            on, and not 2 mm and half a degree.
        anywhere: whether any place on the shield will do, at any angle, as with motions that were
            not planned for the very ball.
        scene: without the batch's axes; by default the paper's scene.
        arm: without the batch's axes; by default an IRB 1600 with a shield.
        angles: (6,) [rad], at the start; by default the arm's home.
        rates: (6,) [rad/s], at the start.
        gravity: [m/s^2], > 0.
        dtype: of every floating leaf.

    Raises:
        ValueError: there is no such regime; or as of `pj.hit.case`, as all other errors.
    """
    require_name(REGIMES, "regime", regime)
    require_switch("wide", wide)
    require_switch("anywhere", anywhere)
    scene = paper_scene() if scene is None else scene
    require_kind("scene", scene, Scene)
    arm = irb1600() if arm is None else arm
    require_kind("arm", arm, Arm)
    angles = arm.home if angles is None else angles
    rates = np.full(6, rates) if shape_of("rates", rates) == () else rates
    vectors = {"ball_pos": (ball_pos, 3), "ball_vel": (ball_vel, 3), "angles": (angles, 6)}
    shapes = [batch_of(name, *given) for name, given in vectors.items()]
    shapes += [shape_of("delay", delay), shape_of("gravity", gravity)]
    batch, dtype = max(shapes, key=len), floating(dtype)

    def leaf(name: str, value: ArrayLike, *trailing: int) -> Array:
        return array_of(name, value, batch, trailing, dtype)

    def shared(tree: TreeT) -> TreeT:
        def one(value: ArrayLike) -> Array:
            value = np.asarray(value)
            kind = np.dtype(dtype) if value.dtype.kind == "f" else value.dtype
            return jnp.asarray(np.broadcast_to(value, batch + value.shape), kind)

        return jax.tree.map(one, tree)

    chosen = REGIMES[regime]
    offset, tilt = ANYWHERE if anywhere else WIDE if wide else STRICT
    made = BlockCase(
        ball=BallState(pos=leaf("ball_pos", ball_pos, 3), vel=leaf("ball_vel", ball_vel, 3)),
        gravity=leaf("gravity", gravity),
        delay=leaf("delay", delay),
        angles=leaf("angles", angles, 6),
        rates=leaf("rates", rates, 6),
        arm=shared(arm),
        limits=shared(chosen.limits),
        ends_at_rest=jnp.broadcast_to(jnp.asarray(chosen.ends_at_rest), batch),
        offset=leaf("offset", offset),
        tilt=leaf("tilt", tilt),
        scene=shared(scene),
    )
    require_sound(made, {"ball.pos": "ball_pos", "ball.vel": "ball_vel"})
    return made
