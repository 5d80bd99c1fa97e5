"""Second derivatives of the objective of minimum-snap segments, for Newton's method.

`cost.along_curvature` differentiates the penalties along a segment by its columns (scaled boundary
states and waypoint offsets) and by its duration. Columns and durations depend on the end variables
(of a segment's end), and the chain rule gives the derivatives by end variables.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.cost.along import BETWEEN_NODES, Along
from planner_jax.cost.along_curvature import block_and_diagonal, columns_columns, curvature_along
from planner_jax.optimise.preconditioner import block_preconditioner
from planner_jax.optimise.settings import Curvature, Evaluation
from planner_jax.trajectory.proportional_minco import ProportionalMinco, offset_energy

# A function of the k end variables of N segments (N, k). It returns the positions and derivatives
# at both ends, scaled, (N, 8, 3) for minimum snap; mean durations of a piece (N,) [s]; the part of
# the cost () that depends on the ends alone; and the greatest excess over a limit at the ends ().
Ends = Callable[[Array], tuple[Array, Array, Array, Array]]


def chain_curvature(
    maps: ProportionalMinco,
    along: Along,
    ends: Ends,
    found: tuple[Array, Array, Array, Array],
    natural: Array,
    offsets: Array,
    scale: Array,
    parameters: PyTree,
    energy_weight: Array | float,
    active: Array,
) -> Curvature:
    """Return evaluation, gradient and second derivatives of a trajectory's objective at a point.

    The objective is the cost of the ends, plus for each active segment the integral of penalties,
    and the energy (integral of the squared derivative of order `maps.order`) due to its waypoint
    offsets. A point lists, segment by segment, offsets and end variables, in units of `scale`.
    Products with the Hessian contain all second derivatives. The preconditioner contains the second
    derivatives among the end variables, and the diagonal for the offsets.

    Args:
        maps: constants of a segment of M pieces with the least energy.
        along: penalties along the trajectory.
        ends: function of the end variables. The first variable of each segment is the logarithm of
            its duration and affects nothing else. The first segment's initial state is fixed.
        found: result of `ends` at `natural`.
        natural: (N, k), k end variables of each of N segments, in SI units.
        offsets: (N, M - 1, 3) whitened waypoint offsets.
        scale: (3 (M - 1) + k,) units of one segment's variables.
        parameters: gravity, limits and the user's extra terms, for the functions in `along`.
        energy_weight: weight of the energy in the cost.
        active: (N,) bool, the segments that the planning problem uses; the others are padding.

    Returns:
        The evaluation's `violation` is the greatest excess at ends or samples + `BETWEEN_NODES`.
    """
    rows, durations, core, excess = found
    num, order, power = natural.shape[0], maps.order, 2 * maps.order - 1
    given = order if num == 1 else 0  # number of fixed rows: the initial state of a single segment
    columns = jnp.concatenate([rows, offsets], axis=1)
    one = functools.partial(curvature_along, along, parameters=parameters, given=given)
    of = jax.vmap(lambda columns, duration: one(columns, duration))(columns, durations)
    worst = jnp.max(jnp.where(active, of.worst, -jnp.inf))

    def keep_active(values: Array) -> Array:
        return jnp.where(active.reshape(-1, *[1] * (values.ndim - 1)), values, 0.0)

    of = jax.tree.map(keep_active, of)
    num_rows = rows.shape[1] - given  # number of rows that depend on the end variables
    energies = jax.vmap(functools.partial(offset_energy, maps))(offsets, durations)
    energies = energy_weight * keep_active(energies)
    bend = keep_active(2.0 * energy_weight * maps.offset_energy / durations**power)[:, None, None]
    by_rows = of.by_columns[:, :num_rows]

    def pull_back(natural: Array) -> tuple[Array, Array]:
        rows, _, core, _ = ends(natural.reshape(num, -1))
        moving = rows[:, given:]
        return jnp.sum(by_rows * moving) + core, moving

    def slope(natural: Array) -> tuple[Array, Array]:
        return jax.grad(pull_back, has_aux=True)(natural)

    unit = jnp.asarray(np.eye(natural.size), natural.dtype)
    tangent = lambda unit: jax.jvp(slope, (natural.ravel(),), (unit,))  # noqa: E731
    (by_natural, _), (within, turned) = jax.vmap(tangent, out_axes=((None, None), 0))(unit)
    dot = functools.partial(jnp.tensordot, precision=lax.Precision.HIGHEST)
    einsum = functools.partial(jnp.einsum, precision=lax.Precision.HIGHEST)
    theta_theta = of.theta_theta + power**2 * energies
    own_units, offset_units = scale[3 * offsets.shape[1] :], scale[: 3 * offsets.shape[1]]

    def join(offsets: Array, natural: Array) -> Array:
        parts = [
            offsets.reshape(num, -1) * offset_units[None],
            natural.reshape(num, -1) * own_units[None],
        ]
        return jnp.concatenate(parts, axis=1).ravel()

    def products() -> Callable[[Array], Array]:
        hessian = jax.vmap(functools.partial(columns_columns, along, given=given))(of.at_samples)

        def product(direction: Array) -> Array:
            parts = direction.reshape(num, -1) * scale[None]
            step = parts[:, : offset_units.size].reshape(offsets.shape)
            move = parts[:, offset_units.size :]
            longer = move[:, 0, None, None]
            columns = jnp.concatenate([dot(move.ravel(), turned, 1), step], axis=1)
            image = einsum("ncafb,nfb->nca", hessian, columns)
            image = image + of.columns_theta * longer
            theta = jnp.sum(of.columns_theta * columns, axis=(1, 2)) + theta_theta * move[:, 0]
            theta = theta - power * jnp.sum(bend * offsets * step, axis=(1, 2))
            own = dot(turned, image[:, :num_rows], 3) + dot(within, move.ravel(), 1)
            own = own.reshape(num, -1).at[:, 0].add(theta)
            outer = image[:, num_rows:] + bend * step - power * bend * offsets * longer
            return join(outer, own)

        return product

    by_natural = by_natural.reshape(num, -1).at[:, 0].add(of.by_theta - power * energies)
    by_offsets = of.by_columns[:, num_rows:] + bend * offsets
    strong = functools.partial(block_and_diagonal, along, num=num_rows, given=given)
    among_rows, alone = jax.vmap(strong)(of.at_samples)
    half = einsum("pnca,ncafb->pnfb", turned, among_rows)
    is_time = jnp.asarray(np.eye(natural.size)[:: natural.shape[1]], scale.dtype)  # (N, N k)
    beside = einsum("pnca,nca->pn", turned, of.columns_theta[:, :num_rows])
    beside = dot(beside + 0.5 * theta_theta[None] * is_time.T, is_time, 1)
    block = dot(half, turned, ((1, 2, 3), (1, 2, 3))) + within + beside + beside.T
    units = jnp.tile(own_units, num)
    own_bend = alone + bend
    places = np.arange(num * scale.size).reshape(num, -1)[:, offset_units.size :]
    return Curvature(
        evaluation=Evaluation(
            cost=jnp.sum(of.penalty + energies) + core,
            violation=jnp.maximum(worst, excess) + BETWEEN_NODES,
        ),
        gradient=join(by_offsets, by_natural),
        products=products,
        preconditioner=block_preconditioner(
            places.reshape(1, -1),
            (block * units[None] * units[:, None])[None],
            join(own_bend * offset_units.reshape(1, *offsets.shape[1:]), jnp.zeros_like(natural)),
        ),
    )
