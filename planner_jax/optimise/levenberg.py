"""Levenberg-Marquardt: least squares of few unknowns, one Cholesky factorisation a step.

For problems whose terms are squares of residuals with known Jacobians, such as hinges on limits.
The curvature J'J is then accurate enough for a dozen steps where a quasi-Newton method takes many
more. Each step tries one point. It is accepted with less damping for the next step if it costs
less, and rejected with more damping otherwise.
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
    curvature: Array  # (n, n), J'J plus other positive terms
    violation: Array  # (), largest relative excess over a limit; <= 0 is good


@dataclasses.dataclass(frozen=True)
class LevenbergConfig:
    """Sizes and switches; static."""

    max_steps: int = 20
    damping: float = 1e-2  # initial, times the mean diagonal of the curvature
    ease: float = 0.2  # factor on the damping after an accepted step
    tighten: float = 6.0  # factor on the damping after a rejected step
    longest: float = 1.5  # greatest change of an unknown in one step
    # A search ends after `settled` steps at feasible points that each lower the cost by less than
    # the share `tolerance`.
    settled: int = 2
    tolerance: float = 1e-2
    # A search is aborted once its cost is above `hope` * `fade`^k, k steps after the step `trial`.
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
    stalled: Array  # () int32, steps in a row at feasible points with little decrease


def least_squares(
    evaluate: Callable[[Array], Model], start: Array, config: LevenbergConfig
) -> LevenbergState:
    """Minimise a sum of squares from one start (n,); pure, so jit and vmap it.

    `evaluate` returns the model at a point. In the last state, which is returned, the search has
    settled if `stalled` has reached `config.settled`.
    """
    return continue_search(evaluate, start_search(start, config), config)


def start_search(start: Array, config: LevenbergConfig) -> LevenbergState:
    """Return the state of a search before the evaluation of its start (n,)."""
    # The first step, of length zero, evaluates the start: to do so here would compile the model
    # twice.
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


def continue_search(
    evaluate: Callable[[Array], Model],
    state: LevenbergState,
    config: LevenbergConfig,
    most: Array | int | None = None,
) -> LevenbergState:
    """Continue a search from a state to `most` steps in all, and return its last state."""
    most = config.max_steps if most is None else most

    def is_unfinished(state: LevenbergState) -> Array:
        is_open = (state.steps < most) & (state.stalled < config.settled)
        if config.hope is None:
            return is_open
        behind = state.steps - config.trial
        fade = jnp.asarray(config.fade, state.model.cost.dtype)
        bound = config.hope * lax.pow(fade, jnp.maximum(behind, 0))
        return is_open & ((behind < 0) | (state.model.cost <= bound))

    return lax.while_loop(is_unfinished, lambda state: _step(evaluate, state, config), state)


def _step(
    evaluate: Callable[[Array], Model], state: LevenbergState, config: LevenbergConfig
) -> LevenbergState:
    model = state.model
    # One damping for all unknowns, so that unknowns without effect on the residuals do not move.
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
