"""Penalties of `cost.along` with first and second derivatives, for Newton's method.

The motion at a sample is linear in a segment's columns: scaled end states and waypoint offsets.
Each part of the Hessian, for a pair of axes such as (x, y), is therefore one product of a constant
matrix and the penalty's second derivatives by the motion. `jax.hessian` would need one tangent for
each unknown.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.core.arithmetic import reciprocal
from planner_jax.cost.along import Along
from planner_jax.cost.penalty import smooth_hinge
from planner_jax.trajectory.polynomial import Motion

_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # pairs of axes

Slot = tuple[int, int]  # order of a derivative of the motion, and its axis


@struct.dataclass
class AlongCurvature:
    """Penalties of one segment, with derivatives by its C variable columns and theta = log h.

    A column is a d-th derivative of the position at an end of the segment, multiplied by h^d, or a
    waypoint offset (scaled deviation from the smoothest trajectory). h is the mean duration of a
    piece. Columns of a known initial state are fixed except for the factor h^d.
    """

    penalty: Array  # ()
    worst: Array  # (), the greatest excess at the samples
    by_columns: Array  # (C, 3)
    by_theta: Array  # ()
    columns_theta: Array  # (C, 3)
    theta_theta: Array  # ()
    # Second derivatives of the penalty by the motion at the samples. Only `columns_columns` and
    # `block_and_diagonal` use these arrays.
    at_samples: tuple[Array, ...]


def curvature_along(
    along: Along, columns: Array, piece_duration: Array, parameters: PyTree, given: int = 0
) -> AlongCurvature:
    """Integrate the penalties of one segment, with derivatives by its columns and by log h.

    Args:
        along: functions of the excess over limits, and the quadrature.
        columns: (G + C, 3), G fixed and C variable columns: scaled end states, then waypoint
            offsets (scaled deviations from the smoothest trajectory).
        piece_duration: () [s], mean duration h of the pieces.
        parameters: second argument of the excess functions, such as gravity and limits.
        given: G, the number of fixed columns, which precede the variable columns.
    """
    constants = _constants(along, given)
    samples = functools.partial(jnp.asarray, dtype=columns.dtype)
    orders = along.orders
    unit = jnp.matmul(samples(constants.samples), columns, precision=lax.Precision.HIGHEST)
    unit = unit.reshape(3, orders, -1, 3)
    rate = reciprocal(piece_duration)
    powers = [jnp.ones_like(rate)]
    for _ in range(orders - 1):
        powers.append(powers[-1] * rate)
    rates = jnp.stack(powers)[:, None, None]
    order = np.arange(orders)[:, None, None]
    motion, drift, drift_of_drift = unit * rates[None]  # (orders, K, 3) each
    # First and second derivatives of the samples by theta, the logarithm of `piece_duration`.
    first = drift - samples(order) * motion
    second = drift_of_drift - samples(2.0 * order) * drift + samples(order**2) * motion
    value, worst, slope, curvature = _at_samples(along, motion, parameters)
    weight = piece_duration * samples(along.weights())
    image = _product(constants.groups, curvature, first)

    def integrate(values: Array) -> Array:
        return jnp.sum(weight * jnp.sum(values, axis=(0, 2)))

    back = samples(constants.moving_samples)  # (orders, K, C)
    weighed = weight[None, :, None] * rates
    slopes = jnp.stack([slope, (1.0 - samples(order)) * slope + image]) * weighed[None]
    by, mixed = jnp.einsum("dkc,odka->oca", back, slopes, precision=lax.Precision.HIGHEST)
    return AlongCurvature(
        penalty=jnp.sum(weight * value),
        worst=worst,
        by_columns=by,
        by_theta=jnp.sum(weight * value) + integrate(slope * first),
        columns_theta=mixed,
        theta_theta=jnp.sum(weight * value)
        + integrate(2.0 * slope * first + slope * second + image * first),
        at_samples=tuple(
            jnp.stack(
                [
                    jnp.concatenate(
                        [
                            weight * rates[d, 0, 0] * rates[e, 0, 0] * curvature[(d, a), (e, b)]
                            for d, e in terms
                        ]
                    )
                    for a, b in pairs
                ],
                axis=1,
            )
            for pairs, terms in constants.pairs
        ),
    )


def columns_columns(along: Along, at_samples: tuple[Array, ...], given: int = 0) -> Array:
    """Return the Hessian (C, 3, C, 3) of a segment's penalty by its C variable columns.

    Columns are scaled end states and waypoint offsets, the first `given` of them fixed.
    `at_samples` are the second derivatives at the samples, the field of `AlongCurvature`.
    """
    num = _constants(along, given).num_moving
    every = [(c, f) for c in range(num) for f in range(num)]
    return _square(_entries(along, given, every, at_samples), num)


def block_and_diagonal(
    along: Along, at_samples: tuple[Array, ...], num: int, given: int = 0
) -> tuple[Array, Array]:
    """Return a part of the second derivatives of a segment's penalty by its C variable columns.

    Columns are vectors (3,) that, with the durations, determine the motion: scaled end states and
    waypoint offsets. All derivatives that are in neither result below are left out.

    Args:
        along: functions of the excess over limits, and the quadrature.
        at_samples: second derivatives at the samples, the field of `AlongCurvature`.
        num: E, the number of columns in the block.
        given: number of fixed columns, which precede the variable columns.

    Returns:
        block: (E, 3, E, 3), all second derivatives by the first E variable columns.
        diagonal: (C - E, 3), d^2/dx^2 by each component x of the other columns.
    """
    among = [(c, f) for c in range(num) for f in range(num)]
    alone = [(c, c) for c in range(num, _constants(along, given).num_moving)]
    entries = _entries(along, given, among + alone, at_samples)
    block = {pair: found[: len(among)] for pair, found in entries.items()}
    diagonal = [entries[axis, axis][len(among) :] for axis in range(3)]
    return _square(block, num), jnp.stack(diagonal, axis=1)


def _at_samples(
    along: Along, motion: Array, parameters: PyTree
) -> tuple[Array, Array, Array, dict[tuple[Slot, Slot], Array]]:
    margins, factors = (
        jnp.asarray(np.array(each)[:, None], motion.dtype)
        for each in (along.margins, along.hinge_weights)
    )
    parameters, share, width = along.split(parameters)
    if along.hinge_width is None:
        margins = share * margins

    def value(at: Array) -> tuple[Array, tuple[Array, Array]]:
        pos, vel, acc, jerk, *snap = at
        parts = {"snap": snap[0]} if snap else {}
        samples = Motion(height=pos[:, 2], vel=vel, acc=acc, jerk=jerk, pos=pos, **parts)
        excess = jnp.stack(along.excess(samples, parameters))
        penalty = jnp.sum(factors * smooth_hinge(excess + margins, width), axis=0)
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


def _entries(
    along: Along, given: int, places: list[tuple[int, int]], at_samples: tuple[Array, ...]
) -> dict[tuple[int, int], Array]:
    matrices = _matrices(along, given, tuple(places))
    found = {}
    for (pairs, _), matrix, numbers in zip(
        _constants(along, given).pairs, matrices, at_samples, strict=True
    ):
        constant = jnp.asarray(matrix, numbers.dtype)
        product = jnp.matmul(constant, numbers, precision=lax.Precision.HIGHEST)
        found |= {pair: product[:, place] for place, pair in enumerate(pairs)}
    return found


def _square(entries: dict[tuple[int, int], Array], num: int) -> Array:
    blocks = {pair: found.reshape(num, num) for pair, found in entries.items()}
    rows = [
        jnp.stack([blocks[a, b] if a <= b else blocks[b, a].T for b in range(3)], axis=-1)
        for a in range(3)
    ]
    return jnp.stack(rows, axis=1)


@dataclasses.dataclass(frozen=True)
class _Constants:
    samples: np.ndarray  # (3 * orders * K, G + C)
    moving_samples: np.ndarray  # (orders, K, C)
    groups: tuple[tuple[Slot, ...], ...]
    # Entries (pairs of axes, pairs of orders); order 1 is the velocity. Only for these pairs the
    # penalty's second derivatives by two components of the motion may differ from zero.
    pairs: tuple[tuple[tuple[tuple[int, int], ...], tuple[tuple[int, int], ...]], ...]

    @property
    def num_moving(self) -> int:
        return self.moving_samples.shape[-1]


@functools.cache
def _constants(along: Along, given: int) -> _Constants:
    matrices = along.matrices().transpose(1, 0, 2)  # (orders, K, G + C)
    powers = np.where(np.arange(matrices.shape[-1]) < given, np.arange(matrices.shape[-1]), 0)
    samples = np.stack([matrices, matrices * powers, matrices * powers**2])
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
    return _Constants(
        samples=samples.reshape(-1, samples.shape[-1]),
        moving_samples=matrices[..., given:],
        groups=along.groups,
        pairs=tuple((tuple(pairs), terms) for terms, pairs in by_terms.items()),
    )


@functools.cache
def _matrices(
    along: Along, given: int, places: tuple[tuple[int, int], ...]
) -> tuple[np.ndarray, ...]:
    constants = _constants(along, given)
    first, second = np.array(places).T
    found = []
    for pairs, terms in constants.pairs:
        outer = []
        for d, e in terms:
            one, other = constants.moving_samples[d], constants.moving_samples[e]  # (K, C) each
            each = one[:, first] * other[:, second]
            if pairs[0][0] == pairs[0][1] and d != e:  # add the mirrored term, which is not listed
                each = each + one[:, second] * other[:, first]
            outer.append(each.T)
        found.append(np.concatenate(outer, axis=1))
    return tuple(found)
