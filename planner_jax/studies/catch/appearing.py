"""Targets that appear one by one, while others are being caught.

The balls are those of the suite `swarm8`, eight that sink at a constant speed all around; each
appears at a moment of its own, even between 0 and `span`, and sinks from there. Nothing is known of
it before. With a span of zero all are known from the start, which is the suite itself; the longer
the span, the fewer are there at a time. World frame, z up, SI units.
"""

import dataclasses
import zlib

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import PyTree

from planner_jax.ball.flight import BallState
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.suites import draw

SUITE = "swarm8"
SPAN = 6.0  # [s], in which all targets appear
_COMING = 1000.0  # [m/s], at which a target comes down that has not appeared


@struct.dataclass
class AppearingPath:
    """A ball at a constant velocity from when it appears.

    Before that it is as far above the place where it appears as nothing flies: it comes down at
    1 km/s. A plan that knows of it can therefore not catch it sooner.
    """

    pos: Array  # (3,) [m], where it appears
    vel: Array  # (3,) [m/s], from then on
    appears: Array  # () [s]

    def at(self, time: Array) -> BallState:
        """Position [m] and velocity [m/s] at one time () [s]."""
        since = time - self.appears
        there = since >= 0.0
        down = jnp.array([0.0, 0.0, -_COMING], self.pos.dtype)
        vel = jnp.where(there, self.vel, down)
        return BallState(pos=self.pos + vel * since, vel=vel)


def states_of(
    targets: AppearingPath, order: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity (B, N, 3) of targets `order` at `times`, (B, N) each: for the referee.

    A target that has not appeared is nowhere, an infinite way above.
    """
    lanes = np.arange(len(order))[:, None]
    pos, vel, appears = (
        np.asarray(leaf, np.float64)[lanes, order]
        for leaf in (targets.pos, targets.vel, targets.appears)
    )
    since = times - appears
    pos = pos + vel * since[..., None]
    pos[..., 2] = np.where(since < 0.0, np.inf, pos[..., 2])
    return pos, vel


def draw_appearing(
    num: int, seed: int = 0, first: int = 0, *, span: float = SPAN, dtype: DTypeLike = jnp.float32
) -> CatchCase:
    """Cases of balls that appear one by one, leaves with a leading axis B.

    Args:
        num: B, how many, >= 1.
        seed: >= 0. Case k of a seed and span is always the same one.
        first: place of the first one, >= 0.
        span: [s], in which all appear, >= 0.
        dtype: of every floating leaf.

    Raises:
        ValueError: an argument is out of its range.
    """
    if not 0.0 <= span < np.inf:
        raise ValueError(f"span must be >= 0, got {span}")
    cases: PyTree = draw(num, SUITE, seed, first=first, dtype=dtype)
    size = cases.num_targets
    random = np.random.default_rng([seed, zlib.crc32(b"appearing")])
    random.bit_generator.advance(first * size)  # type: ignore[attr-defined]
    appears = jnp.asarray(span * random.random((num, size)), dtype)
    ball = cases.targets.ball
    return dataclasses.replace(
        cases,
        targets=AppearingPath(pos=ball.pos, vel=ball.vel, appears=appears),
        horizon=cases.horizon + appears,
    )
