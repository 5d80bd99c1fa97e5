"""Targets that appear one by one: what is flown, what is caught, and what is known when."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.core.protocol import Status
from planner_jax.optimise.settings import LbfgsConfig, Round
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.studies.catch.appearing import AppearingPath, draw_appearing, states_of
from planner_jax.studies.catch.braking import braking
from planner_jax.studies.catch.live import fly_live, judge_live
from planner_jax.task.catch.suites import draw
from planner_jax.trajectory.polynomial import states_at

PLANNER = pj.catch.ExactCatch(rounds=(Round(1, LbfgsConfig(max_steps=40)),))
NUM = 6


def of_three(cases) -> Any:
    """Cases (B,) of the first three targets, NumPy leaves."""
    first = ("targets", "present", "horizon", "times")
    fewer = {name: jax.tree.map(lambda x: x[:, :3], getattr(cases, name)) for name in first}
    order = np.tile(np.arange(3, dtype=np.int32), (len(cases.present), 1))
    return jax.tree.map(np.asarray, dataclasses.replace(cases, order=order, **fewer))


@pytest.fixture(scope="module")
def cases():
    """Three balls each, which appear within 3 s."""
    return of_three(draw_appearing(NUM, 1, span=3.0))


def fly(cases):
    return fly_live(cases, pj.catch.Greedy(), planner=PLANNER)


@pytest.fixture(scope="module")
def flown(cases):
    return fly(cases)


def test_what_was_flown_passes_the_referee_as_one_plan(cases, flown):
    verdict = judge_live(flown)
    assert verdict.success.all(), verdict.sentence()
    caught = np.isfinite(flown.caught)
    np.testing.assert_array_equal(verdict.num_caught, caught.sum(axis=1))
    assert caught.mean() > 0.5
    in_order = np.sort(np.where(caught, flown.caught, np.inf), axis=1)
    claimed = np.where(np.isfinite(in_order), in_order, np.nan)
    np.testing.assert_allclose(verdict.catch_times[:, :3], claimed, atol=1e-6)


def test_no_target_is_caught_before_it_appears_or_too_late(cases, flown):
    caught = np.isfinite(flown.caught)
    assert (flown.caught >= cases.targets.appears)[caught].all()
    assert (flown.caught <= cases.horizon + 1e-4)[caught].all()
    assert cases.targets.appears[caught].max() > 1.0


def test_nothing_is_known_of_a_target_before_it_appears(cases, flown):
    """With the last target elsewhere, the way up to its appearance is the same."""
    appears = cases.targets.appears
    last = appears.argmax(axis=1)
    pos = np.array(cases.targets.pos)
    pos[np.arange(NUM), last] *= [-1.0, -1.0, 1.0]
    other = fly(dataclasses.replace(cases, targets=dataclasses.replace(cases.targets, pos=pos)))
    before = appears.max(axis=1, keepdims=True)
    early = [np.where(x.caught < before, x.caught, 0.0) for x in (flown, other)]
    np.testing.assert_array_equal(*early)
    assert (early[0] > 0.0).any()


def test_one_target_that_is_known_from_the_start_is_caught_as_an_ordinary_plan_has_it(cases):
    known = dataclasses.replace(
        cases,
        targets=dataclasses.replace(cases.targets, appears=np.zeros_like(cases.horizon)),
        present=np.tile([True, False, False], (NUM, 1)),
    )
    plans = pj.plan(DecidedPlanner(PLANNER, pj.catch.Greedy()), known)
    flown = fly(known)
    solved = pj.solved(plans) & (np.asarray(plans.num_taken) == 1)
    taken = np.isfinite(flown.caught[:, 0])
    assert taken.sum() >= NUM // 2 and not taken[~solved].any()
    np.testing.assert_allclose(flown.caught[taken, 0], plans.times[taken, 0], atol=1e-5)
    # What is not flown could not come to rest afterwards, or at the very limits.
    at_catch = states_at(plans.trajectory, np.maximum(plans.times[:, 0] - 1e-4, 0.0))
    limits = jax.vmap(lambda limits, g: limits.scaled(0.98, g))(known.limits, known.gravity)
    stops = np.asarray(jax.vmap(braking)(at_catch, known.gravity, limits).possible)
    assert not stops[solved & ~taken].any()
    assert np.isinf(flown.caught[:, 1:]).all()


def test_a_case_that_is_broken_says_so_and_leaves_its_neighbours_alone(cases, flown):
    vel = np.array(cases.targets.vel)
    vel[2] = np.nan
    broken = fly(dataclasses.replace(cases, targets=dataclasses.replace(cases.targets, vel=vel)))
    assert broken.plans.status[2] == Status.NON_FINITE
    assert np.isinf(broken.caught[2]).all()
    verdict = judge_live(broken)
    assert verdict.failed_limit[2] == "not finite" and verdict.num_caught[2] == 0
    others = np.arange(NUM) != 2
    np.testing.assert_allclose(broken.caught[others], flown.caught[others], atol=1e-5)


def test_a_catch_that_was_not_made_is_refused(flown):
    """The referee does not take the word of what was flown."""
    pos = np.array(flown.cases.targets.pos) + [0.5, 0.0, 0.0]
    moved = dataclasses.replace(flown.cases.targets, pos=pos)
    verdict = judge_live(
        dataclasses.replace(flown, cases=dataclasses.replace(flown.cases, targets=moved))
    )
    some = np.isfinite(flown.caught).any(axis=1)
    assert not verdict.success[some].any()
    assert set(verdict.failed_limit[some]) <= {"net", "net plane"}


def test_a_target_is_at_its_place_when_it_appears_and_far_above_before():
    path = AppearingPath(
        pos=jnp.array([1.0, 2.0, 3.0]), vel=jnp.array([0.1, 0.0, -1.0]), appears=jnp.array(2.0)
    )
    states = jax.jit(jax.vmap(path.at))(jnp.array([1.0, 2.0, 4.0]))
    np.testing.assert_allclose(states.pos, [[1, 2, 1003], [1, 2, 3], [1.2, 2, 1]], rtol=1e-6)
    np.testing.assert_allclose(states.vel[1:], [[0.1, 0, -1], [0.1, 0, -1]], rtol=1e-6)
    several = jax.tree.map(lambda leaf: np.asarray(leaf)[None, None], path)
    pos, vel = states_of(several, np.zeros((1, 1), int), np.array([[4.0]]))
    np.testing.assert_allclose(pos[0, 0], states.pos[2], rtol=1e-6)
    np.testing.assert_allclose(vel[0, 0], states.vel[2], rtol=1e-6)
    assert np.isinf(states_of(several, np.zeros((1, 1), int), np.array([[1.9]]))[0][0, 0, 2])


def test_with_a_span_of_zero_the_balls_are_those_of_the_swarm():
    cases, swarm = draw_appearing(5, 3, span=0.0), draw(5, "swarm8", 3)
    np.testing.assert_array_equal(cases.targets.pos, swarm.targets.ball.pos)
    np.testing.assert_array_equal(cases.horizon, swarm.horizon)
    assert cases.optional and not np.asarray(cases.targets.appears).any()


def test_a_case_is_the_same_in_every_batch():
    many, one = draw_appearing(4, 5), draw_appearing(1, 5, first=3)
    for all_of_them, alone in zip(jax.tree.leaves(many), jax.tree.leaves(one), strict=True):
        np.testing.assert_array_equal(np.asarray(all_of_them)[3:], alone)
    appears = np.asarray(many.targets.appears)
    assert (appears >= 0.0).all() and (appears <= 6.0).all() and appears.max() > 5.0
    with pytest.raises(ValueError, match="^span must be >= 0, got -1.0$"):
        draw_appearing(1, span=-1.0)


@pytest.mark.parametrize(
    ("height", "vel", "possible"),
    [
        (2.0, (4.0, 0.0, 0.0), True),
        (2.0, (0.0, 0.0, 0.0), True),
        (0.3, (0.0, 0.0, -3.0), False),
    ],
)
def test_a_quadrotor_brakes_to_rest_within_its_limits_where_it_can(height, vel, possible):
    one = draw(1, "throws")
    limits, gravity = jax.tree.map(lambda leaf: leaf[0], (one.limits, one.gravity))
    state = jnp.zeros((4, 3)).at[0, 2].set(height).at[1].set(jnp.array(vel))
    found = jax.device_get(jax.jit(braking)(state, gravity, limits))
    assert bool(found.possible) == possible
    coeffs, time = found.coeffs.astype(float), float(found.duration)
    for order in range(4):
        way = [np.polynomial.Polynomial(coeffs[:, axis]) for axis in range(3)]
        way = [axis.deriv(order) if order else axis for axis in way]
        np.testing.assert_allclose([axis(0.0) for axis in way], state[order], atol=1e-6)
        if order:
            np.testing.assert_allclose([axis(time) for axis in way], 0.0, atol=2e-3)


@pytest.mark.slow
def test_cases_are_flown_in_a_batch_as_one_by_one(cases, flown):
    for k in range(NUM):
        alone = fly(pj.lane(jax.tree.map(lambda leaf: leaf[:, None], cases), k))
        np.testing.assert_allclose(alone.caught[0], flown.caught[k], atol=1e-3)


@pytest.mark.slow
def test_of_eight_balls_those_are_caught_that_all_were_known_from_the_start_and_more():
    """Nothing is lost against the plan that was made at the start."""
    cases = jax.tree.map(np.asarray, draw_appearing(16, 2, span=0.0))
    greedy = pj.catch.Greedy()
    plans = pj.plan(DecidedPlanner(PLANNER, greedy), cases)
    flown = fly_live(cases, greedy, planner=PLANNER)
    number = np.isfinite(flown.caught).sum(axis=1)
    solved = pj.solved(plans)
    assert (number >= np.asarray(plans.num_taken))[solved].all()
    assert judge_live(flown).success.all()
