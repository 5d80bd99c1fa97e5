"""Random states of a quadrotor at time 0, for suites whose robot otherwise starts at standstill.

[Yu2023catch, Section VII] trains its policy from random states, whose ranges it does not state.
"""

import dataclasses
import math
import zlib
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from planner_jax.core.arithmetic import numpy_of, to_host
from planner_jax.core.choices import STARTS, require_one_of
from planner_jax.robot.quadrotor import QuadrotorLimits

NUM = 9  # random numbers of one state
_ASIDE = 1.0  # [m], greatest distance from the standstill along x and along y
_HEIGHT = (0.8, 2.0)  # [m]
_SPEED = 2.0  # [m/s]
_TILT = math.radians(30.0)  # [rad]
_THRUST = (0.7, 1.3)  # divided by gravity
_WITHIN = 0.9  # greatest fraction of a limit that a state may use


def draw_states(
    starts: object, cases: PyTree, suite: str, seed: int, index: np.ndarray | range
) -> PyTree:
    """Return a batch of B cases with random states at time 0; see `with_states`.

    The state of the case with number k in `index` (B,) depends on `suite`, `seed` and k alone.

    Raises:
        ValueError: `starts` is not "random".
    """
    require_one_of(STARTS, "starts", starts)
    index = np.asarray(index)
    random = np.random.default_rng([seed, zlib.crc32(suite.encode()), zlib.crc32(b"starts")])
    first, last = int(index.min()), int(index.max())
    random.bit_generator.advance(first * NUM)  # type: ignore[attr-defined]
    return with_states(cases, random.random((last + 1 - first, NUM))[index - first])


def with_states(cases: PyTree, uniform: PyTree) -> PyTree:
    """Return a batch of B cases of quadrotors with other states at time 0.

    Positions are within 1 m of the case's start along x and y, at heights from 0.8 to 2 m. Speeds
    are at most 2 m/s in any direction, tilts at most 30 degrees, thrusts 0.7 to 1.3 times the
    weight, and the jerk is 0. If limits of the case require it, the ranges are smaller.

    Args:
        cases: the cases, with `head_state` (B, 4, 3) and `limits`.
        uniform: (B, 9) random numbers of [0, 1), NumPy or JAX.
    """
    dtype = cases.head_state.dtype
    limits: QuadrotorLimits = dataclasses.replace(cases.limits, air=None, rotors=None)
    limits = jax.tree.map(to_host, limits)
    start, gravity = to_host(cases.head_state)[:, 0], to_host(cases.gravity)
    xp, u = numpy_of(uniform, start), [uniform[:, k] for k in range(NUM)]

    level = start[:, :2] + _ASIDE * (2.0 * uniform[:, :2] - 1.0)
    lowest = xp.maximum(_HEIGHT[0], limits.min_height)
    height = lowest + u[2] * (_HEIGHT[1] - _HEIGHT[0])
    speed = u[3] * xp.minimum(_SPEED, _WITHIN * limits.speed)
    rise = 2.0 * u[4] - 1.0
    vel = speed[:, None] * _direction(xp, rise, u[5])

    widest = _TILT if limits.max_tilt is None else xp.minimum(_TILT, _WITHIN * limits.max_tilt)
    thrust = gravity * (_THRUST[0] + u[6] * (_THRUST[1] - _THRUST[0]))
    for bound in (limits.min_thrust, limits.max_thrust):
        if bound is not None:
            inside = gravity + _WITHIN * (bound - gravity)
            clip = xp.maximum if bound is limits.min_thrust else xp.minimum
            thrust = clip(thrust, inside)
    acc = thrust[:, None] * _direction(xp, xp.cos(u[7] * widest), u[8])
    acc = acc - gravity[:, None] * np.array([[0.0, 0.0, 1.0]])
    if limits.acceleration is not None:
        size = xp.sqrt(xp.sum(acc**2, axis=1))
        most = _WITHIN * limits.acceleration
        acc = acc * xp.minimum(1.0, most / xp.maximum(size, 1e-9))[:, None]
    pos = xp.concatenate([level, height[:, None]], axis=1)
    states = xp.stack([pos, vel, acc, xp.zeros_like(pos)], axis=1)
    return dataclasses.replace(cases, head_state=jnp.asarray(states, dtype))


def _direction(xp: ModuleType, rise: PyTree, turn: PyTree) -> PyTree:
    """Return unit vectors (B, 3) of the vertical component `rise`, turned by `turn` revolutions."""
    level, angle = xp.sqrt(1.0 - rise**2), 2.0 * math.pi * turn
    return xp.stack([level * xp.cos(angle), level * xp.sin(angle), rise], axis=1)
