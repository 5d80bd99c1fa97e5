"""A pinhole camera that projects world points to pixels with depths, and pixels back to points.

A position in the image is (column, row) in pixels; whole numbers are the centres of pixels. In the
camera frame x points to the right of the image, y down in the image, and z forward. The depth of a
point is its z coordinate in the camera frame, and not its distance from the camera. Arrays of
points and pixels may have any leading axes.
"""

import functools
from collections.abc import Callable
from typing import TypeVar

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jax.typing import ArrayLike

from planner_jax.core.choices import require

Kind = TypeVar("Kind")


@struct.dataclass
class Camera:
    """A pinhole camera: its position, orientation, focal length and image size."""

    rotation: Array  # (3, 3), its columns are the camera's axes in the world frame
    position: Array  # (3,) [m], pinhole in the world frame
    focal: Array  # () [px], focal length
    size: tuple[int, int] = struct.field(pytree_node=False)  # numbers of columns and rows

    @property
    def centre(self) -> Array:
        """Position (2,) [px] of the optical axis in the image: its centre."""
        return jnp.asarray(0.5 * (np.array(self.size) - 1.0), jnp.result_type(self.focal))


def from_numbers(kind: Callable[..., Kind], **leaves: ArrayLike) -> Kind:
    """Create an object of the dataclass `kind`; fields are converted to NumPy float32 arrays."""
    return kind(**{name: np.asarray(leaf, np.float32) for name, leaf in leaves.items()})


def looking_at(
    position: ArrayLike, target: ArrayLike, *, size: tuple[int, int], field_of_view: float
) -> Camera:
    """Create a camera that points at a target, with its x axis horizontal.

    Args:
        position: (3,) [m], position of the camera in the world frame.
        target: (3,) [m], point on the optical axis, neither straight above nor below the camera.
        size: numbers of columns and rows of the image.
        field_of_view: [rad], horizontal opening angle, between 0 and pi.

    Raises:
        ArgumentError: an argument is out of its range.
    """
    position, target = np.asarray(position, float), np.asarray(target, float)
    ahead = target - position
    is_beside = bool(np.hypot(*ahead[:2]) > 1e-6)
    require(is_beside, "target", "beside the camera, not above, below or within it", shown="")
    require(bool(0.0 < field_of_view < np.pi), "field_of_view", "between 0 and pi", field_of_view)
    require(min(size) >= 1, "size", ">= 1 in both directions", size)
    z = ahead / np.linalg.norm(ahead)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z], axis=1)
    focal = 0.5 * size[0] / np.tan(0.5 * field_of_view)
    pinhole = functools.partial(Camera, size=size)
    return from_numbers(pinhole, rotation=rotation, position=position, focal=focal)


def to_camera(camera: Camera, points: Array) -> Array:
    """Convert points (..., 3) [m] from the world frame to the camera frame."""
    away = points - camera.position[(None,) * (points.ndim - 1)]
    return jnp.matmul(away, jnp.asarray(camera.rotation), precision=lax.Precision.HIGHEST)


def to_world(camera: Camera, points: Array) -> Array:
    """Convert points (..., 3) [m] from the camera frame to the world frame."""
    rotation = jnp.asarray(camera.rotation)
    turned = jnp.matmul(points, rotation.T, precision=lax.Precision.HIGHEST)
    return jnp.broadcast_to(camera.position, turned.shape) + turned


def project(camera: Camera, points: Array) -> tuple[Array, Array]:
    """Project world points (..., 3) [m] into the image.

    Returns:
        pixels: (..., 2) [px], inside or outside the image. For points that are not in front of the
            camera they are finite numbers without meaning.
        depths: (...) [m], z coordinates in the camera frame; negative behind the camera.
    """
    point_in_camera = to_camera(camera, points)
    depths = point_in_camera[..., 2]
    safe = jnp.where(depths > 1e-6, depths, 1.0)
    centre = jnp.broadcast_to(camera.centre, (*depths.shape, 2))
    return centre + camera.focal * point_in_camera[..., :2] / safe[..., None], depths


def back_project(camera: Camera, pixels: Array, depths: Array) -> Array:
    """Return the world points (..., 3) [m] seen at pixels (..., 2) [px] with depths (...) [m]."""
    across = (pixels - jnp.broadcast_to(camera.centre, pixels.shape)) / camera.focal
    ray = jnp.concatenate([across, jnp.ones_like(across[..., :1])], axis=-1)
    return to_world(camera, ray * depths[..., None])


def in_view(camera: Camera, points: Array) -> Array:
    """Return whether world points (..., 3) [m] are in front of the camera and in its image."""
    pixels, depths = project(camera, points)
    inside = (pixels > -0.5) & (
        pixels < jnp.broadcast_to(np.array(camera.size) - 0.5, pixels.shape)
    )
    return (depths > 1e-6) & jnp.all(inside, axis=-1)
