"""How well a camera sees a ball, frame by frame.

A stereo camera measures the disparity  d = f b / z  of two images a baseline b apart. An error of
the disparity is one of the depth z of  z^2 / (f b)  times as much, so the noise of depth grows with
the square of the distance, whereas that across the ray grows with the distance itself. Round noise,
as large in every direction and at every distance, stands beside it for comparisons.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from planner_jax.core.errors import ArgumentError
from planner_jax.studies.block.camera import (
    Camera,
    back_project,
    from_numbers,
    in_view,
    project,
    to_camera,
)


@struct.dataclass
class StereoNoise:
    """Errors of a stereo camera; those of one frame do not depend on those of another."""

    baseline: Array  # () [m]
    pixel_std: Array  # () [px], of the ball's middle in the image, each way
    disparity_std: Array  # () [px], of the ball's disparity as a whole
    speckle_std: Array  # () [px], of the disparity of one pixel, beside that
    dropout: Array  # () probability that a pixel, or in `sightings` a frame, has no depth
    mismatch: Array  # () probability that a pixel has the depth of something else


@struct.dataclass
class RoundNoise:
    """Errors that are alike in every direction; those of frames do not depend on each other."""

    std: Array  # () [m], of each coordinate


Noise = StereoNoise | RoundNoise


def stereo_noise(
    *,
    baseline: float = 0.12,
    pixel_std: float = 0.1,
    disparity_std: float = 0.1,
    speckle_std: float = 0.2,
    dropout: float = 0.05,
    mismatch: float = 0.05,
) -> StereoNoise:
    """Errors of a stereo camera as NumPy float32 leaves.

    The baseline of 0.12 m is that of the ZED 2i with which [Natarajan2024] sees, by its maker's
    documentation. A fifth of a pixel is the usual estimate for the matching of one pixel; that
    half of it is left in the mean over a ball, and the other numbers, are assumptions.

    Raises:
        ValueError: a number is out of its range; one line.
    """
    given = locals()
    for name, value in given.items():
        if not value >= 0.0:
            raise ArgumentError(name, ">= 0", value)
    if not baseline > 0.0:
        raise ArgumentError("baseline", "> 0", baseline)
    for name in ("dropout", "mismatch"):
        if not given[name] < 1.0:
            raise ArgumentError(name, "< 1", given[name])
    return from_numbers(StereoNoise, **given)


def depth_std(camera: Camera, noise: StereoNoise, depths: Array) -> Array:
    """Standard deviations (...) [m] of a ball's depths (...) [m], to first order."""
    return depths**2 * noise.disparity_std / (camera.focal * noise.baseline)


def information(camera: Camera, noise: Noise, points: Array) -> Array:
    """Inverses (..., 3, 3) [1/m^2] of the covariance with which balls at (..., 3) [m] are seen.

    The error of a stereo camera is that of the pixel along the image, and that of the depth along
    the ray. World frame; to first order in the errors. Places where balls were seen serve as well
    as those where they were.
    """
    if isinstance(noise, RoundNoise):
        alike = jnp.eye(3, dtype=points.dtype) / noise.std**2
        return jnp.broadcast_to(alike, (*points.shape[:-1], 3, 3))
    own = to_camera(camera, points)
    depth = jnp.maximum(own[..., 2], 1e-3)
    sharp = camera.focal / (depth * noise.pixel_std)
    blurred = 1.0 / depth_std(camera, noise, depth)
    none = jnp.zeros_like(depth)
    # Rows that make the error along the camera's axes one of independent unit deviations.
    rows = [
        jnp.stack([sharp, none, -sharp * own[..., 0] / depth], axis=-1),
        jnp.stack([none, sharp, -sharp * own[..., 1] / depth], axis=-1),
        jnp.stack([none, none, blurred], axis=-1),
    ]
    rotation = jnp.asarray(camera.rotation)
    white = jnp.matmul(jnp.stack(rows, axis=-2), rotation.T, precision=lax.Precision.HIGHEST)
    return jnp.einsum("...ki,...kj->...ij", white, white, precision=lax.Precision.HIGHEST)


def sightings(key: Array, camera: Camera, noise: Noise, points: Array) -> Array:
    """Where balls at (N, 3) [m] are seen, a frame each; NaN where they are not.

    This is what `sims.segment.sighting` makes of images, without the images. A ball outside the
    image is not seen, but nothing stands in its way either. A stereo camera's pixels and
    disparities have Gaussian errors, and frames are lost.

    Returns:
        (N, 3) [m], world frame.
    """
    if isinstance(noise, RoundNoise):
        seen = points + noise.std * jax.random.normal(key, points.shape, points.dtype)
        return jnp.where(in_view(camera, points)[:, None], seen, jnp.nan)
    to_pixel, to_disparity, to_loss = jax.random.split(key, 3)
    pixels, depths = project(camera, points)
    dtype = points.dtype
    pixels = pixels + noise.pixel_std * jax.random.normal(to_pixel, pixels.shape, dtype)
    scale = camera.focal * noise.baseline
    error = noise.disparity_std * jax.random.normal(to_disparity, depths.shape, dtype)
    disparity = scale / jnp.where(depths > 1e-6, depths, 1.0) + error
    there = in_view(camera, points) & (disparity > 0.0)
    lost = jax.random.uniform(to_loss, depths.shape, dtype) < noise.dropout
    seen = back_project(camera, pixels, scale / jnp.where(there, disparity, 1.0))
    return jnp.where((there & ~lost)[:, None], seen, jnp.nan)
