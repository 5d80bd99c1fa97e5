"""Paths of targets through positions at given times, such as recorded or simulated motions."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.typing import DTypeLike
from jaxtyping import PyTree
from numpy.typing import ArrayLike
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from planner_jax.ball.prediction import PathTable, convolution_weights
from planner_jax.core.arithmetic import Numbers
from planner_jax.core.checks import floating, require_number, shape_of
from planner_jax.core.choices import require_size
from planner_jax.core.errors import ArgumentError
from planner_jax.core.origin import split_far, to_world
from planner_jax.core.rules import POSITIVE

MOST_NODES = 4096  # greatest number of nodes that `table_path` chooses by itself
# Fractions of the time between two nodes at which the interpolation error is measured.
_CHECKED = (0.2, 0.5, 0.8)


def table_path(
    times: ArrayLike,
    positions: ArrayLike,
    velocities: ArrayLike | None = None,
    *,
    nodes: int | None = None,
    error: float = 1e-3,
    dtype: DTypeLike = jnp.float32,
) -> PathTable:
    """Return a target path through positions at times that need not be evenly spaced.

    A cubic spline with continuous acceleration interpolates the positions, or a cubic Hermite
    spline if velocities are passed. With times at most d apart, the error of the position is
    O(d^4), and the error of the velocity O(d^3). Noisy observations should be smoothed before.

    The result is a table of samples of the spline at equal time steps, between which planners
    interpolate by cubic convolution. By default the table has enough nodes to approximate the
    spline's position to `error` [m], and its velocity to 10 `error` [m/s].

    Args:
        times: NumPy array of K >= 2 increasing times [s]. Planning starts at time 0, which must be
            within the times. After the last time the target keeps its velocity.
        positions: (..., K, 3) [m], or (..., K, 2) in the plane; leading axes are leading axes of
            the result, such as (N,) for the targets of one catch. The path is differentiable by
            positions.
        velocities: (..., K, 3) or (..., K, 2) [m/s].
        nodes: number of nodes, >= 5. Required if positions are traced by JAX; pass it also if
            several batches of tables should share a compiled program.
        error: [m], > 0, greatest error of the table; used only if `nodes` is not passed.
        dtype: floating type of every leaf of the result. Positions over 1 km from the origin stay
            in float64 NumPy arrays, from which the function `case` subtracts its origin.

    Raises:
        ValueError: the times do not rise or exclude time 0, a shape does not fit, or the path needs
            more than `MOST_NODES`.
        TypeError: an argument does not hold numbers, or `dtype` is not a floating type.
    """
    dtype, times = floating(dtype), _check_times(times)
    values = [_check_values("positions", positions, times.size)]
    if velocities is not None:
        values.append(_check_values("velocities", velocities, times.size))
    values[0], away = split_far(values[0])
    if len(values) == 2 and np.shape(values[0]) != np.shape(values[1]):
        rule = f"the shape {np.shape(values[0])} of positions"
        raise ArgumentError("velocities", rule, np.shape(values[1]), verb="have")
    if nodes is None:
        nodes = _fewest_nodes(times, values, error)
    require_size("nodes", nodes, 5)
    resolution, at = _nodes_at(times, nodes)
    evaluate = _spline(times, values)
    pos, vel = (jnp.asarray(evaluate(at, order), dtype) for order in (0, 1))
    pos = to_world(pos, away)
    return PathTable(pos, vel, jnp.full(pos.shape[:-2], resolution, dtype))


def _check_times(times: ArrayLike) -> np.ndarray:
    if isinstance(times, Tracer):
        raise ArgumentError("times", "known when a program is compiled", shown="traced ones")
    shape = shape_of("times", times)
    if len(shape) != 1 or shape[0] < 2:
        raise ArgumentError("times", "the shape (K,) with K >= 2", shape, verb="have")
    times = np.asarray(times, np.float64)
    steps = np.diff(times)
    if not np.isfinite(times).all() or not (steps > 0.0).all():
        raise ArgumentError("times", "finite and rise", shown=f"a step of {steps.min():g} s")
    if not times[0] <= 0.0 < times[-1]:
        rule = "at 0, when planning begins, or before, and end after it"
        shown = f"{times[0]:g} to {times[-1]:g} s"
        raise ArgumentError("times", rule, verb="begin", shown=shown)
    return times


def _check_values(name: str, value: ArrayLike, num: int) -> Numbers:
    if shape_of(name, value)[-2:] not in ((num, 3), (num, 2)):
        raise ArgumentError(name, f"the shape (..., {num}, 3)", np.shape(value), verb="have")
    if isinstance(value, Tracer):
        return value
    value = np.asarray(value, np.float64)
    if not np.isfinite(value).all():
        raise ArgumentError(name, "finite", value[~np.isfinite(value)][0])
    return value


def _nodes_at(times: np.ndarray, nodes: int) -> tuple[float, np.ndarray]:
    """Return the time between two nodes [s], and the times of all nodes, (nodes,) [s]."""
    resolution = float(times[-1]) / (nodes - 3)
    return resolution, (np.arange(nodes) - 1) * resolution


def _spline(times: np.ndarray, values: list[PyTree]) -> Callable[[np.ndarray, int], PyTree]:
    """Return a function of times (N,) and an order that evaluates a derivative of the spline."""
    if not any(isinstance(value, Tracer) for value in values):
        make = CubicSpline if len(values) == 1 else CubicHermiteSpline
        return make(times, *values, axis=-2)
    # The spline is linear in its values, so that its weights for traced values are constant.
    units, none = np.eye(times.size), np.zeros((times.size, times.size))
    if len(values) == 1:
        splines = [CubicSpline(times, units)]
    else:
        splines = [CubicHermiteSpline(times, *pair) for pair in ((units, none), (none, units))]

    def evaluate(at: np.ndarray, order: int) -> PyTree:
        parts = [
            jnp.matmul(
                jnp.asarray(spline(at, order), jnp.result_type(value)),
                value,
                precision=lax.Precision.HIGHEST,
            )
            for spline, value in zip(splines, values, strict=True)
        ]
        return sum(parts[1:], parts[0])

    return evaluate


def _fewest_nodes(times: np.ndarray, values: list[PyTree], error: float) -> int:
    if any(isinstance(value, Tracer) for value in values):
        raise ArgumentError("nodes", "passed if positions are traced", shown="none")
    require_number("error", error, POSITIVE)
    evaluate, nodes, worst = _spline(times, values), 16, np.inf
    rows = {share: np.asarray(convolution_weights(jnp.asarray(share))) for share in _CHECKED}
    while nodes <= MOST_NODES:
        resolution, at = _nodes_at(times, nodes)
        worst = 0.0
        for order, allowed in ((0, error), (1, 10.0 * error)):
            table = evaluate(at, order)
            for share, weights in rows.items():
                read = sum(weights[k] * table[..., k : nodes - 3 + k, :] for k in range(4))
                exact = evaluate(at[1:-2] + share * resolution, order)
                worst = max(worst, np.abs(read - exact).max(initial=0.0) / allowed)
                if worst > 1.0:
                    break
        if worst <= 1.0:
            return nodes
        nodes *= 2
    raise ArgumentError(
        "error", f">= {worst * error:.2g} m, which is what {MOST_NODES} nodes leave", error
    )
