"""Cases of the task `team`: several quadrotors, the targets that they share, and a distance."""

import dataclasses
import functools
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.typing import ArrayLike

from planner_jax.ball.target import TargetPath
from planner_jax.core.arithmetic import Numbers, numpy_of
from planner_jax.core.checks import shape_of
from planner_jax.core.errors import ArgumentError
from planner_jax.core.origin import NEAR, move
from planner_jax.core.rules import POSITIVE, Field, Rule, Table, require_sound
from planner_jax.task import quadrotor
from planner_jax.task.arguments import array_of
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.case import case as catch_case


def _are_apart(states: Numbers, case: "TeamCase") -> Numbers:
    pos, xp = states[..., 0, :], numpy_of(states)
    away = ((pos[..., :, None, :] - pos[..., None, :, :]) ** 2).sum(-1) ** 0.5
    apart = (away >= case.least_distance[..., None, None]) | np.eye(pos.shape[-2], dtype=bool)
    return xp.broadcast_to(apart.all(-1)[..., None, None], states.shape)


LEAST_DISTANCE = 1.0  # [m], between the centres of two robots
# Shapes and ranges that `pj.require_sound` checks for the arrays of a `TeamCase`.
RULES: Table = (
    Field("head_states", ("N", 4, 3), NEAR),
    Field("least_distance", (), POSITIVE),
    Field("head_states", ("N", 4, 3), Rule("of robots least_distance apart", _are_apart)),
)


@struct.dataclass
class TeamCase:
    """One case, or a batch: N quadrotors catch the targets of one catch case together.

    A target may be left out, and no target is caught twice. The distance between the centres of any
    two robots is at least `least_distance` from time 0 until all robots stand still.

    Attributes:
        shared: targets, net and limits, which all robots share. Its `head_state` is the first
            robot's.
        head_states: (N, 4, 3) position [m], velocity, acceleration and jerk of the robots at time
            0.
        least_distance: () [m], least distance between the centres of the propeller planes of two
            robots.
    """

    rules: ClassVar[Table] = RULES

    shared: CatchCase
    head_states: Array
    least_distance: Array

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the batch: () for one case, (B,) for a batch of B cases."""
        return self.shared.batch_shape

    @property
    def num_robots(self) -> int:
        """Number N of robots."""
        return np.shape(self.head_states)[-3]

    def of_robot(self, k: int, **fields: object) -> CatchCase:
        """Return the catch case, or the batch, of robot `k`, with other values of some fields."""
        return dataclasses.replace(self.shared, head_state=self.head_states[..., k, :, :], **fields)


def case(
    targets: TargetPath,
    horizon: ArrayLike,
    starts: ArrayLike,
    *,
    least_distance: ArrayLike = LEAST_DISTANCE,
    **settings: Any,
) -> TeamCase:
    """Make one case in which N quadrotors share M targets, or a batch, by default of [Yu2023catch].

    Every target is optional, and the number of caught targets is maximised.

    `CaseError` is raised for an invalid number, such as starts that are too near to each other.

    * `targets`, `horizon`: as for `pj.catch.case`, with leading axes (..., M).
    * `starts`: (..., N, 3) [m], positions at which the robots hover at time 0.
    * `least_distance`: () or (B,) [m], between the centres of any two robots at any time.
    * `settings`: other arguments of `pj.catch.case`, such as `present`, `robot` and `speed`.
    """
    shape = shape_of("starts", starts)
    if len(shape) < 2 or 0 in shape[-2:]:
        raise ArgumentError("starts", "the shape (..., N, 3)", shape, verb="have")
    starts = np.asarray(starts)
    shared = catch_case(targets, horizon, start=starts[..., 0, :], optional=True, **settings)
    batch, dtype, shift = shared.batch_shape, shared.gravity.dtype, shared.origin
    moved = move("starts", starts, None if shift is None else -np.asarray(shift, float), dtype)
    leaf = functools.partial(array_of, batch=batch, dtype=dtype)
    pos = leaf("starts", moved, *shape[-2:])[..., None, :]
    heads = jnp.concatenate([pos, jnp.zeros((*pos.shape[:-2], 3, 3), dtype)], axis=-2)
    cases = TeamCase(shared, heads, leaf("least_distance", least_distance))
    require_sound(cases, {"head_states": "starts"})
    for k in range(cases.num_robots):
        quadrotor.check_start(cases.of_robot(k))
    return cases
