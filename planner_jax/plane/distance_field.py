"""Distance from the nearest wall in the plane, computed once on a grid and interpolated."""

import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from planner_jax.plane.obstacles import Obstacles, distances

# A wall's array of corners is padded by repeats of its last corner. To save time, distances are
# computed from half the array, but at least so many corners, if the others are only padding.
_FEWEST = 4


@struct.dataclass
class DistanceField:
    """Distances from the nearest wall at equally spaced nodes; negative inside a wall."""

    values: Array  # (rows, columns) [m]; the first index is along y
    corner: Array  # (2,) [m], position of the entry (0, 0)
    spacing: Array  # (2,) [m], distances between neighbouring nodes along x and y

    def near(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return the distances [m] of points (x, y) from the nearest wall, and derivatives by x, y.

        Interpolation is bilinear. Near a corner of a wall it overestimates the distance by up to
        spacing^2 / (4 distance). A point outside the grid gets the distance of the nearest point of
        the grid. All arrays have the shape of `x`.
        """
        most = (self.values.shape[1] - 2, self.values.shape[0] - 2)
        at = [(each - self.corner[k]) / self.spacing[k] for k, each in enumerate((x, y))]
        below = [jnp.clip(jnp.floor(at[k]), 0, most[k]).astype(jnp.int32) for k in range(2)]
        (u, v) = (
            jnp.clip(each - low.astype(each.dtype), 0.0, 1.0)
            for each, low in zip(at, below, strict=True)
        )
        index = below[1] * self.values.shape[1] + below[0]
        flat = self.values.reshape(-1)
        corners = [
            flat.at[index + by].get(mode="promise_in_bounds")
            for by in (0, 1, self.values.shape[1], self.values.shape[1] + 1)
        ]
        low, high = (corners[k] + u * (corners[k + 1] - corners[k]) for k in (0, 2))
        left, right = (corners[k] + v * (corners[k + 2] - corners[k]) for k in (0, 1))
        return (
            low + v * (high - low),
            (right - left) / self.spacing[0],
            (high - low) / self.spacing[1],
        )


def distance_field(
    walls: Obstacles, corner: Array, spacing: Array, size: tuple[int, int]
) -> DistanceField:
    """Compute the distances from the walls on a grid.

    Args:
        walls: obstacles, evaluated at their positions at time 0.
        corner: (2,) [m], position of the grid's first node.
        spacing: (2,) [m], distances between neighbouring nodes along x and y.
        size: numbers of nodes along x and y, static ints.
    """
    along = [corner[k] + spacing[k] * jnp.arange(size[k], dtype=corner.dtype) for k in range(2)]
    x, y = jnp.meshgrid(*along)
    vertices = walls.vertices(jnp.zeros_like(spacing[0]))
    num, most = vertices.shape[:2]
    half = max(_FEWEST, most // 2)

    def take_nearer(k: Array, nearest: Array) -> Array:
        corners, present, radius = (
            lax.dynamic_slice_in_dim(each, k, 1) for each in (vertices, walls.present, walls.radius)
        )

        def measure(corners: Array) -> Array:
            far = distances(corners, present, x.reshape(1, -1), y.reshape(1, -1))[0]
            return far - radius[:, None]

        if half >= most:
            return jnp.minimum(nearest, measure(corners))
        few = corners[:, :half]
        is_padded = jnp.all(corners[:, half:] == few[:, -1:])
        far = lax.cond(is_padded, lambda: measure(few), lambda: measure(corners))
        return jnp.minimum(nearest, far)

    # The loops take one wall at a time, since a program for all walls takes minutes to compile. On
    # a CPU the loop ends at the last wall that is present, so that padding costs no time.
    none = jnp.full((1, x.size), 1e3, corner.dtype)

    def loop(present: Array) -> Array:
        needed = jnp.max(jnp.where(present, jnp.arange(1, num + 1), 0))
        return lax.fori_loop(0, needed, take_nearer, none)

    nearest = lax.platform_dependent(
        walls.present, cpu=loop, default=lambda _: lax.fori_loop(0, num, take_nearer, none)
    )
    return DistanceField(values=nearest.reshape(x.shape), corner=corner, spacing=spacing)
