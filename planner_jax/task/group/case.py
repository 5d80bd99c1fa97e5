"""The case of a group: one car meets several targets in an order that a decision selects.

[Qu2022] meets one target and names groups as future work; groups are this library's extension.
"""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from numpy.typing import ArrayLike

from planner_jax.core.checks import require_path
from planner_jax.core.errors import ArgumentError
from planner_jax.core.rules import PERMUTATION, Field, Table
from planner_jax.plane.target import LaterPath, PlanePath
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.case import case as single_case

# Shapes, types and ranges of the leaves of a case.
RULES: Table = (
    Field("present", ("N",), kind=np.bool_),
    Field("order", ("N",), PERMUTATION, kind=np.integer),
)


@struct.dataclass
class GroupChoice:
    """The decision about one group, or about a batch."""

    order: Array  # (N,) int32, a permutation, present targets first


@struct.dataclass
class CarState:
    """Pose, speed and curvature of a car."""

    pose: Array  # (3,) x [m], y [m] of the rear axle's middle and heading [rad]
    speed: Array  # () [m/s]
    curvature: Array  # () [1/m]


@struct.dataclass
class InterceptGroup:
    """The case of one group, or a batch; every number is a leaf of the pytree.

    The body's middle has to meet every target as in an `InterceptCase`, with the same tolerance
    and, if it is not free, the same heading.
    """

    rules: ClassVar[Table] = RULES

    # Car, obstacles and map. The leaves of `shared.target` have a leading axis N. All targets must
    # be met before `shared.time`.
    shared: InterceptCase
    present: Array  # (N,) bool, whether each of the N targets exists
    order: Array  # (N,) int32, a permutation: index of the first target to meet, the second, ...

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """() for one group, (B,) for a batch."""
        return self.shared.batch_shape

    @property
    def num_targets(self) -> int:
        """N, the number of present and absent targets."""
        return np.shape(self.present)[-1]

    def with_choice(self, choice: GroupChoice) -> "InterceptGroup":
        """Return the group, or the batch, with the order of a choice."""
        return dataclasses.replace(self, order=choice.order)

    def leg(self, target: Array, begin: Array, car: CarState) -> InterceptCase:
        """Return the interception of the target with an index () int that starts at a time () [s].

        The times of the interception count from `begin`; `car` is the car's state at `begin`.
        """
        shared = self.shared
        path = jax.tree.map(lambda leaf: leaf[target], shared.target)
        movers = shared.movers
        return dataclasses.replace(
            shared,
            start=car.pose,
            speed=car.speed,
            curvature=car.curvature,
            target=LaterPath(path=path, begin=begin),
            # Positive even if no time is left.
            time=jnp.maximum(shared.time - begin, 1e-3),
            movers=dataclasses.replace(movers, centre=movers.centre + begin * movers.velocity),
        )


def case(
    targets: PlanePath, time: ArrayLike = 15.0, *, present: ArrayLike = True, **settings: Any
) -> InterceptGroup:
    """Make a group, or a batch, by default with the car and the map of `pj.intercept.case`.

    The order is 0, 1, ..., N - 1 until a decision sets it.

    Args:
        targets: a path pytree such as `TurningPath`, leaves with axes (..., N) first.
        time: () or (B,) [s], by which all targets must be met.
        present: () or (N,) or (B, N) bool, whether each target exists.
        **settings: arguments of `pj.intercept.case`, such as `start` and `walls`.

    Raises:
        TypeError, ValueError: as for `pj.intercept.case`.
    """
    scalars = [settings.get(name, 0.0) for name in ("initial_speed", "tolerance")]
    shapes = [np.shape(time), np.shape(settings.get("start", 0.0))[:-1], *map(np.shape, scalars)]
    axis, leaves = len(max(shapes, key=len)), jax.tree.leaves(targets)
    if not leaves or any(np.ndim(leaf) <= axis for leaf in leaves):
        raise ArgumentError("targets", f"paths with {axis + 1} axes in front", targets)
    one = jax.tree.map(lambda leaf: np.asarray(leaf).take(0, axis), targets)
    shared = single_case(one, time, **settings)
    batch, num = shared.batch_shape, np.shape(leaves[0])[axis]
    require_path("targets", targets, (*batch, num), 2)
    exists = np.asarray(present)
    if exists.dtype != np.bool_ or exists.shape not in ((), (num,), (*batch, num)):
        raise ArgumentError("present", f"True or False of {num} targets", present)
    return InterceptGroup(
        shared=dataclasses.replace(shared, target=targets),
        present=jnp.asarray(np.broadcast_to(exists, (*batch, num))),
        order=jnp.asarray(np.broadcast_to(np.arange(num), (*batch, num)), jnp.int32),
    )
