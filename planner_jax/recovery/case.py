"""Case of a recovery: a quadrotor's trajectory from the end of a plan to standstill."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.core.rules import POSITIVE, Field, Table
from planner_jax.cost.extras import Extra
from planner_jax.robot.quadrotor import QuadrotorLimits
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate


@struct.dataclass
class RecoveryCase:
    """The start and limits of one recovery trajectory, or of a batch; all numbers are leaves."""

    rules: ClassVar[Table] = (
        Field("head_state", (4, 3)),
        Field("home", (3,)),
        Field("gravity", (), POSITIVE),
    )

    head_state: Array  # (4, 3) position, velocity, acceleration, jerk of the quadrotor at time 0
    home: Array  # (3,) [m], position of standstill for a planner with `to="home"`
    gravity: Array  # () [m/s^2], magnitude
    limits: QuadrotorLimits
    extras: tuple[Extra, ...] = ()  # limits and costs of the user, see `cost.extras`

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape () for one case, or (B,) for a batch of B cases."""
        return np.shape(self.gravity)


def end_state(path: PiecewisePolynomial) -> Array:
    """Return the state (4, 3), position to jerk, at the end of the last piece that lasts > 0 s."""
    last = jnp.max(jnp.where(path.durations > 0.0, jnp.arange(path.durations.size), 0))
    piece = PiecewisePolynomial(path.coeffs[last][None], path.durations[last][None])
    return jnp.stack([evaluate(piece, path.durations[last], order) for order in range(4)])
