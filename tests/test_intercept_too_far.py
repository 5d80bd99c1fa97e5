"""Targets that a car cannot meet in time, whatever the obstacles: the status TOO_FAR."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.plane.target import LaterPath
from planner_jax.robot.car import pose_at
from planner_jax.task.intercept.problem import bounds

NUM, KNOTS, SPEED = 1000, 9, 1.5


@pytest.fixture(scope="module")
def driven():
    """Return cases whose targets are where random drives within all limits end."""
    random = np.random.default_rng(0)
    time, bend = random.uniform(0.3, 8.0, NUM), random.uniform(0.3, 3.0, NUM)
    reverse = np.where(random.random(NUM) < 0.5, 0.0, 0.8)
    speed = random.uniform(-reverse[:, None], SPEED, (NUM, KNOTS))
    curvature = random.choice([-1.0, 0.0, 1.0], (NUM, KNOTS)) * bend[:, None]
    start = random.uniform([0, 0, -3], [8, 8, 3], (NUM, 3))
    ends = jax.jit(jax.vmap(lambda s, t, v, c: pose_at(s, t, v, c, t)))
    x, y, heading = np.asarray(ends(*map(jnp.float32, (start, time, speed, curvature))), float).T
    middle = np.stack([x + 0.15 * np.cos(heading), y + 0.15 * np.sin(heading)], axis=1)
    velocity, rate = 0.5 * random.normal(size=(NUM, 2)), 0.3 * random.normal(size=NUM)
    path = pj.TurningPath(*map(jnp.float32, (middle, velocity, rate)))
    return pj.intercept.case(
        LaterPath(path=path, begin=jnp.float32(-time)),
        time,
        start=start,
        initial_speed=speed[:, 0],
        acceleration=np.abs(np.diff(speed)).max(axis=1) * (KNOTS - 1) / time,
        speed=SPEED,
        curvature=bend,
        reverse_speed=reverse,
        end_heading=heading,
        heading_tolerance=np.where(random.random(NUM) < 0.5, np.pi, 0.05),
        tolerance=0.01,
    )


@pytest.mark.parametrize("is_time_free", [False, True])
def test_a_target_that_a_drive_meets_is_never_too_far(driven, is_time_free):
    is_too_far = jax.jit(jax.vmap(partial(bounds.is_too_far, is_time_free=is_time_free)))
    assert not is_too_far(driven).any()
    other = dataclasses.replace(driven, target=pj.take(driven.target, np.arange(NUM)[::-1]))
    assert 0.3 < is_too_far(other).mean() < 0.6


def shortest(goal, **numbers):
    target = pj.TurningPath(jnp.array([0.0, 0.0]), jnp.zeros(2), jnp.array(0.0))
    case = pj.intercept.case(target, start=(0.0, 0.0, 0.0), **{"tolerance": 1e-6, **numbers})
    return float(bounds.shortest_drive(case, jnp.asarray(goal), jnp.zeros(())))


def test_a_drive_straight_ahead_or_back_is_as_long_as_its_distance():
    at_end = {"end_heading": 0.0, "heading_tolerance": 1e-6}
    assert shortest((3.15, 0.0), **at_end) == pytest.approx(3.0, abs=1e-5)
    assert shortest((-2.85, 0.0), **at_end, reverse_speed=0.5) == pytest.approx(3.0, abs=1e-5)
    assert shortest((3.0, 0.0), region=[(-1, -1), (1, -1), (1, 1), (-1, 1)], **at_end) < 1.86


def test_a_drive_to_a_target_behind_or_beside_includes_the_turn():
    radius = 0.5  # the curvature is at most 2 1/m
    behind = shortest((-3.0, 0.0), rear_overhang=0.2)  # the middle is above the rear axle
    exact = radius * 2.0 * (np.pi - np.arctan(3.0 / radius)) + 3.0
    assert 0.95 * exact < behind <= exact
    beside = shortest((0.0, 4.0), rear_overhang=0.2)
    turn = np.pi - np.arccos(radius / 3.5)
    exact = radius * turn + np.sqrt(3.5**2 - radius**2)
    assert 0.98 * exact < beside <= exact
    assert shortest((0.0, 4.0), rear_overhang=0.2, reverse_speed=1.0) < beside + 1e-5
    about = shortest((1e-7, 0.0), end_heading=np.pi, heading_tolerance=0.1)
    assert about == pytest.approx(radius * (np.pi - 0.1), rel=1e-5)


@pytest.mark.slow
def test_an_early_meeting_that_no_time_allows_is_too_far():
    target = pj.TurningPath(jnp.array([4.0, 4.0]), jnp.array([1.6, 0.0]), jnp.array(0.0))
    plan = pj.plan(
        pj.intercept.planner(meet="early"), pj.intercept.case(target, 6.0, upper=(20, 8))
    )
    assert plan.status == pj.Status.TOO_FAR
