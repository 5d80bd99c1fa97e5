"""Iterations of the solvers for one problem of n variables, with or without bounds.

Bounds hold exactly, because every point is projected: a variable is replaced by the bound that it
exceeds. A variable is fixed during an iteration if it is at a bound, and a step along the negative
gradient would exceed the bound. The direction of a step is computed for the free variables alone,
and trial points along it are projected, as in the two-metric projection of [Bertsekas1982].
"""

import dataclasses
from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.core.choices import require_size
from planner_jax.core.errors import ArgumentTypeError
from planner_jax.core.protocol import is_better
from planner_jax.lanes.kernels import is_on_gpu
from planner_jax.optimise import lbfgs, levenberg, newton
from planner_jax.optimise.levenberg import LevenbergConfig
from planner_jax.optimise.settings import Evaluation, LbfgsConfig, NewtonConfig

if TYPE_CHECKING:
    import optax


class Box(NamedTuple):
    """Bounds on the variables of one problem; infinite where there is none."""

    lower: Array  # (n,)
    upper: Array  # (n,)


@dataclasses.dataclass(frozen=True)
class OptaxSolver:
    """A solver of the package optax, such as `optax.adam(0.1)` or `optax.lbfgs()`."""

    transformation: "optax.GradientTransformation"
    max_steps: int = 1000  # greatest number of iterations

    def __post_init__(self) -> None:
        require_size("max_steps", self.max_steps, 0)
        if not all(callable(getattr(self.transformation, f, None)) for f in ("init", "update")):
            rule = "a GradientTransformation of optax"
            raise ArgumentTypeError("transformation", rule, self.transformation)


Method = LbfgsConfig | NewtonConfig | LevenbergConfig | OptaxSolver


class Steps(NamedTuple):
    """The functions of a solver for one problem; see `steps_of`."""

    start: Callable[[Array], PyTree]  # state before the first iteration, from a point
    advance: Callable[[PyTree], tuple[PyTree, Array]]  # next state; norm of projected gradient
    is_open: Callable[[PyTree], Array]  # whether the search continues
    outcome: Callable[[PyTree], tuple[Array, Array, Array]]  # point, iterations, is_stationary


def project(point: Array, box: Box | None) -> Array:
    """Return the nearest point (n,) within the bounds."""
    return point if box is None else jnp.clip(point, box.lower, box.upper)


def are_free(point: Array, gradient: Array, box: Box | None) -> Array:
    """Return 1 for each variable that may move, and 0 for each variable that a bound fixes."""
    if box is None:
        return jnp.ones_like(point)
    fixed = (point <= box.lower) & (gradient > 0.0) | (point >= box.upper) & (gradient < 0.0)
    return jnp.where(fixed, 0.0, jnp.ones_like(point))


def projected_norm(point: Array, gradient: Array, box: Box | None) -> Array:
    """Return the greatest change () of a variable in the projected step x - gradient."""
    return jnp.max(jnp.abs(point - project(point - gradient, box) if box else gradient))


def steps_of(method: Method, objective: Callable, box: Box | None) -> Steps:
    """Return the steps of a solver for one problem.

    `objective` returns an `Evaluation`, or for Levenberg-Marquardt the residuals (m,).
    """
    if isinstance(method, LevenbergConfig):
        return _levenberg(method, objective, box)
    make = {LbfgsConfig: _lbfgs, NewtonConfig: _newton, OptaxSolver: _optax}[type(method)]
    return make(method, objective, lambda x: objective(project(x, box)), box)


def _lbfgs(config: LbfgsConfig, objective: Callable, inside: Callable, box: Box | None) -> Steps:

    def advance(state: lbfgs.LbfgsState) -> lbfgs.LbfgsState:
        if box is None and is_on_gpu():
            return lbfgs.step(objective, state, config)  # by a kernel
        here, grad = lbfgs.evaluate(objective, state.point)
        memory = lbfgs.remember(state.memory, state.step, grad - state.grad)
        within, free = memory, are_free(state.point, grad, box)
        if box is not None:
            steps, changes = memory.steps * free[None], memory.changes * free[None]
            pairs = ((steps, changes), (changes, changes), (steps, steps))
            sums = [jnp.sum(a * b, axis=1) for a, b in pairs]
            within = lbfgs.Memory(steps, changes, lbfgs.weigh_pair(*sums)[2])
        # On a CPU loops over the pairs take a tenth of the time of the unrolled recursion.
        direction = lbfgs.recur_twice(within, free * grad, config.step_cap, lax.scan, lambda f: f)
        return lbfgs.try_steps(inside, config, state, here, grad, memory, direction)

    def advance_inside(state: lbfgs.LbfgsState) -> tuple[lbfgs.LbfgsState, Array]:
        after = _inside(advance(state), box)
        if box is not None:
            after = dataclasses.replace(after, step=after.point - state.point)
        return after, projected_norm(state.point, after.grad, box)

    return _steps_by(lbfgs, config, advance_inside)


def _newton(config: NewtonConfig, objective: Callable, inside: Callable, box: Box | None) -> Steps:
    config = newton.with_stragglers(config)
    curved = newton.by_products(objective)

    def advance(state: newton.NewtonState) -> tuple[newton.NewtonState, Array]:
        here = curved(state.point)
        free = are_free(state.point, here.gradient, box)

        def products() -> Callable[[Array], Array]:
            product = here.products()
            return lambda direction: free * product(free * direction)

        reduced = here._replace(gradient=free * here.gradient, products=products)
        after = _inside(newton.step(inside, lambda _: reduced, state, config), box)
        return after, projected_norm(state.point, here.gradient, box)

    return _steps_by(newton, config, advance)


def _inside(state: PyTree, box: Box | None) -> PyTree:
    """Return a state of L-BFGS or Newton's method whose points are within the bounds."""
    point, best = project(state.point, box), project(state.best_point, box)
    return dataclasses.replace(state, point=point, best_point=best)


def _steps_by(module: ModuleType, config: LbfgsConfig | NewtonConfig, advance: Callable) -> Steps:
    """Return the steps of a module whose states have the best point so far and `numbers`."""

    def outcome(state: PyTree) -> tuple[Array, Array, Array]:
        numbers = state.numbers
        return state.best_point, numbers.iteration, module.is_stationary(numbers, config)

    is_open = lambda state: module.is_unfinished(state.numbers, config)  # noqa: E731
    return Steps(lambda point: module.init(point, config), advance, is_open, outcome)


def _levenberg(config: LevenbergConfig, residuals: Callable, box: Box | None) -> Steps:

    def evaluate(point: Array) -> levenberg.Model:
        point = project(point, box)
        values, push = jax.linearize(residuals, point)
        unit = jnp.eye(point.size, dtype=point.dtype)
        slopes = jax.vmap(push)(unit)  # (n, m), the transposed Jacobian
        gradient = jnp.matmul(slopes, values, precision=lax.Precision.HIGHEST)
        curvature = jnp.matmul(slopes, slopes.T, precision=lax.Precision.HIGHEST)
        free = are_free(point, gradient, box)
        # A fixed variable keeps its diagonal entry, so that the matrix stays positive definite.
        curvature = jnp.where(jnp.outer(free, free) + unit > 0.0, curvature, 0.0)
        no_limit = jnp.zeros((), point.dtype)
        return levenberg.Model(jnp.sum(values**2), free * gradient, curvature, no_limit)

    def advance(state: levenberg.LevenbergState) -> tuple[levenberg.LevenbergState, Array]:
        after = levenberg.step(evaluate, state, config)
        after = dataclasses.replace(after, point=project(after.point, box))
        return after, projected_norm(after.point, 2.0 * after.model.gradient, box)

    return Steps(
        start=lambda point: levenberg.start_search(point, config),
        advance=advance,
        is_open=lambda state: levenberg.is_open(state, config, config.max_steps),
        outcome=lambda state: (state.point, state.steps, state.stalled >= config.settled),
    )


def _optax(config: OptaxSolver, objective: Callable, inside: Callable, box: Box | None) -> Steps:
    import optax  # an optional package, which has made the transformation

    transformation = optax.with_extra_args_support(config.transformation)
    value_fn = lambda x: inside(x).cost  # noqa: E731

    def start(point: Array) -> tuple:
        unknown = Evaluation(*[jnp.full((), jnp.inf, point.dtype)] * 2)
        # The first iteration evaluates the start. The numbers of iterations begin with it.
        return point, transformation.init(point), (point, unknown), jnp.full((), -1, jnp.int32)

    def advance(state: tuple) -> tuple[tuple, Array]:
        point, inner, best, iteration = state
        here, grad = lbfgs.evaluate(objective, point)
        is_best = is_better(here, best[1], tolerance=0.0) | ~jnp.isfinite(best[1].cost)
        best = jax.tree.map(lambda a, b: jnp.where(is_best, a, b), (point, here), best)
        slope = are_free(point, grad, box) * grad
        updates, inner = transformation.update(
            slope, inner, point, value=here.cost, grad=slope, value_fn=value_fn
        )
        after: PyTree = optax.apply_updates(point, updates)
        return (project(after, box), inner, best, iteration + 1), projected_norm(point, grad, box)

    return Steps(
        start=start,
        advance=advance,
        is_open=lambda state: state[3] < config.max_steps,
        outcome=lambda state: (state[2][0], state[3], jnp.zeros((), bool)),
    )
