"""Rallies: cases, suites, the planner's equations, plans and re-plans."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rallies import bounces, fly_on

import planner_jax as pj
from planner_jax.ball.flight import BallState
from planner_jax.core import GRAVITY
from planner_jax.optimise.settings import LbfgsConfig
from planner_jax.planning.replan import Replanning
from planner_jax.task.hit.court import fly
from planner_jax.task.rally.replan import count_done
from planner_jax.task.rally.suites import COURSES
from tests.trees import assert_same

PLACES = np.tile([0.0, 0.0, 1.5], (2, 1))


def test_a_hovering_racket_is_a_rally_of_the_equations():
    case, plan = bounces(hits=3)
    problem = pj.rally.RallyProblem()
    one, strokes = pj.take(case, 0), pj.take(plan, 0).strokes
    natural = np.zeros((3, 11))
    natural[:, 0] = np.log(np.diff(strokes.time, prepend=0.0))
    natural[-1, 1] = np.log(strokes.flight_time[-1])
    natural[:, 2] = np.log(9.8)
    ends = problem.meet(jnp.asarray(natural, jnp.float32), problem.prepare(one))
    hover = np.zeros((3, 4, 3))
    hover[:, 0] = one.head_state[0]
    np.testing.assert_allclose(ends.tail_states, hover, atol=2e-3)
    np.testing.assert_allclose(ends.contact[0].ball_pos, strokes.ball_pos, atol=1e-4)
    np.testing.assert_allclose(ends.contact[0].ball_vel_after, strokes.ball_vel_after, atol=2e-3)
    np.testing.assert_allclose(ends.contact[1], plan.places[0], atol=1e-6)
    assert float(ends.excess.max()) < 0.0


def test_drawn_balls_fall_into_the_volume():
    cases = pj.rally.draw(50)
    apex = np.asarray(cases.hit_limits.max_apex)
    fall = np.linspace(0.5, 1.4, 200)[:, None]
    pos, vel = fly(cases.ball.pos, cases.ball.vel, fall, cases.drag, cases.gravity)
    is_near = (np.abs(pos[..., 2] - 1.5) < 0.05) & (vel[..., 2] < 0.0)
    assert is_near.any(axis=0).all()
    aside = np.where(is_near, np.abs(pos[..., :2]).max(axis=-1), 0.0)
    assert aside.max() <= 0.55 and pos[..., 2].max() <= apex.max() + 0.01


def test_the_first_ball_of_a_volley_comes_over_the_net_to_the_first_robot():
    cases = pj.rally.draw(50, "volley")
    course = COURSES["volley"]
    time = np.linspace(0.0, 1.9, 400)[:, None]
    pos, vel = fly(cases.ball.pos, cases.ball.vel, time, cases.drag, cases.gravity)
    over = np.abs(pos[..., 0]).argmin(axis=0)
    assert (pos[over, np.arange(50), 2] > course.net + 0.5).all()
    falls = (np.abs(pos[..., 2] - 1.5) < 0.05) & (vel[..., 2] < 0.0)
    aside = np.abs(pos - np.array(course.home))[..., :2].max(axis=-1)
    assert falls.any(axis=0).all() and np.where(falls, aside, 0.0).max() < 1.2


def test_robots_of_volleybots_start_tilted_below_a_ball_at_rest():
    cases = pj.rally.draw(200, "volleybots-juggle")
    start = np.asarray(cases.head_state)[:, 0]
    np.testing.assert_allclose(cases.ball.pos, start + np.array([0.0, 0.0, 2.0]), atol=1e-6)
    assert not np.any(cases.ball.vel) and not np.any(cases.drag)
    assert (np.abs(start - np.array([4.5, 0.0, 2.0])) <= np.array([0.5, 0.5, 0.2]) + 1e-6).all()
    thrust = np.asarray(cases.head_state)[:, 2] + np.array([0.0, 0.0, GRAVITY])
    tilt = np.arccos(thrust[:, 2] / np.linalg.norm(thrust, axis=1))
    assert 0.3 < tilt.max() <= np.arccos(np.cos(0.1 * np.pi) ** 2) + 1e-3
    np.testing.assert_allclose(np.linalg.norm(thrust, axis=1), GRAVITY, rtol=1e-4)


def test_boxes_of_a_suite_repeat():
    places = np.asarray(pj.rally.draw(1, "target", hits=7).places)[0]
    np.testing.assert_array_equal(places[:3], places[3:6])
    np.testing.assert_allclose(places[2], COURSES["target"].places[2])
    assert (places[6] == places[0]).all() and (places[2] != places[0]).any()


def test_a_ball_that_is_struck_later_is_met_later():
    case, _ = bounces(hits=1)
    later = case.replace(ball_time=np.full(1, 0.7))
    natural = np.zeros((1, 11))
    natural[0, :3] = np.log([0.6, 1.0, 9.8])
    problem = pj.rally.RallyProblem()
    meet = jax.jit(lambda case, natural: problem.meet(natural, problem.prepare(case)))
    first = meet(pj.take(case, 0), natural)
    natural[0, 0] = np.log(1.3)
    second = meet(pj.take(later, 0), natural)
    np.testing.assert_allclose(first.tail_states, second.tail_states, atol=2e-3)
    assert float(second.contact[0].time[0]) == pytest.approx(1.3)


def test_a_plan_with_a_home_ends_where_the_way_home_is_short():
    case, problem = pj.take(bounces(hits=1), 0), pj.rally.RallyProblem()
    tail = np.zeros((4, 3))
    tail[0] = case[0].head_state[0]
    costs = []
    for away in (0.0, 1.0, 2.0):
        home = np.array([away, 0.0, 1.5], np.float32)
        at_home = case[0].replace(home=home)
        place, time = at_home.places[0], jnp.asarray(1.0)
        costs.append(float(problem._cost_to_go(jnp.asarray(tail), place, time, at_home)))
    assert costs[0] < 1e-6 * costs[2]
    np.testing.assert_allclose(costs[2], 4.0 * costs[1], rtol=1e-3)  # energy is quadratic


def test_draws_continue_and_depend_on_the_seed():
    whole = pj.rally.draw(8, "juggle", 3)
    assert_same(pj.rally.draw(3, seed=3, first=5), pj.take(whole, slice(5, 8)))
    assert (np.asarray(whole.ball.pos) != np.asarray(pj.rally.draw(8, seed=4).ball.pos)).any()
    assert pj.rally.draw(2, hits=4).places.shape == (2, 4, 3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"places": (0.0, 0.0, 1.5)}, r"places must have the shape \(K, 3\) with K >= 1"),
        ({"places": np.tile([0.0, 0.0, 1.9], (2, 1))}, "places must be .* min_contact"),
        ({"max_contact": 0.9}, "min_contact must be .* got 1"),
        ({"max_apex": 1.8, "min_apex": 1.0}, "max_contact must be .* got 2"),
        ({"place_range": (-0.1, 0.0, 0.0)}, "place_range must be >= 0"),
        ({"ball_time": np.nan}, "ball_time must be finite"),
        ({"home": (0.0, 1.0)}, "home must have the shape"),
        ({"restitution": 1.5}, r"restitution must be in \[0, 1\]"),
    ],
)
def test_a_volume_that_cannot_be_kept_is_one_line(changes, message):
    arguments = {"ball_pos": (0.0, 0.0, 2.0), "ball_vel": np.zeros(3), "places": PLACES}
    with pytest.raises(ValueError, match=message) as caught:
        pj.rally.case(**(arguments | {"start": (0.0, 0.0, 1.2)} | changes))
    assert "\n" not in str(caught.value)


def test_a_hit_is_done_from_its_planned_time_on():
    _, plan = bounces(hits=3)
    plan = pj.take(plan, 0)
    time = float(plan.strokes.time[1])
    for elapsed, done in ((0.0, 0), (time - 1e-3, 1), (time, 2), (99.0, 3)):
        assert int(count_done(plan, np.asarray(elapsed))) == done
        assert int(count_done(plan, jnp.asarray(elapsed))) == done


@pytest.mark.slow
@pytest.mark.parametrize("suite", ["target", "volley", "volleybots-juggle", "volleybots-hit"])
def test_solved_plans_of_all_suites_are_accepted(suite):
    cases = pj.rally.draw(32, suite, seed=6)
    plans = pj.plan(pj.rally.planner(), cases)
    verdict, is_solved = pj.rally.judge(cases, plans), pj.are_solved(plans)
    refused = [verdict.sentence(k) for k in np.flatnonzero(is_solved & ~verdict.success)]
    assert not refused
    # Of `volleybots-hit` about one case in 170 is not solved; rounding decides which.
    assert is_solved.sum() >= (31 if suite == "volleybots-hit" else 32)


@pytest.mark.slow
def test_plans_of_drawn_rallies_are_accepted_and_a_batch_is_a_loop():
    cases, planner = pj.rally.draw(16, seed=5), pj.rally.planner()
    plans = pj.plan(planner, cases)
    verdict = pj.rally.judge(cases, plans)
    assert verdict.success.all(), [verdict.sentence(k) for k in np.flatnonzero(~verdict.success)]
    assert verdict.contact_error.max() < 5e-4 and verdict.place_error.max() < 5e-4
    alone = pj.plan(planner, pj.take(cases, 3))
    np.testing.assert_allclose(alone.strokes.time, plans.strokes.time[3], atol=2e-3)


@pytest.mark.slow
def test_a_ball_is_kept_up_for_thirty_hits_by_looking_one_hit_ahead():
    cases, planner = pj.rally.draw(16, seed=1), pj.rally.planner()
    plans = pj.plan(planner, cases)
    for _ in range(30):
        assert pj.are_solved(plans).all()
        verdict = pj.rally.judge(cases, plans)
        assert verdict.success.all()
        time = np.asarray(plans.strokes.time)[:, 0]
        ball = fly_on(cases, plans)
        again = planner.replanner().begin(cases, plans, time, ball=ball)
        plans = pj.replan(planner, cases, plans, time, ball=ball)
        cases = again.case


@pytest.mark.slow
def test_the_start_of_a_replan_is_the_plan_itself_and_the_ball_may_change():
    case, planner = pj.take(pj.rally.draw(1, seed=2), 0), pj.rally.planner()
    plan = pj.plan(planner, case)
    again = planner.replanner().problem
    zero = jnp.zeros((), jnp.float32)
    context = again.prepare(Replanning(case=case, previous=plan, elapsed=zero))
    start = again.decode(context.start, context)
    assert_close = lambda a, b: np.testing.assert_allclose(a, b, atol=2e-3)  # noqa: E731
    jax.tree.map(assert_close, start.strokes, plan.strokes)
    elapsed = 0.4
    now = pj.fly(case.ball, elapsed, case.drag, case.gravity, num_steps=50)[0]
    moved = BallState(now.pos + jnp.array([0.05, -0.03, 0.0]), now.vel)
    new = pj.replan(planner, case, plan, elapsed, ball=moved)
    left = planner.replanner().begin(case, plan, elapsed, ball=moved).case
    assert pj.rally.judge(left, new).success
    assert abs(float(new.strokes.time[0]) - float(plan.strokes.time[0]) + elapsed) < 0.1


@pytest.mark.slow
def test_the_metric_of_two_hits_changes_variables_only(float64):
    case, problem = pj.rally.draw(1, seed=3, dtype=jnp.float64), pj.rally.RallyProblem()
    plain = pj.rally.RallyProblem(metric=False)
    context = problem.prepare(pj.take(case, 0))
    point = problem.guesses(context, 2)[1]
    again = plain.join(*problem.split(point))
    np.testing.assert_allclose(again, plain.guesses(context, 2)[1], atol=1e-9)
    np.testing.assert_allclose(problem.join(*problem.split(point)), point, atol=1e-9)
    direction = jnp.cos(jnp.arange(point.size))

    @jax.jit
    def derive(point):
        found = problem.curvature_at(point, context)
        slope = jax.grad(lambda x: problem.objective(x, context).cost)
        own = found.gradient, found.products()(direction)
        return own, jax.jvp(slope, (point,), (direction,))

    for own, other in zip(*derive(point), strict=True):
        np.testing.assert_allclose(own, other, rtol=1e-5, atol=1e-8)


@pytest.mark.slow
def test_the_gradient_of_a_plans_cost_agrees_with_plans_of_changed_cases(float64):
    case = pj.take(pj.rally.draw(1, seed=904, dtype=jnp.float64), 0)
    steps = 1e-4 * np.concatenate([np.zeros((1, 4)), np.eye(4), -np.eye(4)])
    cases = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (len(steps), *np.shape(leaf))), case)
    ball = dataclasses.replace(cases.ball, pos=cases.ball.pos + steps[:, :3])
    cases = dataclasses.replace(cases, ball=ball, drag=cases.drag + steps[:, 3])
    solver = LbfgsConfig(max_steps=300, memory=20, tolerance=0.0, patience=20)
    found = pj.gradient(
        pj.rally.planner(), cases, of="cost", by=("ball.pos", "drag"), steps=0, solver=solver
    )
    cost = np.asarray(found.plans.cost)
    slopes = np.append(found.by["ball.pos"][0], found.by["drag"][0])
    np.testing.assert_allclose(slopes, (cost[1:5] - cost[5:]) / 2e-4, rtol=1e-3, atol=1e-6)
