"""Several targets for one car, met one after another in an order to be decided.

[Qu2022] meets one target and names groups as future work; what is here is this library's.
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

# What the numbers of a case must be.
RULES: Table = (
    Field("present", ("N",), kind=np.bool_),
    Field("order", ("N",), PERMUTATION, kind=np.integer),
)


@struct.dataclass
class GroupChoice:
    """What a decision settles of a group."""

    order: Array  # (N,) int32, a permutation, present targets first


@struct.dataclass
class CarState:
    """Where a car is, and how it moves."""

    pose: Array  # (3,) x [m], y [m] of the rear axle's middle and heading [rad]
    speed: Array  # () [m/s]
    curvature: Array  # () [1/m]


@struct.dataclass
class InterceptGroup:
    """One group. Every number is a leaf: batch it, randomise it.

    What goes for an `InterceptCase` goes for every target: the body's middle meets it, within the
    same tolerance and with the same heading if one is given.
    """

    rules: ClassVar[Table] = RULES

    # Car, obstacles and map. Its `target` has leaves with a leading axis N, and all are to be met
    # until its `time`.
    shared: InterceptCase
    present: Array  # (N,) bool, which of the N targets there are
    order: Array  # (N,) int32, a permutation: which target is met first, second, ...

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """() for one group, (B,) for a batch."""
        return self.shared.batch_shape

    @property
    def num_targets(self) -> int:
        """N, the number of targets that the shape holds."""
        return np.shape(self.present)[-1]

    def with_choice(self, choice: GroupChoice) -> "InterceptGroup":
        """The group, or the batch, with an order."""
        return dataclasses.replace(self, order=choice.order)

    def leg(self, target: Array, begin: Array, car: CarState) -> InterceptCase:
        """Return the interception of a target, by its index () int, from a time () [s] on.

        Its times count from then; the car is where it is then.
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
            # Never nothing: what is left of the time may be used up.
            time=jnp.maximum(shared.time - begin, 1e-3),
            movers=dataclasses.replace(movers, centre=movers.centre + begin * movers.velocity),
        )


def case(
    targets: PlanePath, time: ArrayLike = 15.0, *, present: ArrayLike = True, **settings: Any
) -> InterceptGroup:
    """Return a group, or a batch, by default with the car and the map of `pj.intercept.case`.

    The order is a placeholder until a decision sets it: the targets as they come. `targets` is a
    path pytree such as `TurningPath`, leaves with axes (..., N) first, `present` is (N,) or (B, N)
    bool, and all targets are to be met until `time`. `pj.intercept.case` describes the settings,
    such as `start` and `walls`, and the errors.
    """
    given = [settings.get(name, 0.0) for name in ("initial_speed", "tolerance")]
    shapes = [np.shape(time), np.shape(settings.get("start", 0.0))[:-1], *map(np.shape, given)]
    axis, leaves = len(max(shapes, key=len)), jax.tree.leaves(targets)
    if not leaves or any(np.ndim(leaf) <= axis for leaf in leaves):
        raise ArgumentError("targets", f"paths with {axis + 1} axes in front", targets)
    one = jax.tree.map(lambda leaf: np.asarray(leaf).take(0, axis), targets)
    shared = single_case(one, time, **settings)
    batch, num = shared.batch_shape, np.shape(leaves[0])[axis]
    require_path("targets", targets, (*batch, num), 2)
    there = np.asarray(present)
    if there.dtype != np.bool_ or there.shape not in ((), (num,), (*batch, num)):
        raise ArgumentError("present", f"True or False of {num} targets", present)
    return InterceptGroup(
        shared=dataclasses.replace(shared, target=targets),
        present=jnp.asarray(np.broadcast_to(there, (*batch, num))),
        order=jnp.asarray(np.broadcast_to(np.arange(num), (*batch, num)), jnp.int32),
    )
