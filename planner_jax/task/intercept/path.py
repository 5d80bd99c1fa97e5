"""A way of the rear axle, without a speed: the first half of a plan that splits both."""

import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.task.intercept.motion import motion


@struct.dataclass
class Path:
    """N equally spaced points of a way, or a batch with leading axes; stations count from 0.

    Between two points the curvature changes evenly along the way.
    """

    pos: Array  # (N, 2) [m], of the rear axle's middle
    heading: Array  # (N,) [rad]
    curvature: Array  # (N,) [1/m]
    length: Array  # () [m]

    def curvature_at(self, station: Array) -> Array:
        """Curvature [1/m] of one way at stations (M,) [m]; held at its ends."""
        stations = jnp.linspace(0.0, 1.0, self.curvature.shape[-1]) * self.length
        return jnp.interp(station, stations, self.curvature)


def path_along(start: Array, length: Array, curvature: Array) -> Path:
    """The path from a pose (3,) with curvatures (N,) [1/m] at equal distances."""
    way = motion(start, length, jnp.ones_like(curvature), curvature, 1)
    return Path(
        pos=jnp.concatenate([start[None, :2], way.pos]),
        heading=jnp.concatenate([start[None, 2], way.heading]),
        curvature=curvature,
        length=length,
    )


def path_of_drive(
    start: Array, time: Array, speed: Array, curvature: Array, num: int, samples: int = 8
) -> Path:
    """The way of a drive whose speed and curvature change evenly between equal knots.

    Args:
        start: (3,) x, y [m], heading [rad].
        time: () [s], the end.
        speed: (K + 1,) [m/s], at the knots, nowhere negative.
        curvature: (K + 1,) [1/m].
        num: N, points of the path.
        samples: of every piece, between which the curvature is interpolated by the station.
    """
    knots = jnp.arange(speed.shape[0]) * samples
    fine = jnp.arange((speed.shape[0] - 1) * samples + 1)
    v, c = (jnp.interp(fine, knots, each) for each in (speed, curvature))
    step = time / (fine.shape[0] - 1)
    # Where the car stands the station has to grow a little, to be interpolated by.
    moved = jnp.maximum(0.5 * (v[1:] + v[:-1]) * step, 1e-6)
    station = jnp.concatenate([jnp.zeros_like(moved[:1]), jnp.cumsum(moved)])
    even = jnp.linspace(0.0, 1.0, num) * station[-1]
    return path_along(start, station[-1], jnp.interp(even, station, c))
