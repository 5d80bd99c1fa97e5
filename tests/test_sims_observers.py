"""The observers of thrown balls that follow the papers, in simulated flights."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.ball.linear_drag import linear_drag_flight
from planner_jax.sims import sensing as sight
from planner_jax.sims.launch import await_ball, ready
from planner_jax.sims.loop_state import Loop
from planner_jax.sims.noise import NOISES, Sensing
from planner_jax.sims.settings import CatchFly, HitFly
from planner_jax.sims.tasks.catch import CATCH_WORLD, fly_catches, throws
from planner_jax.sims.tasks.catch_pilot import tables
from planner_jax.sims.tasks.hit import HIT_WORLD, REAL_SCENARIOS, fly_hits, volleys

GRAVITY, DRAG = jnp.float32(9.81), jnp.float32(0.0616)
LINEAR = np.array([0.5, 0.4, 0.45], np.float32)
BALL = pj.BallState(jnp.array([4.0, 0.0, 0.8]), jnp.array([-4.0, 2.0, 7.0]))
TIMES = (0.01 * np.arange(81)).astype(np.float32)


@functools.partial(jax.jit, static_argnames="observer")
def observe(path, observer):
    """Return the estimates after the positions (n, 3); 27 of them set the reference energy."""
    sensing = Sensing(position_std=0.001)

    def advance(estimate, now):
        number, seen = now
        estimate = sight.update_estimate(estimate, seen, sensing, GRAVITY)
        fresh = sight.anchor_energy(estimate, GRAVITY)
        later = sight.with_drag(estimate, GRAVITY)
        return jax.tree.map(lambda a, b: jnp.where(number < 27, a, b), fresh, later), None

    first = sight.first_estimate(path[0], 1.15 * DRAG, observer)
    return jax.lax.scan(advance, first, (jnp.arange(80), path[1:]))[0]


def with_gap(path):
    return jnp.asarray(path).at[40:43].set(jnp.nan)


def test_the_linear_observer_finds_linear_drag_and_predicts_by_it():
    fly = jax.jit(jax.vmap(lambda t: linear_drag_flight(BALL, t, LINEAR, GRAVITY)))
    estimate = observe(with_gap(fly(TIMES).pos), "linear")
    prior = 1.15 * DRAG * np.linalg.norm(estimate.belief.ball.vel)
    assert 0.5 * (prior + LINEAR[0]) < estimate.path_drag[0] < LINEAR[0]
    later = sight.predict(estimate, 0.4, GRAVITY).pos
    own = linear_drag_flight(estimate.belief.ball, 0.4, estimate.path_drag, GRAVITY)
    np.testing.assert_allclose(later, own.pos, atol=1e-5)
    np.testing.assert_allclose(later, fly(TIMES[-1:] + 0.4).pos[0], atol=0.06)
    np.testing.assert_array_equal(estimate.drag, np.float32(1.15) * DRAG)


def test_the_observer_with_rls_corrects_the_drag_by_lost_energy():
    fly = jax.vmap(lambda t: pj.fly(BALL, t, DRAG, GRAVITY, num_steps=16)[0])
    estimate = observe(with_gap(jax.jit(fly)(TIMES).pos), "rls")
    assert abs(estimate.drag / DRAG - 1.0) < 0.13
    assert estimate.path_drag is estimate.drag


def test_an_awaited_ball_has_the_linear_drag_of_its_guessed_speed():
    loop = Loop(CATCH_WORLD, NOISES["lab"], replan=100.0, observer="linear")
    flights = ready(loop, jnp.zeros((1, 3)), jax.random.split(jax.random.key(0), 1))
    coming = await_ball(loop, flights, BALL, jnp.full((1, 1), 0.06), ball=0, ahead=0.8).estimates
    speed = np.linalg.norm(coming.belief.mean[0, 0, 3:])
    np.testing.assert_allclose(coming.path_drag, np.full((1, 1, 3), 0.06 * speed), rtol=1e-5)


def test_a_table_with_linear_drag_is_the_closed_form():
    ball = jax.tree.map(lambda leaf: leaf[None], BALL)
    table = jax.tree.map(lambda x: x[0], tables(ball, LINEAR[None], jnp.ones(1), GRAVITY))
    for time in (0.0, 0.31, 1.0):
        expected = linear_drag_flight(BALL, jnp.float32(time), LINEAR, GRAVITY)
        np.testing.assert_allclose(table.at(time).pos, expected.pos, atol=1e-4)


def test_the_observer_is_named_by_the_settings_and_needs_the_filter():
    assert CatchFly().flight().loop(record=False).observer == "energy"
    assert CatchFly(observer="published").flight().loop(record=False).observer == "linear"
    assert HitFly(observer="published").flight().loop(record=False).observer == "rls"
    with pytest.raises(ValueError, match="observer must be one of default, published, got 'x'"):
        HitFly(observer="x")
    with pytest.raises(ValueError, match="observer must be one of energy, linear, rls, got 'x'"):
        Loop(CATCH_WORLD, observer="x")
    with pytest.raises(ValueError, match="observer must be energy without filter, got 'rls'"):
        Loop(HIT_WORLD, kalman=False, observer="rls")


@pytest.mark.slow
def test_published_observers_meet_balls():
    lab = functools.partial(Loop, sensing=NOISES["lab"])
    caught = fly_catches(lab(CATCH_WORLD, replan=100.0, observer="linear"), throws(8)).caught
    served = volleys(8, REAL_SCENARIOS["S.1"])
    hit = fly_hits(lab(HIT_WORLD, replan=50.0, observer="rls"), served).flown.contact.met
    assert caught.any() and hit.any()
