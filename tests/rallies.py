"""Rallies of closed form, and the physics of executed hits, for tests of planner and referee."""

import numpy as np

import planner_jax as pj
from planner_jax.ball.flight import BallState
from planner_jax.planning.replan import planned_state
from planner_jax.task.hit.court import fly
from planner_jax.task.hit.plan import Stroke
from planner_jax.trajectory.polynomial import PiecewisePolynomial

GRAVITY = 9.8


def bounces(hits=2, restitution=1.0, drop=1.2, offset=0.0, **changes):
    """Return a case and a plan (B = 1): a ball bounces without loss on a racket at rest.

    The ball falls from `drop` [m] above the racket's centre at (0, 0, 1.5), without drag. The plan
    has the times and places of a restitution of 1. Boxes are `offset` [m] higher than the racket.
    """
    fall, speed = np.sqrt(2.0 * drop / GRAVITY), np.sqrt(2.0 * drop * GRAVITY)
    centre = np.array([0.0, 0.0, 1.5])
    arguments = {"place_range": (0.1, 0.1, 0.1), "min_apex": 2.2, "max_apex": 3.7, "drag": 0.0}
    case = pj.rally.case(
        np.array([[0.0, 0.0, 1.5 + drop]]),
        np.zeros((1, 3)),
        np.tile(centre + [0.0, 0.0, offset], (hits, 1)),
        start=centre - [0.0, 0.0, 0.06],
        racket_height=0.06,
        gravity=GRAVITY,
        restitution=restitution,
        **(arguments | changes),
    )
    durations = np.full((1, hits), 2.0 * fall)
    durations[:, 0] = fall
    coeffs = np.zeros((1, hits, 8, 3))
    coeffs[:, :, 0] = centre - [0.0, 0.0, 0.06]
    every = lambda value: np.broadcast_to(value, (1, hits, *np.shape(value)))  # noqa: E731
    up = np.array([0.0, 0.0, 1.0])
    zero = np.zeros(1)
    plan = pj.rally.RallyPlan(
        trajectory=PiecewisePolynomial(coeffs, durations),
        gravity=np.full(1, GRAVITY),
        strokes=Stroke(
            time=durations.cumsum(axis=1),
            ball_pos=every(centre),
            ball_vel=every(-speed * up),
            ball_vel_after=every(speed * up),
            normal=every(up),
            flight_time=np.full((1, hits), 2.0 * fall),
        ),
        places=every(centre),
        cost=zero,
        violation=zero,
        iterations=zero.astype(np.int32),
        status=zero.astype(np.int32),
    )
    return case, plan


def fly_on(cases, plans):
    """Return the balls just after the first hits of plans, by the exact physics."""
    time = np.asarray(plans.strokes.time, float)[:, 0]
    drag, gravity = np.asarray(cases.drag, float), np.asarray(cases.gravity, float)
    pos, vel = fly(cases.ball.pos, cases.ball.vel, time, drag, gravity, num_steps=80)
    state = planned_state(plans.trajectory, time).astype(float)
    thrust = state[:, 2] + np.stack([0.0 * gravity, 0.0 * gravity, gravity], axis=1)
    normal = thrust / np.linalg.norm(thrust, axis=1, keepdims=True)
    approach = np.sum((vel - state[:, 1]) * normal, axis=1)
    after = vel - ((1.0 + np.asarray(cases.restitution, float)) * approach)[:, None] * normal
    return BallState(pos.astype(np.float32), after.astype(np.float32))
