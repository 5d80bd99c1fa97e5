"""Paths of targets in space: position and velocity as functions of time.

A target path is a pytree with a method `at(time)`, differentiable in time and in every leaf, that
returns a `BallState` or a position. The classes of this module cover the targets of [Yu2023catch].
Users may write classes of their own.
"""

from typing import ClassVar, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.ball.linear_drag import linear_drag_flight
from planner_jax.core.rules import NOT_NEGATIVE, Field, Table


@runtime_checkable
class TargetPath(Protocol):
    """Interface of a target's path, as the planner of catches uses it."""

    def at(self, time: Array) -> BallState | Array:
        """Return position (3,) [m], or position and velocity [m/s], at one time () [s]."""
        ...


def state_at(path: TargetPath, time: Array) -> BallState:
    """Return a target's state at a time () [s]; if `at` returns a position, differentiate it."""
    state = path.at(time)
    if isinstance(state, BallState):
        return state
    pos, vel = jax.jvp(path.at, (time,), (jnp.ones_like(time),))
    return BallState(pos=pos, vel=vel)


@struct.dataclass
class BallPath:
    """Path of a ball with drag acceleration -K_i v_i on each axis i [Yu2023catch, eq. 9a].

    Attributes:
        ball: position and velocity of the ball at time 0.
        drag: (3,) [1/s], drag coefficients K_i of the axes.
        gravity: () [m/s^2], magnitude of gravity.
    """

    rules: ClassVar[Table] = (
        Field("ball.pos", (3,)),
        Field("ball.vel", (3,)),
        Field("drag", (3,), NOT_NEGATIVE),
        Field("gravity", (), NOT_NEGATIVE),
    )
    positions: ClassVar[dict] = {"ball": ()}

    ball: BallState
    drag: Array
    gravity: Array

    def at(self, time: Array) -> BallState:
        """Return position [m] and velocity [m/s] at one time () [s]."""
        return linear_drag_flight(self.ball, time, self.drag, self.gravity)


@struct.dataclass
class HarmonicPath:
    """A target that drifts and oscillates, p_0 + v t + A sin(w t + phi) [Yu2023catch, VII-B b].

    Attributes:
        pos: (3,) [m], the point p_0.
        vel: (3,) [m/s], velocity v of the drift.
        amplitude: (3,) [m], amplitude A.
        rate: () [rad/s], angular frequency w.
        phase: () [rad], phase phi.
    """

    rules: ClassVar[Table] = (
        *(Field(name, (3,)) for name in ("pos", "vel", "amplitude")),
        *(Field(name, ()) for name in ("rate", "phase")),
    )
    positions: ClassVar[dict] = {"pos": ()}

    pos: Array
    vel: Array
    amplitude: Array
    rate: Array
    phase: Array

    def at(self, time: Array) -> BallState:
        """Return position [m] and velocity [m/s] at one time () [s]."""
        angle = self.rate * time + self.phase
        return BallState(
            pos=self.pos + self.vel * time + self.amplitude * jnp.sin(angle),
            vel=self.vel + self.amplitude * self.rate * jnp.cos(angle),
        )
