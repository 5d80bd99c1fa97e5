"""Levenberg-Marquardt: least squares of few unknowns, a Cholesky factorisation a step.

For problems whose terms are squares of residuals with Jacobians that are known, such as hinges on
limits: the curvature J'J is then good enough to take a dozen steps where a quasi-Newton method
takes many more. Each step tries one point; it is kept if it costs less, with less damping for the
next one, and dropped with more if not.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jax.scipy.linalg import cho_factor, cho_solve


@struct.dataclass
class Model:
    """A sum of squares and its quadratic model at a point."""

    cost: Array  # ()
    gradient: Array  # (n,)
    curvature: Array  # (n, n), J'J with what else is positive
    violation: Array  # (), largest relative excess over a limit; <= 0 is good


@dataclasses.dataclass(frozen=True)
class LevenbergConfig:
    """Sizes and switches; static."""

    max_steps: int = 20
    damping: float = 1e-2  # at first, times the curvature's mean diagonal
    ease: float = 0.2  # of the damping, after a step that is kept
    tighten: float = 6.0  # of the damping, after one that is dropped
    longest: float = 1.5  # change of an unknown in one step
    settled: int = 2  # steps without a share `tolerance` less cost end the search of a good point
    tolerance: float = 1e-2
    # A search is given up once its cost is above `hope` x `fade`^k, k steps after the step `trial`.
    trial: int = 0
    hope: float | None = None
    fade: float = 1.0


@struct.dataclass
class LevenbergState:
    """The best point so far, and what the next step needs."""

    point: Array  # (n,)
    model: Model  # at the point
    damping: Array  # ()
    steps: Array  # () int32
    stalled: Array  # () int32, steps in a row that brought little, while every limit holds


def least_squares(
    evaluate: Callable[[Array], Model], start: Array, config: LevenbergConfig
) -> LevenbergState:
    """Minimise a sum of squares from one start; pure, so jit and vmap it.

    Args:
        evaluate: the model at a point (n,).
        start: (n,).
        config: sizes and switches, static.

    Returns:
        The last state. It is settled if `stalled` has reached `config.settled`.
    """
    return go_on(evaluate, begun(start, config), config)


def begun(start: Array, config: LevenbergConfig) -> LevenbergState:
    """The state of a search that has not looked at its start (n,) yet."""
    # The first step, of no length, looks at the start: to evaluate it here would compile the
    # model twice.
    zero = jnp.zeros((), start.dtype)
    nothing = Model(
        cost=zero + jnp.inf,
        gradient=jnp.zeros_like(start),
        curvature=jnp.eye(start.size, dtype=start.dtype),
        violation=zero + jnp.inf,
    )
    return LevenbergState(
        point=start,
        model=nothing,
        damping=zero + config.damping / config.ease,
        steps=jnp.full((), -1, jnp.int32),
        stalled=jnp.zeros((), jnp.int32),
    )


def go_on(
    evaluate: Callable[[Array], Model],
    state: LevenbergState,
    config: LevenbergConfig,
    most: Array | int | None = None,
) -> LevenbergState:
    """The last state of a search that goes on from one.

    Args:
        evaluate: the model at a point (n,).
        state: to go on from.
        config: sizes and switches, static.
        most: () int32, steps in all; None for `config.max_steps`.
    """
    most = config.max_steps if most is None else most

    def goes_on(state: LevenbergState) -> Array:
        is_open = (state.steps < most) & (state.stalled < config.settled)
        if config.hope is None:
            return is_open
        behind = state.steps - config.trial
        bound = config.hope * config.fade ** jnp.maximum(behind, 0)
        return is_open & ((behind < 0) | (state.model.cost <= bound))

    return lax.while_loop(goes_on, lambda state: _step(evaluate, state, config), state)


def _step(
    evaluate: Callable[[Array], Model], state: LevenbergState, config: LevenbergConfig
) -> LevenbergState:
    model = state.model
    # Damped by one number for all, so that what no residual sees stays where it is.
    scale = jnp.mean(jnp.diagonal(model.curvature)) * state.damping
    damped = model.curvature + scale * jnp.eye(state.point.size, dtype=state.point.dtype)
    change = -cho_solve(cho_factor(damped), model.gradient)
    longest = jnp.max(jnp.abs(change))
    change = change * jnp.minimum(1.0, config.longest / jnp.maximum(longest, 1e-9))
    point = state.point + jnp.where(jnp.isfinite(change), change, 0.0)
    tried = evaluate(point)
    better = tried.cost < model.cost
    little = ~(tried.cost < (1.0 - config.tolerance) * model.cost)
    kept = jax.tree.map(
        lambda new, old: jnp.where(better, new, old), (point, tried), (state.point, model)
    )
    good = kept[1].violation <= 0.0
    return LevenbergState(
        point=kept[0],
        model=kept[1],
        damping=state.damping * jnp.where(better, config.ease, config.tighten),
        steps=state.steps + 1,
        stalled=jnp.where(good & little, state.stalled + 1, 0),
    )
