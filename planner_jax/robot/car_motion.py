"""Car motions given by speed and curvature at knots, and derivatives of costs by these unknowns.

Speed and curvature are linear in time between the equally spaced knots 0 to K. The heading, the
integral of their product, is then a cubic polynomial on each piece between two knots. The position
is computed by Simpson's rule. The unknowns are the speeds and the curvatures at the knots 1 to K,
and the end time if it is free. Speed and curvature at knot 0 are known from the car's state.

A change of the values at a knot deforms the motion only on the two pieces beside the knot. All
later pieces are displaced as one rigid body, by a twist (a, b): it moves a point p by a + b (-p_y,
p_x) and turns headings by b. Gradient and Hessian of a cost that is a sum over samples therefore
follow from sums over pieces and from twists (3,).
"""

import functools

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

_HIGHEST = lax.Precision.HIGHEST
# Indices of the five variables that a piece of the motion depends on: speed at its start and end,
# curvature at its start and end, and the end time of the whole motion.
V_LEFT, V_RIGHT, C_LEFT, C_RIGHT, TIME = range(5)


@struct.dataclass
class Motion:
    """A car motion of K pieces with S equally spaced samples each, the last at the piece's end."""

    pos: Array  # (K, S, 2) [m], of the rear axle's middle
    heading: Array  # (K, S) [rad]
    direction: Array  # (K, S, 2), cosine and sine of the heading
    time: Array  # (K, S) [s]
    # Derivatives of x, y, heading and time of each sample by 8 variables: speed and curvature at
    # both ends of its piece, the end time of the motion, and the three components of a twist (rigid
    # displacement in the plane) of all earlier pieces.
    slope: Array  # (K, S, 4, 8)
    # Derivatives of the twist (rigid displacement) of all later pieces by speed and curvature at
    # the end of each piece (`right`) and at its start (`left`).
    right: Array  # (K, 2, 3)
    left: Array  # (K, 2, 3)


@struct.dataclass
class Quadratic:
    """Half the gradient and half the Hessian of a cost that is a sum of weighted squares.

    The cost has terms that depend on x, y, heading and time of one sample, and terms that depend on
    the five variables of one piece: speed and curvature at its start and end, and the end time.
    """

    push: Array  # (K, S, 4), half gradient by x, y, heading and time of every sample
    stiffness: Array  # (K, S, 4, 4), half Hessian by x, y, heading and time of every sample
    piece_push: Array  # (K, 5), half gradient by the five variables of each piece
    piece_stiffness: Array  # (K, 5, 5), half Hessian by the five variables of each piece


@functools.cache
def _weights(samples: int) -> tuple[np.ndarray, ...]:
    """Return constant matrices for the integrals over one piece of a motion with S samples.

    Let u be the time since the start of the piece, divided by its duration. Speed and curvature are
    combinations of l = 1 - u and r = u. Of 2 S + 1 equally spaced nodes every second is a sample.

    Returns:
        turned: (3, 2 S + 1), integrals of l^2, l r and r^2 up to each node, for the heading.
        weights: (2 S + 1, 9 S), maps f, cosine or sine of the heading at the nodes, to nine values
            at each sample: f; the integrals of f l and f r, for the position; and the integrals of
            f times l or r times each row of `turned`, for the derivatives of the position.
    """
    u = np.linspace(0.0, 1.0, 2 * samples + 1)
    hats = np.stack([1.0 - u, u])
    turned = np.stack([u - u**2 + u**3 / 3.0, u**2 / 2.0 - u**3 / 3.0, u**3 / 3.0])
    simpson = np.zeros((samples, 2 * samples + 1))
    for k in range(samples):
        simpson[k:, 2 * k : 2 * k + 3] += np.array([1.0, 4.0, 1.0]) / (6.0 * samples)
    factors = np.concatenate([hats, (hats[:, None] * turned).reshape(6, -1)])
    selection = np.eye(2 * samples + 1)[2::2]
    weights = np.concatenate([selection, (factors[:, None] * simpson).reshape(8 * samples, -1)])
    return turned, weights.T


def motion(start: Array, time: Array, speed: Array, curvature: Array, samples: int) -> Motion:
    """Compute samples of a car motion of K pieces, and their derivatives by speeds and curvatures.

    Args:
        start: (3,) x, y [m] and heading [rad] at time 0.
        time: () [s], of the last knot; the first knot is at time 0.
        speed: (K + 1,) [m/s], at the knots.
        curvature: (K + 1,) [1/m], at the knots.
        samples: number S of samples on each piece.
    """
    num, dtype = speed.shape[0] - 1, speed.dtype
    turned, weights = (jnp.asarray(each, dtype) for each in _weights(samples))
    step = time / num
    v0, v1, c0, c1 = (
        each[:, None] for each in (speed[:-1], speed[1:], curvature[:-1], curvature[1:])
    )
    ll, lr, rr = turned[:, None]
    angle = step * (v0 * (ll * c0 + lr * c1) + v1 * (lr * c0 + rr * c1))  # (K, nodes)
    whole = angle[:, -1]
    heading = start[2] + (jnp.cumsum(whole) - whole)[:, None] + angle
    direction = jnp.concatenate([jnp.cos(heading), jnp.sin(heading)])
    sums = jnp.matmul(direction, weights, precision=_HIGHEST).reshape(2, num, 9, samples)
    cos, sin = sums[:, :, 0]
    by_hat = sums[:, :, 1:3]  # (2, K, 2, S), integrals of the direction
    aside = jnp.stack([-sums[1, :, 3:], sums[0, :, 3:]]).reshape(2, num, 2, 3, samples)
    p0, p1, p2 = (
        v0[None] * aside[:, :, 0, k] + v1[None] * aside[:, :, 1, k] for k in range(3)
    )  # (2, K, S)
    hat0, hat1 = by_hat[:, :, 0], by_hat[:, :, 1]
    local = step * (v0[None] * hat0 + v1[None] * hat1)
    stretch = (v0 * c0)[None] * p0 + (v0 * c1 + v1 * c0)[None] * p1 + (v1 * c1)[None] * p2
    ends = local[:, :, -1]
    pos = start[:2, None, None] + (jnp.cumsum(ends, axis=1) - ends)[:, :, None] + local
    x, y = pos  # (K, S)
    at_ll, at_lr, at_rr = turned[:, None, 2::2]
    square = step * step
    own = jnp.stack(  # x, y and heading of the samples by the five variables, (5, 3, K, S)
        [
            jnp.stack([*moved, turning])
            for moved, turning in (
                (
                    step * hat0 + square * (c0[None] * p0 + c1[None] * p1),
                    step * (at_ll * c0 + at_lr * c1),
                ),
                (
                    step * hat1 + square * (c0[None] * p1 + c1[None] * p2),
                    step * (at_lr * c0 + at_rr * c1),
                ),
                (square * (v0[None] * p0 + v1[None] * p1), step * (at_ll * v0 + at_lr * v1)),
                (square * (v0[None] * p1 + v1[None] * p2), step * (at_lr * v0 + at_rr * v1)),
                ((local + square * stretch) / time, angle[:, 2::2] / time),
            )
        ]
    )
    last = own[..., -1]  # (5, 3, K)
    end_x, end_y = x[None, :, -1], y[None, :, -1]
    after = jnp.stack(  # twists of later pieces by the five variables of a piece, (5, K, 3)
        [last[:, 0] + last[:, 2] * end_y, last[:, 1] - last[:, 2] * end_x, last[:, 2]], axis=-1
    )
    # A piece is displaced rigidly if its variables deform earlier pieces: the end time deforms all
    # earlier pieces; the speed and curvature at the piece's start deform the previous piece.
    zero = jnp.zeros((1, 3), dtype)
    before = jnp.stack(
        [
            jnp.concatenate([zero, after[V_RIGHT, :-1]]),
            jnp.zeros_like(after[0]),
            jnp.concatenate([zero, after[C_RIGHT, :-1]]),
            jnp.zeros_like(after[0]),
            jnp.cumsum(after[TIME], axis=0) - after[TIME],
        ]
    )
    a, b, turn = (before[..., k, None] for k in range(3))  # (5, K, 1)
    moved = own + jnp.stack([a - turn * y[None], b + turn * x[None], turn + 0.0 * x[None]], axis=1)
    share = jnp.asarray((np.arange(num)[:, None] + np.arange(1, samples + 1) / samples) / num)
    share = share.astype(dtype)
    zeros, ones = jnp.zeros_like(x), jnp.ones_like(x)
    later = jnp.stack([zeros, zeros, zeros, zeros, share])[:, None]
    rigid = jnp.stack(
        [
            jnp.stack([ones, zeros, zeros, zeros]),
            jnp.stack([zeros, ones, zeros, zeros]),
            jnp.stack([-y, x, ones, zeros]),
        ]
    )
    slope = jnp.concatenate([jnp.concatenate([moved, later], axis=1), rigid])  # (8, 4, K, S)
    return Motion(
        pos=jnp.moveaxis(pos, 0, -1),
        heading=heading[:, 2::2],
        direction=jnp.stack([cos, sin], axis=-1),
        time=share * time,
        slope=jnp.moveaxis(slope, (0, 1), (-1, -2)),
        right=jnp.moveaxis(after[V_RIGHT::2][:2], 0, 1),
        left=jnp.moveaxis(after[V_LEFT:TIME:2], 0, 1),
    )


def by_unknowns(drive: Motion, cost: Quadratic, is_time_free: bool) -> tuple[Array, Array]:
    """Return half the gradient (n,) and half the Hessian (n, n) of a cost by the n unknowns.

    The unknowns are the speeds at the knots 1 to K, then the curvatures, then the end time if it is
    free. The chain rule is applied to `cost`, which has derivatives by the samples of `drive`.
    """
    num, samples = drive.heading.shape
    flat = drive.slope.reshape(num, samples * 4, 8)
    pushed = jnp.matmul(cost.stiffness, drive.slope, precision=_HIGHEST).reshape(flat.shape)
    pushed = jnp.concatenate([pushed, cost.push.reshape(num, -1, 1)], axis=2)
    forms = jnp.matmul(flat.swapaxes(1, 2), pushed, precision=_HIGHEST)  # (K, 8, 9)
    own = forms[:, :5, :5] + cost.piece_stiffness
    pull = forms[:, :5, 8] + cost.piece_push

    def shift(values: Array, by: int) -> Array:
        if by >= num:
            return jnp.zeros_like(values)
        return jnp.concatenate([values[by:], jnp.zeros_like(values[:by])])

    later = shift(jnp.cumsum(forms[::-1, 5:], axis=0)[::-1], 2)  # (K, 3, 9)
    lefts, rights = np.array([V_LEFT, C_LEFT]), np.array([V_RIGHT, C_RIGHT])
    twist = drive.right + shift(drive.left, 1)  # (K, 2, 3)
    rigid = jnp.sum(later[:, None, :, 5:8] * twist[:, :, None], axis=-1)  # (K, 2, 3)
    next_left = shift(forms[:, 5:, lefts], 1).swapaxes(1, 2)  # (K, 2, 3)
    own_right = forms[:, 5:, rights].swapaxes(1, 2)
    beside = own[:, rights][:, :, lefts]  # (K, 2, 2), of a knot with the knot before
    same = own[:, rights][:, :, rights] + shift(own[:, lefts][:, :, lefts], 1)

    def flatten(values: Array) -> Array:
        return values.swapaxes(0, 1).reshape(2 * num, *values.shape[2:])

    knot = np.arange(2 * num) % num
    gap = knot[:, None] - knot
    twists = flatten(twist)

    def product(left: Array) -> Array:
        left = flatten(left)
        x, y, turn = (left[:, None, k] * twists[None, :, k] for k in range(3))
        return x + y + turn

    def spread(values: Array) -> Array:
        return jnp.repeat(flatten(values), num, axis=1)

    far = product(rigid + next_left + own_right)
    near, own_knot = product(rigid + next_left) + spread(beside), product(rigid) + spread(same)
    lower = jnp.where(gap >= 2, far, jnp.where(gap == 1, near, own_knot))
    curvature = jnp.where(gap >= 0, lower, lower.T)
    gradient = pull[:, rights] + shift(pull[:, lefts], 1)
    gradient = flatten(gradient + jnp.sum(twist * later[:, None, :, 8], axis=-1))
    if not is_time_free:
        return gradient, curvature
    with_time = own[:, rights, TIME] + shift(own[:, lefts, TIME], 1)
    with_time = flatten(with_time + jnp.sum(twist * later[:, None, :, TIME], axis=-1))
    last = jnp.sum(own[:, TIME, TIME])
    return (
        jnp.append(gradient, jnp.sum(pull[:, TIME])),
        jnp.block([[curvature, with_time[:, None]], [with_time[None], last[None, None]]]),
    )
