"""Paths of targets in the plane: classes that return position and velocity at a time.

A path is a pytree with a method `at(time) -> PointState`, differentiable in time and in every leaf.
The classes here cover the targets of [Qu2022], and polynomials fitted to observed positions of a
target. Users may write classes of their own. World frame in the plane, SI units.
"""

import dataclasses
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import PyTree


@struct.dataclass
class PointState:
    """Position and velocity of a point in the plane."""

    pos: Array  # (2,) [m]
    vel: Array  # (2,) [m/s]


class PlanePath(Protocol):
    """Interface of a target's path in the plane, as the planners of interceptions use it."""

    def at(self, time: Array) -> PointState:
        """Return position [m] and velocity [m/s] at one time () [s]."""
        ...


@struct.dataclass
class TurningPath:
    """A target of constant speed whose direction turns at a constant rate, which may be 0.

    It covers the two modes of motion of [Qu2022, Section V-A], straight and turning.

    Attributes:
        pos: (2,) [m], position at time 0.
        vel: (2,) [m/s], velocity at time 0.
        turn_rate: () [rad/s], rate of the velocity's direction, positive to the left.
    """

    pos: Array
    vel: Array
    turn_rate: Array

    def at(self, time: Array) -> PointState:
        """Return position [m] and velocity [m/s] at one time () [s]."""
        ahead, aside = arc(self.turn_rate, time)
        left = jnp.stack([-self.vel[1], self.vel[0]])
        cos, sin = jnp.cos(self.turn_rate * time), jnp.sin(self.turn_rate * time)
        return PointState(
            pos=self.pos + ahead * self.vel + aside * left, vel=cos * self.vel + sin * left
        )


@struct.dataclass
class PolynomialPath:
    """Path of a target: a polynomial of degree n in time on each axis [Qu2022, eq. 9].

    Attributes:
        coeffs: (n + 1, 2) [m/s^k], coefficients in ascending powers k of the time.
        origin: () [s], time from which the powers count.
    """

    coeffs: Array
    origin: Array

    def at(self, time: Array) -> PointState:
        """Return position [m] and velocity [m/s] at one time () [s]."""
        passed = time - self.origin
        pos = vel = jnp.zeros_like(self.coeffs[0])
        for row in self.coeffs[::-1]:
            pos, vel = pos * passed + row, vel * passed + pos
        return PointState(pos=pos, vel=vel)


@struct.dataclass
class ControlledPath:
    """A target whose velocity changes by a control input at equal steps in time [Qu2022, eq. 3].

    With the position x_k, the velocity v_k and the control u_k at the time k h, the recursion is
    x_{k+1} = x_k + h v_k and v_{k+1} = v_k + u_k. The path is straight between these times, before
    time 0, and after the last of the K controls.

    Attributes:
        state: (4,) x, y [m] and their derivatives [m/s] at time 0.
        controls: (K, 2) [m/s], control inputs u_0 to u_{K-1}.
        step: () [s], step h, > 0.
    """

    state: Array
    controls: Array
    step: Array

    def at(self, time: Array) -> PointState:
        """Return position [m] and velocity [m/s], right-continuous, at one time () [s]."""
        numbers = jnp.arange(1, len(self.controls) + 1, dtype=self.controls.dtype)
        passed = (time - self.step * numbers)[:, None]
        changes = jnp.where(passed >= 0.0, self.controls, 0.0)
        start, vel = self.state[:2], self.state[2:]
        pos = start + time * vel + jnp.sum(passed * changes, axis=0)
        return PointState(pos=pos, vel=vel + jnp.sum(changes, axis=0))


@struct.dataclass
class PositionPath:
    """A path whose velocity is the derivative of the positions that another path returns."""

    path: PyTree  # a pytree whose method `at(time)` returns a position (2,) [m]

    def at(self, time: Array) -> PointState:
        """Return position [m] and velocity [m/s] at one time () [s]."""
        return PointState(*jax.jvp(self.path.at, (time,), (jnp.ones_like(time),)))


@struct.dataclass
class ScaledPath:
    """A path in another frame and in other units of length and time."""

    path: PlanePath
    frame: Array  # (3,) x [m], y [m] and heading [rad] of the frame in the world of `path`
    length: Array  # () [m], unit of length
    time: Array  # () [s], unit of time

    def at(self, time: Array) -> PointState:
        """Return position and velocity at one time (), all in the units."""
        state = self.path.at(time * self.time)
        pos = rotate(state.pos - self.frame[:2], -self.frame[2]) / self.length
        return PointState(pos, rotate(state.vel, -self.frame[2]) * (self.time / self.length))


def rotate(vectors: Array, angle: Array) -> Array:
    """Rotate vectors (..., 2) counter-clockwise by an angle () [rad]."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


@struct.dataclass
class LaterPath:
    """A path with a later time origin: its time 0 is the time `begin` of another path."""

    path: PlanePath
    begin: Array  # () [s], time of `path` at which this path has time 0

    def at(self, time: Array) -> PointState:
        """Return position [m] and velocity [m/s] at one time () [s] after `begin`."""
        return self.path.at(self.begin + time)


@struct.dataclass
class FadingPath:
    """A path whose velocity is a sum of J velocities that turn and decay, such as a predicted path.

    The time t counts from the last observation. For t >= 0 the velocity is the sum of
    vel_j exp(-rate_j t), turned by the angle turn_rate_j t. For t < 0 the path is straight.
    """

    pos: Array  # (2,) [m], at the last observation
    vel: Array  # (J, 2) [m/s]
    rate: Array  # (J,) [1/s], >= 0
    turn_rates: Array  # (J,) [rad/s], positive to the left
    ahead: Array  # () [s], time from the last observation to the path's time 0

    def at(self, time: Array) -> PointState:
        """Return position [m] and velocity [m/s] at one time () [s]."""
        passed = self.ahead + time
        after = jnp.maximum(passed, 0.0)
        decay, angle = self.rate * after, self.turn_rates * after
        left = jnp.exp(-decay)
        cos, sin = left * jnp.cos(angle), left * jnp.sin(angle)
        # Displacement divided by velocity and time: (1 - exp(-z)) / z with z = decay - i angle.
        square = decay**2 + angle**2
        small = square < 1e-4
        safe = jnp.where(small, 1.0, square)
        ahead = (decay * (1.0 - cos) + angle * sin) / safe
        aside = (angle * (1.0 - cos) - decay * sin) / safe
        ahead = jnp.where(small, 1.0 - decay / 2.0 + (decay**2 - angle**2) / 6.0, ahead)
        aside = jnp.where(small, angle / 2.0 - decay * angle / 3.0, aside)
        across = jnp.stack([-self.vel[:, 1], self.vel[:, 0]], axis=-1)
        way = jnp.sum(ahead[:, None] * self.vel + aside[:, None] * across, axis=0)
        vel = jnp.sum(cos[:, None] * self.vel + sin[:, None] * across, axis=0)
        return PointState(pos=self.pos + passed * way, vel=vel)


def move_path(path: PlanePath, by: np.ndarray) -> PlanePath:
    """Return a path of one of the classes above, moved by a vector (2,) float64 [m].

    The vector is added in float64. Paths of other classes are returned unchanged.
    """

    def add(leaf: Array, *index: int | slice) -> Array:
        moved = np.array(leaf, np.float64)
        moved[(..., *(index or (slice(None),)))] += by
        return jnp.asarray(moved.astype(np.result_type(np.asarray(leaf).dtype, np.float32)))

    if isinstance(path, LaterPath):
        return dataclasses.replace(path, path=move_path(path.path, by))
    if isinstance(path, TurningPath | FadingPath):
        return dataclasses.replace(path, pos=add(path.pos))
    if isinstance(path, PolynomialPath):
        return dataclasses.replace(path, coeffs=add(path.coeffs, 0, slice(None)))
    if isinstance(path, ControlledPath):
        return dataclasses.replace(path, state=add(path.state, slice(2)))
    return path


def arc(turn_rate: Array, time: Array) -> tuple[Array, Array]:
    """Return how far a target moves ahead and to its left, both divided by its speed, (...) [s].

    Ahead is the direction of the velocity at time 0. Speed and turn rate [rad/s] are constant.
    """
    angle = turn_rate * time
    return time * _sinc(angle), time * _cosc(angle)


def _sinc(angle: Array) -> Array:
    small = jnp.abs(angle) < 1e-2
    safe = jnp.where(small, 1.0, angle)
    return jnp.where(small, 1.0 - angle**2 / 6.0, jnp.sin(safe) / safe)


def _cosc(angle: Array) -> Array:
    """Return (1 - cos(x)) / x as 2 sin(x / 2)^2 / x, which avoids cancellation."""
    return 0.5 * angle * _sinc(0.5 * angle) ** 2
