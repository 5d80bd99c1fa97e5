"""Observations of the balls by motion capture, and estimates of the balls' states and drag.

An observation is the noisy position of a ball one latency ago, or is missing. The library's Kalman
filter estimates position and velocity from the observations. The energy that a ball has lost since
the start of the plan for it gives its drag [Yu2023bat, eqs 6 and 7]. `noise.OBSERVERS` lists other
observers, which follow the papers in each step. World frame, SI units.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.ball.estimation import EkfModel, EkfState, ekf_init, ekf_predict, ekf_update
from planner_jax.ball.flight import BallState, fly, rk4_step
from planner_jax.ball.linear_drag import linear_drag_flight
from planner_jax.perception.drag import RlsState, drag_by_rls, rls_update, specific_energy
from planner_jax.perception.linear_fit import (
    DragWindow,
    refine_model,
    window_init,
    window_update,
)
from planner_jax.sims.noise import Sensing

_LEAST_STD = 1e-3  # [m], least standard deviation that the filter assumes of an observation
_ACCELERATION_DENSITY = 0.01  # [m^2/s^3], spectral density of the filter's process noise
_FLIGHT_STEPS = 4  # number of integration steps of a prediction over latency and planning
_DRAG_SPREAD = 0.2  # relative standard deviation of the initial drag estimate
# Relative standard deviation of the prior of linear drag, which is K_D times the ball's speed, and
# its least standard deviation [1/s].
_LINEAR_SPREAD, _LEAST_LINEAR_STD = 0.5, 0.01
# [1/m], standard deviation of one measurement of K_D by the energy lost between two observations,
# for velocities that are wrong by 0.05 m/s. RLS weighs the initial estimate by it.
_MEASURED_STD = 0.2


@struct.dataclass
class LinearFit:
    """The coefficients of linear drag of one ball, and the estimates to which they are fitted."""

    drag: Array  # (3,) K_i [1/s]
    window: DragWindow


@struct.dataclass
class Estimate:
    """The estimated state and drag of one ball."""

    belief: EkfState  # Gaussian estimate of position and velocity, one latency ago
    energy: Array  # () [m^2/s^2], energy per unit mass at `anchor_energy`
    energy_variance: Array  # () [m^4/s^4], variance of that energy
    lever: Array  # () [m^3/s^2], integral of |v|^3 since `anchor_energy`, speed |v|
    prior: RlsState  # estimate of K_D [1/m] before any energy loss is observed
    drag: Array  # () [1/m], current estimate of K_D
    fit: LinearFit | None = None  # None for the observer "energy"
    rls: RlsState | None = None  # estimate of K_D by the observer "rls", else None

    @property
    def path_drag(self) -> Array:
        """Drag for predictions: (3,) K_i [1/s] by the observer "linear", else () K_D [1/m]."""
        return self.drag if self.fit is None or self.rls is not None else self.fit.drag


def observe(key: Array, pos: Array, sensing: Sensing) -> Array:
    """Return noisy positions (N, 3) [m] of N balls at `pos`; a lost observation is a row of NaN."""
    noise_key, drop_key = jax.random.split(key)
    seen = pos + sensing.position_std * jax.random.normal(noise_key, pos.shape, pos.dtype)
    lost = jax.random.uniform(drop_key, pos.shape[:1], pos.dtype) < sensing.dropout
    return jnp.where(lost[:, None], jnp.nan, seen)


def _model(sensing: Sensing, drag: Array, gravity: Array) -> EkfModel:
    return EkfModel(
        drag=drag,
        gravity=gravity,
        acceleration_density=jnp.full((), _ACCELERATION_DENSITY, drag.dtype),
        observation_std=jnp.full((), max(sensing.position_std, _LEAST_STD), drag.dtype),
    )


def first_estimate(
    pos: Array, drag: Array, observer: str = "energy", vel: Array | None = None
) -> Estimate:
    """Return the first estimate of a ball that leaves a pitching machine at `pos` (3,) [m].

    `drag` () [1/m] is the initial estimate of the drag coefficient. The velocity `vel` (3,) [m/s],
    by default 0, is a guess with an error of 10 m/s. `observer` is a key of `noise.OBSERVERS`.
    """
    zero, vel = jnp.zeros_like(drag), jnp.zeros_like(pos) if vel is None else vel
    wide = ekf_init(pos, vel, pos_std=zero + 0.1, vel_std=zero + 10.0)
    prior = RlsState(estimate=drag, variance=(_DRAG_SPREAD * drag) ** 2 + 1e-8)
    linear = LinearFit(_linear_drag(drag, vel), window_init(dtype=drag.dtype))
    return Estimate(
        belief=wide,
        energy=zero,
        energy_variance=zero,
        lever=zero,
        prior=prior,
        drag=drag,
        fit=None if observer == "energy" else linear,
        rls=_unit_rls(prior) if observer == "rls" else None,
    )


def _linear_drag(drag: Array, vel: Array) -> Array:
    """Return the coefficients (3,) [1/s] of linear drag that equals quadratic drag at `vel`."""
    square = jnp.sum(vel**2)
    moves = square > 0.0
    return jnp.full(3, drag * jnp.where(moves, jnp.sqrt(jnp.where(moves, square, 1.0)), 0.0))


def _unit_rls(prior: RlsState) -> RlsState:
    return RlsState(prior.estimate, prior.variance / _MEASURED_STD**2)


def advance_belief(
    estimate: Estimate, duration: Array, sensing: Sensing, gravity: Array
) -> EkfState:
    """Return the belief about a ball `duration` [s] later, without an observation."""
    if estimate.fit is None:
        model, flight = _model(sensing, estimate.drag, gravity), rk4_step
    else:
        model, flight = _model(sensing, estimate.fit.drag, gravity), linear_drag_flight
    return ekf_predict(estimate.belief, duration, model, flight=flight)


def update_estimate(
    estimate: Estimate,
    seen: Array,
    sensing: Sensing,
    gravity: Array,
    period: Array | None = None,
) -> Estimate:
    """Update the estimate of one ball by the Kalman filter with one observed position (3,) [m].

    The estimate belongs to a time `period` [s] earlier, by default one period of observation.
    """
    if period is None:
        period = jnp.full_like(estimate.drag, 1.0 / sensing.rate)
    ahead = advance_belief(estimate, period, sensing, gravity)
    belief = ekf_update(ahead, seen, _model(sensing, estimate.drag, gravity))
    speed = jnp.sqrt(jnp.sum(belief.ball.vel**2))
    after = dataclasses.replace(estimate, belief=belief, lever=estimate.lever + speed**3 * period)
    return (
        after if estimate.fit is None else _refine(after, estimate, seen, sensing, gravity, period)
    )


def _refine(
    after: Estimate,
    before: Estimate,
    seen: Array,
    sensing: Sensing,
    gravity: Array,
    period: Array,
) -> Estimate:
    """Return the estimate with linear drag [Yu2023catch, eq. 12] and RLS [Yu2023bat, eq. 7]."""
    assert before.fit is not None
    mean = jnp.where(jnp.all(jnp.isfinite(seen)), after.belief.mean, jnp.nan)
    seen_belief = dataclasses.replace(after.belief, mean=mean)
    window = window_update(before.fit.window, period, seen_belief)
    prior = _linear_drag(before.prior.estimate, after.belief.ball.vel)
    model = _model(sensing, before.fit.drag, gravity)
    drag = refine_model(window, model, prior, _LINEAR_SPREAD * prior + _LEAST_LINEAR_STD).drag
    rls = before.rls
    if rls is not None:
        rls = drag_by_rls(rls, before.belief.ball, seen_belief.ball, period, gravity)
    return dataclasses.replace(after, fit=LinearFit(drag, window), rls=rls)


def update_unfiltered(
    estimate: Estimate, seen: Array, sensing: Sensing, gravity: Array
) -> Estimate:
    """Update the estimate of one ball with one observed position (3,) [m], without a filter.

    The velocity follows from the observed position and the previous position. If the observation
    is missing (NaN), the ball's flight is predicted instead.
    """
    period = 1.0 / sensing.rate
    before = estimate.belief.ball
    flown = rk4_step(before, jnp.full_like(estimate.drag, period), estimate.drag, gravity)
    # The mean velocity between two observations belongs to the middle of their times. Half of the
    # predicted change of velocity is added, to get the velocity at the later observation.
    vel = (seen - before.pos) / period + 0.5 * (flown.vel - before.vel)
    taken = jnp.concatenate([seen, vel])
    blind = jnp.concatenate([flown.pos, flown.vel])
    mean = jnp.where(jnp.all(jnp.isfinite(seen)), taken, blind)
    return dataclasses.replace(estimate, belief=dataclasses.replace(estimate.belief, mean=mean))


def anchor_energy(estimate: Estimate, gravity: Array) -> Estimate:
    """Make the ball's current energy the reference from which energy losses are measured."""
    energy, variance = _energy(estimate.belief, gravity)
    return dataclasses.replace(
        estimate,
        energy=energy,
        energy_variance=variance,
        lever=jnp.zeros_like(estimate.lever),
        rls=None if estimate.rls is None else _unit_rls(estimate.prior),
    )


def _energy(belief: EkfState, gravity: Array) -> tuple[Array, Array]:
    slope = jnp.concatenate([jnp.stack([0.0 * gravity, 0.0 * gravity, gravity]), belief.ball.vel])
    variance = jnp.sum(slope[:, None] * belief.covariance * slope[None])
    return specific_energy(belief.ball, gravity), variance


def with_drag(estimate: Estimate, gravity: Array) -> Estimate:
    """Update the drag coefficient K_D from the energy that the ball has lost [Yu2023bat, eq. 7].

    At speed |v|, drag takes the energy K_D * (integral of |v|^3) per unit mass. One least-squares
    update combines the loss since `anchor_energy` with the prior estimate of K_D. The paper instead
    averages the losses between single observations, which would count the same noise repeatedly.
    The observer "rls" does so; the observer "linear" does not change K_D.
    """
    if estimate.fit is not None:
        rls = estimate.rls
        return estimate if rls is None else dataclasses.replace(estimate, drag=rls.estimate)
    return dataclasses.replace(estimate, drag=_find_drag(estimate, gravity).estimate)


def settle_drag(estimate: Estimate, gravity: Array) -> Estimate:
    """Make the drag estimated since `anchor_energy` the prior estimate of the next flight."""
    found = _find_drag(estimate, gravity)
    return dataclasses.replace(estimate, prior=found, drag=found.estimate)


def _find_drag(estimate: Estimate, gravity: Array) -> RlsState:
    energy, variance = _energy(estimate.belief, gravity)
    std = jnp.sqrt(jnp.maximum(variance + estimate.energy_variance, 1e-12))
    return rls_update(estimate.prior, estimate.lever / std, (estimate.energy - energy) / std)


def predict(estimate: Estimate, ahead: Array, gravity: Array) -> BallState:
    """Predict the state of a ball `ahead` [s] after the time of its position estimate."""
    return fly_on(estimate, ahead, gravity, _FLIGHT_STEPS)


def fly_on(estimate: Estimate, ahead: Array, gravity: Array, num_steps: int) -> BallState:
    """Return the ball `ahead` [s] later; quadratic drag is integrated in `num_steps` steps."""
    ball, drag = estimate.belief.ball, estimate.path_drag
    if drag.ndim:
        return linear_drag_flight(ball, ahead, drag, gravity)
    return fly(ball, ahead, drag, gravity, num_steps=num_steps)[0]
