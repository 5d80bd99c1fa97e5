"""Coefficients K_i of a ball's linear drag, fitted to its positions [Yu2023catch, eq. 12].

World frame, z up, SI units. Functions take one ball; use `jax.vmap` for many.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jax.typing import DTypeLike
from jaxtyping import Float

from planner_jax.ball.estimation import EkfModel, EkfState
from planner_jax.ball.flight import BallState
from planner_jax.ball.linear_drag import linear_drag_flight
from planner_jax.optimise.levenberg import LevenbergConfig, Model, least_squares


@struct.dataclass
class LinearDragFit:
    """Coefficients of linear drag that fit positions of a ball, and their uncertainty.

    Attributes:
        drag: (3,) [1/s], coefficients K_i; negative where noise outweighs the effect of drag.
        covariance: (3, 3) [1/s^2], covariance of the coefficients; infinite for an axis that no
            observation informs about, without entries between axes unless they share one
            coefficient.
        residual: () [m], root mean square of a coordinate's residual; 0 without observations.
    """

    drag: Array
    covariance: Array
    residual: Array


def fit_linear_drag(
    times: Float[Array, " n"],
    positions: Float[Array, "n 3"],
    start: BallState,
    drag: Float[Array, "3"],
    *,
    gravity: Array,
    observation_std: Array,
    shared: bool = False,
    prior_std: Array | float = jnp.inf,
    max_steps: int = 8,
) -> LinearDragFit:
    """Fit coefficients of linear drag to a ball's positions by least squares.

    The fit minimises  sum_k |s_k - s(t_k; K)|^2  over K [Yu2023catch, eq. 12], where s(t; K) is the
    flight from `start`, plus (observation_std / prior_std)^2 |K - drag|^2. It is the most probable
    K for independent errors of the positions. The fit is pure, for use under `jax.jit`, `jax.vmap`
    and `jax.grad`; derivatives come from the implicit function theorem.

    Args:
        times: (n,) [s], times t_k since `start`.
        positions: (n, 3) [m], positions s_k. A row that is not finite is ignored.
        start: leaves (3,), state of the ball at time 0, taken as exact.
        drag: (3,) [1/s], start of the search, and mean of the prior.
        gravity: () [m/s^2], magnitude.
        observation_std: () or (3,), or (n, 3) [m] > 0, standard deviation of a coordinate of a
            position.
        shared: whether the axes share one coefficient, whose start is the mean of `drag`.
        prior_std: () or (3,) [1/s] > 0, standard deviation of the prior; infinite for no prior.
            With `shared` it is ().
        max_steps: greatest number of Levenberg-Marquardt steps.
    """
    dtype = positions.dtype
    present = jnp.all(jnp.isfinite(positions), axis=1, keepdims=True)
    seen = jnp.where(present, positions, 0.0)
    after = jnp.where(present[:, 0], times, 0.0)
    mean = jnp.mean(drag, keepdims=True) if shared else drag
    information = jnp.ones_like(mean) / jnp.asarray(prior_std, dtype) ** 2
    per_axis = (lambda each: jnp.sum(each)[None]) if shared else lambda each: jnp.sum(each, axis=0)

    def residuals(found: Array) -> Array:
        axes = jnp.broadcast_to(found, (3,))
        flown = jax.vmap(lambda t: linear_drag_flight(start, t, axes, gravity).pos)(after)
        return jnp.where(present, (flown - seen) / observation_std, 0.0)

    def evaluate(found: Array) -> Model:
        # A coordinate depends on the coefficient of its own axis only, so that one derivative along
        # (1, 1, 1) has the whole Jacobian, and the curvature is diagonal.
        errors, slope = jax.jvp(residuals, (found,), (jnp.ones_like(found),))
        away = found - mean
        return Model(
            cost=0.5 * (jnp.sum(errors**2) + jnp.sum(information * away**2)),
            gradient=per_axis(slope * errors) + information * away,
            curvature=jnp.diag(per_axis(slope**2) + information),
            violation=jnp.zeros((), dtype),
        )

    def divide(numerator: Array, denominator: Array) -> Array:
        return numerator / jnp.where(denominator > 0.0, denominator, jnp.inf)

    config = LevenbergConfig(max_steps=max_steps, damping=1e-4, tolerance=0.0)
    found = lax.custom_root(
        lambda found: evaluate(found).gradient,
        lax.stop_gradient(mean),
        lambda _, at: least_squares(evaluate, at, config).point,
        lambda slope, value: divide(value, slope(jnp.ones_like(value))),
    )
    known = jnp.diagonal(evaluate(found).curvature)
    variance = jnp.where(known > 0.0, divide(jnp.ones_like(known), known), jnp.inf)
    square = jnp.sum((residuals(found) * observation_std) ** 2)
    mean_square = square / jnp.maximum(3.0 * jnp.sum(present.astype(dtype)), 1.0)
    is_exact = mean_square <= 0.0
    linked = jnp.ones((3, 3), bool) if shared else jnp.eye(3, dtype=bool)
    return LinearDragFit(
        drag=jnp.broadcast_to(found, (3,)),
        covariance=jnp.where(linked, jnp.broadcast_to(variance, (3,))[:, None], 0.0),
        residual=jnp.where(is_exact, 0.0, jnp.sqrt(jnp.where(is_exact, 1.0, mean_square))),
    )


@struct.dataclass
class DragWindow:
    """The last n estimates of a ball's state, from old to new; NaN before there are n.

    Attributes:
        ages: (n,) [s], time from each estimate to the last one.
        beliefs: estimates with leaves (n, 6) and (n, 6, 6).
    """

    ages: Array
    beliefs: EkfState


def window_init(num: int = 20, dtype: DTypeLike = jnp.float32) -> DragWindow:
    """Return an empty window of `num` estimates."""
    empty = EkfState(jnp.full((num, 6), jnp.nan, dtype), jnp.zeros((num, 6, 6), dtype))
    return DragWindow(ages=jnp.zeros(num, dtype), beliefs=empty)


def window_update(window: DragWindow, duration: Array, belief: EkfState) -> DragWindow:
    """Return the window after one more estimate, in place of the oldest one.

    Args:
        window: the estimates so far.
        duration: () [s], time since the last update.
        belief: estimate of the filter; its mean is NaN if the ball was not seen.
    """
    push = lambda old, new: jnp.concatenate([old[1:], new[None]])  # noqa: E731
    ages = push(window.ages + duration, jnp.zeros_like(window.ages[0]))
    return DragWindow(ages=ages, beliefs=jax.tree.map(push, window.beliefs, belief))


def refine_model(
    window: DragWindow, model: EkfModel, drag: Float[Array, "3"], prior_std: Array
) -> EkfModel:
    """Return the Kalman filter's model with the drag that fits the window [Yu2023catch, eq. 12].

    The fitted flight starts from the oldest estimate of the window. This estimate's uncertainty
    reduces the weights of the later ones. Otherwise the filter and its drag could diverge, since an
    error of the drag causes an error of the start, which changes the drag.

    Args:
        window: the last estimates of the filter.
        model: model of the filter, whose `drag` is replaced.
        drag: (3,) [1/s], mean of the prior, the same at every call for one ball.
        prior_std: () or (3,) [1/s], standard deviation of the prior.
    """
    means = window.beliefs.mean
    there = jnp.all(jnp.isfinite(means), axis=1)
    first = jnp.argmax(there)
    mean = jnp.where(jnp.any(there), means[first], 0.0)
    times = window.ages[first] - window.ages
    P, t = window.beliefs.covariance[first], times[:, None]
    pos, cross, vel = (jnp.diagonal(each)[None] for each in (P[:3, :3], P[:3, 3:], P[3:, 3:]))
    # All n positions have the start's error in common. With n times its variance it counts once.
    common = jnp.sum(there.astype(t.dtype)) * (pos + 2.0 * t * cross + t**2 * vel)
    fit = fit_linear_drag(
        times,
        means[:, :3],
        BallState(pos=mean[:3], vel=mean[3:]),
        drag,
        gravity=model.gravity,
        observation_std=jnp.sqrt(model.observation_std**2 + common),
        prior_std=prior_std,
    )
    return dataclasses.replace(model, drag=fit.drag)
