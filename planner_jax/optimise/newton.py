"""Newton's method for small smooth problems, made for batches.

Each iteration builds a subspace of a few vectors from the gradient, by products with the damped
Hessian [Lanczos1950]. In this subspace the Hessian is tridiagonal. If it has negative eigenvalues
there, it is shifted until it has none, as in trust-region methods ([More1983]; in such a subspace
[Gould1999]). As in `optimise.lbfgs`, the solver also tracks feasibility and returns the best
feasible iterate. A lane is one problem of the batch.

Few vectors are enough if the planner has a preconditioner, an inverse of the dominant part of the
Hessian. There are two kinds of damping. First, each lane has its own damping, a multiple of the
identity that is added to the Hessian. Far from the optimum it turns the step towards the negative
gradient. Second, each iteration tries several steps, for which different multiples of the
preconditioner's matrix are added to the Hessian. (A line search under `vmap` would continue until
the slowest lane is done.) The best multiple determines the lane's next damping. The damping
decreases towards the optimum, where the last steps are undamped Newton steps.

Near an optimum the costs of two points differ by less than their rounding errors, while gradients
still show where the optimum is. With a `slack` > 0 a step may raise the cost by a rounding error,
as in the approximate Wolfe conditions [Hager2005]. Among the steps of equal cost up to this error,
the least damped one is taken.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from planner_jax.core.protocol import is_better
from planner_jax.optimise.settings import (
    MOST_DAMPING,
    Curvature,
    Curved,
    Evaluation,
    NewtonConfig,
    Objective,
)

_HIGHEST = lax.Precision.HIGHEST
_HALVINGS = 14  # number of bisections of the interval that contains the least eigenvalue
_LEAST_DAMPING = 1e-10  # least damping of one problem of the batch
_LEAST = 1e-7  # least pivot, relative to the greatest entry of its matrix


@struct.dataclass
class NewtonNumbers:
    """The scalars in the state of Newton's method for one problem of the batch."""

    best: Evaluation  # at the best point; not finite before the first iteration
    damping: Array  # ()
    expected: Array  # (), decrease that the last iteration predicted, relative to the cost
    iteration: Array  # () int32
    stalled: Array  # () int32, iterations in a row without progress


@struct.dataclass
class NewtonState:
    """The state of Newton's method for one problem of the batch, between two iterations."""

    point: Array  # (n,)
    best_point: Array  # (n,)
    numbers: NewtonNumbers


def by_products(objective: Objective) -> Curved:
    """Make the function of an objective's `Curvature` at a point, by automatic differentiation."""

    def preconditioner(damping: Array) -> Callable[[Array], Array]:
        return lambda right: right / damping  # nothing but the damping of the Hessian is known

    def expand(point: Array) -> Curvature:
        def slope(at: Array) -> tuple[Array, Evaluation]:
            def cost(x: Array) -> tuple[Array, Evaluation]:
                evaluation = objective(x)
                return evaluation.cost, evaluation

            by, evaluation = jax.grad(cost, has_aux=True)(at)
            return by, evaluation

        gradient, product, evaluation = jax.linearize(slope, point, has_aux=True)
        return Curvature(evaluation, gradient, lambda: product, preconditioner)

    return expand


def init(point: Array, config: NewtonConfig) -> NewtonState:
    """Return the state before the first iteration from a `point` (n,); nothing is evaluated."""
    unknown = jnp.full((), jnp.inf, point.dtype)
    return NewtonState(
        point=point,
        best_point=point,
        numbers=NewtonNumbers(
            best=Evaluation(unknown, unknown),
            damping=jnp.full((), config.damping, point.dtype),
            expected=unknown,
            iteration=jnp.zeros((), jnp.int32),
            stalled=jnp.zeros((), jnp.int32),
        ),
    )


def with_stragglers(config: NewtonConfig) -> NewtonConfig:
    """Return settings with which every problem may make the iterations of stragglers."""
    if config.stragglers is None:
        return config
    _, steps, groups = config.stragglers
    return dataclasses.replace(config, max_steps=config.max_steps + steps * groups, stragglers=None)


def is_unfinished(numbers: NewtonNumbers, config: NewtonConfig) -> Array:
    """Return whether a problem has iterations left and is not stationary, () bool."""
    return (numbers.iteration < config.max_steps) & ~is_stationary(numbers, config)


def is_stationary(numbers: NewtonNumbers, config: NewtonConfig) -> Array:
    """Return whether the predicted decrease is small, or progress has stalled, () bool."""
    return (numbers.expected <= config.tolerance) | (numbers.stalled >= config.patience)


def most_to_gain(numbers: NewtonNumbers, config: NewtonConfig, num: int) -> Array:
    """Return indices (num,) of problems, unfinished first, by falling predicted cost decrease."""
    expected = jnp.where(jnp.isnan(numbers.expected), jnp.inf, numbers.expected)
    return jnp.argsort(jnp.where(is_unfinished(numbers, config), -expected, 1.0))[:num]


def step(
    objective: Objective, curved: Curved, state: NewtonState, config: NewtonConfig
) -> NewtonState:
    """Return the state after one iteration of Newton's method.

    An iteration computes derivatives, a Krylov subspace and one step for each trial damping, and
    takes the step to the least cost. A finished problem of a batch keeps its point.
    """
    here = curved(state.point)
    steps, decrease = solve_damped(here, state.numbers.damping, config)
    trials = jax.vmap(lambda step: objective(state.point + step))(steps)
    numbers, chosen, is_best, going = _choose(
        config, state.numbers, here.evaluation, trials, decrease
    )
    point = state.point + jnp.where(going, jnp.matmul(chosen, steps, precision=_HIGHEST), 0.0)
    return NewtonState(
        point=point, best_point=jnp.where(is_best, point, state.best_point), numbers=numbers
    )


def solve_damped(here: Curvature, damping: Array, config: NewtonConfig) -> tuple[Array, Array]:
    """Return Newton steps (k, n) within the Krylov subspace, one for each of k trial dampings.

    `damping` > 0 is added to the Hessian's diagonal. A trial damping t also adds t times the
    preconditioner's matrix. No step is longer than `config.step_cap`. The second result () is the
    decrease of the cost that the quadratic model predicts for the step with t = 0.
    """
    gradient = here.gradient
    solve_about = here.preconditioner(damping)
    turned = solve_about(gradient)
    size = jnp.sqrt(jnp.maximum(jnp.sum(gradient * turned), 0.0))
    if config.subspace:
        product = here.products()

        def multiply(direction: Array) -> tuple[Array, Array]:
            found = product(direction) + damping * direction
            return found, solve_about(found)

        directions, diagonal, beside = _lanczos(gradient, turned, size, multiply, config.subspace)
    else:  # the preconditioner is taken for the complete inverse of the Hessian
        directions = turned[None] / jnp.maximum(size, 1e-30)
        diagonal, beside = [jnp.ones_like(size)], []
    shift = jnp.maximum(-_lowest(diagonal, beside), 0.0)
    solve = lambda trial: _tridiagonal_solve(diagonal, beside, shift + trial)  # noqa: E731
    inside = size * jax.vmap(solve)(jnp.asarray(config.trial_dampings, gradient.dtype))  # (k, m)
    steps = -jnp.matmul(inside, directions, precision=_HIGHEST)
    lengths = jnp.sqrt(jnp.sum(steps**2, axis=1, keepdims=True))
    steps = steps * jnp.minimum(1.0, config.step_cap / jnp.maximum(lengths, 1e-20))
    decrease = 0.5 * size**2 * solve(jnp.zeros_like(size))[0]
    return jnp.where(jnp.isfinite(steps), steps, 0.0), decrease


def _lanczos(
    gradient: Array, turned: Array, size: Array, image: Callable, num: int
) -> tuple[Array, list[Array], list[Array]]:
    """Return directions (m, n) of a Krylov subspace, and the damped Hessian in the subspace.

    The subspace has m dimensions, at most `num`. The directions are orthonormal with respect to the
    matrix M whose inverse is the preconditioner. The Hessian is returned as its diagonal, m
    numbers, and its subdiagonal, m - 1 numbers. `turned` is M^-1 gradient, and `size` is
    sqrt(gradient . turned). `image` returns the Hessian's product with a direction, and M^-1 times
    this product.
    """
    num = min(num, gradient.size)
    scale = 1.0 / jnp.maximum(size, 1e-30)
    # Row k of `images` is M times row k of `directions`; M^-1 is the preconditioner.
    images = jnp.zeros((num, gradient.size), gradient.dtype).at[0].set(gradient * scale)
    directions = jnp.zeros_like(images).at[0].set(turned * scale)
    diagonal, beside = [], []
    for k in range(num):
        product, turned = image(directions[k])
        diagonal.append(jnp.sum(directions[k] * product))
        if k + 1 == num:
            break
        # Orthogonalise against all previous directions: rounding errors add components along them.
        shares = jnp.matmul(directions, product, precision=_HIGHEST)
        product = product - jnp.matmul(shares, images, precision=_HIGHEST)
        turned = turned - jnp.matmul(shares, directions, precision=_HIGHEST)
        length = jnp.sqrt(jnp.maximum(jnp.sum(product * turned), 0.0))
        # If the subspace is invariant under the Hessian, the next direction is zero.
        is_new = length > 1e-5 * jnp.abs(diagonal[-1])
        scale = jnp.where(is_new, 1.0 / jnp.where(is_new, length, 1.0), 0.0)
        beside.append(jnp.where(is_new, length, 0.0))
        images = images.at[k + 1].set(scale * product)
        directions = directions.at[k + 1].set(scale * turned)
    return directions, diagonal, beside


def _pivots(diagonal: list[Array], beside: list[Array], shift: Array) -> list[Array]:
    scale = functools.reduce(jnp.maximum, [jnp.abs(each) for each in (*diagonal, *beside)])
    least = _LEAST * scale + 1e-30
    found = []
    for k, entry in enumerate(diagonal):
        pivot = entry + shift
        if k:
            pivot = pivot - beside[k - 1] ** 2 / found[-1]
        found.append(jnp.where(jnp.abs(pivot) < least, least, pivot))
    return found


def _lowest(diagonal: list[Array], beside: list[Array]) -> Array:
    """Return a lower bound of a tridiagonal matrix's least eigenvalue, or 0 if it is >= 0.

    The symmetric matrix has `diagonal` and subdiagonal `beside`. An interval around the eigenvalue
    is bisected: if elimination of (matrix - x I) has a negative pivot, an eigenvalue is below x.
    """
    around = [jnp.abs(each) for each in beside]
    zero = jnp.zeros_like(diagonal[0])
    reach = [
        (around[k - 1] if k else zero) + (around[k] if k < len(around) else zero)
        for k in range(len(diagonal))
    ]
    low = functools.reduce(jnp.minimum, [d - r for d, r in zip(diagonal, reach, strict=True)])
    high = functools.reduce(jnp.minimum, diagonal)

    def any_below(value: Array) -> Array:
        pivots = _pivots(diagonal, beside, -value)
        return functools.reduce(jnp.logical_or, [pivot < 0.0 for pivot in pivots])

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        is_below = any_below(middle)
        return jnp.where(is_below, low, middle), jnp.where(is_below, middle, high)

    lowest = lax.fori_loop(0, _HALVINGS, halve, (low, high))[0]
    return jnp.where(any_below(zero), lowest, 0.0)


def _tridiagonal_solve(diagonal: list[Array], beside: list[Array], shift: Array) -> Array:
    pivots = _pivots(diagonal, beside, shift)
    right = [jnp.ones_like(pivots[0])]
    for k in range(1, len(pivots)):
        right.append(-beside[k - 1] / pivots[k - 1] * right[-1])
    found = [right[-1] / pivots[-1]]
    for k in reversed(range(len(pivots) - 1)):
        found.append((right[k] - beside[k] * found[-1]) / pivots[k])
    return jnp.stack(found[::-1])


def _choose(
    config: NewtonConfig,
    numbers: NewtonNumbers,
    here: Evaluation,
    trials: Evaluation,
    decrease: Array,
) -> tuple[NewtonNumbers, Array, Array, Array]:
    """Choose the trial step of least cost, if it lowers the cost.

    Returns the new scalars of the state; weights of the trial steps, 1 for the chosen step; whether
    the new point is the best so far; and whether the search was unfinished before.
    """
    costs = jnp.where(jnp.isfinite(trials.cost), trials.cost, jnp.inf)
    slack = config.slack * jnp.finfo(costs.dtype).eps * jnp.abs(here.cost)
    places = jnp.arange(costs.size)
    # Among the trial steps whose costs are equal up to rounding, the least damped step is chosen.
    is_chosen = places == jnp.argmin(jnp.where(costs <= jnp.min(costs) + slack, places, costs.size))

    def of_chosen(values: Array) -> Array:  # a masked sum; a gather would need its own loop
        return jnp.sum(jnp.where(is_chosen, values, 0.0))

    moved = of_chosen(costs) < here.cost + slack
    there = jax.tree.map(lambda new, old: jnp.where(moved, of_chosen(new), old), trials, here)
    best = jax.tree.map(lambda a, b: jnp.where(numbers.iteration == 0, a, b), here, numbers.best)
    before = best._replace(cost=best.cost + slack)
    is_best = is_better(there, before, tolerance=0.0) | ~jnp.isfinite(before.cost)
    is_best &= moved
    factors = jnp.maximum(jnp.asarray(config.trial_dampings, costs.dtype), config.ease)
    damping = numbers.damping * jnp.where(moved, of_chosen(factors), config.tighten)
    predicted = decrease / jnp.maximum(jnp.abs(here.cost), 1e-30)
    # A strongly damped step is short, and predicts a small decrease also far from the optimum. The
    # greater of this and the last predicted decrease is kept, so that the search continues.
    is_short = numbers.damping > config.trusted
    expected = jnp.where(is_short, jnp.maximum(predicted, numbers.expected), predicted)
    is_nearer = (there.cost < here.cost - slack) | (moved & (expected < 0.5 * numbers.expected))
    after = NewtonNumbers(
        best=jax.tree.map(lambda a, b: jnp.where(is_best, a, b), there, best),
        damping=jnp.clip(damping, _LEAST_DAMPING, MOST_DAMPING),
        expected=expected,
        iteration=numbers.iteration + 1,
        stalled=jnp.where(is_nearer, 0, numbers.stalled + 1),
    )
    going = is_unfinished(numbers, config)
    after = jax.tree.map(lambda new, old: jnp.where(going, new, old), after, numbers)
    return after, jnp.where(is_chosen & moved, 1.0, 0.0), is_best & going, going
