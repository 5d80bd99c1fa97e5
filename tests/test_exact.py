"""The exact hit planner: what is exact by construction, what is promised, what is refused."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from planner_jax.ball.aim import aim_with_drag, apex_with_drag
from planner_jax.ball.flight import BallState, fly
from planner_jax.ball.impact import racket_impact
from planner_jax.optimise.scaling import shipped_scale
from planner_jax.planning.plan import plan
from planner_jax.protocol import Status, is_solved
from planner_jax.referee.hit import referee_hits
from planner_jax.task.hit.exact import ExactHit
from planner_jax.task.hit.serves import generate_serves, to_cases
from planner_jax.trajectory.polynomial import evaluate, total_duration
from tests.jaxpr import assert_full_precision

PLANNER = ExactHit()
FIRST_ROUND = ExactHit(rounds=PLANNER.rounds[:1])
NUM = 16


@pytest.fixture(scope="module")
def cases():
    return to_cases(generate_serves(NUM, 11))


@pytest.fixture(scope="module")
def plans(cases):
    return plan(PLANNER, cases)


def test_every_easy_serve_is_solved_and_confirmed_by_the_referee(cases, plans):
    assert is_solved(plans.status).all()
    verdict = referee_hits(cases, plans)
    assert verdict.success.all(), [verdict.sentence(k) for k in np.flatnonzero(~verdict.success)]


def test_any_decision_vector_meets_the_ball_and_reaches_the_target(cases):
    """The elimination itself: no optimisation, random variables, and still no miss."""
    lane = jax.tree.map(lambda leaf: leaf[3], cases)
    context = PLANNER.prepare(lane)
    size = PLANNER.guesses(context, 1).shape[1]
    offsets = 0.3 * jax.random.normal(jax.random.key(0), (8, size))
    points = PLANNER.guesses(context, 1) + offsets
    found = jax.jit(jax.vmap(lambda x: PLANNER.decode(x, context)))(points)
    many = jax.tree.map(lambda leaf: jnp.repeat(leaf[None], 8, axis=0), lane)
    verdict = referee_hits(many, found)
    assert verdict.contact_error.max() < 1e-3
    assert verdict.landing_error.max() < 2e-3
    assert verdict.head_error.max() < 1e-4


def test_stroke_obeys_the_impact_map(plans):
    for lane in range(NUM):
        one = jax.tree.map(lambda leaf, k=lane: jnp.asarray(leaf[k]), plans)
        end = total_duration(one.trajectory)
        vel = evaluate(one.trajectory, end, 1)
        after = racket_impact(one.stroke.ball_vel, vel, one.stroke.normal, 0.7)
        np.testing.assert_allclose(after, one.stroke.ball_vel_after, atol=2e-3)


def test_one_plan_equals_its_lane_in_the_batch(cases, plans):
    alone = plan(PLANNER, jax.tree.map(lambda leaf: leaf[5], cases))
    assert alone.status == plans.status[5]
    np.testing.assert_allclose(alone.stroke.time, plans.stroke.time[5], rtol=1e-3)
    np.testing.assert_allclose(alone.cost, plans.cost[5], rtol=2e-2)


def test_a_nan_serve_is_a_row_and_leaves_its_neighbours_bits_alone(cases, plans):
    broken = cases.replace(ball=cases.ball.replace(pos=cases.ball.pos.at[2, 0].set(jnp.nan)))
    found = plan(PLANNER, broken)
    assert found.status[2] == Status.NON_FINITE
    for old, new in zip(jax.tree.leaves(plans), jax.tree.leaves(found), strict=True):
        np.testing.assert_array_equal(np.delete(old, 2, axis=0), np.delete(new, 2, axis=0))


def test_an_impossible_lane_says_so_and_stays_finite(cases):
    crippled = cases.limits.scaled(0.05)
    limits = jax.tree.map(lambda a, b: a.at[1].set(b[1]), cases.limits, crippled)
    found = plan(FIRST_ROUND, cases.replace(limits=limits))
    assert found.status[1] in (Status.INFEASIBLE, Status.MAX_STEPS)
    assert found.violation[1] > 0.0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    assert is_solved(np.delete(found.status, 1)).all()


def test_drag_after_the_impact_is_aimed_for(float64):
    pos, target = jnp.array([-2.0, 0.4, 1.5]), jnp.array([4.0, -0.5, 0.0])
    time, drag, gravity = jnp.asarray(1.7), jnp.asarray(0.0616), jnp.asarray(9.8)
    vel = jax.jit(aim_with_drag)(pos, target, time, drag, gravity)
    landed, path = fly(BallState(pos, vel), time, drag, gravity, num_steps=400)
    np.testing.assert_allclose(landed.pos, target, atol=2e-4)
    apex = apex_with_drag(BallState(pos, vel), time, drag, gravity)
    np.testing.assert_allclose(apex, path.pos[:, 2].max(), atol=2e-3)


@pytest.mark.parametrize("leaf", ["target", "drag", "flight_time"])
def test_aim_with_drag_has_the_gradient_of_the_root(float64, leaf):
    args = {
        "pos": jnp.array([-2.0, 0.4, 1.5]),
        "target": jnp.array([4.0, -0.5, 0.0]),
        "flight_time": jnp.asarray(1.7),
        "drag": jnp.asarray(0.0616),
        "gravity": jnp.asarray(9.8),
    }

    @jax.jit
    def speed(value):
        return jnp.sum(aim_with_drag(**{**args, leaf: value}) ** 2)

    slope = jnp.sum(jax.grad(speed)(args[leaf]))
    step = 1e-5
    numeric = (speed(args[leaf] + step) - speed(args[leaf] - step)) / (2 * step)
    # Three Newton steps leave an error of 1e-5 m, and this much in the slope.
    np.testing.assert_allclose(slope, numeric, rtol=2e-4)


def test_falling_ball_is_highest_now():
    ball = BallState(jnp.array([0.0, 0.0, 2.0]), jnp.array([3.0, 0.0, -1.0]))
    assert apex_with_drag(ball, jnp.asarray(1.0), jnp.asarray(0.06), jnp.asarray(9.8)) == 2.0


def test_all_products_of_the_objective_are_in_full_precision(cases):
    lane = jax.tree.map(lambda leaf: leaf[0], cases)
    context = PLANNER.prepare(lane)
    start = PLANNER.guesses(context, 1)[0]
    assert_full_precision(jax.grad(lambda x: PLANNER.objective(x, context).cost), start)
    assert_full_precision(lambda x: PLANNER.decode(x, context), start)


def test_objective_gradient_agrees_with_finite_differences(float64):
    case = jax.tree.map(
        lambda leaf: leaf[0], to_cases(generate_serves(1, 4), delay=0.5, dtype=jnp.float64)
    )
    context = PLANNER.prepare(case)
    cost = jax.jit(lambda x: PLANNER.objective(x, context).cost)
    point = PLANNER.guesses(context, 1)[0] + 0.1
    slopes = jax.jit(jax.grad(cost))(point)
    for k in range(point.size):
        step = jnp.zeros_like(point).at[k].set(1e-6)
        numeric = (cost(point + step) - cost(point - step)) / 2e-6
        np.testing.assert_allclose(slopes[k], numeric, rtol=1e-4, atol=1e-9)


def test_sizes_that_make_no_sense_are_refused(cases):
    with pytest.raises(ValueError, match=r"proportions must be of >= 2 pieces, got \(1.0,\)"):
        ExactHit(proportions=(1.0,))
    with pytest.raises(ValueError, match="no measured scale for 'exact-5'"):
        ExactHit(proportions=(1.0,) * 5)
    context = PLANNER.prepare(jax.tree.map(lambda leaf: leaf[0], cases))
    with pytest.raises(ValueError, match="starts must be <= 12, got 13"):
        PLANNER.guesses(context, 13)


def test_shipped_scales_fit_their_planners():
    for pieces in (6, 12):
        assert len(shipped_scale("planner_jax.task.hit", f"exact-{pieces}")) == 3 * (pieces - 1) + 8
    assert json.dumps(shipped_scale("planner_jax.task.hit", "exact-6"))
