"""The integrated penalties of `cost.along` with all their second derivatives, as one matrix.

Samples are linear in a segment's columns, and a limit looks at few orders of the motion at once. So
the matrix is a sum over samples and pairs of orders of one number times the outer product of two
constant rows: one product with a constant matrix for each pair of axes, whatever the number of
lanes. By `jax.hessian` it would take as many tangents as there are unknowns.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.arithmetic import reciprocal
from planner_jax.cost.along import Along
from planner_jax.cost.penalty import smoothed_hinge
from planner_jax.trajectory.polynomial import Motion

_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # of axes

Slot = tuple[int, int]  # order of a derivative of the motion, and axis


@struct.dataclass
class AlongCurvature:
    """Penalties of one segment, with derivatives by its moving columns and theta = log h.

    h is the mean duration of a piece. The columns that do not move are the first rows of the state
    at the begin, which is given: those of order d grow with h^d.
    """

    penalty: Array  # ()
    worst: Array  # (), the greatest excess at the samples
    by_columns: Array  # (C, 3)
    by_theta: Array  # ()
    columns_columns: Array  # (C, 3, C, 3)
    columns_theta: Array  # (C, 3)
    theta_theta: Array  # ()


def curvature_along(
    along: Along, columns: Array, piece_duration: Array, parameters: Any, given: int = 0
) -> AlongCurvature:
    """Integrated penalties of one segment with first and second derivatives.

    Args:
        along: constants.
        columns: (G + C, 3) boundary rows and whitened offsets.
        piece_duration: () [s], mean of the pieces.
        parameters: that the excess takes.
        given: G, the columns at the front that do not move.
    """
    constants = _constants(along, given)
    samples = functools.partial(jnp.asarray, dtype=columns.dtype)
    orders = along.orders
    unit = jnp.matmul(samples(constants.samples), columns, precision=lax.Precision.HIGHEST)
    unit = unit.reshape(3, orders, -1, 3)
    rate = reciprocal(piece_duration)
    rates = [jnp.ones_like(rate)]
    for _ in range(orders - 1):
        rates.append(rates[-1] * rate)
    rates = jnp.stack(rates)[:, None, None]
    order = np.arange(orders)[:, None, None]
    motion, drift, drift_of_drift = unit * rates  # (orders, K, 3) each
    # First and second derivative of the samples by theta.
    moved = drift - samples(order) * motion
    bent = drift_of_drift - samples(2.0 * order) * drift + samples(order**2) * motion
    value, worst, slope, curvature = _at_samples(along, motion, parameters)
    weight = piece_duration * samples(along.weights())
    turned = _product(constants.groups, curvature, moved)

    def summed(values: Array) -> Array:
        return jnp.sum(weight * jnp.sum(values, axis=(0, 2)))

    back = samples(constants.moving_samples)  # (orders, K, C)
    weighed = weight[:, None] * rates
    slopes = jnp.stack([slope, (1.0 - samples(order)) * slope + turned]) * weighed
    by, mixed = jnp.einsum("dkc,odka->oca", back, slopes, precision=lax.Precision.HIGHEST)
    return AlongCurvature(
        penalty=jnp.sum(weight * value),
        worst=worst,
        by_columns=by,
        by_theta=jnp.sum(weight * value) + summed(slope * moved),
        columns_columns=_pulled_back(constants, curvature, weight, rates[:, 0, 0]),
        columns_theta=mixed,
        theta_theta=jnp.sum(weight * value)
        + summed(2.0 * slope * moved + slope * bent + turned * moved),
    )


def _at_samples(
    along: Along, motion: Array, parameters: Any
) -> tuple[Array, Array, Array, dict[tuple[Slot, Slot], Array]]:
    """Penalties (K,), their greatest excess, slopes (orders, K, 3) and second derivatives (K,).

    Groups of slots that no limit looks at together share the tangents of one derivative.
    """
    margins = jnp.asarray(np.array(along.margins)[:, None], motion.dtype)

    def value(at: Array) -> tuple[Array, tuple[Array, Array]]:
        pos, vel, acc, jerk, *snap = at
        parts: Any = {"snap": snap[0]} if snap else {}
        samples = Motion(height=pos[:, 2], vel=vel, acc=acc, jerk=jerk, pos=pos, **parts)
        excess = jnp.stack(along.excess(samples, parameters))
        penalty = jnp.sum(smoothed_hinge(excess + margins, along.hinge_width), axis=0)
        if along.rate is not None:
            penalty = penalty + along.rate(samples, parameters)
        return jnp.sum(penalty), (penalty, jnp.max(excess))

    def slope(at: Array) -> tuple[Array, tuple[Array, tuple[Array, Array]]]:
        (_, values), by = jax.value_and_grad(value, has_aux=True)(at)
        return by, (by, values)

    groups = along.groups
    seeds = np.zeros((max(map(len, groups)), motion.shape[0], 1, 3))
    for group in groups:
        for seed, (order, axis) in zip(seeds, group, strict=False):
            seed[order, 0, axis] = 1.0
    tangents = jnp.broadcast_to(jnp.asarray(seeds, motion.dtype), (len(seeds), *motion.shape))
    along_seed = lambda seed: jax.jvp(slope, (motion,), (seed,), has_aux=True)  # noqa: E731
    _, derived, (by, (values, worst)) = jax.vmap(along_seed, out_axes=(None, 0, None))(tangents)
    curvature = {}
    for group in groups:
        for one in group:
            for place, other in enumerate(group):
                curvature[one, other] = derived[place, one[0], :, one[1]]
    return values, lax.stop_gradient(worst), by, curvature


def _product(groups: tuple[tuple[Slot, ...], ...], curvature: dict, direction: Array) -> Array:
    """Second derivatives at the samples times a direction (orders, K, 3)."""
    found = {}
    for group in groups:
        for one in group:
            parts = [curvature[one, other] * direction[other[0], :, other[1]] for other in group]
            found[one] = functools.reduce(jnp.add, parts)
    zero = jnp.zeros_like(direction[0, :, 0])
    rows = [
        jnp.stack([found.get((order, axis), zero) for axis in range(3)], axis=-1)
        for order in range(direction.shape[0])
    ]
    return jnp.stack(rows)


def _pulled_back(constants: "_Constants", curvature: dict, weight: Array, rates: Array) -> Array:
    """Second derivatives by the moving columns, (C, 3, C, 3)."""
    blocks: dict[tuple[int, int], Array] = {}
    for pairs, terms, matrix in constants.products:
        numbers = [
            jnp.concatenate(
                [weight * (rates[d] * rates[e]) * curvature[(d, a), (e, b)] for d, e in terms]
            )
            for a, b in pairs
        ]
        product = jnp.matmul(
            jnp.asarray(matrix, weight.dtype),
            jnp.stack(numbers, axis=1),
            precision=lax.Precision.HIGHEST,
        )
        for place, pair in enumerate(pairs):
            block = product[:, place].reshape(constants.num_moving, -1)
            blocks[pair] = blocks[pair] + block if pair in blocks else block
    rows = [
        jnp.stack([blocks[a, b] if a <= b else blocks[b, a].T for b in range(3)], axis=-1)
        for a in range(3)
    ]
    return jnp.stack(rows, axis=1)


@dataclasses.dataclass(frozen=True)
class _Constants:
    """What `curvature_along` multiplies with."""

    # Samples of all orders from all columns, and the same with each column's rows weighted once
    # and twice by the power of h with which it grows while it is given: (3 orders K, G + C).
    samples: np.ndarray
    moving_samples: np.ndarray  # (orders, K, C)
    groups: tuple[tuple[Slot, ...], ...]
    # Pairs of axes, their terms (pairs of orders), and the matrix (C C, terms K) for them.
    products: tuple[tuple[list[tuple[int, int]], list[tuple[int, int]], np.ndarray], ...]

    @property
    def num_moving(self) -> int:
        """C."""
        return self.moving_samples.shape[-1]


@functools.cache
def _constants(along: Along, given: int) -> _Constants:
    matrices = along.matrices().transpose(1, 0, 2)  # (orders, K, G + C)
    powers = np.where(np.arange(matrices.shape[-1]) < given, np.arange(matrices.shape[-1]), 0)
    samples = np.stack([matrices, matrices * powers, matrices * powers**2])
    moving = matrices[..., given:]
    by_terms: dict[tuple, list[tuple[int, int]]] = {}
    for a, b in _PAIRS:
        terms = {
            (one[0], other[0])
            for group in along.groups
            for one in group
            for other in group
            if one[1] == a and other[1] == b and (a != b or one[0] <= other[0])
        }
        if not terms:
            terms = {(0, 0)}
        by_terms.setdefault(tuple(sorted(terms)), []).append((a, b))
    products = []
    for terms, pairs in by_terms.items():
        outer = []
        for d, e in terms:
            each = np.einsum("kc,kf->cfk", moving[d], moving[e])
            is_half = pairs[0][0] == pairs[0][1] and d != e
            outer.append(each + each.transpose(1, 0, 2) if is_half else each)
        matrix = np.concatenate(outer, axis=2).reshape(moving.shape[-1] ** 2, -1)
        products.append((pairs, list(terms), matrix))
    return _Constants(
        samples=samples.reshape(-1, samples.shape[-1]),
        moving_samples=moving,
        groups=along.groups,
        products=tuple(products),
    )
