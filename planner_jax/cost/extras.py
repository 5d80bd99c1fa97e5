"""Limits and cost terms of a user's own along a quadrotor's way: a part of the case.

An extra is a `flax.struct.dataclass` of arrays with a method `excess`, `cost` or both, pure and for
one case. The planner calls them on jax arrays and the referee calls `excess` on float64 NumPy
arrays, so they use operators and the methods that both kinds of arrays have. Another value in an
extra compiles nothing anew; another class does. What is smaller than the way between two samples
of a plan, some centimetres, may be missed.
"""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.trajectory.polynomial import Motion


@runtime_checkable
class ExtraLimit(Protocol):
    """A limit; the planner keeps it, the referee judges it."""

    def excess(self, pos: Any, vel: Any, acc: Any) -> Any:
        """Excess (...) relative to the limit, > 0 where it is broken; it may have no NaN.

        Args:
            pos: (..., 3) [m], of the quadrotor in the world.
            vel: (..., 3) [m/s].
            acc: (..., 3) [m/s^2].
        """
        ...


@runtime_checkable
class ExtraCost(Protocol):
    """A term of the planner's cost; the referee does not look at it."""

    def cost(self, pos: Any, vel: Any, acc: Any) -> Any:
        """Cost a second (...), >= 0, which is integrated along the way; arguments as above."""
        ...


Extra = ExtraLimit | ExtraCost


def _size(vector: Any) -> Any:
    """Length (...) of vectors (..., 3); its slope at zero is zero."""
    return ((vector**2).sum(-1) + 1e-12) ** 0.5


@struct.dataclass
class KeepOut:
    """A sphere that the quadrotor's centre may not enter; the excess is the depth over radius."""

    centre: Array  # (3,) [m]
    radius: Array  # () [m], > 0

    def excess(self, pos: Any, vel: Any, acc: Any) -> Any:
        """1 - distance / radius."""
        return 1.0 - _size(pos - self.centre) / self.radius


@struct.dataclass
class Geofence:
    """A box that the quadrotor's centre may not leave; a metre outside is an excess of one.

    Its sides are finite: an open one takes a number such as 100.
    """

    low: Array  # (3,) [m]
    high: Array  # (3,) [m]

    def excess(self, pos: Any, vel: Any, acc: Any) -> Any:
        """How far outside the farthest side is, in metres."""
        half = 0.5 * (self.high - self.low)
        return (abs(pos - self.low - half) - half).max(-1)


@struct.dataclass
class SpeedZone:
    """A speed limit within a sphere.

    From the surface to 1.25 radii the limit rises to infinity, speed / (u^2 (3 - 2 u)) with u
    falling from one to zero. So its slope is continuous, and a solver sees that it may slow down
    or go round.
    """

    centre: Array  # (3,) [m]
    radius: Array  # () [m], > 0
    speed: Array  # () [m/s], > 0

    def excess(self, pos: Any, vel: Any, acc: Any) -> Any:
        """Speed over the limit there, less one."""
        u = (5.0 - 4.0 * _size(pos - self.centre) / self.radius).clip(0.0, 1.0)
        return u * u * (3.0 - 2.0 * u) * _size(vel) / self.speed - 1.0


@struct.dataclass
class Dislike:
    """A sphere that is better avoided: cost a second, falling smoothly to zero at its surface."""

    centre: Array  # (3,) [m]
    radius: Array  # () [m], > 0
    weight: Array  # () [1/s], at the centre; of the order of 1 beside the planners' other costs

    def cost(self, pos: Any, vel: Any, acc: Any) -> Any:
        """Weight * (1 - distance^2 / radius^2)^2 inside."""
        inside = (1.0 - ((pos - self.centre) ** 2).sum(-1) / self.radius**2).clip(0.0, 1.0)
        return self.weight * inside**2


def for_batch(extras: Sequence[Extra], batch: tuple[int, ...], dtype: Any) -> tuple[Any, ...]:
    """Extras whose leaves carry the batch shape of the cases.

    Args:
        extras: each for one case, which all of them get, or with the batch's axes on every leaf.
        batch: () or (B,).
        dtype: of every leaf.

    Raises:
        ValueError: an extra is neither, or gives anything but a number a sample.
    """

    def spread(k: int, extra: Any) -> Any:
        extra = jax.tree.map(np.asarray, extra, is_leaf=lambda x: isinstance(x, tuple | list))
        leaves = jax.tree.leaves(extra)
        methods = [m for m in ("excess", "cost") if hasattr(extra, m)]
        # So many samples that no axis of a leaf can be taken for theirs.
        num = 1 + max((2, *batch, *(n for leaf in leaves for n in leaf.shape)))
        sample = np.linspace(0.1, 1.0, 3 * num).reshape(num, 3)
        try:
            one = {np.shape(getattr(extra, m)(sample, sample, sample)) for m in methods} == {(num,)}
        except (ValueError, TypeError):
            one = False
        alike = batch and all(leaf.shape[: len(batch)] == batch for leaf in leaves)
        if not methods or not (one or alike):
            raise ValueError(
                f"extras[{k}] must give a number a sample by excess or cost, its leaves those of "
                f"one case or all of them with the leading axes {batch}: {type(extra).__name__}"
            )
        lead = batch if one else ()
        whole = lambda leaf: jnp.asarray(np.broadcast_to(leaf, lead + leaf.shape), dtype)  # noqa: E731
        return jax.tree.map(whole, extra)

    return tuple(spread(k, extra) for k, extra in enumerate(extras))


def num_limits(extras: tuple[Any, ...]) -> int:
    """How many of them are limits."""
    return sum(isinstance(extra, ExtraLimit) for extra in extras)


def extra_excess(motion: Motion, extras: tuple[Any, ...]) -> tuple[Array, ...]:
    """The excess (N,) over each that is a limit, along samples of a motion."""
    samples = motion.pos, motion.vel, motion.acc
    return tuple(extra.excess(*samples) for extra in extras if isinstance(extra, ExtraLimit))


def extra_rate(motion: Motion, given: tuple[Any, ...]) -> Array:
    """The cost a second (N,) of all extras, which are the last of what is given."""
    samples = motion.pos, motion.vel, motion.acc
    rates = (extra.cost(*samples) for extra in given[-1] if isinstance(extra, ExtraCost))
    return sum(rates, jnp.zeros_like(motion.height))
