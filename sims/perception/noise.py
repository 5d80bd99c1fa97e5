"""Measurement noise of a camera that observes a ball.

A stereo camera with focal length f [px] and baseline b [m] measures the disparity  d = f b / z  of
a point at depth z. An error of the disparity causes an error of the depth that is  z^2 / (f b)
times as large. The depth noise thus grows with the square of the depth, and the noise normal to the
line of sight grows linearly. Isotropic noise, which is equal in all directions and at all depths,
serves for comparisons.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from planner_jax.core.choices import require
from planner_jax.sims.perception.camera import (
    Camera,
    back_project,
    from_numbers,
    in_view,
    project,
    to_camera,
)


@struct.dataclass
class StereoNoise:
    """Parameters of a stereo camera's measurement errors, which are independent between frames."""

    baseline: Array  # () [m], distance between the two lenses
    pixel_std: Array  # () [px], standard deviation of the ball's centre along each image axis
    disparity_std: Array  # () [px], standard deviation of the disparity, averaged over the ball
    dropout: Array  # () probability that the ball has no depth in a frame


@struct.dataclass
class IsotropicNoise:
    """Measurement errors that are equal in all directions and independent between frames."""

    std: Array  # () [m], standard deviation of each coordinate


Noise = StereoNoise | IsotropicNoise


def stereo_noise(
    *,
    baseline: float = 0.12,
    pixel_std: float = 0.1,
    disparity_std: float = 0.1,
    dropout: float = 0.05,
) -> StereoNoise:
    """Create the error parameters of a stereo camera, with NumPy float32 leaves.

    Args:
        baseline: [m], distance between the lenses; the default is the baseline of the ZED 2i, the
            camera of [Natarajan2024]. Most other defaults are assumptions.
        pixel_std: [px], standard deviation of the ball's centre along each image axis.
        disparity_std: [px], standard deviation of the disparity, averaged over the ball.
        dropout: probability that the ball has no depth in a frame.

    Raises:
        ArgumentError: a number is out of its range.
    """
    given = locals()
    for name, value in given.items():
        require(bool(value >= 0.0), name, ">= 0", value)
    require(bool(baseline > 0.0), "baseline", "> 0", baseline)
    require(bool(dropout < 1.0), "dropout", "< 1", dropout)
    return from_numbers(StereoNoise, **given)


def depth_std(camera: Camera, noise: StereoNoise, depths: Array) -> Array:
    """Return the standard deviations of measured depths, in the shape of `depths` (...) [m]."""
    return depths**2 * noise.disparity_std / (camera.focal * noise.baseline)


def information(camera: Camera, noise: Noise, points: Array) -> Array:
    """Return inverse covariances (..., 3, 3) [1/m^2] of observed positions, in the world frame.

    `points` (..., 3) [m] are the true or the observed positions of the ball. A stereo camera has a
    pixel error within the image and a depth error along the line of sight. The covariances are
    correct to first order in both errors.
    """
    if isinstance(noise, IsotropicNoise):
        isotropic = jnp.eye(3, dtype=points.dtype) / noise.std**2
        return jnp.broadcast_to(isotropic, (*points.shape[:-1], 3, 3))
    point_in_camera = to_camera(camera, points)
    depth = jnp.maximum(point_in_camera[..., 2], 1e-3)
    sharp = camera.focal / (depth * noise.pixel_std)
    blurred = 1.0 / depth_std(camera, noise, depth)
    none = jnp.zeros_like(depth)
    # `rows` are the rows of a matrix W that scales a position error e in the camera frame, such
    # that W e has the identity matrix as its covariance.
    rows = [
        jnp.stack([sharp, none, -sharp * point_in_camera[..., 0] / depth], axis=-1),
        jnp.stack([none, sharp, -sharp * point_in_camera[..., 1] / depth], axis=-1),
        jnp.stack([none, none, blurred], axis=-1),
    ]
    rotation = jnp.asarray(camera.rotation)
    white = jnp.matmul(jnp.stack(rows, axis=-2), rotation.T, precision=lax.Precision.HIGHEST)
    return jnp.einsum("...ki,...kj->...ij", white, white, precision=lax.Precision.HIGHEST)


def sightings(key: Array, camera: Camera, noise: Noise, points: Array) -> Array:
    """Simulate the observed positions of a ball whose true positions in N frames are `points`.

    No images are rendered. A ball outside the image is not seen, and occlusion is ignored. A stereo
    camera's pixels and disparities have Gaussian errors, and some frames have no depth at random.

    Returns:
        (N, 3) [m], observed positions in the world frame; NaN in frames without the ball.
    """
    if isinstance(noise, IsotropicNoise):
        seen = points + noise.std * jax.random.normal(key, points.shape, points.dtype)
        return jnp.where(in_view(camera, points)[:, None], seen, jnp.nan)
    to_pixel, to_disparity, to_loss = jax.random.split(key, 3)
    pixels, depths = project(camera, points)
    dtype = points.dtype
    pixels = pixels + noise.pixel_std * jax.random.normal(to_pixel, pixels.shape, dtype)
    scale = camera.focal * noise.baseline
    error = noise.disparity_std * jax.random.normal(to_disparity, depths.shape, dtype)
    disparity = scale / jnp.where(depths > 1e-6, depths, 1.0) + error
    is_valid = in_view(camera, points) & (disparity > 0.0)
    lost = jax.random.uniform(to_loss, depths.shape, dtype) < noise.dropout
    seen = back_project(camera, pixels, scale / jnp.where(is_valid, disparity, 1.0))
    return jnp.where((is_valid & ~lost)[:, None], seen, jnp.nan)
