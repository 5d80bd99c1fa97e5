"""A ball in an image by its colour, and where it is by the depth of its pixels.

[Natarajan2024, Section IV-F]: thresholds of hue, saturation and value make a mask; pixels
of little confidence and depths that do not belong to the ball are dropped, and what is left, if
there is enough of it, has a centroid.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.studies.block.camera import Camera, back_project, from_numbers
from planner_jax.studies.block.noise import StereoNoise

WINDOW = 64  # [px], edge of the square around the mask's middle that is looked at closely
# Of a sphere's visible half, seen from afar: mean height above the plane through its middle, in
# radii.
_MEAN_HEIGHT = 2.0 / 3.0
_WHOLE = 0.7  # least share of the pixels that a ball at its depth has


@struct.dataclass
class BallLook:
    """What tells a ball's pixels from others."""

    lower: Array  # (3,) hue, saturation and value, each 0 to 1
    upper: Array  # (3,) likewise; a hue below the lower one is reached by way of 1
    radius: Array  # () [m], of the ball
    confidence: Array  # () least of a pixel
    pixels: Array  # () least number of pixels of a ball
    reach: Array  # () [m], greatest depth


def ball_look(
    lower: np.ndarray | tuple[float, ...] = (0.02, 0.5, 0.25),
    upper: np.ndarray | tuple[float, ...] = (0.13, 1.0, 1.0),
    *,
    radius: float = 0.05,
    confidence: float = 0.5,
    pixels: float = 4,
    reach: float = 14.0,
) -> BallLook:
    """The look of a ball as NumPy float32 leaves; an orange one if no colours are given.

    Raises:
        ValueError: a colour is not between 0 and 1, or the radius is not positive; one line.
    """
    for name, value in (("lower", lower), ("upper", upper)):
        colour = np.asarray(value)
        if colour.shape != (3,) or not np.all((colour >= 0.0) & (colour <= 1.0)):
            raise ValueError(f"{name} must be three numbers between 0 and 1, got {value}")
    if not radius > 0.0:
        raise ValueError(f"radius must be > 0, got {radius:g}")
    return from_numbers(
        BallLook,
        lower=np.asarray(lower),
        upper=np.asarray(upper),
        radius=radius,
        confidence=confidence,
        pixels=pixels,
        reach=reach,
    )


@struct.dataclass
class Sighting:
    """A ball in one frame; NaN where it is not seen."""

    place: Array  # (3,) [m], of the ball's middle, world frame
    pixel: Array  # (2,) [px], column and row
    depth: Array  # () [m], of the ball's middle, along the camera's axis
    pixels: Array  # () int32, how many its depth was made of


def hue_saturation_value(rgb: Array) -> Array:
    """Hue, saturation and value (..., 3), each 0 to 1, of colours (..., 3) from 0 to 1."""
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


def colour_mask(image: Array, look: BallLook) -> Array:
    """Which pixels of an image (rows, columns, 3) of bytes have the ball's colour, (rows, columns).

    The same as to compare `hue_saturation_value`, but without a division a pixel.
    """
    red, green, blue = (image[..., k].astype(jnp.float32) for k in range(3))
    value = jnp.maximum(jnp.maximum(red, green), blue)
    span = value - jnp.minimum(jnp.minimum(red, green), blue)
    # Six times the hue times the span, from 0 to 6 spans.
    turn = jnp.where(
        value == red,
        green - blue + jnp.where(green < blue, 6.0, 0.0) * span,
        jnp.where(value == green, 2.0 * span + blue - red, 4.0 * span + red - green),
    )
    low, high = 6.0 * look.lower[0], 6.0 * look.upper[0]
    above, below = turn >= low * span, turn <= high * span
    hue = jnp.where(look.lower[0] <= look.upper[0], above & below, above | below)
    saturation = (span >= look.lower[1] * value) & (span <= look.upper[1] * value)
    bright = (value >= 255.0 * look.lower[2]) & (value <= 255.0 * look.upper[2])
    return hue & saturation & bright


def sighting(
    image: Array, depth: Array, confidence: Array, camera: Camera, look: BallLook
) -> Sighting:
    """The ball in one frame.

    The middle of the mask is where half of its pixels are on either side, which stray pixels do not
    move far. In a window of 64 pixels around it those tell the depth that have confidence, and a
    depth no more than three robust standard deviations (1.48 times the median deviation) and a
    radius off the median; the centroid is that of all the mask's pixels near them. Depths are of
    the ball's surface, whose mean over the visible half is two thirds of a radius before its
    middle. A ball of which less than 0.7 is to be seen, such as behind a pole, counts as not seen:
    its middle would be off.

    Args:
        image: (rows, columns, 3) bytes, red, green and blue; at least 64 each way.
        depth: (rows, columns) [m]; NaN where there is none.
        confidence: (rows, columns), 0 to 1.
        camera: that took it.
        look: of the ball.
    """
    mask = colour_mask(image, look)
    corner = [_middle(jnp.sum(mask, axis=1 - axis)) - WINDOW // 2 for axis in range(2)]
    corner = [jnp.clip(at, 0, mask.shape[axis] - WINDOW) for axis, at in enumerate(corner)]
    mask, depth, confidence = (
        lax.dynamic_slice(each, corner, (WINDOW, WINDOW)) for each in (mask, depth, confidence)
    )
    usable = mask & (confidence >= look.confidence) & (depth > 0.0) & (depth < look.reach)
    middle = _median(depth, usable)
    spread = 1.4826 * _median(jnp.abs(depth - middle), usable)
    usable = usable & (jnp.abs(depth - middle) <= 3.0 * spread + look.radius)
    num = jnp.sum(usable)

    def mean(values: Array, of: Array) -> Array:
        return jnp.sum(jnp.where(of, values, 0.0)) / jnp.maximum(jnp.sum(of), 1)

    row, column = jnp.meshgrid(jnp.arange(WINDOW), jnp.arange(WINDOW), indexing="ij")
    first = jnp.stack([mean(column, usable), mean(row, usable)])
    across = (first + jnp.stack(corner[::-1]) - camera.centre) / camera.focal
    along = jnp.sqrt(1.0 + jnp.sum(across**2))
    deep = mean(depth, usable) + _MEAN_HEIGHT * look.radius / along
    # Holes in the depth leave an image of the ball that is not round: where it is in the image,
    # all of its colour say that are as near as it is large. Off the axis it is seen drawn out.
    round_px = camera.focal * look.radius / jnp.maximum(deep, look.radius)
    within = 1.5 * along * round_px + 1.0
    near = mask & ((column - first[0]) ** 2 + (row - first[1]) ** 2 <= within**2)
    pixel = jnp.stack([mean(column, near), mean(row, near)]) + jnp.stack(corner[::-1])
    whole = jnp.sum(near) >= _WHOLE * jnp.pi * round_px**2 * along
    seen = (num >= look.pixels) & whole
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
    """A depth image as a stereo camera would have it, from the true one.

    One error of disparity is common to the image, as if one thing were looked at; pixels have
    errors of their own beside it, none at all (NaN), or the depth of something else, up to twice
    as near or far.

    Args:
        key: of the noise.
        camera: for its focal length.
        noise: of the stereo camera.
        depth: (rows, columns) [m], > 0.

    Returns:
        depth: (rows, columns) [m].
        confidence: (rows, columns), 0 to 1; an assumption: evenly spread over 0.4 to 1 where the
            pixel was matched well, and over 0 to 0.6 where with something else.
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
    """The place () in counts (n,) before which half of them lie."""
    until = jnp.cumsum(counts)
    return jnp.searchsorted(until, 0.5 * until[-1])


def _median(values: Array, usable: Array) -> Array:
    """Median () of those values that are usable; 0 if none is."""
    num = jnp.sum(usable)
    ordered = jnp.sort(jnp.where(usable, values, jnp.inf).reshape(-1))
    both = ordered[jnp.maximum(num - 1, 0) // 2] + ordered[num // 2]
    return jnp.where(num > 0, 0.5 * both, 0.0)
