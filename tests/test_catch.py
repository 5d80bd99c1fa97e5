import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_solve import Well, WellProblem

import planner_jax as pj
from planner_jax.core.protocol import Status, is_solved
from planner_jax.optimise.settings import Attempt, Evaluation, LbfgsConfig, Stage
from planner_jax.planning.decided import first_choice
from planner_jax.planning.plan import plan
from planner_jax.referee.catch import referee_catches
from planner_jax.task.catch.context import nearest_upright
from planner_jax.task.catch.decide import Greedy
from planner_jax.task.catch.default_planner import CatchProblem
from planner_jax.task.catch.suites import draw
from planner_jax.trajectory.polynomial import evaluate
from tests.jaxpr import assert_full_precision
from tests.trees import assert_same

PROBLEM = CatchProblem()
PLANNER = pj.SearchPlanner(PROBLEM, (Attempt(1, LbfgsConfig(max_steps=20)),))
NUM = 8
THROWS = NUM // 2  # Number of cases with one ball, which come first. The others have two balls.


@pytest.fixture(scope="module")
def cases():
    suites = [draw(THROWS, name, 4, num_targets=2) for name in ("throws", "parabola2")]
    cases = jax.tree.map(lambda *leaves: np.concatenate(leaves), *suites)
    return jax.tree.map(np.asarray, first_choice(Greedy(), cases))


@pytest.fixture(scope="module")
def plans(cases):
    return plan(PLANNER, cases)


def test_easy_throws_and_pairs_of_them_are_caught_and_confirmed_by_the_referee(cases, plans):
    assert is_solved(plans.status).all()
    verdict = referee_catches(cases, plans)
    assert verdict.success.all(), [verdict.sentence(k) for k in np.flatnonzero(~verdict.success)]
    assert verdict.num_caught.tolist() == [1] * THROWS + [2] * THROWS


def test_any_decision_vector_has_every_ball_in_the_net(cases):
    pairs = pj.take(cases, slice(THROWS, None))
    random = np.random.default_rng(0)

    @jax.jit
    @jax.vmap
    def decode_beside(case, noise):
        context = PROBLEM.prepare(case)
        return PROBLEM.decode(PROBLEM.guesses(context, 1)[0] + noise, context)

    size = 2 * len(PROBLEM.scale)
    found = decode_beside(pairs, random.normal(size=(len(pairs.gravity), size)).astype(np.float32))
    verdict = referee_catches(pairs, found)
    assert verdict.net_distance.max() < 0.125
    assert np.abs(verdict.net_offset).max() < 1e-3
    assert verdict.head_error.max() < 1e-4
    assert np.abs(verdict.catch_times - found.times).max() < 1e-5


def test_absent_targets_have_no_flight_and_the_plan_stays_at_the_last_catch(plans):
    pieces = PROBLEM.num_pieces
    assert (plans.trajectory.durations[:THROWS, pieces:] == 0.0).all()
    assert (plans.trajectory.durations[THROWS:] > 0.0).all()
    np.testing.assert_array_equal(plans.times[:THROWS, 1], plans.times[:THROWS, 0])
    one = pj.take(plans, 0)
    at_catch = evaluate(one.trajectory, one.times[0] - 1e-6)
    np.testing.assert_allclose(evaluate(one.trajectory, one.times[0] + 1.0), at_catch, atol=1e-4)


@pytest.mark.slow
def test_one_throw_planned_alone_equals_its_lane_in_a_batch_for_more_targets(cases, plans):
    wide = pj.take(cases, 0)
    each_target = ("targets", "present", "horizon", "order", "times")
    fields = {name: pj.take(vars(wide)[name], slice(1)) for name in each_target}
    planner = PLANNER.with_settings((("learned", False),))  # Networks guess for one target only.
    alone = plan(planner, wide.replace(**fields))
    assert alone.status == plans.status[0]
    np.testing.assert_allclose(alone.times, plans.times[0, :1], rtol=1e-3)
    np.testing.assert_allclose(alone.cost, plans.cost[0], rtol=1e-3)
    durations = plans.trajectory.durations[0, : PROBLEM.num_pieces]
    np.testing.assert_allclose(alone.trajectory.durations, durations, rtol=1e-3)


@jax.jit
@jax.value_and_grad
def cost_and_slopes(shift, case):
    context = PROBLEM.prepare(case)
    return PROBLEM.objective(PROBLEM.guesses(context, 1)[0] + shift, context).cost


def test_absent_targets_cost_nothing_and_have_no_slope(float64):
    size = len(PROBLEM.scale)
    shifts = 0.5 * np.random.default_rng(2).normal(size=(2, 2 * size))
    shifts[1, :size] = shifts[0, :size]
    wide = pj.take(draw(1, "throws", 4, num_targets=2, dtype=jnp.float64), 0)
    (cost, slopes), (same, same_slopes) = (cost_and_slopes(shift, wide) for shift in shifts)
    assert cost == same
    np.testing.assert_array_equal(slopes, same_slopes)
    assert (slopes[size:] == 0.0).all()
    assert (slopes[:size] != 0.0).any()


def test_objective_gradient_agrees_with_finite_differences(float64):
    pair = pj.take(draw(1, "parabola2", 4, dtype=jnp.float64), 0)
    random = np.random.default_rng(3)
    shift = 0.3 * random.normal(size=2 * len(PROBLEM.scale))
    _, slopes = cost_and_slopes(shift, pair)
    assert np.count_nonzero(slopes) == slopes.size
    for direction in random.normal(size=(4, shift.size)):
        ahead, behind = (cost_and_slopes(shift + h * direction, pair)[0] for h in (1e-6, -1e-6))
        numeric, terms = (ahead - behind) / 2e-6, slopes * direction
        np.testing.assert_allclose(terms.sum(), numeric, atol=1e-6 * np.abs(terms).sum())


def test_a_nan_case_is_a_row_and_leaves_its_neighbours_bits_alone(cases, plans):
    ball = cases.targets.ball
    pos = np.array(ball.pos)
    pos[5, 1, 0] = np.nan
    targets = cases.targets.replace(ball=ball.replace(pos=pos))
    found = plan(PLANNER, jax.tree.map(jnp.asarray, cases.replace(targets=targets)))
    assert found.status[5] == Status.BAD_INPUT
    assert_same(found, plans, np.arange(NUM) != 5)


def test_an_impossible_lane_says_so_and_stays_finite(cases):
    speed = np.array(cases.limits.speed)
    speed[[1, 6]] *= 0.05
    found = plan(PLANNER, cases.replace(limits=cases.limits.replace(speed=speed)))
    assert np.isin(found.status[[1, 6]], (Status.INFEASIBLE, Status.MAX_STEPS)).all()
    assert (found.violation[[1, 6]] > 0.0).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    assert is_solved(np.delete(found.status, [1, 6])).all()


def test_a_ball_that_is_due_too_early_is_reported_and_not_caught_late(cases):
    found = plan(PLANNER, cases.replace(horizon=np.asarray(cases.horizon) * 0.3))
    assert not is_solved(found.status).any()
    assert (found.violation > 0.0).all()


def test_all_products_of_the_objective_are_in_full_precision(cases):
    context = PROBLEM.prepare(pj.take(cases, 0))
    start = jnp.zeros(2 * len(PROBLEM.scale))
    slopes = jax.grad(lambda x: PROBLEM.objective(x, context).cost)
    assert assert_full_precision(slopes, start) > 0
    assert assert_full_precision(lambda x: PROBLEM.decode(x, context), start) > 0


SEARCH, STAND = LbfgsConfig(max_steps=30, memory=2), LbfgsConfig(max_steps=0)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Bowl(WellProblem):
    """The squared distance of a number from `goal`, without limits."""

    goal: float = 0.0

    def guesses(self, context, num):
        return jnp.full((num, 1), 7.0)

    def objective(self, point, context):
        away = jnp.sum((point - self.goal) ** 2)
        return Evaluation(cost=away, violation=-jnp.ones_like(away))


def solve(starts, solver, *, settings=(), goals=()):
    stages = tuple(Stage(SEARCH, (("goal", goal),)) for goal in goals)
    attempt = Attempt(starts, solver, settings, stages)
    return jax.jit(lambda case: Bowl.planner().solve(case, attempt))(Well(np.zeros((), np.float32)))


def test_a_round_starts_where_its_last_stage_ended():
    early, late = solve(1, STAND, goals=(5.0,)), solve(1, STAND, goals=(5.0, 3.0))
    np.testing.assert_allclose([early.point[0], late.point[0]], [5.0, 3.0], atol=1e-3)
    assert 0 < early.iterations < late.iterations  # Iterations of stages count, too.
    np.testing.assert_allclose([early.cost, late.cost], [25.0, 9.0], atol=1e-2)


def test_a_round_after_stages_solves_the_problem_of_its_own_settings():
    found = solve(2, SEARCH, settings=(("goal", -1.0),), goals=(5.0,))
    np.testing.assert_allclose(found.point, -1.0, atol=1e-3)
    assert found.status == Status.CONVERGED


def test_axes_nearest_to_upright_lean_from_the_reversed_velocity_as_far_as_they_may():
    rows = [[0.1, 0.0, -2.0], [2.0, 0.0, 0.0], [1.0, 1.0, -1.0], [0.0, 1.0, 3.0], [0.0] * 3]
    vel = jnp.array(rows)
    axes = np.asarray(nearest_upright(vel, jnp.float32(0.5)))
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1.0, rtol=1e-5)
    np.testing.assert_allclose(axes[[0, 4]], [[0.0, 0.0, 1.0]] * 2, atol=1e-6)
    np.testing.assert_allclose(axes[1], [-np.cos(0.5), 0.0, np.sin(0.5)], atol=1e-3)
    back = -np.asarray(vel[2]) / np.sqrt(3.0)
    assert np.arccos(axes[2] @ back) == pytest.approx(0.5, abs=1e-3)
    np.testing.assert_allclose(axes[3], [0.0, -np.cos(0.5), np.sin(0.5)], atol=1e-3)
