"""Batches of convex quadratic programs that share their matrices, each solved exactly.

    minimise x' Q x / 2 + c' x   subject to   E x = e,   lower <= R x <= upper

The matrices Q, E and R and the vector c are constant; e, lower and upper differ between programs.
All work that depends only on the matrices is done once, in double precision on the host. With the
substitution x = base e + Z y, where Z' Q Z = 1, the program is to find the shortest vector y
between pairs of parallel planes. The start y = 0 is the optimum without bounds. The dual method of
[Goldfarb1983] adds one violated bound (plane) after another to its working set, and drops planes
that are no more active. Steps are matrix products without factorisations, which a batch computes
together.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from numpy.typing import ArrayLike

from planner_jax.core.arithmetic import Numbers
from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import Status


@struct.dataclass
class QpTemplate:
    """The arrays that programs with equal matrices share, computed by `qp_template`.

    A program has n unknowns x, q equalities E x = e and M bounded rows R x. The vectors that fulfil
    the equalities are x = base e + Z y, with d free coordinates y. Bounds on a row of R x are
    planes in the space of y; `normals` are their unit normals, the rows of R Z divided by `scales`.
    If the equalities alone determine a row of R x, its normal is 0 and its scale 1.
    """

    base: Array | np.ndarray  # (n, q), maps e to the optimum without bounds
    base_cost: Array | np.ndarray  # (q, q), the cost of this optimum is e' base_cost e
    directions: Array | np.ndarray  # (n, d), the matrix Z, of d free directions
    reach: Array | np.ndarray  # (M, q), maps e to R x at the optimum without bounds
    normals: Array | np.ndarray  # (M, d), rows of R Z, divided by their lengths
    scales: Array | np.ndarray  # (M,), lengths of the rows of R Z


@struct.dataclass
class QpSolution:
    """The solution of one program, or a batch of solutions with a leading axis on every leaf."""

    point: Array  # (n,), the n unknowns
    cost: Array  # ()
    # (M,), derivative of the cost by each bound: > 0 lower, < 0 upper, 0 if neither is active.
    multiplier: Array
    violation: Array  # (), the largest excess over a bound, relative to 1 + |bound|
    steps: Array  # () int32, number of steps that added or dropped an active bound
    status: Array  # () int32: CONVERGED, INFEASIBLE, MAX_STEPS or NON_FINITE of `Status`


@dataclasses.dataclass(frozen=True)
class QpConfig:
    """Greatest numbers of active bounds and steps; the status is MAX_STEPS if one is exceeded."""

    active: int = 64  # greatest number of active bounds
    max_steps: int = 60  # greatest number of steps; a step adds or drops one active bound


def qp_template(
    hessian: ArrayLike,
    equalities: ArrayLike,
    rows: ArrayLike,
    zeros: ArrayLike | None = None,
    linear: ArrayLike | None = None,
) -> QpTemplate:
    """Compute the arrays that all programs with these matrices share, in double precision.

    Args:
        hessian: (n, n), the matrix Q, symmetric and positive definite where the equalities hold.
        equalities: (q, n), left sides of q independent equalities; q may be 0.
        rows: (M, n), matrix whose product with x is bounded.
        zeros: (z, n), left sides of z more equalities, whose right sides are always 0.
        linear: (n,), vector c of a linear term c' x of the cost.

    Raises:
        ArgumentError: the equalities are not independent, or the minimum is not unique.
    """
    q, e, r = (np.asarray(each, np.float64) for each in (hessian, equalities, rows))
    num, given = len(q), len(e)
    if linear is not None:  # the product with another unknown, which an equality fixes to 1
        c = np.asarray(linear, np.float64)[:, None]
        q, r = np.block([[q, c], [c.T, np.zeros((1, 1))]]), np.pad(r, [(0, 0), (0, 1)])
        e, given = np.vstack([np.pad(e, [(0, 0), (0, 1)]), np.eye(num + 1)[-1]]), given + 1
    if zeros is not None:
        zeros = np.asarray(zeros, np.float64)
        e = np.concatenate([e, np.pad(zeros, [(0, 0), (0, len(q) - num)])])
    _, singular, axes = np.linalg.svd(e)
    least = singular.min(initial=np.inf)
    if e.shape[0] > e.shape[1] or not least > 1e-12 * singular.max(initial=0.0):
        raise ArgumentError(
            "equalities", "independent", shown=f"singular values from {singular[-1]}"
        )
    free = axes[len(singular) :].T
    try:
        factor = np.linalg.cholesky(free.T @ q @ free)
    except np.linalg.LinAlgError:
        raise ArgumentError(
            "hessian", "positive definite where the equalities hold", shown=""
        ) from None
    directions = np.linalg.solve(factor, free.T).T
    base = np.linalg.pinv(e)[:, :given]
    base = base - directions @ (directions.T @ q @ base)
    normals = r @ directions
    scales = np.linalg.norm(normals, axis=1)
    is_decided = scales <= 1e-9 * scales.max(initial=0.0)
    normals[is_decided], scales[is_decided] = 0.0, 1.0
    return QpTemplate(
        base=base[:num],
        base_cost=0.5 * base.T @ q @ base,
        directions=directions[:num],
        reach=r @ base,
        normals=normals / scales[:, None],
        scales=scales,
    )


@struct.dataclass
class _Search:
    """State of the dual method: a point, and its working set of at most A active bounds.

    The point is the optimum without all other bounds. A row's bounds are two parallel planes.
    """

    point: Array  # (d,), coordinates of the point along d free directions
    excess: Array  # (M,), distance beyond the nearer plane of each row, less the tolerance
    maps: Array  # (d + A, d): projector orthogonal to the active planes, and their pseudo-inverse
    rows: Array  # (A,) int32, indices of the active rows
    sides: Array  # (A,), 1 for a lower bound, -1 for an upper bound, 0 for an unused entry
    multipliers: Array  # (A,), Lagrange multipliers of the active bounds
    held: Array  # (M,) bool, whether a row is active
    entering: Array  # () int32, index of the row that is being added; -1 if none is selected
    pressure: Array  # (), Lagrange multiplier of the row that is being added
    steps: Array  # () int32, number of bounds added and dropped
    status: Array  # () int32: MAX_STEPS, or INFEASIBLE if no step is possible
    is_stuck: Array  # () bool, whether no step is possible or the working set is full


def solve_qp(
    template: QpTemplate,
    right_side: Array,
    lower: Array,
    upper: Array,
    config: QpConfig = QpConfig(),
) -> QpSolution:
    """Return the optimum of one program; differentiable by the right side and the bounds.

    Derivatives assume that the set of active bounds does not change. In single precision the
    relative error of the cost is about 1e-6.

    Args:
        template: the arrays from `qp_template`.
        right_side: (q,), right sides of the q equalities.
        lower: (M,), lower bounds of the M bounded rows, -inf for no bound.
        upper: (M,), upper bounds, inf for no bound.
        config: limits of the method.

    Returns:
        The solution, or the best point found if the program has no solution.
    """
    dtype = lower.dtype
    t: QpTemplate = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), template)
    if t.base.shape[1] > right_side.shape[0]:  # of an unknown that is fixed to 1
        right_side = jnp.append(right_side, jnp.ones((), dtype))
    unbounded = _product(t.reach, right_side)
    # `low` and `high` bound (unit normal) @ point for each row; `slack` is for rounding errors.
    low, high = (lower - unbounded) / t.scales, (upper - unbounded) / t.scales
    eps = jnp.finfo(dtype).eps
    slack = 16.0 * eps * (1.0 + jnp.where(jnp.isfinite(low), jnp.abs(low), 0.0))
    slack = slack + 16.0 * eps * jnp.where(jnp.isfinite(high), jnp.abs(high), 0.0)
    is_free = jnp.any(t.normals != 0.0, axis=1)
    search = _search(t.normals, is_free, *lax.stop_gradient((low, high, slack)), config)

    inverse = search.maps[t.normals.shape[1] :]  # (A, d)
    is_lower, is_upper = search.sides > 0.0, search.sides < 0.0
    target = jnp.where(is_upper, -high[search.rows], low[search.rows])
    target = jnp.where(is_lower | is_upper, target, 0.0)
    point = _product(target, inverse)
    missing = target - search.sides * _product(t.normals, point)[search.rows]
    point = point + _product(missing, inverse)

    reached = unbounded + t.scales * _product(t.normals, point)
    excess = jnp.maximum(
        jnp.where(jnp.isfinite(lower), (lower - reached) / (1.0 + jnp.abs(lower)), -jnp.inf),
        jnp.where(jnp.isfinite(upper), (reached - upper) / (1.0 + jnp.abs(upper)), -jnp.inf),
    )
    cost = _product(right_side, _product(t.base_cost, right_side)) + 0.5 * jnp.sum(point**2)
    pressure = search.sides * _product(inverse, point)
    is_row = search.rows[:, None] == jnp.arange(lower.shape[0])[None]
    multiplier = jnp.sum(jnp.where(is_row, pressure[:, None], 0.0), axis=0) / t.scales
    violation = jnp.max(excess, initial=0.0)
    is_over = jnp.max(search.excess) > 0.0
    status = jnp.where(is_over, search.status, Status.CONVERGED)
    status = jnp.where(violation > 1e-5, jnp.maximum(status, Status.INFEASIBLE), status)
    status = jnp.where(jnp.isfinite(cost + violation), status, Status.NON_FINITE)
    return QpSolution(
        point=_product(t.base, right_side) + _product(t.directions, point),
        cost=cost,
        multiplier=multiplier,
        violation=violation,
        steps=search.steps,
        status=status.astype(jnp.int32),
    )


def _search(
    normals: Numbers, is_free: Array, low: Array, high: Array, slack: Array, config: QpConfig
) -> _Search:
    num, size = normals.shape
    slots = min(config.active, size)
    dtype = normals.dtype
    rounding = jnp.asarray(float(jnp.finfo(dtype).eps) ** 0.7, dtype)

    def excess_of(reached: Array) -> Array:
        return jnp.where(is_free, jnp.maximum(low - reached, reached - high) - slack, -jnp.inf)

    def is_running(s: _Search) -> Array:
        is_optimal = (s.entering < 0) & ~(jnp.max(s.excess) > 0.0)
        return ~is_optimal & ~s.is_stuck & (s.steps < config.max_steps)

    def step(s: _Search) -> _Search:
        row = jnp.where(s.entering < 0, lax.argmax(s.excess, 0, jnp.int32), s.entering)
        normal = normals[row]
        reached = jnp.sum(normal * s.point)
        side = jnp.where(low[row] - reached > reached - high[row], 1.0, -1.0).astype(dtype)
        gap = jnp.maximum(low[row] - reached, reached - high[row])
        # While the multiplier of the entering bound grows by 1, the point moves by `move`, and the
        # multipliers of the active bounds decrease by `fall`.
        both = _product(s.maps, side * normal)
        move, fall = both[:size], both[size:]
        freedom = jnp.sum(move**2)
        is_movable = freedom > rounding
        taken = s.sides != 0.0
        until = jnp.where(taken & (fall > rounding), s.multipliers / fall, jnp.inf)
        loser = lax.argmin(until, 0, jnp.int32)
        full = jnp.where(is_movable, gap / freedom, jnp.inf)
        is_added = full <= until[loser]
        length = jnp.minimum(full, until[loser])
        place = jnp.where(is_added, lax.argmin(taken.astype(jnp.int32), 0, jnp.int32), loser)
        is_hopeless = ~jnp.isfinite(length)
        is_stuck = is_hopeless | (is_added & taken[place])
        length = jnp.where(is_stuck, 0.0, length)

        lost = s.maps[size + loser]
        other = jnp.where(is_added, both, _product(s.maps, lost))
        axis = jnp.where(is_added, move, lost)
        is_place = jnp.arange(slots) == place
        kept = jnp.concatenate(
            [jnp.where(is_added, 0.0, lost), (is_added & is_place).astype(dtype)]
        )
        maps = s.maps + (kept - other)[:, None] * (axis / jnp.sum(axis**2))[None]

        point = s.point + jnp.where(is_movable, length, 0.0) * move
        pressure = s.pressure + length
        multipliers = jnp.maximum(s.multipliers - length * fall, 0.0)
        gone = jnp.where(is_added, num, s.rows[place])
        held = (s.held | (is_added & (jnp.arange(num) == row))) & (jnp.arange(num) != gone)
        excess = jnp.where(held, -jnp.inf, excess_of(_product(normals, point)))
        return _Search(
            point=point,
            excess=excess,
            maps=jnp.where(is_stuck, s.maps, maps),
            rows=jnp.where(is_place & is_added & ~is_stuck, row, s.rows),
            sides=jnp.where(is_place & ~is_stuck, jnp.where(is_added, side, 0.0), s.sides),
            multipliers=jnp.where(is_place, jnp.where(is_added, pressure, 0.0), multipliers),
            held=held,
            entering=jnp.where(is_added & ~is_stuck, -1, row),
            pressure=jnp.where(is_added, 0.0, pressure),
            steps=s.steps + 1,
            status=jnp.where(is_hopeless, Status.INFEASIBLE, Status.MAX_STEPS).astype(jnp.int32),
            is_stuck=is_stuck,
        )

    maps = jnp.concatenate([jnp.eye(size, dtype=dtype), jnp.zeros((slots, size), dtype)])
    start = _Search(
        point=jnp.zeros(size, dtype),
        excess=excess_of(jnp.zeros(num, dtype)),
        maps=maps,
        rows=jnp.zeros(slots, jnp.int32),
        sides=jnp.zeros(slots, dtype),
        multipliers=jnp.zeros(slots, dtype),
        held=jnp.zeros(num, bool),
        entering=jnp.asarray(-1, jnp.int32),
        pressure=jnp.zeros((), dtype),
        steps=jnp.asarray(0, jnp.int32),
        status=jnp.asarray(Status.MAX_STEPS, jnp.int32),
        is_stuck=jnp.asarray(False),
    )
    return lax.while_loop(is_running, step, start)


def _product(a: Numbers, b: Numbers) -> Array:
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)
