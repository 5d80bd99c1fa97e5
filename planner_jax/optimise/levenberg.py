"""Levenberg-Marquardt: least squares of few unknowns, one Cholesky factorisation a step.

The method suits costs that are sums of squared residuals with known Jacobians J. The curvature J'J
is then accurate enough to finish in a dozen steps, where a quasi-Newton method takes many more.
Each step evaluates one new point. If its cost is lower, it is accepted, and the damping is reduced
for the next step. Otherwise it is rejected, and the damping is increased.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jax.scipy.linalg import cho_factor, cho_solve

from planner_jax.core.compiled import with_run_time_numbers


@struct.dataclass
class Model:
    """A sum of squares at a point: its cost, gradient and approximate curvature."""

    cost: Array  # ()
    gradient: Array  # (n,)
    curvature: Array  # (n, n), J'J plus other positive terms
    violation: Array  # (), largest relative excess over a limit; feasible if <= 0


@with_run_time_numbers("max_steps", "tolerance", "settled", "fade")
@dataclasses.dataclass(frozen=True)
class LevenbergConfig:
    """Settings of a Levenberg-Marquardt search; hashable, so static under jit."""

    max_steps: int = 20
    damping: float = 1e-2  # initial damping, relative to the mean diagonal of the curvature
    ease: float = 0.2  # factor on the damping after an accepted step
    tighten: float = 6.0  # factor on the damping after a rejected step
    longest: float = 1.5  # greatest change of an unknown in one step
    # A search ends after `settled` steps in a row that each lower the cost by less than the
    # fraction `tolerance`, at points with `Model.violation` <= 0.
    settled: int = 2
    tolerance: float = 1e-2
    # A search is aborted if, k >= 0 steps after step number `trial`, its cost exceeds
    # hope * fade^k. If `hope` is None, no search is aborted.
    trial: int = 0
    hope: float | None = None
    fade: float = 1.0


@struct.dataclass
class LevenbergState:
    """The state of a search: its best point so far, and the numbers that the next step needs."""

    point: Array  # (n,)
    model: Model  # at the point
    damping: Array  # ()
    steps: Array  # () int32
    stalled: Array  # () int32, steps in a row at feasible points with little decrease


def least_squares(
    evaluate: Callable[[Array], Model], start: Array, config: LevenbergConfig
) -> LevenbergState:
    """Minimise a sum of squares from one start (n,); the function is pure, so jit and vmap it.

    `evaluate` returns the model at a point. The result is the last state of the search. The search
    has converged if `stalled` in this state has reached `config.settled`.
    """
    return continue_search(evaluate, start_search(start, config), config)


def start_search(start: Array, config: LevenbergConfig) -> LevenbergState:
    """Return the initial state of a search from `start` (n,), before any evaluation."""
    # With a zero gradient the first step has length zero and evaluates the start. If the start were
    # evaluated here, XLA would compile the function `evaluate` twice.
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
    """Continue to at most `most` steps in total (None: `config.max_steps`); return the state."""
    most = config.max_steps if most is None else most
    return lax.while_loop(
        lambda state: is_open(state, config, most),
        lambda state: step(evaluate, state, config),
        state,
    )


def is_open(state: LevenbergState, config: LevenbergConfig, most: Array | int) -> Array:
    """Return whether a search goes on, with at most `most` steps in total."""
    is_left = (state.steps < most) & (state.stalled < config.settled)
    if config.hope is None:
        return is_left
    behind = state.steps - config.trial
    fade = jnp.asarray(config.fade, state.model.cost.dtype)
    bound = config.hope * lax.pow(fade, jnp.maximum(behind, 0))
    return is_left & ((behind < 0) | (state.model.cost <= bound))


def step(
    evaluate: Callable[[Array], Model], state: LevenbergState, config: LevenbergConfig
) -> LevenbergState:
    """Return the state after one step, which evaluates one new point."""
    model = state.model
    # All unknowns have the same damping > 0, so an unknown without effect on the cost is unchanged.
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
