"""Cases of the task `catch`: up to N flying targets, the quadrotor, its net and its limits."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import PyTree

from planner_jax.ball.target import TargetPath
from planner_jax.core import GRAVITY
from planner_jax.core.arithmetic import Numbers, numpy_of, to_host
from planner_jax.core.checks import floating, numbers_of, numeric, require_switch, shape_of
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.origin import NEAR, Located, find_origin, move
from planner_jax.core.paths import require_path
from planner_jax.core.rules import PERMUTATION, POSITIVE, Field, Rule, Table, require_sound, within
from planner_jax.cost.extras import Extra, for_batch
from planner_jax.robot.quadrotor import QuadrotorLimits
from planner_jax.robot.quadrotor_model import NET, PAPER_CATCHER, QuadrotorModel
from planner_jax.task import quadrotor
from planner_jax.task.arguments import array_of

if TYPE_CHECKING:
    from planner_jax.robot.heading import Heading


def _is_ahead(horizon: Numbers, case: PyTree) -> Numbers:
    return (horizon > 0.0) | ~case.present


# Shapes and ranges that `pj.require_sound` checks for the arrays of a `CatchCase`.
RULES: Table = (
    Field("present", ("N",), kind=np.bool_),
    Field("horizon", ("N",), Rule("> 0 of a target that is present", _is_ahead)),
    Field("order", ("N",), PERMUTATION, kind=np.integer),
    Field("times", ("N",)),
    Field("head_state", (4, 3), NEAR),
    Field("origin", (2,)),
    Field("gravity", (), POSITIVE),
    Field("net.height", ()),
    Field("net.radius", (), POSITIVE),
    Field("net.max_angle", (), within(0.0, np.pi, "in [0, pi]")),
    *quadrotor.FLIGHT_RULES,
    Field("limits.min_height", ()),
)
START = (0.0, 0.0, 1.0)  # [m], hover position of the quadrotor
_ARGUMENTS = {
    **quadrotor.ARGUMENTS,
    **{f"net.{name}": f"net_{name}" for name in ("height", "radius")},
    "net.max_angle": "max_angle",
}


@struct.dataclass
class Net:
    """A net in a hoop above the propellers, across the thrust axis [Yu2023catch, eqs 22 and 25].

    Attributes:
        height: () [m], height l of the hoop's centre above the propeller plane.
        radius: () [m], radius of the hoop.
        max_angle: () [rad], greatest angle theta_safe between the net's axis and the ball's
            reversed velocity.
    """

    height: Array
    radius: Array
    max_angle: Array


@struct.dataclass
class CatchChoice:
    """Which targets of a case to catch, in which order and about when; or a batch of choices.

    Attributes:
        order: (N,) int32, permutation: the targets to catch in their order, then the others.
        times: (N,) [s], first guess of the times of catches in that order, ascending.
        taken: (N,) bool, whether to catch each target; indices as in the case.
    """

    order: Array
    times: Array
    taken: Array


@struct.dataclass
class CatchCase(Located):
    """One case, or a batch: a quadrotor has to catch up to N flying targets in its net.

    Every number is a leaf of the pytree. Time 0 is when planning starts. The planner first replaces
    the order and the guessed times of catches, the fields `order` and `times`. Positions are
    relative to `origin`.

    Attributes:
        targets: paths of the N targets, with leaves that have a leading axis N.
        present: (N,) bool, whether each target exists; absent targets only pad the arrays.
        horizon: (N,) [s], latest time at which each target may be caught.
        order: (N,) int32, permutation: indices of the targets in the order of catching.
        times: (N,) [s], first guess of the times of catches in that order, ascending.
        head_state: (4, 3) position [m], velocity, acceleration and jerk of the quadrotor at time 0.
        gravity: () [m/s^2], magnitude of gravity.
        net: net of the quadrotor.
        limits: limits with a least and a greatest thrust [Yu2023catch, eqs 3d, 3e].
        extras: the user's further constraints and costs.
        optional: whether targets may be left out; the number of caught targets is then maximised.
        heading: requested heading of the quadrotor; None: 0.
    """

    rules: ClassVar[Table] = RULES
    positions: ClassVar[dict] = {"targets": (), "head_state": (0,)}

    targets: TargetPath
    present: Array
    horizon: Array
    order: Array
    times: Array
    head_state: Array
    gravity: Array
    net: Net
    limits: QuadrotorLimits
    extras: tuple[Extra, ...] = ()
    optional: bool = struct.field(pytree_node=False, default=False)
    heading: "Heading | None" = None

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the batch: () for one case, (B,) for a batch of B cases."""
        return np.shape(self.gravity)

    @property
    def num_targets(self) -> int:
        """Number N of targets, including absent targets, which only pad the arrays."""
        return np.shape(self.present)[-1]

    def with_choice(self, choice: CatchChoice) -> "CatchCase":
        """Return the case with a choice's order and times; targets not to catch become absent."""
        present = self.present & choice.taken
        return dataclasses.replace(self, order=choice.order, times=choice.times, present=present)


def case(
    targets: TargetPath,
    horizon,
    *,
    present: ArrayLike = True,
    robot: QuadrotorModel = PAPER_CATCHER,
    start=START,
    start_velocity=(0.0, 0.0, 0.0),
    start_acceleration=(0.0, 0.0, 0.0),
    start_attitude=None,
    heading=None,
    max_yaw_rate=None,
    gravity: ArrayLike = GRAVITY,
    net_height=None,
    net_radius=None,
    max_angle=None,
    speed=None,
    min_thrust=None,
    max_thrust=None,
    body_rate=None,
    min_height=None,
    rotor_drag=None,
    wind=None,
    extras: Sequence[Extra] = (),
    optional: bool = False,
    origin=None,
    dtype=jnp.float32,
) -> CatchCase:
    """Make one case with N targets to catch, or a batch, by default for the robot of [Yu2023catch].

    The paper states no limits of the robot. The defaults are a speed of 5 m/s, a body rate of
    5 rad/s, thrust from 0.3 to 2.5 times the weight, height >= 0.25 m, and theta_safe = 30 degrees.
    `order` is 0, 1, ..., N - 1, and `times` are equally spaced up to the first target's horizon;
    the planner first replaces both. `CaseError` is raised for an invalid number, `ValueError` for a
    wrong shape, `TypeError` for a wrong type.

    Inside compiled functions every number may be a traced array. Values are then not checked: an
    invalid one leads to the status `BAD_INPUT` of the plan. Shapes and types are checked, and a
    traced `start` has the origin (0, 0) by default.

    * `targets`: paths of the targets, such as a `BallPath`; leaves have leading axes (..., N).
    * `horizon`: (..., N) [s], latest time at which each target may be caught.
    * `present`: (..., N) bool, whether each target exists.
    * `robot`: quadrotor with a net. It supplies the numbers of arguments that are None.
    * `net_height`, `net_radius`: height l above the propeller plane and radius of the net [m].
    * `max_angle`: theta_safe [rad], greatest angle between net's axis and ball's reversed velocity.
    * `optional`: whether targets may be left out. The number of caught targets is then maximised.
    * `start`, `start_velocity`, `start_acceleration`: (..., 3), of the quadrotor at time 0; or
      `start_attitude`: (..., 4), quaternion w x y z from body to world, instead of the
      acceleration, for a thrust equal to the weight; `gravity`: [m/s^2], magnitude.
    * `heading`: requested heading of the quadrotor: an angle [rad], or one for each case; a pair of
      times (..., H) [s] and angles (..., H) [rad], linear in between; "velocity", along the
      horizontal velocity; or "ball", towards the next ball until its catch. None: 0. It starts at
      the heading of `start_attitude`, if any. `max_yaw_rate` [rad/s]: of this heading, default 2.
    * `speed` [m/s], `body_rate` [rad/s]: greatest values; `min_height` [m] of the propeller plane;
      `min_thrust`, `max_thrust` [m/s^2], per unit mass.
    * `rotor_drag` [1/s]: linear drag of the quadrotor per unit mass, by default the robot's: one
      number, or two numbers (..., 2) across and along the thrust; `wind`: (..., 3) [m/s].
    * `extras`: further constraints and costs such as `pj.KeepOut`; `dtype`: type of the numbers.
    * `origin`: (2,) x, y [m], world position that is subtracted from all positions in float64, by
      default the multiple of 100 m next to the first start. Positions in float64 are thus exact
      anywhere. Targets and extras whose class has no `positions` are not moved.
    """
    dtype, shape = floating(dtype), shape_of("horizon", horizon)
    if not shape or not shape[-1]:
        shown = "none" if shape else "one number"
        raise ArgumentError("horizon", "an entry for each target", verb="have", shown=shown)
    require_switch("optional", optional)
    batch, num = shape[:-1], shape[-1]
    shift = find_origin(start, origin, batch, dtype)
    near = functools.partial(move, by=None if shift is None else -shift, dtype=dtype)

    leaf = functools.partial(array_of, batch=batch, dtype=dtype)
    require_path("targets", targets, shape, 3, "horizon")
    tool = quadrotor.require_tool(robot, NET)
    motion = start_velocity, start_acceleration, start_attitude
    limits = {"speed": speed, "body_rate": body_rate, "min_height": min_height}
    limits |= {"min_thrust": min_thrust, "max_thrust": max_thrust}
    shares = np.arange(1, num + 1) / (num + 1.0)
    cases = CatchCase(
        targets=near("targets", targets, is_strict=origin is None),
        present=_broadcast_present(present, shape),
        horizon=leaf("horizon", horizon, num),
        order=jnp.asarray(np.broadcast_to(np.arange(num, dtype=np.int32), shape), jnp.int32),
        times=leaf("horizon", shares * numbers_of("horizon", horizon, batch, (num,))[..., :1], num),
        head_state=quadrotor.start_state(near("start", start), motion, gravity, batch, dtype),
        gravity=leaf("gravity", gravity),
        net=Net(
            height=leaf("net_height", tool.height if net_height is None else net_height),
            radius=leaf("net_radius", tool.radius if net_radius is None else net_radius),
            max_angle=leaf("max_angle", tool.max_angle if max_angle is None else max_angle),
        ),
        limits=quadrotor.limits_of(robot, leaf, (rotor_drag, wind), **limits),
        extras=for_batch(near("extras", extras, is_strict=origin is None), batch, dtype),
        optional=optional,
        origin=None if shift is None else leaf("origin", shift, 2),
    )
    cases = quadrotor.add_heading(cases, leaf, heading, max_yaw_rate, start_attitude)
    require_sound(cases, _ARGUMENTS)
    return quadrotor.check_start(cases)


def _broadcast_present(present: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = to_host(numeric(present))
    if array.dtype != np.bool_:
        raise ArgumentTypeError("present", "True or False of each target", present)
    if array.shape not in ((), shape[-1:], shape):
        raise ArgumentError("present", f"the shape {shape}", array.shape, verb="have")
    return jnp.asarray(numpy_of(array).broadcast_to(array, shape), bool)
