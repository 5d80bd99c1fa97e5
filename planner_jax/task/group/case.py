"""Cases of the task `group`: one car has to meet several targets, which extends [Qu2022]."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from numpy.typing import ArrayLike

from planner_jax.core.checks import numeric, shape_of
from planner_jax.core.errors import ArgumentError
from planner_jax.core.paths import require_path
from planner_jax.core.rules import PERMUTATION, Field, Table
from planner_jax.plane.obstacles import move_on
from planner_jax.plane.target import LaterPath, PlanePath
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.case import case as single_case

# Shapes, types and ranges that `pj.require_sound` checks for the arrays of an `InterceptGroup`.
RULES: Table = (
    Field("present", ("N",), kind=np.bool_),
    Field("order", ("N",), PERMUTATION, kind=np.integer),
)


@struct.dataclass
class GroupChoice:
    """The order in which one car meets its N targets, or a batch of orders."""

    order: Array  # (N,) int32, permutation of target indices; targets that exist come first


@struct.dataclass
class CarState:
    """State of a car: pose, speed, and curvature of its path."""

    pose: Array  # (3,) x [m], y [m] of the rear axle's middle and heading [rad]
    speed: Array  # () [m/s], of the rear axle's middle
    curvature: Array  # () [1/m], of the path of the rear axle's middle


@struct.dataclass
class InterceptGroup:
    """One case: a car and the group of N targets that it has to meet; or a batch of cases.

    Every number is a leaf of the pytree. The middle of the car's body must come within
    `shared.tolerance` of every target. If `shared` restricts the heading at a meeting, the
    restriction applies to every meeting.

    Attributes:
        shared: car, obstacles, map and the targets' paths. The leaves of `shared.target` have a
            leading axis N. All targets must be met before `shared.time` [s].
        present: (N,) bool, whether each target exists; absent targets only pad the arrays.
        order: (N,) int32, permutation: indices of the targets in the order of the meetings.
    """

    rules: ClassVar[Table] = RULES

    shared: InterceptCase
    present: Array
    order: Array

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the batch: () for one case, (B,) for a batch of B cases."""
        return self.shared.batch_shape

    @property
    def num_targets(self) -> int:
        """Number N of targets, including absent targets, which only pad the arrays."""
        return np.shape(self.present)[-1]

    def with_choice(self, choice: GroupChoice) -> "InterceptGroup":
        """Return the case, or the batch, with the order of targets that `choice` holds."""
        return dataclasses.replace(self, order=choice.order)

    def leg(self, target: Array, begin: Array, car: CarState) -> InterceptCase:
        """Return the case of the drive to one target, from the state `car` at time `begin` [s]."""
        shared = self.shared
        path = jax.tree.map(lambda leaf: leaf[target], shared.target)
        movers = shared.movers
        return dataclasses.replace(
            shared,
            start=car.pose,
            speed=car.speed,
            curvature=car.curvature,
            target=LaterPath(path=path, begin=begin),
            # Remaining time [s]: at least 1 ms, because the time of a case must be positive.
            time=jnp.maximum(shared.time - begin, 1e-3),
            movers=move_on(movers, begin),
            earliest=jnp.maximum(shared.earliest - begin, 0.0),
        )


def case(
    targets: PlanePath, time: ArrayLike = 15.0, *, present: ArrayLike = True, **settings: Any
) -> InterceptGroup:
    """Make a case with a group of N targets, or a batch of cases.

    Car and map have the defaults of `pj.intercept.case`, from [Qu2022]. The order is 0, 1, ...,
    N - 1; a planner replaces it by the order that it decides.

    Args:
        targets: paths of targets, such as a `TurningPath`; leaves have leading axes (N,), (B, N).
        time: () [s], time before which all targets must be met, or (B,) for B cases.
        present: () or (N,) or (B, N) bool, whether each target exists.
        **settings: arguments of `pj.intercept.case`, such as the car's `start` and `speed`,
            obstacles `walls` and `movers`, and the `tolerance` [m] of a meeting.

    Raises:
        TypeError: an argument has a wrong type, or `pj.intercept.case` has no such argument.
        ValueError: a number breaks a rule, a shape is wrong, or edges of an obstacle cross.
    """
    shapes = [shape_of("start", settings.get("start", 0.0))[:-1], shape_of("time", time)]
    shapes += [shape_of(each, settings.get(each, 0.0)) for each in ("initial_speed", "tolerance")]
    axis, leaves = len(max(shapes, key=len)), jax.tree.leaves(targets)
    if not leaves or any(np.ndim(leaf) <= axis or np.shape(leaf)[axis] == 0 for leaf in leaves):
        raise ArgumentError("targets", f"paths with {axis + 1} axes in front", targets)
    one = jax.tree.map(lambda leaf: np.asarray(leaf).take(0, axis), targets)
    shared = single_case(one, time, **settings)
    batch, num = shared.batch_shape, np.shape(leaves[0])[axis]
    require_path("targets", targets, (*batch, num), 2)
    exists = numeric(present)
    shapes = (), (num,), (*batch, num)
    if exists is None or exists.dtype != np.bool_ or exists.shape not in shapes:
        raise ArgumentError("present", f"True or False of {num} targets", present)
    return InterceptGroup(
        shared=dataclasses.replace(shared, target=targets),
        present=jnp.asarray(np.broadcast_to(exists, (*batch, num)), exists.dtype),
        order=jnp.asarray(
            np.broadcast_to(np.arange(num, dtype=np.int32), (*batch, num)), jnp.int32
        ),
    )
