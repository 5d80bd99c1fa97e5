"""Hits of balls with a known spin: path, impact with friction, and flight with lift after it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import assert_gradient_matches_differences

import planner_jax as pj
from planner_jax.ball.aim import aim_with_drag, apex_with_drag
from planner_jax.ball.flight import BallState, solve_impact
from planner_jax.core.protocol import is_solved
from planner_jax.referee import hit as referee
from planner_jax.referee.return_flight import return_in_air
from planner_jax.referee.spin import rub_ball
from planner_jax.task.hit.spin import meet_spin, predict_spin
from tests.trees import as_numpy

float64 = pytest.mark.usefixtures("float64")
SERVE = (4.0, 0.3, 2.0), (-7.0, 0.0, 5.0), (3.0, 0.5, 0.0)
BALL = BallState(np.array([-2.0, 0.2, 1.5]), np.array([-5.0, 0.1, -5.0]))
TIME, SPEEDS = np.array(1.6), np.array([0.5, -0.3])
SMOOTH = pj.ball.Ball(friction=(1e-12, 0.1))
meet = jax.jit(meet_spin)


def case(spin=(30.0, 200.0, -100.0), **options):
    options = {"drag": 0.1, "rotor_drag": 0.0, "wind": (1.0, -2.0, 0.0)} | options
    return pj.hit.case(*SERVE, spin=spin, **{"dtype": np.float64} | options)


def air_of(of):
    numbers = of.drag, of.gravity, *of.lift, *of.around.wind, of.around.reach
    return np.array(numbers, float)[:, None]


@float64
def test_without_spin_and_friction_the_impact_is_that_of_a_ball_with_drag():
    plain = case(np.zeros(3), ball=SMOOTH, wind=np.zeros(3))
    normal, racket, after, apex, _ = meet(plain, BALL, TIME, SPEEDS)

    @jax.jit
    def without_spin(after):
        aimed = aim_with_drag(BALL.pos, plain.target, TIME, plain.drag, plain.gravity)
        highest = apex_with_drag(BallState(BALL.pos, after), TIME, plain.drag, plain.gravity)
        return aimed, highest, *solve_impact(BALL.vel, after, plain.restitution)

    expected, highest, along, speed = without_spin(after)
    np.testing.assert_allclose(after, expected, atol=2e-4)
    np.testing.assert_allclose(normal, along, atol=1e-9)
    assert np.dot(racket, normal) == pytest.approx(float(speed), abs=1e-9)
    assert apex == pytest.approx(float(highest), abs=2e-3)


@float64
@pytest.mark.parametrize("options", [{}, {"ball": pj.ball.Ball(friction=(0.02, 0.01))}])
def test_the_referee_returns_the_ball_to_the_target_with_and_without_slip_at_the_end(options):
    of = case(**options)
    normal, racket, after, apex, _ = (np.asarray(each) for each in meet(of, BALL, TIME, SPEEDS))
    axes = {"lift": of.lift, **{f"around.{k}": v for k, v in vars(of.around).items()}}
    leaves = {name: np.asarray(leaf, float)[None] for name, leaf in axes.items()}
    slip, up = (BALL.vel - racket)[:, None], normal[:, None]
    push = -(1.0 + float(of.restitution)) * (slip * up).sum(axis=0)
    air = air_of(of)
    rub, air[2:5] = rub_ball(leaves, slip, up, push)
    np.testing.assert_allclose(BALL.vel[:, None] + push * up + rub, after[:, None], atol=1e-10)
    slides = np.linalg.norm(rub) > 0.999 * of.around.friction * push[0]
    assert slides == bool(options)
    state = np.concatenate([BALL.pos, after])[:, None]
    top, _, landing, time = return_in_air(state, np.zeros(1), air)
    np.testing.assert_allclose(landing[:, 0], of.target, atol=1e-3)
    assert time[0] == pytest.approx(TIME, abs=1e-3) and top[0] == pytest.approx(apex, abs=1e-3)


def test_a_spin_about_the_normal_leaves_a_ball_that_comes_along_the_normal():
    normal, lift = np.array([[0.6], [0.0], [0.8]]), np.array([[1.2, 0.0, 1.6]])
    numbers = {"around.friction": [0.3], "around.grip": [0.4], "around.reach": [7.0]}
    leaves = {name: np.array(value) for name, value in numbers.items()} | {"lift": lift}
    rub, after = rub_ball(leaves, -5.0 * normal, normal, np.array([8.0]))
    np.testing.assert_allclose(rub, 0.0, atol=1e-14)
    np.testing.assert_allclose(after, lift.T, atol=1e-14)


@float64
def test_the_path_of_a_spinning_ball_is_that_of_the_referee():
    of = case()
    table = as_numpy(jax.jit(predict_spin)(of))
    state = np.concatenate([of.ball.pos, of.ball.vel])[:, None]
    for k, step in enumerate(np.diff(table.times)):
        np.testing.assert_allclose(table.pos[k], state[:3, 0], atol=1e-5)
        for _ in range(4):
            state = referee.ball_step(state, np.array([0.25 * step]), air_of(of))
    assert table.pos[-1, 2] < 0.0 < table.pos[-8, 2]
    end = table.times[-1]
    straight = pj.fly(of.ball, end, of.drag, of.gravity, num_steps=40)[0]
    assert np.linalg.norm(straight.pos - table.pos[-1]) > 0.5


@float64
def test_a_batch_of_impacts_equals_a_loop():
    spins = np.random.default_rng(0).normal(size=(3, 3)) * 100.0
    cases = [case(spin) for spin in spins]
    balls = jax.tree.map(lambda x: np.tile(x, (3, 1)), BALL)
    many = jax.tree.map(lambda *leaves: np.stack(leaves), *cases)
    meet_all = jax.jit(jax.vmap(meet_spin, (0, 0, None, None)))
    whole = as_numpy(meet_all(many, balls, TIME, SPEEDS))
    for k, one in enumerate(cases):
        for own, alone in zip(whole, meet(one, BALL, TIME, SPEEDS), strict=True):
            np.testing.assert_allclose(own[k], alone, rtol=1e-9, atol=1e-9)


def test_an_absurd_spin_and_a_planner_without_spin_are_errors_of_one_line():
    with pytest.raises(ValueError, match="spin must be within 10,000 rad/s") as raised:
        case((0.0, 2e4, 0.0), dtype=np.float32)
    assert "\n" not in str(raised.value)
    with pytest.raises(pj.ArgumentError, match="spin must be left out, except for .* exact"):
        pj.plan(pj.hit.planner("juggle"), case(dtype=np.float32))


@pytest.mark.slow
@float64
def test_the_gradient_of_an_impact_is_that_of_differences(monkeypatch):
    # Gradients neglect that the steps of a flight depend on its speed. Many steps make this small.
    monkeypatch.setattr("planner_jax.task.hit.spin._RETURN_NODES", 64)
    of = case()

    def everything(args):
        ball, time, speeds, lift = args
        normal, racket, after, apex, _ = meet_spin(of.replace(lift=lift), ball, time, speeds)
        return normal @ jnp.arange(3.0) + racket @ jnp.ones(3) + jnp.sum(after**2) + apex

    assert_gradient_matches_differences(everything, (BALL, TIME, SPEEDS, np.asarray(of.lift)))


@pytest.mark.slow
def test_plans_of_spinning_balls_are_accepted_by_the_referee_and_other_spins_are_not():
    drawn = pj.hit.draw(6, seed=3)
    of = drawn.ball.pos, drawn.ball.vel, drawn.target
    cases = pj.hit.case(*of, spin=(20.0, 150.0, -50.0), drag=0.1)
    plans = pj.plan(pj.hit.planner(), cases)
    solved = is_solved(plans.status)
    verdict = pj.hit.judge(cases, plans)
    assert solved.all() and verdict.success.all() and verdict.landing_error.max() < 2e-3
    still = pj.hit.judge(pj.hit.case(*of, spin=(0.0, 0.0, 0.0), drag=0.1), plans)
    assert not still.success.any()
