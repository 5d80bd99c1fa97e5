"""Detection of a ball in an image by its colour, and its position from the depth of its pixels.

The method follows [Natarajan2024, Section IV-F]. Thresholds of hue, saturation and value give a
mask of pixels. Pixels of low confidence and pixels at the depth of other objects are dropped. The
ball's position is the centroid of the remaining pixels, if there are enough of them.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.sims.perception.camera import Camera, back_project, from_numbers
from planner_jax.sims.perception.noise import StereoNoise

WINDOW = 64  # [px], edge of the evaluated square around the median of the mask's pixels
# Mean distance of a sphere's visible surface from the plane through its centre that faces a distant
# camera, over all pixels of the sphere, divided by its radius.
_MEAN_HEIGHT = 2.0 / 3.0
_WHOLE = 0.7  # least fraction of a ball's pixels, expected at its depth, that must be visible


@struct.dataclass
class BallThresholds:
    """Thresholds that separate the pixels of a ball from other pixels."""

    lower: Array  # (3,), lower limits of hue, saturation and value, each 0 to 1
    upper: Array  # (3,), upper limits; an upper hue below the lower hue means a range across 1
    radius: Array  # () [m], radius of the ball
    confidence: Array  # (), least confidence of a pixel
    pixels: Array  # (), least number of pixels of a ball
    reach: Array  # () [m], greatest depth of a pixel


def ball_thresholds(
    lower: np.ndarray | tuple[float, ...] = (0.02, 0.5, 0.25),
    upper: np.ndarray | tuple[float, ...] = (0.13, 1.0, 1.0),
    *,
    radius: float = 0.05,
    confidence: float = 0.5,
    pixels: float = 4,
    reach: float = 14.0,
) -> BallThresholds:
    """Return thresholds for a ball as float32 NumPy arrays; the default colour is orange.

    `lower` and `upper` bound hue, saturation and value; `radius` [m] is the ball's radius. A pixel
    needs a depth up to `reach` [m]. The camera's confidence in this depth, from 0 to 1, must be at
    least `confidence`. A ball needs `pixels` such pixels.

    Raises:
        ValueError: a colour is not between 0 and 1, or the radius is not positive.
    """
    for name, value in (("lower", lower), ("upper", upper)):
        colour = np.asarray(value)
        if colour.shape != (3,) or not np.all((colour >= 0.0) & (colour <= 1.0)):
            raise ValueError(f"{name} must be three numbers between 0 and 1, got {value}")
    if not radius > 0.0:
        raise ValueError(f"radius must be > 0, got {radius:g}")
    return from_numbers(
        BallThresholds,
        lower=np.asarray(lower),
        upper=np.asarray(upper),
        radius=radius,
        confidence=confidence,
        pixels=pixels,
        reach=reach,
    )


@struct.dataclass
class Sighting:
    """A ball detected in one frame; positions are NaN if the ball is not seen."""

    place: Array  # (3,) [m], position of the ball's centre, world frame
    pixel: Array  # (2,) [px], column and row of the ball's centre
    depth: Array  # () [m], depth of the ball's centre, along the camera's axis
    pixels: Array  # () int32, number of pixels from which the depth was computed


def hue_saturation_value(rgb: Array) -> Array:
    """Return hue, saturation and value (..., 3), each 0 to 1, of colours (..., 3) from 0 to 1."""
    red, green, blue = rgb[..., 0], rgb[..., 1], rgb[..., 2]
    value = jnp.max(rgb, axis=-1)
    span = value - jnp.min(rgb, axis=-1)
    safe = jnp.where(span > 0.0, span, 1.0)
    sixths = jnp.where(
        value == red,
        (green - blue) / safe,
        jnp.where(value == green, 2.0 + (blue - red) / safe, 4.0 + (red - green) / safe),
    )
    hue = jnp.where(span > 0.0, jnp.mod(sixths / 6.0, 1.0), 0.0)
    saturation = jnp.where(value > 0.0, span / jnp.where(value > 0.0, value, 1.0), 0.0)
    return jnp.stack([hue, saturation, value], axis=-1)


def colour_mask(image: Array, thresholds: BallThresholds) -> Array:
    """Return which pixels of an image (rows, columns, 3) have the ball's colour.

    The mask (rows, columns) bool equals the mask by `hue_saturation_value`, without divisions.
    """
    red, green, blue = (image[..., k].astype(jnp.float32) for k in range(3))
    value = jnp.maximum(jnp.maximum(red, green), blue)
    span = value - jnp.minimum(jnp.minimum(red, green), blue)
    # `turn` is 6 * hue * span; span is the greatest minus the least of red, green and blue.
    turn = jnp.where(
        value == red,
        green - blue + jnp.where(green < blue, 6.0, 0.0) * span,
        jnp.where(value == green, 2.0 * span + blue - red, 4.0 * span + red - green),
    )
    low, high = 6.0 * thresholds.lower[0], 6.0 * thresholds.upper[0]
    above, below = turn >= low * span, turn <= high * span
    hue = jnp.where(thresholds.lower[0] <= thresholds.upper[0], above & below, above | below)
    saturation = (span >= thresholds.lower[1] * value) & (span <= thresholds.upper[1] * value)
    bright = (value >= 255.0 * thresholds.lower[2]) & (value <= 255.0 * thresholds.upper[2])
    return hue & saturation & bright


def sighting(
    image: Array, depth: Array, confidence: Array, camera: Camera, thresholds: BallThresholds
) -> Sighting:
    """Detect the ball in one frame and return its position.

    1. A mask marks the pixels of the ball's colour. A window of 64 x 64 pixels is centred at the
    medians of the marked columns and rows, since single wrong pixels hardly change a median.

    2. The depth is the mean over those marked pixels of the window that have enough confidence and
    a depth near the median. Near means within the ball's radius plus three robust standard
    deviations (1.48 times the median deviation).

    3. The ball's centre in the image is the centroid of the marked pixels near the centroid of the
    pixels of step 2.

    4. Depths are of the ball's surface. Their mean is two thirds of a radius in front of the ball's
    centre; this difference is added.

    If less than 0.7 of a ball is visible, the ball counts as not seen: its centroid would be
    wrong.

    Args:
        image: (rows, columns, 3) bytes, red, green and blue; at least 64 rows and columns.
        depth: (rows, columns) [m]; NaN where there is none.
        confidence: (rows, columns), 0 to 1.
        camera: the camera that took the frame.
        thresholds: colour, size and depth range of the ball.
    """
    mask = colour_mask(image, thresholds)
    corner = [_middle(jnp.sum(mask, axis=1 - axis)) - WINDOW // 2 for axis in range(2)]
    corner = [jnp.clip(at, 0, mask.shape[axis] - WINDOW) for axis, at in enumerate(corner)]
    mask, depth, confidence = (
        lax.dynamic_slice(each, corner, (WINDOW, WINDOW)) for each in (mask, depth, confidence)
    )
    usable = (
        mask & (confidence >= thresholds.confidence) & (depth > 0.0) & (depth < thresholds.reach)
    )
    middle = _median(depth, usable)
    spread = 1.4826 * _median(jnp.abs(depth - middle), usable)
    usable = usable & (jnp.abs(depth - middle) <= 3.0 * spread + thresholds.radius)
    num = jnp.sum(usable)

    def mean(values: Array, of: Array) -> Array:
        return jnp.sum(jnp.where(of, values, 0.0)) / jnp.maximum(jnp.sum(of), 1)

    row, column = jnp.meshgrid(jnp.arange(WINDOW), jnp.arange(WINDOW), indexing="ij")
    first = jnp.stack([mean(column, usable), mean(row, usable)])
    across = (first + jnp.stack(corner[::-1]) - camera.centre) / camera.focal
    along = jnp.sqrt(1.0 + jnp.sum(across**2))
    deep = mean(depth, usable) + _MEAN_HEIGHT * thresholds.radius / along
    # The centroid uses all pixels of the ball's colour within 1.5 apparent radii, also pixels
    # without a depth. Away from the camera's axis a ball's image is longer by the factor `along`.
    round_px = camera.focal * thresholds.radius / jnp.maximum(deep, thresholds.radius)
    within = 1.5 * along * round_px + 1.0
    near = mask & ((column - first[0]) ** 2 + (row - first[1]) ** 2 <= within**2)
    pixel = jnp.stack([mean(column, near), mean(row, near)]) + jnp.stack(corner[::-1])
    whole = jnp.sum(near) >= _WHOLE * jnp.pi * round_px**2 * along
    seen = (num >= thresholds.pixels) & whole
    place = back_project(camera, pixel, deep)
    return Sighting(
        place=jnp.where(seen, place, jnp.nan),
        pixel=jnp.where(seen, pixel, jnp.nan),
        depth=jnp.where(seen, deep, jnp.nan),
        pixels=jnp.where(seen, num, 0).astype(jnp.int32),
    )


def noisy_depth(
    key: Array, camera: Camera, noise: StereoNoise, depth: Array
) -> tuple[Array, Array]:
    """Return a stereo camera's noisy depth image, from the true depth image.

    One disparity error is common to the whole image, and each pixel has its own error in addition.
    A pixel may have no depth at all (NaN). A mismatched pixel has a depth from half to twice the
    true depth.

    Args:
        key: random key of the noise.
        camera: the camera; its focal length is used.
        noise: parameters of the stereo camera.
        depth: (rows, columns) [m], > 0.

    Returns:
        depth: (rows, columns) [m].
        confidence: (rows, columns), 0 to 1. It is an assumption: uniform over 0.4 to 1 for matched
            pixels, and over 0 to 0.6 for mismatched pixels.
    """
    common, own, hole, other, factor, trust = jax.random.split(key, 6)
    dtype = depth.dtype
    error = noise.disparity_std * jax.random.normal(common, (), dtype)
    error = error + noise.speckle_std * jax.random.normal(own, depth.shape, dtype)
    disparity = camera.focal * noise.baseline / depth + error
    wrong = jax.random.uniform(other, depth.shape, dtype) < noise.mismatch
    stretch = jnp.exp2(jax.random.uniform(factor, depth.shape, dtype, -1.0, 1.0))
    disparity = jnp.where(wrong, disparity * stretch, disparity)
    lost = (jax.random.uniform(hole, depth.shape, dtype) < noise.dropout) | (disparity <= 0.0)
    seen = camera.focal * noise.baseline / jnp.where(lost, 1.0, disparity)
    confidence = 0.6 * jax.random.uniform(trust, depth.shape, dtype) + jnp.where(wrong, 0.0, 0.4)
    return jnp.where(lost, jnp.nan, seen), confidence


def _middle(counts: Array) -> Array:
    until = jnp.cumsum(counts)
    return jnp.searchsorted(until, 0.5 * until[-1])


def _median(values: Array, usable: Array) -> Array:
    num = jnp.sum(usable)
    ordered = jnp.sort(jnp.where(usable, values, jnp.inf).reshape(-1))
    both = ordered[jnp.maximum(num - 1, 0) // 2] + ordered[num // 2]
    return jnp.where(num > 0, 0.5 * both, 0.0)
