"""Predict and estimate the ball of a rally across impacts, from what the robots observe."""

import dataclasses
import functools

import jax.numpy as jnp
from jax import Array

from planner_jax.ball.estimation import EkfState, congruence
from planner_jax.ball.flight import BallState, fly
from planner_jax.perception.drag import rls_update
from planner_jax.sims import sensing as sight
from planner_jax.sims.loop_state import Loop
from planner_jax.sims.rally_state import Trial, pick
from planner_jax.sims.scoring import racket_impact

_LEARNING = 0.25  # [s], after an impact, when the restitution is estimated from the new flight
# Standard deviation [m/s] of the difference of the ball's velocities before and after an impact, by
# errors of the estimates and of the racket's velocity.
_JUMP_STD = 0.15
_IMPACT_STD = (0.01, 0.1)  # [m], [m/s], additional deviations of a ball's estimate by an impact
_FLIGHT_STEPS = 4  # number of integration steps of a prediction


def predict(trial: Trial, loop: Loop, ahead: float) -> BallState:
    """Return the ball `ahead` [s] from now, across an impact that it has not been seen to pass."""
    gravity = jnp.asarray(loop.world.gravity, trial.time.dtype)
    span = jnp.asarray(loop.sensing.latency + ahead, trial.time.dtype)
    since = trial.time - loop.sensing.latency
    is_due = trial.bounce.is_due
    first = jnp.where(is_due, jnp.clip(trial.bounce.time - since, 0.0, span), 0.0)
    go = functools.partial(fly, drag=trial.estimate.drag, gravity=gravity, num_steps=_FLIGHT_STEPS)
    ball = go(trial.estimate.belief.ball, first)[0]
    vel = jnp.where(is_due, _reflect(trial, ball.vel), ball.vel)
    return go(BallState(ball.pos, vel), span - first)[0]


def _reflect(trial: Trial, vel: Array) -> Array:
    bounce, restitution = trial.bounce, trial.restitution.estimate - 1.0
    return racket_impact(vel, bounce.tool_vel, bounce.normal, restitution)


def reflect_belief(trial: Trial, belief: EkfState) -> EkfState:
    """Return the belief about a ball just after the impact that the robot has felt."""
    bounce, restitution = trial.bounce, trial.restitution
    normal = bounce.normal
    turn = jnp.eye(3) - restitution.estimate * normal[:, None] * normal[None]
    P = congruence(jnp.eye(6).at[3:, 3:].set(turn), belief.covariance)
    approach = jnp.sum((belief.mean[3:] - bounce.tool_vel) * normal)
    along = restitution.variance * approach**2 * normal[:, None] * normal[None]
    stds = jnp.repeat(jnp.asarray(_IMPACT_STD, P.dtype), 3)
    P = P + jnp.diag(stds**2) + jnp.zeros_like(P).at[3:, 3:].set(along)
    mean = jnp.concatenate([belief.mean[:3], _reflect(trial, belief.mean[3:])])
    return EkfState(mean=mean, covariance=P)


def observe(trial: Trial, loop: Loop, seen: Array) -> Trial:
    """Return a trial after one observation (3,) [m], which may be missing (NaN)."""
    sensing, dtype = loop.sensing, trial.time.dtype
    gravity = jnp.asarray(loop.world.gravity, dtype)
    period = jnp.asarray(1.0 / sensing.rate, dtype)
    until = trial.time - sensing.latency  # time of the estimate after the observation
    bounce, estimate = trial.bounce, trial.estimate
    crosses = bounce.is_due & (bounce.time <= until)
    first = jnp.where(crosses, jnp.clip(bounce.time - until + period, 0.0, period), 0.0)

    before = sight.advance_belief(estimate, first, sensing, gravity)
    after = reflect_belief(trial, before)
    settled = dataclasses.replace(sight.settle_drag(estimate, gravity), belief=after)
    started = dataclasses.replace(estimate, belief=before)
    estimate = pick(crosses, settled, started)
    bounce = dataclasses.replace(
        bounce,
        ball_vel=jnp.where(crosses, before.mean[3:], bounce.ball_vel),
        is_due=bounce.is_due & ~crosses,
    )
    estimate = sight.update_estimate(estimate, seen, sensing, gravity, period - first)

    age = until - bounce.time
    learns = (age >= _LEARNING) & ~bounce.is_learned
    ago = jnp.where(learns, -age, 0.0)
    then = fly(estimate.belief.ball, ago, estimate.drag, gravity, num_steps=_FLIGHT_STEPS)[0]
    jump = jnp.sum((then.vel - bounce.ball_vel) * bounce.normal)
    approach = jnp.sum((bounce.tool_vel - bounce.ball_vel) * bounce.normal)
    learned = rls_update(trial.restitution, approach / _JUMP_STD, jump / _JUMP_STD)
    known = bounce.is_learned | learns
    anchored, usual = sight.anchor_energy(estimate, gravity), sight.with_drag(estimate, gravity)
    return dataclasses.replace(
        trial,
        estimate=pick(learns, anchored, pick(known, usual, estimate)),
        restitution=pick(learns, learned, trial.restitution),
        bounce=dataclasses.replace(bounce, is_learned=known),
    )
