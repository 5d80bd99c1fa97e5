"""Observations of the balls by motion capture, and estimates of the balls' states and drag.

An observation is the noisy position of a ball one latency ago, or is missing. The library's Kalman
filter estimates position and velocity from the observations. The energy that a ball has lost since
the start of the plan for it gives its drag [Yu2023bat, eqs 6 and 7]. World frame, SI units.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.ball.estimation import EkfModel, EkfState, ekf_init, ekf_predict, ekf_update
from planner_jax.ball.flight import BallState, fly, rk4_step
from planner_jax.perception.drag import RlsState, rls_update, specific_energy
from planner_jax.sims.noise import Sensing

_LEAST_STD = 1e-3  # [m], least standard deviation that the filter assumes of an observation
_ACCELERATION_DENSITY = 0.01  # [m^2/s^3], spectral density of the filter's process noise
_FLIGHT_STEPS = 4  # number of integration steps of a prediction over latency and planning
_DRAG_SPREAD = 0.2  # relative standard deviation of the initial drag estimate


@struct.dataclass
class Estimate:
    """The estimated state and drag of one ball."""

    belief: EkfState  # Gaussian estimate of position and velocity, one latency ago
    energy: Array  # () [m^2/s^2], energy per unit mass at `anchor_energy`
    energy_variance: Array  # () [m^4/s^4], variance of that energy
    lever: Array  # () [m^3/s^2], integral of |v|^3 since `anchor_energy`, speed |v|
    prior: RlsState  # estimate of K_D [1/m] before any energy loss is observed
    drag: Array  # () [1/m], current estimate of K_D


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
        acceleration_density=jnp.full_like(drag, _ACCELERATION_DENSITY),
        observation_std=jnp.full_like(drag, max(sensing.position_std, _LEAST_STD)),
    )


def first_estimate(pos: Array, drag: Array) -> Estimate:
    """Return the first estimate of a ball that leaves a pitching machine at `pos` (3,) [m].

    The velocity is unknown. `drag` () [1/m] is the initial estimate of the drag coefficient.
    """
    zero = jnp.zeros_like(drag)
    wide = ekf_init(pos, jnp.zeros_like(pos), pos_std=zero + 0.1, vel_std=zero + 10.0)
    prior = RlsState(estimate=drag, variance=(_DRAG_SPREAD * drag) ** 2 + 1e-8)
    return Estimate(
        belief=wide, energy=zero, energy_variance=zero, lever=zero, prior=prior, drag=drag
    )


def advance_belief(
    estimate: Estimate, duration: Array, sensing: Sensing, gravity: Array
) -> EkfState:
    """Return the belief about a ball `duration` [s] later, without an observation."""
    model = _model(sensing, estimate.drag, gravity)
    return ekf_predict(estimate.belief, duration, model, flight=rk4_step)


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
    return dataclasses.replace(estimate, belief=belief, lever=estimate.lever + speed**3 * period)


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
        estimate, energy=energy, energy_variance=variance, lever=jnp.zeros_like(estimate.lever)
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
    """
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
    return fly(estimate.belief.ball, ahead, estimate.drag, gravity, num_steps=_FLIGHT_STEPS)[0]
