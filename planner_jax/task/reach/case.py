"""Cases of the task `reach`: start and goals of an arm's motion, limits, and obstacles."""

import functools
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from numpy.typing import ArrayLike, DTypeLike

from planner_jax.core import GRAVITY, rules
from planner_jax.core.checks import floating, require_kind
from planner_jax.core.errors import ArgumentError
from planner_jax.core.rules import Field, Table, require_sound
from planner_jax.robot import arm_scene
from planner_jax.robot.arm import Arm, ArmLimits
from planner_jax.robot.arm_file import irb1600
from planner_jax.robot.arm_scene import Scene, paper_scene
from planner_jax.robot.arm_scene import make_scene as make_scene  # for users of `pj.reach`
from planner_jax.task.arguments import array_of, batch_of, repeat_leaves

# Shapes and ranges that `pj.require_sound` checks for the arrays of a `ReachCase`.
RULES: Table = (
    Field("angles", ("J",)),
    Field("goals", ("G", "J")),
    Field("gravity", (), rules.NOT_NEGATIVE),
    Field("arm.lower", ("J",), rules.below("arm.upper")),
    Field("arm.upper", ("J",)),
    Field("arm.capsule_radius", ("C",), rules.NOT_NEGATIVE),
    Field("limits.velocity", ("J",), rules.POSITIVE),
    Field("limits.acceleration", ("J",), rules.POSITIVE),
    *(Field(f"{of}limits.torque", ("J",), rules.POSITIVE_OR_NONE) for of in ("", "arm.")),
    *arm_scene.RULES,
)


@struct.dataclass
class ReachCase:
    """One case, or a batch: an arm has to move from standstill to standstill at a goal.

    Robot base frame, z up, SI units. The motion starts at time 0.

    Attributes:
        angles: (n,) [rad], joint angles at the start.
        goals: (G, n) [rad], joint angles of the G goals; the motion may end at any of them.
        arm: kinematics and bodies of the arm.
        limits: limits of the joints.
        scene: obstacles.
        gravity: () [m/s^2], magnitude; it loads motors whose limits have torques.
    """

    rules: ClassVar[Table] = RULES

    angles: Array
    goals: Array
    arm: Arm
    limits: ArmLimits
    scene: Scene
    gravity: Array

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the batch: () for one case, (B,) for a batch of B cases."""
        return np.shape(self.angles)[:-1]


def case(
    goal: ArrayLike | None = None,
    *,
    goals: ArrayLike | None = None,
    angles: ArrayLike | None = None,
    arm: Arm | None = None,
    limits: ArmLimits | None = None,
    scene: Scene | None = None,
    gravity: ArrayLike = GRAVITY,
    dtype: DTypeLike = jnp.float32,
) -> ReachCase:
    """Make one case of a motion of the joints, or a batch.

    Args:
        goal: (n,) [rad], joint angles at the end, or (B, n) for a batch of B cases.
        goals: (G, n) or (B, G, n) [rad], instead of `goal`: the motion may end at any one of G
            goals, for example the results of inverse kinematics for a pose of the tool.
        angles: (n,) or (B, n) [rad], joint angles at the start; by default those at which the arm
            waits.
        arm: without batch axes; by default an IRB 1600 with a shield.
        limits: greatest joint rates, accelerations and torques, without batch axes; by default the
            limits of the arm.
        scene: obstacles, without batch axes, for example of `make_scene`; by default the pole, the
            floor and the beams of [Natarajan2024].
        gravity: () or (B,) [m/s^2], magnitude, for limits that have torques.
        dtype: type of every floating leaf.

    Raises:
        ValueError: a shape is wrong, or a number breaks a rule.
        TypeError: an argument has a wrong type.
    """
    if (goal is None) == (goals is None):
        raise ArgumentError("goal", "either goal or goals", verb="be", shown="both or none")
    scene = paper_scene() if scene is None else scene
    require_kind("scene", scene, Scene)
    arm = irb1600() if arm is None else arm
    require_kind("arm", arm, Arm)
    limits = arm.limits if limits is None else limits
    require_kind("limits", limits, ArmLimits)
    angles = arm.home if angles is None else angles
    name, ends = ("goal", goal) if goals is None else ("goals", goals)
    own = (arm.num,) if goals is None else (*np.shape(goals)[-2:-1], arm.num)
    batch = max(batch_of("angles", angles, arm.num), batch_of(name, ends, *own), key=len)
    dtype = floating(dtype)
    leaf = functools.partial(array_of, batch=batch, dtype=dtype)

    repeat = functools.partial(repeat_leaves, batch=batch, dtype=dtype)
    cases = ReachCase(
        angles=leaf("angles", angles, arm.num),
        goals=leaf(name, ends, *own).reshape(*batch, -1, arm.num),
        arm=repeat(arm),
        limits=repeat(limits),
        scene=repeat(scene),
        gravity=leaf("gravity", gravity),
    )
    require_sound(cases)
    return cases
