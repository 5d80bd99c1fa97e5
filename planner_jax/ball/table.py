"""The path of a target from a table of a user's own: recorded, simulated, or sent by a tracker."""

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
from planner_jax.core.rules import POSITIVE

MOST_NODES = 4096  # that are chosen for a path
_CHECKED = (0.2, 0.5, 0.8)  # shares of the way between two nodes, where errors are looked for


def table_path(
    times: ArrayLike,
    positions: ArrayLike,
    velocities: ArrayLike | None = None,
    *,
    nodes: int | None = None,
    error: float = 1e-3,
    dtype: DTypeLike = jnp.float32,
) -> PathTable:
    """The path through positions at times that need not be evenly spaced.

    Between the times it is the cubic spline with continuous acceleration, or with velocities the
    cubic Hermite spline. Of a smooth flight whose times are at most d apart, the error of the
    position is O(d^4), and that of the velocity, the spline's derivative, O(d^3). Nothing is
    smoothed: noisy observations should be fitted first.

    Planner and referee read the spline from equal steps, by cubic convolution. By default there
    are as many steps as bring its position to within `error`, and its velocity to within ten times
    as much a second.

    Args:
        times: (K,) [s], rising, K >= 2; time 0 is when planning begins, and lies within them.
            After the last one the target goes on at the velocity that it has there. NumPy, as the
            shape of the program follows from them.
        positions: (..., K, 3) [m]; the axes in front are those of the leaves that come back, such
            as (N,) for the targets of one catch. May be differentiated by.
        velocities: likewise [m/s].
        nodes: of the table, >= 5. To be given where positions are traced, and where tables of
            several batches are to share a compiled program.
        error: [m], > 0, from the spline, where `nodes` are not given.
        dtype: of every leaf.

    Raises:
        ValueError: the times do not rise or leave out time 0, a shape does not fit, or the path
            needs more than `MOST_NODES`.
        TypeError: an argument holds no numbers, or `dtype` is not that of floating ones.
    """
    dtype, times = floating(dtype), _checked_times(times)
    given = [("positions", positions), ("velocities", velocities)]
    values = [_checked(name, value, times.size) for name, value in given if value is not None]
    if len(values) == 2 and np.shape(values[0]) != np.shape(values[1]):
        rule = f"the shape {np.shape(values[0])} of positions"
        raise ArgumentError("velocities", rule, np.shape(values[1]), verb="have")
    if nodes is None:
        nodes = _fewest_nodes(times, values, error)
    require_size("nodes", nodes, 5)
    resolution = times[-1] / (nodes - 3)
    at = (np.arange(nodes) - 1) * resolution
    pos, vel = (jnp.asarray(_read(times, values, at, order), dtype) for order in (0, 1))
    return PathTable(pos, vel, jnp.full(pos.shape[:-2], resolution, dtype))


def _checked_times(times: ArrayLike) -> np.ndarray:
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


def _checked(name: str, value: ArrayLike, num: int) -> Numbers:
    """Values (..., K, 3), in float64 if they are not traced."""
    if shape_of(name, value)[-2:] != (num, 3):
        raise ArgumentError(name, f"the shape (..., {num}, 3)", np.shape(value), verb="have")
    if isinstance(value, Tracer):
        return value
    value = np.asarray(value, np.float64)
    if not np.isfinite(value).all():
        raise ArgumentError(name, "finite", value[~np.isfinite(value)][0])
    return value


def _read(times: np.ndarray, values: list[PyTree], at: np.ndarray, order: int) -> PyTree:
    """Derivative (..., T, 3) of the spline at times (T,): linear in the values."""
    units, none = np.eye(times.size), np.zeros((times.size, times.size))
    if len(values) == 1:
        splines = [CubicSpline(times, units)]
    else:
        splines = [CubicHermiteSpline(times, *pair) for pair in ((units, none), (none, units))]
    parts = []
    for spline, value in zip(splines, values, strict=True):
        weights = spline(at, order)
        if isinstance(value, Tracer):
            weights = jnp.asarray(weights, value.dtype)
            parts.append(jnp.matmul(weights, value, precision=lax.Precision.HIGHEST))
        else:
            parts.append(weights @ value)
    return sum(parts[1:], parts[0])


def _fewest_nodes(times: np.ndarray, values: list[PyTree], error: float) -> int:
    """A power of two of nodes with which the table is as near to the spline as it has to be."""
    if any(isinstance(value, Tracer) for value in values):
        raise ArgumentError("nodes", "given where positions are traced", shown="none")
    require_number("error", error, POSITIVE)
    nodes, worst = 16, np.inf
    while nodes <= MOST_NODES:
        resolution = times[-1] / (nodes - 3)
        at = (np.arange(nodes) - 1) * resolution
        worst = 0.0
        for order, allowed in ((0, error), (1, 10.0 * error)):
            table = _read(times, values, at, order)
            for share in _CHECKED:
                weights = np.asarray(convolution_weights(jnp.asarray(share)))
                read = sum(weights[k] * table[..., k : nodes - 3 + k, :] for k in range(4))
                exact = _read(times, values, at[1:-2] + share * resolution, order)
                worst = max(worst, np.abs(read - exact).max(initial=0.0) / allowed)
        if worst <= 1.0:
            return nodes
        nodes *= 2
    raise ArgumentError(
        "error", f">= {worst * error:.2g} m, which is what {MOST_NODES} nodes leave", error
    )
