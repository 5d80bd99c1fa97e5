import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.ball.aim import aim_with_drag, apex_with_drag
from planner_jax.ball.flight import BallState, fly
from planner_jax.core.protocol import Status, is_solved
from planner_jax.optimise.shipped import load_scale
from planner_jax.planning.plan import plan
from planner_jax.referee.hit import referee_hits
from planner_jax.sims.scoring import racket_impact
from planner_jax.task.hit.default_planner import HitProblem
from planner_jax.task.hit.suites import generate_serves, to_cases
from planner_jax.trajectory.polynomial import evaluate, total_duration
from tests.trees import assert_same

PROBLEM, SUPPLE = HitProblem(), HitProblem(velocities=True)
PLANNER = pj.SearchPlanner(PROBLEM)
FIRST_ATTEMPT = pj.SearchPlanner(PROBLEM, PLANNER.attempts[:1])
NUM = 16
apex_of = jax.jit(apex_with_drag)


@jax.jit
def first_guess(case):
    context = PROBLEM.prepare(case)
    return context, PROBLEM.guesses(context, 1)[0]


@pytest.fixture(scope="module")
def cases():
    return jax.tree.map(np.asarray, to_cases(generate_serves(NUM, 11)))


@pytest.fixture(scope="module")
def plans(cases):
    return plan(PLANNER, cases)


def test_every_easy_serve_is_solved_and_confirmed_by_the_referee(cases, plans):
    assert is_solved(plans.status).all()
    verdict = referee_hits(cases, plans)
    assert verdict.success.all(), [verdict.sentence(k) for k in np.flatnonzero(~verdict.success)]


def test_hits_at_utm_coordinates_have_the_same_plans(cases, plans):
    away = np.array([5e5, 4e6, 0.0])
    given = (cases.ball.pos + away, cases.ball.vel, cases.target + away)
    far = pj.hit.case(*given, start=cases.head_state[:, 0] + away, gravity=cases.gravity)
    found = plan(PLANNER, far)
    assert_same(found.replace(origin=None), plans)
    verdict, usual = pj.hit.judge(far, found), pj.hit.judge(cases, plans)
    assert verdict.success.all()
    np.testing.assert_array_equal(verdict.landing_point, usual.landing_point + away)


def test_a_ball_that_lies_on_the_ground_is_too_far(cases):
    ball = BallState(cases.ball.pos * np.float32([1.0, 1.0, 0.0]), 0.0 * cases.ball.vel)
    assert (plan(FIRST_ATTEMPT, cases.replace(ball=ball)).status == Status.TOO_FAR).all()


def test_any_decision_vector_meets_the_ball_and_reaches_the_target(cases):
    lane = pj.take(cases, 3)
    context, guess = first_guess(lane)
    points = guess[None] + 0.3 * np.random.default_rng(0).normal(size=(8, guess.size))
    found = jax.jit(jax.vmap(lambda x: PROBLEM.decode(x, context)))(points.astype(np.float32))
    many = jax.tree.map(lambda leaf: np.repeat(leaf[None], 8, axis=0), lane)
    verdict = referee_hits(many, found)
    assert verdict.contact_error.max() < 1e-3
    assert verdict.landing_error.max() < 2e-3
    assert verdict.head_error.max() < 1e-4


def test_the_violation_of_a_plan_is_the_excess_that_the_referee_finds(cases):
    rates = np.linspace(0.2, 0.5, NUM, dtype=np.float32) * cases.limits.body_rate
    limits = cases.limits.replace(speed=0.4 * cases.limits.speed, body_rate=rates)
    found = plan(FIRST_ATTEMPT, cases.replace(limits=limits))
    verdict = referee_hits(cases.replace(limits=limits), found)
    excess = np.maximum(verdict.max_speed / limits.speed, verdict.max_body_rate / limits.body_rate)
    assert (found.violation > excess - 1.0 - 5e-4).all()  # Other limits count, too.
    broken = found.violation > 0.0
    assert broken.sum() >= NUM // 3
    np.testing.assert_allclose(found.violation[broken], excess[broken] - 1.0, atol=5e-4)


def test_stroke_obeys_the_impact_map(plans):
    @jax.jit
    @jax.vmap
    def ball_vel_after(plan):
        vel, stroke = evaluate(plan.trajectory, total_duration(plan.trajectory), 1), plan.stroke
        return racket_impact(stroke.ball_vel, vel, stroke.normal, 0.7)

    np.testing.assert_allclose(ball_vel_after(plans), plans.stroke.ball_vel_after, atol=2e-3)


def test_one_plan_equals_its_lane_in_the_batch(cases, plans):
    alone = plan(PLANNER, pj.take(cases, 5))
    assert alone.status == plans.status[5]
    np.testing.assert_allclose(alone.stroke.time, plans.stroke.time[5], rtol=1e-3)
    np.testing.assert_allclose(alone.cost, plans.cost[5], rtol=2e-2)


def test_an_impossible_lane_says_so_and_stays_finite(cases):
    crippled = cases.limits.scale(0.05, cases.gravity)
    crippled_lane = np.arange(NUM) == 1
    limits = jax.tree.map(lambda a, b: np.where(crippled_lane, b, a), cases.limits, crippled)
    found = plan(FIRST_ATTEMPT, cases.replace(limits=limits))
    assert found.status[1] == Status.TOO_FAR
    assert found.violation[1] > 0.0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    assert is_solved(np.delete(found.status, 1)).all()


def test_drag_after_the_impact_is_aimed_for(float64):
    pos, target = np.array([-2.0, 0.4, 1.5]), np.array([4.0, -0.5, 0.0])
    time, drag, gravity = np.array(1.7), np.array(0.0616), np.array(9.8)
    vel = jax.jit(aim_with_drag)(pos, target, time, drag, gravity)
    flown = jax.jit(functools.partial(fly, num_steps=400))
    landed, path = flown(BallState(pos, vel), time, drag, gravity)
    np.testing.assert_allclose(landed.pos, target, atol=2e-4)
    apex = apex_of(BallState(pos, vel), time, drag, gravity)
    np.testing.assert_allclose(apex, np.asarray(path.pos)[:, 2].max(), atol=2e-3)


@pytest.mark.parametrize("function", [aim_with_drag, apex_with_drag])
def test_derivatives_with_drag_are_those_of_finite_differences(float64, function):
    def value(x):
        first = (x[:3], x[3:6]) if function is aim_with_drag else (BallState(x[:3], x[3:6]),)
        found = function(*first, *x[6:])
        return jnp.sum(found * jnp.arange(1.0, found.size + 1.0))

    at = np.array([*(-2.0, 0.4, 1.5), *(4.0, -0.5, 3.0), *(1.7, 0.0616, 9.8)])
    derivatives = jax.jit(lambda x: (*jax.value_and_grad(value)(x), jax.hessian(value)(x)))
    _, slopes, bends = derivatives(at)
    ahead, behind = (
        [np.array(found) for found in zip(*map(derivatives, at + h * np.eye(9)), strict=True)]
        for h in (1e-5, -1e-5)
    )
    numeric = [(after - before) / 2e-5 for after, before in zip(ahead, behind, strict=True)]
    np.testing.assert_allclose(slopes, numeric[0], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(bends, numeric[1], rtol=1e-3, atol=1e-5)


def test_a_falling_ball_is_highest_at_once():
    ball = BallState(*np.array([[0.0, 0.0, 2.0], [3.0, 0.0, -1.0]], np.float32))
    assert apex_of(ball, *np.array([1.0, 0.06, 9.8], np.float32)) == 2.0


def test_objective_gradient_agrees_with_finite_differences(float64):
    case = pj.take(to_cases(generate_serves(1, 4), delay=0.5, dtype=jnp.float64), 0)
    context, guess = first_guess(case)
    cost = jax.jit(jax.value_and_grad(lambda x: PROBLEM.objective(x, context).cost))
    point = np.asarray(guess) + 0.1
    _, slopes = cost(point)
    for slope, step in zip(slopes, 1e-6 * np.eye(point.size), strict=True):
        numeric = (cost(point + step)[0] - cost(point - step)[0]) / 2e-6
        np.testing.assert_allclose(slope, numeric, rtol=1e-4, atol=1e-9)


def test_with_zero_offsets_of_velocities_a_point_is_the_same_plan(cases):
    lane = pj.take(cases, 1)
    context, guess = first_guess(lane)
    point = guess + 0.1 * np.random.default_rng(1).normal(size=guess.size).astype(np.float32)

    @jax.jit
    def both(point):
        converted = jnp.zeros(SUPPLE.held.shape).at[~SUPPLE.held].set(point)
        points = (PROBLEM, point), (SUPPLE, converted)
        plans = [problem.decode(x, context).trajectory.coeffs[:, :4] for problem, x in points]
        return converted, plans, [problem.objective(x, context).cost for problem, x in points]

    converted, (usual, supple), costs = both(point)
    assert converted.size == point.size + 33 == len(SUPPLE.scale)
    np.testing.assert_allclose(supple, usual, atol=2e-3)
    np.testing.assert_allclose(costs[1], costs[0], rtol=1e-3)


def test_velocities_as_variables_have_exact_derivatives(float64, cases):
    lane = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), pj.take(cases, 2))
    random, size = np.random.default_rng(2), len(SUPPLE.scale)
    shift, direction = 0.2 * random.normal(size=size), random.normal(size=size)

    @jax.jit
    def evaluate_at(shift):
        context = SUPPLE.prepare(lane)
        point = SUPPLE.guesses(context, 1)[0] + shift
        cost = jax.value_and_grad(lambda x: SUPPLE.objective(x, context).cost)
        return SUPPLE.curvature_at(point, context).gradient, *cost(point)

    mine, _, slopes = evaluate_at(shift)
    np.testing.assert_allclose(mine, slopes, rtol=1e-6, atol=1e-9)
    ahead, behind = (evaluate_at(shift + h * direction)[1] for h in (1e-6, -1e-6))
    np.testing.assert_allclose(mine @ direction, (ahead - behind) / 2e-6, rtol=1e-5)


def test_all_guesses_but_the_first_have_the_tangential_velocity_of_an_even_motion(cases):
    lane = pj.take(cases, 3)

    @jax.jit
    def impacts(case):
        context = PROBLEM.prepare(case)
        natural = PROBLEM.guesses(context, 13)[1:, -8:] * jnp.asarray(PROBLEM.scale[-8:])[None]
        return jax.vmap(lambda own: PROBLEM.impact(own, context))(natural)

    found = impacts(lane)
    places, vels = found.tail_state[:, 0], found.tail_state[:, 1]
    even = 2.0 * (places - lane.head_state[None, 0]) / found.stroke.time[:, None]
    speed = np.linalg.norm(even, axis=1, keepdims=True)
    even = even * np.minimum(1.0, 0.9 * lane.limits.speed / speed)
    normal = found.stroke.normal
    across = even - np.sum(even * normal, axis=1, keepdims=True) * normal
    own = vels - np.sum(vels * normal, axis=1, keepdims=True) * normal
    np.testing.assert_allclose(own[1:], across[1:], atol=1e-3)


@pytest.mark.slow
def test_late_hits_that_no_short_search_finds_are_found_by_the_rounds_after_it():
    late = jax.tree.map(np.asarray, to_cases(generate_serves(300, 3), delay=0.6))
    by_rounds = [
        referee_hits(late, plan(dataclasses.replace(PLANNER, attempts=PLANNER.attempts[:k]), late))
        for k in (2, 3, 6)
    ]
    shares = [verdict.success.mean() for verdict in by_rounds]
    assert shares[0] + 0.01 < shares[1] <= shares[2]
    assert shares[2] > 0.965


@pytest.mark.parametrize(("problem", "starts"), [(PROBLEM, 13), (pj.catch.CatchProblem(), 6)])
def test_sizes_that_make_no_sense_are_refused(problem, starts):
    rule = r"proportions must be of >= 2 pieces, finite and > 0, got \(1.0,\)"
    with pytest.raises(ValueError, match=rule):
        dataclasses.replace(problem, proportions=(1.0,), scale=())
    with pytest.raises(pj.ArgumentError, match="scale must be passed, except for .*, got exact-5"):
        dataclasses.replace(problem, proportions=(1.0,) * 5, scale=())
    with pytest.raises(ValueError, match=f"starts must be <= {starts}, got {starts + 1}"):
        problem.guesses(None, starts + 1)


@pytest.mark.parametrize(("task", "pieces"), [(pj.hit, 6), (pj.hit, 12), (pj.catch, 6)])
def test_a_load_scale_is_a_positive_number_for_every_decision_variable(task, pieces):
    problem = task.planner().inner.replanner().inner.problem
    problem = dataclasses.replace(problem, proportions=(1.0,) * pieces, scale=())
    case = pj.take(task.draw(1), 0)
    points = jax.eval_shape(lambda one: problem.guesses(problem.prepare(one), 1), case)
    scale = load_scale(problem.package, f"exact-{pieces}")
    assert points.shape == (1, len(scale))
    assert np.isfinite(scale).all() and min(scale) > 0.0
