"""Speed and curvature at knots, the way that follows, and how it changes with them.

Between equal knots both change evenly, so that the heading is a cubic in time, known exactly; the
position is its integral by Simpson's rule. Slopes by the knots' values are sums over the same
nodes. Unknowns (2 K,): speeds at the knots 1..K, then curvatures there; those at knot 0 are where
the car is.
"""

import functools

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

_HIGHEST = lax.Precision.HIGHEST


@struct.dataclass
class Motion:
    """The way at M equally spaced times, the last one at the end."""

    pos: Array  # (M, 2) [m], of the rear axle's middle
    heading: Array  # (M,) [rad]
    pos_slope: Array  # (M, 2, 2 K), by the unknowns
    heading_slope: Array  # (M, 2 K)


@functools.cache
def _weights(samples: int) -> tuple[np.ndarray, ...]:
    """What is the same for all pieces: integrals at the nodes of one piece.

    A piece has 2 S + 1 nodes at u = 0 .. 1. With hat functions l = 1 - u and r = u of its two
    knots, the integrals from 0 to u of l l, l r and r r; and Simpson's weights from the piece's
    beginning to each of its S samples, (S, 2 S + 1).
    """
    u = np.linspace(0.0, 1.0, 2 * samples + 1)
    ll, lr, rr = u - u**2 + u**3 / 3.0, u**2 / 2.0 - u**3 / 3.0, u**3 / 3.0
    simpson = np.zeros((samples, 2 * samples + 1))
    for k in range(samples):
        simpson[k:, 2 * k : 2 * k + 3] += np.array([1.0, 4.0, 1.0]) / (6.0 * samples)
    return u, ll, lr, rr, simpson


def motion(start: Array, time: Array, speed: Array, curvature: Array, samples: int) -> Motion:
    """The way of K pieces and its slopes.

    Args:
        start: (3,) x, y [m], heading [rad].
        time: () [s], the end.
        speed: (K + 1,) [m/s], at the knots.
        curvature: (K + 1,) [1/m], at the knots.
        samples: of every piece, static; the way has M = K * samples of them.
    """
    num, dtype = speed.shape[0] - 1, speed.dtype
    u, ll, lr, rr, simpson = (jnp.asarray(each, dtype) for each in _weights(samples))
    step = time / num
    v0, v1, c0, c1 = (
        each[:, None] for each in (speed[:-1], speed[1:], curvature[:-1], curvature[1:])
    )
    # Of the heading, since the beginning of each piece, and by the four numbers of the piece.
    by_v0, by_v1 = step * (ll * c0 + lr * c1), step * (lr * c0 + rr * c1)
    by_c0, by_c1 = step * (ll * v0 + lr * v1), step * (lr * v0 + rr * v1)
    turned = v0 * by_v0 + v1 * by_v1
    whole = turned[:, -1]
    heading = start[2] + (jnp.cumsum(whole) - whole)[:, None] + turned  # (K, nodes)
    own, nxt = np.eye(num, num + 1), np.eye(num, num + 1, 1)
    earlier = np.tri(num, num, -1)

    def spread(at_own: Array, at_next: Array) -> Array:
        """Slopes by the values at all knots but the first, (K, nodes, K), of a running integral."""
        local = at_own[:, :, None] * own[:, None, 1:] + at_next[:, :, None] * nxt[:, None, 1:]
        ends = jnp.diag(at_next[:, -1]) + jnp.diag(at_own[1:, -1], -1)  # of each piece, (K, K)
        passed = jnp.matmul(jnp.asarray(earlier, dtype), ends, precision=_HIGHEST)
        return local + passed[:, None, :]

    # (K, nodes, 2 K)
    heading_slope = jnp.concatenate([spread(by_v0, by_v1), spread(by_c0, by_c1)], axis=2)
    fast = v0 + (v1 - v0) * u
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    # The integrals up to every sample are sums over nodes, whose weights take in the direction:
    # of the slopes of speed, then of heading.
    along = jnp.stack([cos, sin]), jnp.stack([-fast * sin, fast * cos])  # (2, K, nodes)
    sums = jnp.concatenate([each[:, :, None] * simpson for each in along], axis=-1)
    hats = (1.0 - u)[None, :, None] * own[:, None, 1:] + u[None, :, None] * nxt[:, None, 1:]
    fast_slope = jnp.concatenate([hats, jnp.zeros((num, u.size, num), dtype)], axis=2)
    slopes = jnp.concatenate([fast_slope, heading_slope], axis=1)  # (K, 2 nodes, 2 K)
    sums = jnp.moveaxis(sums, 0, 1).reshape(num, 2 * samples, -1)
    local_slope = step * jnp.matmul(sums, slopes, precision=_HIGHEST)
    local_slope = local_slope.reshape(num, 2, samples, 2 * num)
    local = step * jnp.sum((along[0] * fast)[:, :, None] * simpson, axis=-1)  # (2, K, samples)
    local = jnp.moveaxis(local, 0, 1)
    tri = jnp.asarray(earlier, dtype)

    def passed(part: Array) -> Array:
        """Sums since the start of sums since the beginning of each piece, (K, 2, samples, ...)."""
        ends = jnp.matmul(tri, part[:, :, -1].reshape(num, -1), precision=_HIGHEST)
        return part + ends.reshape(part[:, :, -1:].shape)

    pos, pos_slope = (jnp.moveaxis(passed(part), 1, 2) for part in (local, local_slope))
    return Motion(
        pos=start[:2] + pos.reshape(-1, 2),
        heading=heading[:, 2::2].reshape(-1),
        pos_slope=pos_slope.reshape(num * samples, 2, 2 * num),
        heading_slope=heading_slope[:, 2::2].reshape(-1, 2 * num),
    )
