"""`minimise`: the library's solvers on an objective of the user, for one problem or many."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jax.core import Tracer
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from planner_jax.core.arithmetic import numpy_of
from planner_jax.core.checks import numbers_of, require_kind, require_number, require_numeric
from planner_jax.core.compiled import Fixed
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.rules import NOT_NEGATIVE
from planner_jax.lanes import over_lanes
from planner_jax.optimise.efforts import LONG
from planner_jax.optimise.levenberg import LevenbergConfig
from planner_jax.optimise.methods import Box, Method, are_free, project, projected_norm, steps_of
from planner_jax.optimise.multistart import put_lanes_first, put_lanes_last
from planner_jax.optimise.settings import Evaluation, LbfgsConfig, NewtonConfig


@struct.dataclass
class Minimum:
    """The best point that a search found, for one lane; a batch has one more leading axis."""

    point: Array  # (n,), within the bounds
    cost: Array  # ()
    violation: Array  # (), largest relative excess over a limit; feasible if <= 0
    gradient_norm: Array  # (), greatest change of a variable in the projected step x - gradient
    iterations: Array  # () int32
    is_stationary: Array  # () bool, False if iterations ran out, or if the cost is not finite


def minimise(
    objective: Callable[..., PyTree],
    start: ArrayLike,
    solver: Method = LONG,
    *,
    args: tuple = (),
    bounds: tuple[ArrayLike, ArrayLike] | None = None,
    gradient_tolerance: float = 1e-5,
) -> Minimum:
    """Minimise an objective from one start (n,), or from B starts (B, n) in B lanes at once.

    The function works inside `jax.jit` and `jax.vmap`, and computes in the type of `start`.
    The implicit function theorem gives the derivatives of the minimum by `args`, by bounds, and by
    arrays that the objective closes over. They are NaN in a lane that is not stationary. The
    derivatives by `start` are zero. Outside of `jax.jit`, each new objective is compiled.

    Args:
        objective: pure function of a point (n,) and of the `args` of one lane. It returns the cost
            (), or the pair (cost, violation) with the largest relative excess over a limit: points
            with a violation <= 0 are selected before others. For `LevenbergConfig` it returns
            residuals (m,), whose sum of squares is the cost.
        start: floating-point numbers (n,) or (B, n).
        solver: `LbfgsConfig`, `NewtonConfig`, `LevenbergConfig` or `OptaxSolver`.
        args: further arguments of the objective, pytrees of arrays. With B starts, each array has a
            leading axis B.
        bounds: the pair (lower, upper) of arrays (n,) or (B, n), infinite where there is no bound.
            The objective is evaluated only at points within the bounds.
        gradient_tolerance: a search also ends if its `gradient_norm` is at most this number.

    Raises:
        ArgumentError: an array has a wrong shape, or a lower bound exceeds the upper bound. In
            traced bounds the latter makes the point of the lane NaN instead.
        ArgumentTypeError: an argument has a wrong type, such as a `start` of integers.
    """
    require_kind("solver", solver, *Method.__args__)
    if not callable(objective):
        raise ArgumentTypeError("objective", "a function", objective)
    require_number("gradient_tolerance", gradient_tolerance, NOT_NEGATIVE)
    point, *data = _check(start, args, bounds)
    axes = (None,) if point.ndim == 1 else ()
    lanes = jax.tree.map(lambda leaf: jnp.asarray(leaf)[axes], (point, *data))
    lane = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape[1:], leaf.dtype), lanes)
    # Arrays that the objective closes over become arguments, so that they can be differentiated.
    pure, shared = jax.closure_convert(objective, lane[0], *lane[1])
    settings = solver if isinstance(solver, LbfgsConfig | LevenbergConfig) else Fixed(solver)
    rest = (settings, jnp.asarray(gradient_tolerance, point.dtype), lanes, shared)
    found = _search(pure, *rest) if shared else _search_compiled(objective, *rest)
    return jax.tree.map(lambda leaf: leaf[0], found) if axes else found


def _check(start: ArrayLike, args: tuple, bounds: PyTree) -> tuple[Array, tuple, Box | None]:
    """Return checked arguments; the start is within the bounds, and NaN where they are wrong."""
    point = require_numeric("start", start)
    if not jnp.issubdtype(point.dtype, jnp.floating):
        raise ArgumentTypeError("start", "floating-point numbers", shown=f"{point.dtype}")
    if point.ndim not in (1, 2) or not point.shape[-1]:
        raise ArgumentError("start", "the shape (n,) or (B, n), n > 0", point.shape, verb="have")
    require_kind("args", args, tuple)
    point, batch = jnp.asarray(point), point.shape[:-1]
    for shape in map(np.shape, jax.tree.leaves(args)):
        if shape[: len(batch)] != batch:
            raise ArgumentError("args", f"the leading axis {batch[0]}", shape, verb="have")
    if bounds is None:
        return point, args, None
    if not isinstance(bounds, tuple | list) or len(bounds) != 2:
        raise ArgumentTypeError("bounds", "a pair (lower, upper)", bounds)
    shapes = (batch, point.shape[-1:])
    lower, upper = (numbers_of(f"bounds[{k}]", bounds[k], *shapes) for k in (0, 1))
    is_wrong = numpy_of(lower, upper).logical_not(lower <= upper)
    if not isinstance(is_wrong, Tracer) and is_wrong.any():
        index = tuple(np.argwhere(np.asarray(is_wrong))[0].tolist())
        raise ArgumentError("bounds[0]", "<=", lower[index], index, other="bounds[1]")
    box = Box(*(jnp.asarray(each, point.dtype) for each in (lower, upper)))
    return jnp.where(is_wrong, jnp.nan, project(point, box)), args, box


def _search(
    objective: Callable, settings: PyTree, tolerance: Array, lanes: tuple, shared: list
) -> Minimum:
    """Minimise B lanes, whose axis is the first one in `lanes`: starts, arguments and bounds."""
    solver: PyTree = settings.attempt if isinstance(settings, Fixed) else settings
    is_squares = isinstance(solver, LevenbergConfig)
    over = over_lanes if isinstance(solver, LbfgsConfig | NewtonConfig) else _over_last
    (starts, *data), constants = lax.stop_gradient((put_lanes_last(lanes), shared))

    def steps(args: tuple, box: Box | None) -> PyTree:
        def goal(point: Array) -> PyTree:
            values = _read(objective(point, *args, *constants), point.dtype, is_squares)
            return values if is_squares else Evaluation(*values)

        return steps_of(solver, goal, box)

    def start(point: Array, *own: PyTree) -> tuple:
        return steps(*own).start(point), jnp.zeros((), bool)

    def is_open(lane: tuple, *own: PyTree) -> Array:
        return steps(*own).is_open(lane[0]) & ~lane[1]

    def advance(lane: tuple, *own: PyTree) -> tuple:
        state, norm = steps(*own).advance(lane[0])
        goes_on = is_open(lane, *own)
        return jax.tree.map(lambda a, b: jnp.where(goes_on, a, b), (state, norm <= tolerance), lane)

    def finish(lane: tuple, *own: PyTree) -> tuple:
        point, iterations, is_stationary = steps(*own).outcome(lane[0])
        return point, iterations, is_stationary | lane[1]

    last = lax.while_loop(
        lambda state: jnp.any(over(is_open)(state, *data)),
        lambda state: over(advance)(state, *data),
        over(start)(starts, *data),
    )

    def value(point: Array, args: tuple, shared: list) -> Evaluation:
        values = _read(objective(point, *args, *shared), point.dtype, is_squares)
        none = jnp.zeros((), point.dtype)
        return Evaluation(jnp.sum(values**2), none) if is_squares else Evaluation(*values)

    found = put_lanes_first(over(finish)(last, *data))
    return jax.vmap(lambda found, args, box: _result(value, found, args, shared, box))(
        found, *lanes[1:]
    )


_search_compiled = functools.partial(jax.jit, static_argnums=0)(_search)


def _over_last(function: Callable) -> Callable:
    return jax.vmap(function, in_axes=-1, out_axes=-1)


def _read(value: PyTree, dtype: np.dtype, is_squares: bool) -> PyTree:
    """Return residuals (m,), or the pair of cost and violation, as an objective returned them."""
    pair = value if isinstance(value, tuple) else (value,) if is_squares else (value, 0.0)
    shapes = [jnp.shape(each) for each in pair]
    rule = "residuals (m,)" if is_squares else "a cost () or a pair (cost, violation)"
    is_right = list(map(len, shapes)) == ([1] if is_squares else [0, 0])
    if not is_right:
        shown = f"shapes {', '.join(map(str, shapes))}"
        raise ArgumentError("objective", rule, shown=shown, verb="return")
    arrays = [jnp.asarray(each, dtype) for each in pair]
    return arrays[0] if is_squares else arrays


def _result(value: Callable, found: tuple, args: tuple, shared: list, box: Box | None) -> Minimum:
    """Return the result of one lane, with the derivatives of the minimum."""
    point, iterations, is_stationary = found
    cost = lambda x, *data: value(x, *data).cost  # noqa: E731

    @jax.custom_jvp
    def attach(point: Array, is_stationary: Array, box: Box | None, data: tuple) -> Array:
        return point

    @attach.defjvp
    def differentiate(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
        point, is_stationary, box, data = primals
        slope = lambda *data: jax.grad(cost)(point, *data)  # noqa: E731
        gradient, right = jax.jvp(slope, data, tangents[3])
        free, moved = are_free(point, gradient, box), jnp.zeros_like(point)
        if box is not None:  # a fixed variable moves as its bound
            moved = (1.0 - free) * jnp.where(point <= box.lower, *tangents[2])
        hessian = jax.hessian(cost)(point, *data)
        right = right + jnp.matmul(hessian, moved, precision=lax.Precision.HIGHEST)
        block = jnp.where(jnp.outer(free, free) > 0.0, hessian, jnp.eye(free.size))
        step = moved - jnp.linalg.solve(block, free * right)
        return point, jnp.where(is_stationary, step, jnp.nan)

    point = attach(point, is_stationary, box, (args, shared))
    there, pull, violation = jax.vjp(lambda x: tuple(value(x, args, shared)), point, has_aux=True)
    (gradient,) = pull(jnp.ones_like(there))
    norm = projected_norm(point, gradient, box)
    is_stationary &= jnp.isfinite(there)
    return Minimum(point, there, violation, norm, iterations, is_stationary)
