"""Tests of the published planners of hits."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import assert_gradient_matches_differences

import planner_jax as pj
from planner_jax.ball.flight import BallState, drag_free_flight, fly
from planner_jax.baselines.hit.bat import BatHit, serve_origin, transition_point
from planner_jax.baselines.hit.comparison import choose_reference
from planner_jax.baselines.hit.decoupled import aim_at_angle, solve_decoupled_hit
from planner_jax.baselines.hit.juggle import JuggleHit
from planner_jax.baselines.parts.minimum_jerk import minimum_jerk, minimum_jerk_after_ramp
from planner_jax.core.protocol import Status, is_solved
from planner_jax.planning.plan import plan
from planner_jax.referee.hit import referee_hits
from planner_jax.sims.scoring import racket_impact
from planner_jax.task.hit import court
from planner_jax.task.hit.spec import TASK
from planner_jax.task.hit.suites import generate_serves, to_cases
from planner_jax.trajectory.polynomial import evaluate

NUM = 16
GRAVITY = 9.8
RESTITUTION = 0.7
BAT = BatHit.planner()
JUGGLE = JuggleHit()
position = jax.jit(lambda head, tail, end, t: evaluate(minimum_jerk(head, tail, end), t))
float64 = pytest.mark.usefixtures("float64")


@pytest.fixture(scope="module")
def cases():
    return jax.tree.map(np.asarray, to_cases(generate_serves(NUM, 5)))


@pytest.fixture(scope="module")
def bat_plans(cases):
    return plan(BAT, cases)


@pytest.fixture(scope="module")
def juggle_plans(cases):
    return plan(JUGGLE, cases)


def serves_gone_wrong():
    """Return cases in which an equation of a published planner divides by zero or has no root."""
    pos = [[-2.0, 0.0, 2.0]] * 3 + [[-2.0, 0.0, 1.0], [-2.0, 0.0, 0.01], [-2.0, 0.0, 3.0]]
    vel = [[0.0, 0.0, 7.0]] * 3 + [[0.0, 0.0, -4.0], [-3.0, 0.0, -8.0], [0.0, 0.0, 0.0]]
    target = [[-2.0, 0.0, 5.0], [-2.0, 0.0, 0.0], [-2.0, 3.0, 0.0]] + [[3.0, 0.0, 0.0]] * 3
    good = [3.5, 0.3, 2.0], [-4.0, -0.2, 7.4], [3.0, 1.67, 0.0]
    return pj.hit.case(*(np.array([*a, b]) for a, b in zip((pos, vel, target), good, strict=True)))


def generic_hits():
    rng = np.random.default_rng(1)
    ball = BallState(
        pos=rng.uniform([-4.0, -2.0, 0.5], [-1.0, 2.0, 2.5], (32, 3)),
        vel=rng.uniform([-4.0, -1.5, -7.5], [-1.5, 1.5, -4.0], (32, 3)),
    )
    target = rng.uniform([1.5, -2.0, 0.0], [4.0, 2.0, 0.0], (32, 3))
    racket_vel = rng.uniform(-2.0, 2.0, (32, 2))
    return ball, target, racket_vel, rng.uniform([3.0, 8.0], [8.0, 14.0], (32, 2))


def solve(ball, target, racket_vel_yz, thrust_xz):
    return solve_decoupled_hit(ball, target, racket_vel_yz, thrust_xz, RESTITUTION, GRAVITY)


def solve_hits():
    given = generic_hits()
    return given, jax.jit(jax.vmap(solve))(*given)


@float64
def test_a_generic_hit_sends_the_ball_to_the_target():
    (ball, target, racket_vel, thrust), hit = solve_hits()
    assert (hit.defect == 0.0).all()
    np.testing.assert_array_equal(hit.racket_vel[:, 1:], racket_vel)
    np.testing.assert_array_equal(hit.thrust[:, ::2], thrust)
    normal = hit.thrust / jnp.linalg.norm(hit.thrust, axis=1, keepdims=True)
    bounce = jax.vmap(racket_impact, in_axes=(0, 0, 0, None))
    after = bounce(ball.vel, hit.racket_vel, normal, RESTITUTION)
    np.testing.assert_allclose(after, hit.ball_vel_after, atol=1e-11)
    fall = jax.vmap(drag_free_flight, in_axes=(0, 0, None))
    landing = fall(BallState(ball.pos, after), hit.flight_time, GRAVITY).pos
    np.testing.assert_allclose(landing, target, atol=1e-11)


@float64
def test_the_flight_time_is_the_one_of_the_printed_equations():
    (ball, target, racket_vel, thrust), hit = solve_hits()
    xi, delta = target - ball.pos, thrust[:, 1] / thrust[:, 0]
    vx, vy, vz = ball.vel.T
    lead = delta * vx - vz
    below = delta * xi[:, 0] - xi[:, 2]
    after_x = (np.sqrt(lead**2 + 2.0 * GRAVITY * below) + lead) * xi[:, 0] / (2.0 * below)
    tau_y = (vy - xi[:, 1] / xi[:, 0] * after_x) / (vx - after_x) * thrust[:, 0]
    cross = xi[:, 0] * tau_y - xi[:, 1] * thrust[:, 0]
    after_y = xi[:, 1] * (tau_y * vx - thrust[:, 0] * vy) / cross
    after_z = -thrust[:, 1] / tau_y * (vy - after_y) + vz
    np.testing.assert_allclose(hit.thrust[:, 1], tau_y, rtol=1e-9)
    after = np.stack([after_x, after_y, after_z], axis=1)
    np.testing.assert_allclose(hit.ball_vel_after, after, rtol=1e-8)


@float64
def test_gradients_of_the_hit_match_differences():
    ball, target, racket_vel, thrust = jax.tree.map(lambda x: x[3], generic_hits())

    def some_number(given):
        hit = solve(ball, target, *given)
        return jnp.sum(hit.racket_vel**2) + jnp.sum(hit.thrust) + hit.flight_time

    assert_gradient_matches_differences(some_number, (racket_vel, thrust))


@jax.jit
@functools.partial(jax.value_and_grad, has_aux=True, argnums=(0, 1, 2))
def sum_of_hit(thrust_xz, ball_vel, xi):
    hit = solve(BallState(jnp.zeros(3), ball_vel), xi, jnp.array([0.0, 1.0]), thrust_xz)
    return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(hit)), hit


@pytest.mark.parametrize(
    ("xi", "ball_vel", "thrust"),
    [
        ((0.0, 0.0, 3.0), (0.0, 0.0, -5.0), (4.0, 10.0)),  # The target is straight above.
        ((0.0, 0.0, -1.0), (0.0, 0.0, -5.0), (0.0, 10.0)),  # straight below, no tau_x
        ((3.0, 1.0, -1.0), (0.0, 0.0, -5.0), (0.0, 10.0)),
        ((3.0, 1.0, -1.0), (-3.0, 0.0, -5.0), (-4.0, 10.0)),  # The racket faces away.
        ((5.0, 1.0, 0.0), (5.0, 0.0, 0.0), (1e-3, 0.0)),
    ],
)
def test_an_impossible_hit_is_finite_and_has_a_defect(xi, ball_vel, thrust):
    (_, hit), gradient = sum_of_hit(jnp.array(thrust), jnp.array(ball_vel), jnp.array(xi))
    assert hit.defect > 0.0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((hit, gradient)))


@float64
def test_a_ball_aimed_at_an_angle_leaves_at_it_and_arrives():
    pos, target = jnp.array([-2.0, 0.5, 1.4]), jnp.array([3.0, -1.0, 0.0])
    vel = aim_at_angle(pos, target, np.radians(60.0), GRAVITY)
    np.testing.assert_allclose(vel[2] / jnp.hypot(vel[0], vel[1]), np.sqrt(3.0), rtol=1e-12)
    time = (target[0] - pos[0]) / vel[0]
    landing = drag_free_flight(BallState(pos, vel), time, GRAVITY).pos
    np.testing.assert_allclose(landing, target, atol=1e-12)


def test_transition_point_of_an_example_by_hand():
    points = jnp.array([[-4.0, 3.0, 0.0], [-2.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    point = transition_point(**dict(zip(("start", "hit", "origin", "target"), points, strict=True)))
    np.testing.assert_allclose(point, [-3.0, 1.0, 0.0], atol=1e-6)


@float64
def test_the_serve_comes_from_where_its_flight_began(cases):
    origin = np.array([3.0, -1.0, 0.0])
    launched = BallState(jnp.array(origin), jnp.array([-4.0, 0.5, 9.5]))
    drag, gravity = jnp.asarray(0.0616), jnp.asarray(GRAVITY)
    ball, _ = fly(launched, jnp.asarray(0.25), drag, gravity, num_steps=100)
    lane = pj.hit.case(ball.pos, ball.vel, np.zeros(3), dtype=jnp.float64)
    np.testing.assert_allclose(serve_origin(lane), origin, atol=1e-3)
    falling = dataclasses.replace(lane, ball=BallState(ball.pos, jnp.array([-9.0, 0.0, -30.0])))
    assert np.isfinite(serve_origin(falling)).all()


def first_guess(transition, case):
    bat = BatHit(transition=transition)
    context = bat.prepare(case)
    natural = bat.guesses(context, 1)[0] * jnp.asarray(bat.scale)
    impact, defect = bat.impact(natural[bat.num_offsets :], context)
    waypoints = natural[: bat.num_offsets].reshape(-1, 3)
    return waypoints, impact, defect, bat.transition_state(impact, case)


@pytest.mark.parametrize("transition", [True, False])
def test_first_waypoints_lie_on_the_primitives(cases, transition):
    case = jax.tree.map(lambda leaf: jnp.asarray(leaf[2]), cases)
    waypoints, impact, defect, state = jax.jit(first_guess, static_argnums=0)(transition, case)
    head, tail, end = case.head_state[:3], impact.tail_state[:3], impact.stroke.time
    assert defect == 0.0
    np.testing.assert_allclose(end, 1.2 if transition else 0.7, rtol=1e-5)
    rise = impact.stroke.ball_vel_after
    np.testing.assert_allclose(rise[2] / np.hypot(rise[0], rise[1]), np.sqrt(3.0), rtol=1e-3)
    if transition:
        np.testing.assert_allclose(state[1], tail[1] * np.array([0.5, 0.5, 1.0 / 3.0]), atol=1e-5)
        np.testing.assert_allclose(state[2, 2], 2.0 / 3.0 * tail[2, 2], atol=1e-5)
        switch = 0.7 / 1.2 * end
        expected = [
            position(head, state, switch, 0.25 * end),
            position(head, state, switch, 0.5 * end),
            position(state, tail, end - switch, 0.75 * end - switch),
        ]
    else:
        expected = [position(head, tail, end, share * end) for share in (0.25, 0.5, 0.75)]
    np.testing.assert_allclose(waypoints, np.stack(expected), atol=1e-4)


def test_juggle_starts_at_rest_and_ends_in_its_fixed_stroke(cases, juggle_plans):
    verdict = referee_hits(cases, juggle_plans)
    assert (juggle_plans.iterations == 0).all()
    assert set(np.asarray(juggle_plans.status)) <= {Status.CONVERGED, Status.INFEASIBLE}
    assert verdict.head_error.max() < 1e-6 and verdict.continuity_error.max() < 1e-4
    assert verdict.contact_error.max() < 1e-3 and verdict.landing_error.max() < 1e-3
    np.testing.assert_allclose(juggle_plans.stroke.ball_pos[:, 2], JUGGLE.height, atol=1e-3)
    np.testing.assert_allclose(verdict.apex, JUGGLE.apex, atol=2e-3)
    np.testing.assert_allclose(verdict.hitting_velocity[:, :2], 0.0, atol=1e-3)
    acc_of = jax.vmap(lambda plan: evaluate(plan.trajectory, plan.stroke.time, 2))
    acc = acc_of(juggle_plans)
    np.testing.assert_allclose(acc[:, 2], 0.1 * GRAVITY, atol=2e-3)  # The thrust is 1.1 g.


@float64
def test_a_short_ease_leaves_the_minimum_jerk_primitive_and_joins_it_up_to_the_jerk():
    rng = np.random.default_rng(3)
    head, tail, end = rng.normal(size=(4, 3)), rng.normal(size=(3, 3)), 1.3
    eased_primitive = jax.jit(minimum_jerk_after_ramp, static_argnums=3)

    def derivatives(coeffs, t, num):
        value = [np.polynomial.polynomial.polyder(coeffs, n) for n in range(num)]
        return np.stack([np.polynomial.polynomial.polyval(t, c) for c in value])

    plain = minimum_jerk(jnp.asarray(head[:3]), jnp.asarray(tail), jnp.asarray(end))
    for ease, away in ((1e-2, 2e-2), (1e-4, 2e-4)):
        eased = eased_primitive(head, tail, jnp.asarray(end), ease)
        ramp, primitive = np.asarray(eased.coeffs)
        np.testing.assert_allclose(eased.durations, [ease, end - ease], rtol=1e-12)
        np.testing.assert_allclose(derivatives(ramp, 0.0, 4), head, atol=1e-12)
        joint = derivatives(ramp, ease, 4), derivatives(primitive, 0.0, 4)
        np.testing.assert_allclose(*joint, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(derivatives(primitive, end - ease, 3), tail, atol=1e-9)
        middle, usual = derivatives(primitive, 0.6 - ease, 1), derivatives(plain.coeffs[0], 0.6, 1)
        np.testing.assert_allclose(middle, usual, atol=away)


def test_bat_meets_the_ball_and_reaches_the_target_on_every_lane(cases, bat_plans):
    verdict = referee_hits(cases, bat_plans)
    assert verdict.contact_error.max() < 1e-3 and verdict.landing_error.max() < 1e-2
    assert verdict.head_error.max() < 1e-4
    solved = is_solved(bat_plans.status)
    assert solved.sum() >= NUM // 2
    assert verdict.success[solved].all()


@pytest.mark.parametrize("planner", [BAT, JUGGLE])
def test_a_plan_that_breaks_a_limit_has_a_failure_status(planner):
    cases = jax.tree.map(np.asarray, to_cases(generate_serves(64, 5)))
    plans = plan(planner, cases)
    verdict = referee_hits(cases, plans)
    refused = np.isin(verdict.failed_limit, ["speed", "acceleration", "body rate", "apex low"])
    assert refused.any()
    assert set(np.asarray(plans.status)[refused]) <= {Status.INFEASIBLE, Status.MAX_STEPS}
    assert (plans.violation[refused] > 0.0).all()


@pytest.mark.parametrize("make", [BatHit.planner, JuggleHit])
def test_degenerate_cases_stay_finite_and_leave_other_lanes_unchanged(make, cases):
    broken = jax.tree.map(lambda a, b: np.concatenate([b[:9], a]), serves_gone_wrong(), cases)
    found = plan(make(), broken)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    assert not is_solved(found.status[9]), "the target is above every path"
    verdict = referee_hits(broken, found)
    solved = is_solved(found.status)
    assert solved.any() and verdict.success[solved].all()
    alone = plan(make(), cases)
    for old, new in zip(jax.tree.leaves(alone), jax.tree.leaves(found), strict=True):
        np.testing.assert_array_equal(old[:9], new[:9])


def test_every_published_planner_has_its_name():
    fitted = {"bat-fitted", "bat-lite-fitted"}
    assert {"exact", *court.PLANNERS} | fitted == set(TASK.planners)
    assert pj.hit.planner("juggle") == JUGGLE
    assert pj.hit.planner("bat-fitted") == BAT
    lite = pj.hit.planner("bat-lite-fitted", nodes=8)
    assert lite == BatHit.planner(transition=False, nodes=8)
    published = pj.hit.planner("bat-lite", nodes=8)
    assert published.problem == BatHit(transition=False, nodes=8, scale=(1.0,) * 14)
    assert {choose_reference(name) for name in TASK.planners} == set(court.PLANNERS)


def test_planners_with_one_piece_or_two_starts_are_rejected():
    with pytest.raises(ValueError, match="starts must be 1, got 2"):
        BAT.problem.guesses(None, 2)
    assert {attempt.starts for each in (BAT, JUGGLE) for attempt in each.attempts} == {1}
    with pytest.raises(ValueError, match="num_pieces must be >= 2, got 1"):
        BatHit(num_pieces=1)
