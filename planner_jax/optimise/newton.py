"""Newton's method for small smooth problems, many at once.

Each iteration builds a subspace of a few vectors from the gradient by products with the damped
Hessian [Lanczos1950], in which that is tridiagonal. Where it bends downward there, it is shifted
until it does not, as in trust-region methods ([More1983]; in such a subspace [Gould1999]). As in
`optimise.lbfgs` feasibility is watched beside the cost, and the best feasible iterate comes back.

Few vectors are enough where the planner has a preconditioner, the inverse of what in the Hessian is
strong. Damping has two metrics. A lane's own is added to the Hessian as it is: far from the optimum
it leads down the gradient, in variables that are scaled. Beside it several multiples of the
preconditioner's curvature are tried at once, at a few operations each, because under `vmap` a
search for the right one would run to the slowest lane. The multiple that did best says how the
lane's own damping goes on; it fades, and the last steps are Newton's, along flat valleys too.

Near an optimum two costs differ by less than their rounding, while slopes still say where it is.
With a slack the least damped step that costs no more than rounding goes on from there, as in the
approximate conditions of Wolfe [Hager2005], until steps lead no nearer.
"""

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
_HALVINGS = 14  # of the interval in which the least eigenvalue is looked for
_LEAST_DAMPING = 1e-10  # of a lane's own
_LEAST = 1e-7  # of a pivot, beside the greatest number of its matrix


@struct.dataclass
class NewtonNumbers:
    """What one lane carries from iteration to iteration beside its points."""

    best: Evaluation  # at the best point; not finite before the first iteration
    damping: Array  # ()
    expected: Array  # (), decrease that the last iteration expected, relative to the cost
    iteration: Array  # () int32
    stalled: Array  # () int32, iterations in a row that led no nearer


@struct.dataclass
class NewtonState:
    """What one lane carries from iteration to iteration."""

    point: Array  # (n,)
    best_point: Array  # (n,)
    numbers: NewtonNumbers


def by_products(objective: Objective) -> Curved:
    """The second derivatives of any objective, a tangent of its gradient for each product."""

    def preconditioner(damping: Array) -> Callable[[Array], Array]:
        return lambda right: right / damping  # nothing but the damping is known of the Hessian

    def curved(point: Array) -> Curvature:
        def slope(at: Array) -> tuple[Array, Evaluation]:
            def cost(x: Array) -> tuple[Array, Evaluation]:
                evaluation = objective(x)
                return evaluation.cost, evaluation

            by, evaluation = jax.grad(cost, has_aux=True)(at)
            return by, evaluation

        gradient, product, evaluation = jax.linearize(slope, point, has_aux=True)
        return Curvature(evaluation, gradient, lambda: product, preconditioner)

    return curved


def init(point: Array, config: NewtonConfig) -> NewtonState:
    """State before the first iteration; nothing is evaluated."""
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


def is_unfinished(numbers: NewtonNumbers, config: NewtonConfig) -> Array:
    """Whether a lane has iterations left and is not stationary, () bool."""
    return (numbers.iteration < config.max_steps) & ~is_stationary(numbers, config)


def is_stationary(numbers: NewtonNumbers, config: NewtonConfig) -> Array:
    """Whether nothing more is to be gained, () bool."""
    return (numbers.expected <= config.tolerance) | (numbers.stalled >= config.patience)


def most_to_gain(numbers: NewtonNumbers, config: NewtonConfig, num: int) -> Array:
    """The lanes (num,) of a batch whose last iterations expected the greatest decreases.

    Unfinished ones come before those that are finished.
    """
    expected = jnp.where(jnp.isnan(numbers.expected), jnp.inf, numbers.expected)
    return jnp.argsort(jnp.where(is_unfinished(numbers, config), -expected, 1.0))[:num]


def step(
    objective: Objective, curved: Curved, state: NewtonState, config: NewtonConfig
) -> NewtonState:
    """One iteration: gradient, subspace, steps of all dampings at once, the lowest kept.

    A finished lane stands still.
    """
    here = curved(state.point)
    steps, decrease = damped_steps(here, state.numbers.damping, config)
    trials = jax.vmap(lambda step: objective(state.point + step))(steps)
    numbers, chosen, is_best, going = _chosen(
        config, state.numbers, here.evaluation, trials, decrease
    )
    move = jnp.matmul(chosen, steps, precision=_HIGHEST)
    point = state.point + jnp.where(going, move, 0.0)
    return NewtonState(
        point=point,
        best_point=jnp.where(is_best, point, state.best_point),
        numbers=numbers,
    )


def damped_steps(here: Curvature, damping: Array, config: NewtonConfig) -> tuple[Array, Array]:
    """Newton steps within the subspace, a step for each trial damping.

    Args:
        here: gradient, products and preconditioner; n unknowns.
        damping: (), the lane's own, > 0: added to the Hessian's diagonal.
        config: sizes and switches, static; k trial dampings.

    Returns:
        steps: (k, n), none longer than the step cap.
        decrease: (), of the cost that the step without trial damping promises.
    """
    gradient = here.gradient
    solve_about = here.preconditioner(damping)
    turned = solve_about(gradient)
    size = jnp.sqrt(jnp.maximum(jnp.sum(gradient * turned), 0.0))
    if config.subspace:
        product = here.products()

        def image(direction: Array) -> tuple[Array, Array]:
            found = product(direction) + damping * direction
            return found, solve_about(found)

        directions, diagonal, beside = _lanczos(gradient, turned, size, image, config.subspace)
    else:  # as if the preconditioner were the whole inverse
        directions = turned[None] / jnp.maximum(size, 1e-30)
        diagonal, beside = [jnp.ones_like(size)], []
    shift = jnp.maximum(-_lowest(diagonal, beside), 0.0)
    solve = lambda trial: _tridiagonal_solve(diagonal, beside, shift + trial)  # noqa: E731
    trials = jnp.asarray(config.trial_dampings, gradient.dtype)
    inside = size * jax.vmap(solve)(trials)  # (k, m)
    steps = -jnp.matmul(inside, directions, precision=_HIGHEST)
    lengths = jnp.sqrt(jnp.sum(steps**2, axis=1, keepdims=True))
    steps = steps * jnp.minimum(1.0, config.step_cap / jnp.maximum(lengths, 1e-20))
    promised = 0.5 * size**2 * solve(jnp.zeros_like(size))[0]
    return jnp.where(jnp.isfinite(steps), steps, 0.0), promised


def _lanczos(
    gradient: Array, turned: Array, size: Array, image: Callable, num: int
) -> tuple[Array, list[Array], list[Array]]:
    """Directions (m, n) of the subspace, and the damped Hessian there.

    They are orthonormal by the preconditioner's curvature M. Returns the Hessian's diagonal, m
    numbers, and what stands beside it, m - 1 numbers.

    Args:
        gradient: (n,).
        turned: (n,), M^-1 gradient.
        size: (), sqrt(gradient . turned).
        image: Hessian's product with a direction (n,), and M^-1 of that.
        num: m.
    """
    num = min(num, gradient.size)
    scale = 1.0 / jnp.maximum(size, 1e-30)
    # Rows M d beside rows d, of each direction d.
    images = jnp.zeros((num, gradient.size), gradient.dtype).at[0].set(gradient * scale)
    directions = jnp.zeros_like(images).at[0].set(turned * scale)
    diagonal, beside = [], []
    for k in range(num):
        product, turned = image(directions[k])
        diagonal.append(jnp.sum(directions[k] * product))
        if k + 1 == num:
            break
        # Against all that went before, since rounding would bring them back.
        shares = jnp.matmul(directions, product, precision=_HIGHEST)
        product = product - jnp.matmul(shares, images, precision=_HIGHEST)
        turned = turned - jnp.matmul(shares, directions, precision=_HIGHEST)
        length = jnp.sqrt(jnp.maximum(jnp.sum(product * turned), 0.0))
        # An invariant subspace ends here: what follows is a vector of zeros.
        is_new = length > 1e-5 * jnp.abs(diagonal[-1])
        scale = jnp.where(is_new, 1.0 / jnp.where(is_new, length, 1.0), 0.0)
        beside.append(jnp.where(is_new, length, 0.0))
        images = images.at[k + 1].set(scale * product)
        directions = directions.at[k + 1].set(scale * turned)
    return directions, diagonal, beside


def _pivots(diagonal: list[Array], beside: list[Array], shift: Array) -> list[Array]:
    """Of the tridiagonal matrix with a number added to its diagonal; none is zero."""
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
    """Least eigenvalue of the tridiagonal matrix, from below; 0 if none is negative.

    By halving an interval, by the signs of pivots (Sturm).
    """
    around = [*(jnp.abs(each) for each in beside)]
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
    """Solution (m,) of the shifted tridiagonal system, the first unit vector on its right."""
    pivots = _pivots(diagonal, beside, shift)
    right = [jnp.ones_like(pivots[0])]
    for k in range(1, len(pivots)):
        right.append(-beside[k - 1] / pivots[k - 1] * right[-1])
    found = [right[-1] / pivots[-1]]
    for k in reversed(range(len(pivots) - 1)):
        found.append((right[k] - beside[k] * found[-1]) / pivots[k])
    return jnp.stack(found[::-1])


def _chosen(
    config: NewtonConfig,
    numbers: NewtonNumbers,
    here: Evaluation,
    trials: Evaluation,
    decrease: Array,
) -> tuple[NewtonNumbers, Array, Array, Array]:
    """What an iteration comes to: numbers, shares of the trials, if it is best, if it counts."""
    costs = jnp.where(jnp.isfinite(trials.cost), trials.cost, jnp.inf)
    slack = config.slack * jnp.finfo(costs.dtype).eps * jnp.abs(here.cost)
    places = jnp.arange(costs.size)
    # Of trials that rounding does not tell apart the one with the least damping.
    is_chosen = places == jnp.argmin(jnp.where(costs <= jnp.min(costs) + slack, places, costs.size))

    def of_chosen(values: Array) -> Array:  # without a gather, which would need a loop of its own
        return jnp.sum(jnp.where(is_chosen, values, 0.0))

    moved = of_chosen(costs) < here.cost + slack
    there = jax.tree.map(lambda new, old: jnp.where(moved, of_chosen(new), old), trials, here)
    best = jax.tree.map(lambda a, b: jnp.where(numbers.iteration == 0, a, b), here, numbers.best)
    before = best.replace(cost=best.cost + slack)
    is_best = is_better(there, before, tolerance=0.0) | ~jnp.isfinite(before.cost)
    is_best &= moved
    factors = jnp.maximum(jnp.asarray(config.trial_dampings, costs.dtype), config.ease)
    damping = numbers.damping * jnp.where(moved, of_chosen(factors), config.tighten)
    promised = decrease / jnp.maximum(jnp.abs(here.cost), 1e-30)
    # A step that is much damped promises less than there is to be gained.
    is_short = numbers.damping > config.trusted
    expected = jnp.where(is_short, jnp.maximum(promised, numbers.expected), promised)
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
    shares = jnp.where(is_chosen & moved, 1.0, 0.0)
    return after, shares, is_best & going, going
