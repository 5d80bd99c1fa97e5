"""Targets that flee: what they do, what the car makes of it, and what it captures."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import planner_jax as pj
from planner_jax.plane.target import SampledPath
from planner_jax.studies.intercept.escape import (
    CAPTURE,
    HORIZON,
    PLANNER,
    ROOM,
    STEP,
    Runner,
    begun,
    draw_escapes,
    evader_of,
    flee,
    manoeuvres,
    middle_of,
    pursue,
    stepped,
    worst_case,
)

TARGET = pj.TurningPath(
    pos=jnp.array([4.0, 4.0]), vel=jnp.array([0.3, 0.0]), turn_rate=jnp.zeros(())
)
WALL = np.array([[5.0, 2.0], [5.5, 2.0], [5.5, 6.0], [5.0, 6.0]])


def runner(x, y, heading=0.0):
    return Runner(pos=jnp.array([x, y]), heading=jnp.asarray(heading))


def evader(case, speed=0.8, turn_rate=1.5):
    return evader_of(case, jnp.asarray(speed), jnp.asarray(turn_rate))


@jax.jit
def fled(evader, begin, car):
    """Places (60, 2) of a target that flees from a car which stands."""

    def step(now, _):
        later = flee(evader, now, car, jnp.zeros(2))
        return later, later.pos

    return lax.scan(step, begin, None, 60)[1]


def test_a_target_flees_from_the_car_and_stays_on_the_map():
    car = jnp.array([3.0, 4.0])
    open_field = evader(pj.intercept.case(TARGET))
    places = np.asarray(fled(open_field, runner(4.0, 4.0, np.pi / 2.0), car))
    away = np.linalg.norm(places - np.asarray(car), axis=1)
    assert (np.diff(away[:15]) > 0.0).all() and away[-1] > 4.0
    assert (places >= ROOM).all() and (places <= 8.0 - ROOM).all()
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert steps.max() == pytest.approx(0.8 * STEP, rel=1e-3)


def test_a_target_keeps_off_walls_in_everything_that_it_can_do():
    beside = evader(pj.intercept.case(TARGET, walls=[WALL]))
    all_it_can = jax.jit(lambda begin: manoeuvres(beside, begin, 40))
    places = np.asarray(all_it_can(runner(4.4, 4.0)))
    assert places.shape == (16, 41, 2)
    outside = np.maximum(np.abs(places - [5.25, 4.0]) - [0.25, 2.0], 0.0)
    assert np.linalg.norm(outside, axis=-1).min() > ROOM - 0.01
    # Straight on, and then it stands.
    np.testing.assert_allclose(places[0, -1], [4.72, 4.0], atol=1e-5)
    way = np.diff(np.asarray(all_it_can(runner(2.0, 4.0)))[4, :10], axis=0)
    turned = np.diff(np.arctan2(way[:, 1], way[:, 0]))  # from 0 to a quarter of a turn
    np.testing.assert_allclose(turned[:4], 1.5 * STEP, atol=1e-4)
    np.testing.assert_allclose(turned[5:], 0.0, atol=1e-4)


def test_the_middle_of_places_is_that_of_the_least_circle_around_them():
    angle = np.array([0.1, 1.9, 2.5, 4.4, 5.2])
    circle = 3.0 + 2.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    places = jnp.asarray(np.concatenate([circle, [[2.5, 3.2], [3.4, 3.9]]]), jnp.float32)
    found = np.asarray(jax.jit(middle_of)(places))
    assert np.linalg.norm(np.asarray(places) - found, axis=1).max() < 2.0 * (1.0 + 1.0 / 24.0)


def test_a_car_without_a_plan_brakes_within_its_limit():
    case = pj.intercept.case(TARGET, initial_curvature=0.5)
    advance = jax.jit(lambda chase: stepped(case, evader(case), chase))
    chase, (speed, curvature, apart) = advance(begun(case, runner(4.0, 4.0)))
    np.testing.assert_allclose(np.diff(speed), -0.98 * STEP / 10, atol=1e-6)
    np.testing.assert_allclose(curvature, 0.5)
    for _ in range(3):
        chase, (speed, _, apart) = advance(chase)
    assert speed[-1] == 0.0
    assert float(chase.pose[0]) == pytest.approx(0.8 + 0.5**2 / (2.0 * 0.98), abs=1e-3)
    assert float(apart[-1]) == pytest.approx(
        float(jnp.linalg.norm(chase.runner.pos - chase.pose[:2] - 0.15 * direction(chase))),
        abs=1e-5,
    )


def direction(chase):
    return jnp.array([jnp.cos(chase.pose[2]), jnp.sin(chase.pose[2])])


def test_the_worst_case_is_that_of_the_manoeuvre_which_gets_away():
    case = pj.intercept.case(TARGET)
    ahead = begun(case, runner(4.0, 4.0))
    # From x = 0.8 m on at 1 m/s for 4 s, the body's middle 0.15 m ahead.
    plan = dataclasses.replace(
        ahead.plan, time=jnp.asarray(4.0), speed=jnp.ones_like(ahead.plan.speed)
    )
    chase = dataclasses.replace(ahead, plan=plan)
    miss = jax.jit(lambda places: worst_case(case, chase, places))
    stands = jnp.broadcast_to(jnp.array([4.0, 4.0]), (41, 2))
    aside = stands.at[:, 1].add(1.5)
    met = float(miss(stands[None]))
    assert met == pytest.approx(0.1 * 2.8, abs=0.03)
    passed = float(miss(jnp.stack([stands, aside])))
    assert passed == pytest.approx(1.5 - CAPTURE + 0.1 * (2.8 + 8.0) / 2.0, abs=0.03)


def test_sampled_paths_go_straight_between_their_places_and_then_stay():
    path = SampledPath(
        places=jnp.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]]), step=jnp.asarray(0.5)
    )
    states = jax.jit(jax.vmap(path.at))(jnp.array([0.25, 0.5, 0.75, 1.0, 3.0]))
    np.testing.assert_allclose(states.pos, [[0.5, 0], [1, 0], [1, 1], [1, 2], [1, 2]], atol=1e-6)
    np.testing.assert_allclose(states.vel, [[2, 0], [0, 4], [0, 4], [0, 0], [0, 0]], atol=1e-6)


def test_a_case_is_the_same_in_every_batch():
    many, one = draw_escapes(3, "easy", 5), draw_escapes(1, "easy", 5, first=2)
    for all_of, alone in zip(jax.tree.leaves(many), jax.tree.leaves(one), strict=True):
        np.testing.assert_array_equal(all_of[2:], alone)
    evaders = many[1]
    assert (np.asarray(evaders.speed) >= 0.45).all() and (np.asarray(evaders.speed) <= 1.05).all()
    assert np.unique(evaders.turn_rate).size == 3


@pytest.mark.slow
def test_a_target_that_cannot_move_is_captured_as_soon_as_the_planner_says():
    cases, evaders, runners = draw_escapes(4, "easy", 1)
    still = dataclasses.replace(evaders, speed=jnp.zeros(4))
    came = pursue("greedy", cases, still, runners)
    stands = jnp.broadcast_to(runners.pos[:, None], (4, 41, 2))
    asked = dataclasses.replace(
        cases,
        target=SampledPath(places=stands, step=jnp.full(4, STEP)),
        time=jnp.full(4, 8.0),
        tolerance=jnp.full(4, 0.2),
    )
    plans = jax.tree.map(np.asarray, pj.plan(PLANNER, jax.tree.map(np.asarray, asked)))
    assert pj.solved(plans).all()
    assert (came.captured <= plans.time + 0.5).all() and (came.captured < HORIZON).all()
