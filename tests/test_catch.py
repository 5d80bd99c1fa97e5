"""The exact catch planner: what is exact by construction, what is promised, what is refused."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from jax import Array

from planner_jax.core.protocol import Plan, Status, is_solved
from planner_jax.optimise.multistart import solve_round
from planner_jax.optimise.planner import OptimisedPlanner, pending
from planner_jax.optimise.settings import Evaluation, LbfgsConfig, Round, Stage
from planner_jax.optimise.shipped import load_scale
from planner_jax.planning.decided import first_choice
from planner_jax.planning.plan import plan
from planner_jax.referee.catch import referee_catches
from planner_jax.task.catch.context import nearest_upright
from planner_jax.task.catch.decide import Greedy
from planner_jax.task.catch.default_planner import ExactCatch
from planner_jax.task.catch.suites import draw
from planner_jax.trajectory.polynomial import evaluate
from tests.jaxpr import assert_full_precision

PLANNER = ExactCatch(rounds=(Round(1, LbfgsConfig(max_steps=20)),))
NUM = 8
THROWS = NUM // 2  # lanes of one throw, whose second target is absent; the others have two


def lane_of(tree, lane):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[lane]), tree)


def timed(cases):
    return jax.tree.map(np.asarray, first_choice(Greedy(), cases))


@pytest.fixture(scope="module")
def cases():
    """Throws with an absent second target, then pairs of throws."""
    suites = [draw(THROWS, name, 4, num_targets=2) for name in ("throws", "parabola2")]
    return timed(jax.tree.map(lambda *leaves: np.concatenate(leaves), *suites))


@pytest.fixture(scope="module")
def plans(cases):
    return plan(PLANNER, cases)


def test_easy_throws_and_pairs_of_them_are_caught_and_confirmed_by_the_referee(cases, plans):
    assert is_solved(plans.status).all()
    verdict = referee_catches(cases, plans)
    assert verdict.success.all(), [verdict.sentence(k) for k in np.flatnonzero(~verdict.success)]
    assert verdict.num_caught.tolist() == [1] * THROWS + [2] * THROWS


def test_any_decision_vector_has_every_ball_in_the_net(cases):
    """The elimination itself: no optimisation, random variables, and still no miss."""
    pairs = jax.tree.map(lambda leaf: np.asarray(leaf[THROWS:]), cases)
    random = np.random.default_rng(0)

    @jax.jit
    @jax.vmap
    def perturbed(case, noise):
        context = PLANNER.prepare(case)
        return PLANNER.decode(PLANNER.guesses(context, 1)[0] + noise, context)

    size = 2 * len(PLANNER.scale)
    found = perturbed(pairs, random.normal(size=(len(pairs.gravity), size)).astype(np.float32))
    verdict = referee_catches(pairs, found)
    assert verdict.net_distance.max() < 0.125
    assert np.abs(verdict.net_offset).max() < 1e-3
    assert verdict.head_error.max() < 1e-4
    assert np.abs(verdict.catch_times - found.times).max() < 1e-5


def test_absent_targets_have_no_flight_and_the_plan_stays_at_the_last_catch(plans):
    pieces = PLANNER.num_pieces
    assert (plans.trajectory.durations[:THROWS, pieces:] == 0.0).all()
    assert (plans.trajectory.durations[THROWS:] > 0.0).all()
    np.testing.assert_array_equal(plans.times[:THROWS, 1], plans.times[:THROWS, 0])
    one = lane_of(plans, 0)
    at_catch = evaluate(one.trajectory, one.times[0] - 1e-6)
    np.testing.assert_allclose(evaluate(one.trajectory, one.times[0] + 1.0), at_catch, atol=1e-4)


@pytest.mark.slow
def test_one_throw_planned_alone_equals_its_lane_in_a_batch_for_more_targets(cases, plans):
    """From the same start: one is learnt for throws of one target alone."""
    wide = lane_of(cases, 0)
    first = lambda leaf: leaf[:1]  # noqa: E731
    alone = plan(
        dataclasses.replace(PLANNER, learned=False),
        wide.replace(
            targets=jax.tree.map(first, wide.targets),
            present=wide.present[:1],
            horizon=wide.horizon[:1],
            order=wide.order[:1],
            times=wide.times[:1],
        ),
    )
    assert alone.status == plans.status[0]
    np.testing.assert_allclose(alone.times, plans.times[0, :1], rtol=1e-3)
    np.testing.assert_allclose(alone.cost, plans.cost[0], rtol=1e-3)
    pieces = PLANNER.num_pieces
    np.testing.assert_allclose(
        alone.trajectory.durations, plans.trajectory.durations[0, :pieces], rtol=1e-3
    )


@pytest.mark.slow
def test_pairs_planned_one_by_one_equal_their_lanes_in_the_batch(cases, plans):
    for lane in range(THROWS, NUM):
        alone = plan(PLANNER, lane_of(cases, lane))
        assert alone.status == plans.status[lane]
        np.testing.assert_allclose(alone.times, plans.times[lane], rtol=2e-3)
        np.testing.assert_allclose(alone.cost, plans.cost[lane], rtol=1e-2)


@jax.jit
@jax.value_and_grad
def cost_and_slopes(shift, case):
    """Of a point beside the first guess."""
    context = PLANNER.prepare(case)
    return PLANNER.objective(PLANNER.guesses(context, 1)[0] + shift, context).cost


def one_of(name, **sizes):
    cases = draw(1, name, 4, dtype=jnp.float64, **sizes)
    return jax.tree.map(lambda leaf: np.asarray(leaf[0]), cases)


def test_absent_targets_cost_nothing_and_have_no_slope(float64):
    """Two places, one of them taken, and the variables of the other one at random."""
    size = len(PLANNER.scale)
    shifts = 0.5 * np.random.default_rng(2).normal(size=(2, 2 * size))
    shifts[1, :size] = shifts[0, :size]
    wide = one_of("throws", num_targets=2)
    (cost, slopes), (same, same_slopes) = (cost_and_slopes(shift, wide) for shift in shifts)
    assert cost == same
    np.testing.assert_array_equal(slopes, same_slopes)
    assert (slopes[size:] == 0.0).all()
    assert (slopes[:size] != 0.0).any()


def test_objective_gradient_agrees_with_finite_differences(float64):
    pair = one_of("parabola2")
    random = np.random.default_rng(3)
    shift = 0.3 * random.normal(size=2 * len(PLANNER.scale))
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
    for old, new in zip(jax.tree.leaves(plans), jax.tree.leaves(found), strict=True):
        np.testing.assert_array_equal(np.delete(old, 5, axis=0), np.delete(new, 5, axis=0))


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
    context = PLANNER.prepare(lane_of(cases, 0))
    start = jnp.zeros(2 * len(PLANNER.scale))
    slopes = jax.grad(lambda x: PLANNER.objective(x, context).cost)
    assert assert_full_precision(slopes, start) > 0
    assert assert_full_precision(lambda x: PLANNER.decode(x, context), start) > 0


def test_sizes_that_make_no_sense_are_refused(cases):
    with pytest.raises(
        ValueError, match=r"proportions must be of >= 2 pieces, finite and > 0, got \(1.0,\)"
    ):
        ExactCatch(proportions=(1.0,))
    with pytest.raises(ValueError, match="no measured scale for 'exact-5'"):
        ExactCatch(proportions=(1.0,) * 5)
    with pytest.raises(ValueError, match="starts must be <= 6, got 7"):
        PLANNER.guesses(PLANNER.prepare(lane_of(cases, 0)), 7)


def test_the_shipped_scale_is_a_positive_number_for_every_variable_of_a_segment(cases):
    lane = lane_of(cases, 0)
    points = jax.eval_shape(lambda one: PLANNER.guesses(PLANNER.prepare(one), 1), lane)
    scale = load_scale("planner_jax.task.catch", "exact-6")
    assert points.shape == (1, lane.num_targets * len(scale))
    assert np.isfinite(scale).all() and min(scale) > 0.0


# Stages, on a planner without any physics.


@struct.dataclass
class Reached(Plan):
    point: Array


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Bowl(OptimisedPlanner):
    """Its cost is least at `goal`, and every point is feasible."""

    goal: float = 0.0
    rounds: tuple[Round, ...] = (Round(),)

    def prepare(self, case):
        return case

    def guesses(self, context, num):
        return jnp.full((num, 1), 7.0)

    def objective(self, point, context):
        away = jnp.sum((point - self.goal) ** 2)
        return Evaluation(cost=away, violation=-jnp.ones_like(away))

    def decode(self, point, context):
        return Reached(point=point, **pending(-jnp.ones(())))


SEARCH, STAND = LbfgsConfig(max_steps=30, memory=2), LbfgsConfig(max_steps=0)


def solved(starts, solver, *, settings=(), goals=()):
    """A round on the bowl after stages that have goals of their own."""
    stages = tuple(Stage(SEARCH, (("goal", goal),)) for goal in goals)
    attempt = Round(starts, solver, settings, stages)
    return jax.jit(functools.partial(solve_round, Bowl(), attempt))(np.zeros((), np.float32))


def test_a_round_starts_where_its_last_stage_ended():
    early, late = solved(1, STAND, goals=(5.0,)), solved(1, STAND, goals=(5.0, 3.0))
    np.testing.assert_allclose([early.point[0], late.point[0]], [5.0, 3.0], atol=1e-3)
    assert 0 < early.iterations < late.iterations  # those of the stages count
    # What is paid there is the planner's own cost.
    np.testing.assert_allclose([early.cost, late.cost], [25.0, 9.0], atol=1e-2)


def test_a_round_after_stages_solves_the_problem_of_its_own_settings():
    found = solved(2, SEARCH, settings=(("goal", -1.0),), goals=(5.0,))
    np.testing.assert_allclose(found.point, -1.0, atol=1e-3)
    assert found.status == Status.CONVERGED


def test_axes_nearest_to_upright_lean_from_the_way_back_as_far_as_they_may():
    """Of a target that falls steeply, flies level, is in between, rises, or rests."""
    vel = jnp.array(
        [[0.1, 0.0, -2.0], [2.0, 0.0, 0.0], [1.0, 1.0, -1.0], [0.0, 1.0, 3.0], [0.0] * 3]
    )
    axes = np.asarray(nearest_upright(vel, jnp.float32(0.5)))
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1.0, rtol=1e-5)
    np.testing.assert_allclose(axes[[0, 4]], [[0.0, 0.0, 1.0]] * 2, atol=1e-6)
    np.testing.assert_allclose(axes[1], [-np.cos(0.5), 0.0, np.sin(0.5)], atol=1e-3)
    back = -np.asarray(vel[2]) / np.sqrt(3.0)
    assert np.arccos(axes[2] @ back) == pytest.approx(0.5, abs=1e-3)
    np.testing.assert_allclose(axes[3], [0.0, -np.cos(0.5), np.sin(0.5)], atol=1e-3)
