"""One catch to plan: up to N targets, the quadrotor, its net and its limits."""

import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import PyTree

from planner_jax.ball.target import TargetPath
from planner_jax.core.arithmetic import Numbers
from planner_jax.core.checks import floating, require_path, require_switch, shape_of
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.rules import (
    PERMUTATION,
    POSITIVE,
    Field,
    Rule,
    Table,
    require_sound,
    within,
)
from planner_jax.cost.extras import Extra, for_batch
from planner_jax.robot.quadrotor import QuadrotorLimits
from planner_jax.robot.quadrotor_model import NET, PAPER_CATCHER, QuadrotorModel
from planner_jax.task.arguments import array_of
from planner_jax.task.quadrotor import (
    ARGUMENTS,
    FLIGHT_RULES,
    hover_at,
    limits_of,
    require_start,
    require_tool,
)


def _is_ahead(horizon: Numbers, case: PyTree) -> Numbers:
    return (horizon > 0.0) | ~case.present


# Shapes and rules of the numbers of a case.
RULES: Table = (
    Field("present", ("N",), kind=np.bool_),
    Field("horizon", ("N",), Rule("> 0 of a target that is present", _is_ahead)),
    Field("order", ("N",), PERMUTATION, kind=np.integer),
    Field("times", ("N",)),
    Field("head_state", (4, 3)),
    Field("gravity", (), POSITIVE),
    Field("net.height", ()),
    Field("net.radius", (), POSITIVE),
    Field("net.max_angle", (), within(0.0, np.pi, "in [0, pi]")),
    *FLIGHT_RULES,
    Field("limits.min_height", ()),
)
GRAVITY = 9.81  # [m/s^2]
START = (0.0, 0.0, 1.0)  # [m], hover position of the quadrotor
_ARGUMENTS = {
    **ARGUMENTS,
    **{f"net.{name}": f"net_{name}" for name in ("height", "radius")},
    "net.max_angle": "max_angle",
}


@struct.dataclass
class Net:
    """A hoop above the propellers, normal to the thrust [Yu2023catch, eqs 22 and 25]."""

    height: Array  # () l [m], of the hoop's centre above the propeller plane
    radius: Array  # () [m]
    # () theta_safe [rad], between the net's axis and the reversed velocity of the ball
    max_angle: Array


@struct.dataclass
class CatchChoice:
    """A decision's choice for one case, or for a batch."""

    order: Array  # (N,) int32, permutation: the caught targets in their order, then the others
    times: Array  # (N,) [s], rising, of catches in that order, before the optimisation
    taken: Array  # (N,) bool, whether to catch each target, in the order of the case


@struct.dataclass
class CatchCase:
    """One catch to plan, or a batch of catches. Every number is a leaf of the pytree.

    Time 0 is when planning starts. A decision sets `order` and `times`.
    """

    rules: ClassVar[Table] = RULES

    targets: TargetPath  # leaves with a leading axis N
    present: Array  # (N,) bool, whether each target exists; absent targets fill up the shape
    horizon: Array  # (N,) [s], latest time at which each target may be caught
    order: Array  # (N,) int32, permutation: indices of the targets in the order of catching
    times: Array  # (N,) [s], first guess of the times of catches in that order, rising
    head_state: Array  # (4, 3) position, velocity, acceleration, jerk of the quadrotor at time 0
    gravity: Array  # () [m/s^2], magnitude
    net: Net
    limits: QuadrotorLimits  # with a least and a greatest thrust [Yu2023catch, eqs 3d, 3e]
    extras: tuple[Extra, ...] = ()  # the user's constraints and costs, see `cost.extras`
    # Whether targets may be left out; the number of caught targets is then maximised.
    optional: bool = struct.field(pytree_node=False, default=False)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """() for one case, (B,) for a batch."""
        return np.shape(self.gravity)

    @property
    def num_targets(self) -> int:
        """N, the number of targets, present or absent."""
        return np.shape(self.present)[-1]

    def with_choice(self, choice: CatchChoice) -> "CatchCase":
        """Return the case, or the batch, with the order, times and targets of a choice."""
        present = self.present & choice.taken
        return dataclasses.replace(self, order=choice.order, times=choice.times, present=present)


def case(
    targets: TargetPath,
    horizon,
    *,
    present: ArrayLike = True,
    robot: QuadrotorModel = PAPER_CATCHER,
    start=START,
    gravity: ArrayLike = GRAVITY,
    net_height=None,
    net_radius=None,
    max_angle=None,
    speed=None,
    min_thrust=None,
    max_thrust=None,
    body_rate=None,
    min_height=None,
    extras: Sequence[Extra] = (),
    optional: bool = False,
    dtype=jnp.float32,
) -> CatchCase:
    """Make a catch, or a batch of catches, by default for the robot of [Yu2023catch].

    The paper gives no limits. The defaults are |v| <= 5 m/s, |omega| <= 5 rad/s, thrust from 0.3 g
    to 2.5 g, height >= 0.25 m and theta_safe = 30 degrees. Until a decision sets them, `order` is
    0, 1, ..., N - 1 and the times are equally spaced up to the first horizon.

    Further arguments and the errors are as in `pj.hit.case`.

    * `targets`: path pytree whose leaves have leading axes (..., N).
    * `horizon`: (..., N) [s], latest time at which each target may be caught.
    * `present`: (..., N) bool, whether each target exists.
    * `robot`: quadrotor with a net. Arguments that are None take the robot's numbers.
    * `net_height`, `net_radius`: height l above the propeller plane and radius of the net [m].
    * `max_angle`: theta_safe [rad].
    * `optional`: whether targets may be left out; the number of caught ones is then maximised.
    """
    dtype, shape = floating(dtype), shape_of("horizon", horizon)
    if not shape or not shape[-1]:
        shown = "none" if shape else "one number"
        raise ArgumentError("horizon", "an entry for each target", verb="have", shown=shown)
    require_switch("optional", optional)
    batch, num = shape[:-1], shape[-1]

    def leaf(name: str, value: object, *trailing: int) -> Array:
        return array_of(name, value, batch, trailing, dtype)

    require_path("targets", targets, shape, 3, "horizon")
    tool = require_tool(robot, NET)
    shares = np.arange(1, num + 1) / (num + 1.0)
    cases = CatchCase(
        targets=targets,
        present=_broadcast_present(present, shape),
        horizon=leaf("horizon", horizon, num),
        order=jnp.asarray(np.broadcast_to(np.arange(num), shape), jnp.int32),
        times=leaf("horizon", shares * np.asarray(horizon)[..., :1], num),
        head_state=hover_at(start, batch, dtype),
        gravity=leaf("gravity", gravity),
        net=Net(
            height=leaf("net_height", tool.height if net_height is None else net_height),
            radius=leaf("net_radius", tool.radius if net_radius is None else net_radius),
            max_angle=leaf("max_angle", tool.max_angle if max_angle is None else max_angle),
        ),
        limits=limits_of(
            robot,
            leaf,
            speed=speed,
            min_thrust=min_thrust,
            max_thrust=max_thrust,
            body_rate=body_rate,
            min_height=min_height,
        ),
        extras=for_batch(extras, batch, dtype),
        optional=optional,
    )
    require_sound(cases, _ARGUMENTS)
    require_start(cases)
    return cases


def _broadcast_present(present: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return the argument `present` in the shape (..., N) of the horizon."""
    array = np.asarray(present)
    if array.dtype != np.bool_:
        raise ArgumentTypeError("present", "True or False of each target", present)
    if array.shape not in ((), shape[-1:], shape):
        raise ArgumentError("present", f"the shape {shape}", array.shape, verb="have")
    return jnp.asarray(np.broadcast_to(array, shape), bool)
