"""The planner of [Yu2023catch] in JAX against stored results of a C++ planner, on 240 throws.

`data/catch_paper.csv` and `data/catch_hard.csv` hold the ball's state when planning starts, the
catch time T_p of the first guess, the guess's costs for trajectories of 4 and of 8 pieces, and the
optimal cost and catch time that the C++ implementation found.
"""

import csv
import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.baselines.catch.paper import PaperCatch
from planner_jax.baselines.parts.lbfgs_lite import LitePlanner, LiteRule
from planner_jax.referee.catch import referee_catches
from tests.derivatives import assert_gradient_matches_differences, value_and_gradient

PROBLEM = PaperCatch()
PLANNER = pj.SearchPlanner(PROBLEM)
UNIT = 1e3  # the planner's cost is the paper's over 1000
NAMES = ("paper", "hard")

pytestmark = pytest.mark.usefixtures("float64")


def rows(name, num=None):
    path = Path(__file__).parent / "data" / f"catch_{name}.csv"
    with path.open(encoding="utf-8") as file:
        table = list(csv.DictReader(file))[:num]
    columns = {key: np.array([float(row[key]) for row in table]) for key in table[0]}
    pos, vel = (
        np.stack([columns[f"{kind}_{axis}"] for axis in "xyz"], axis=1)[:, None]
        for kind in ("b0", "bv0")
    )
    shape = pos.shape[:2]
    targets = pj.BallPath(pj.BallState(pos, vel), np.full((*shape, 3), 0.5), np.full(shape, 9.81))
    cases = pj.catch.case(targets, np.full(shape, 3.0), dtype=jnp.float64)
    return cases.replace(times=columns["Tp"][:, None]), columns


def run_longer():  # the slowest of the 240 rows takes 181 to 217 steps, depending on rounding
    (full,) = PLANNER.attempts
    patient = dataclasses.replace(full.solver, max_steps=250)
    return dataclasses.replace(PLANNER, attempts=(dataclasses.replace(full, solver=patient),))


def excess(planner):
    (easy, published), (hard, of_hard) = map(rows, NAMES)
    cases = jax.tree.map(lambda *leaves: np.concatenate(leaves), easy, hard)
    plans = pj.plan(planner, cases)
    cost = np.concatenate([published["cost_ref"], of_hard["cost_ref"]])
    times = np.concatenate([published["T_ref"], of_hard["T_ref"]])
    return UNIT * plans.cost / cost - 1.0, plans.times[:, 0] - times, cases, plans


@pytest.mark.parametrize("pieces", [4, 8])
def test_the_guess_has_the_published_cost(pieces):
    problem = PaperCatch(num_pieces=pieces)

    @jax.jit
    @jax.vmap
    def guess_cost(case):
        context = problem.prepare(case)
        return problem.objective(problem.guesses(context, 1)[0], context).cost

    for name in NAMES:
        cases, published = rows(name)
        np.testing.assert_allclose(UNIT * guess_cost(cases), published[f"J0_M{pieces}"], rtol=1e-6)


@pytest.mark.slow
def test_converged_costs_are_the_published_optima():
    gap, late, _, _ = excess(run_longer())
    np.testing.assert_allclose(gap, 0.0, atol=1e-4)
    np.testing.assert_allclose(late, 0.0, atol=1e-3)
    gap, late, cases, plans = excess(PLANNER)
    assert np.abs(gap).max() <= 1e-3 and (np.abs(gap) > 1e-4).sum() <= 1
    first = np.append(np.arange(4), len(gap) // 2 + np.arange(4))  # rows of both files
    np.testing.assert_allclose(gap[first], 0.0, atol=1e-4)
    np.testing.assert_allclose(late[first], 0.0, atol=1e-3)
    # As in [Yu2023catch], limits may be exceeded by 5 %, and a ball is caught if it comes within
    # the net's radius of the net's centre.
    cases, plans = pj.take(cases, first), pj.take(plans, first)
    verdict = referee_catches(cases, plans, tolerance=0.05, net_test="ball")
    assert verdict.success.all(), [verdict.sentence(k) for k in np.flatnonzero(~verdict.success)]


def lite_gaps(num, rule, factors=(1.0,)):
    """Return relative costs above the published optima, (F, B), from F factors on the guess's T_p.

    The rows are the first `num` of both files.
    """
    (easy, published), (hard, of_hard) = (rows(name, num) for name in NAMES)
    cases = jax.tree.map(lambda *leaves: np.concatenate(leaves), easy, hard)
    reference = np.concatenate([published["cost_ref"], of_hard["cost_ref"]])
    guesses = (cases.replace(times=factor * cases.times) for factor in factors)
    costs = [pj.plan(LitePlanner(PROBLEM, UNIT, rule), each).cost for each in guesses]
    return UNIT * np.stack(costs) / reference - 1.0


@pytest.mark.parametrize("num", [4, pytest.param(120, marks=pytest.mark.slow)])
def test_the_search_of_lbfgs_lite_ends_at_the_published_optima(num):
    gradient_alone = LiteRule(gradient=1e-9, decrease=0.0, max_steps=20000)
    gaps = lite_gaps(num, gradient_alone, (1.0, 0.98, 1.02))
    # A few of the 240 throws have a second minimum nearby. Rounding decides which one is reached.
    assert (np.abs(gaps[0]) <= 1e-6).mean() > 0.95 and np.abs(gaps[0]).max() < 1e-3
    # From the best of three guesses no throw ends above its published optimum; two end below.
    assert gaps.min(axis=0).max() <= 1e-6


@pytest.mark.slow
def test_the_published_stopping_rule_of_lbfgs_lite_stops_shortly_above_the_optima():
    (gap,) = lite_gaps(120, LiteRule())
    assert 1e-6 < np.median(gap) < 1e-5 and np.abs(gap).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "least", "most"), [(1.0, 0.0, 0.5), (10.0, 1.0, 1.0)])
def test_three_targets_are_caught_late_by_the_published_weight_of_time_alone(factor, least, most):
    cases = pj.catch.draw(8, "triangle3", 0, dtype=jnp.float64)
    weight = factor * PROBLEM.time_weight
    plans = pj.plan(pj.catch.planner("catch", decide="greedy", time_weight=weight), cases)
    rule = {"tolerance": 0.05, "net_test": "ball"}
    unlimited = cases.replace(horizon=np.full_like(cases.horizon, np.inf))
    assert pj.catch.judge(unlimited, plans, **rule).success.all()
    assert least <= pj.catch.judge(cases, plans, **rule).success.mean() <= most


def test_objective_gradient_agrees_with_finite_differences():
    case = jax.tree.map(lambda leaf: leaf[0], rows("hard", 1)[0])

    def cost(shift):
        context = PROBLEM.prepare(case)
        return PROBLEM.objective(PROBLEM.guesses(context, 1)[0] + shift, context).cost

    shift = 0.3 * np.random.default_rng(0).normal(size=len(PROBLEM.scale))
    assert_gradient_matches_differences(cost, shift, step=1e-6, rtol=1e-6)
    # The first guess meets the ball exactly, where the distance from the net has no derivative.
    assert np.isfinite(value_and_gradient(cost)(np.zeros_like(shift))[1]).all()


def test_free_durations_at_equal_values_have_the_cost_and_motion_of_equal_durations():
    case = jax.tree.map(lambda leaf: leaf[0], rows("hard", 1)[0])
    free = PaperCatch(free_pieces=True)
    moves = 0.3 * np.random.default_rng(1).normal(size=len(PROBLEM.scale))

    @jax.jit
    def evaluate_both(moves):
        context = PROBLEM.prepare(case)
        point = PROBLEM.guesses(context, 1)[0] + moves
        each = (PROBLEM, point), (free, jnp.pad(point, (0, len(free.scale) - point.size)))
        return [(p.objective(x, context).cost, p.decode(x, context)) for p, x in each]

    (cost, plan), (free_cost, free_plan) = evaluate_both(moves)
    np.testing.assert_allclose(free_cost, cost, rtol=1e-9)
    np.testing.assert_allclose(free_plan.violation, plan.violation, rtol=1e-6)
    size = np.abs(plan.trajectory.coeffs).max()
    np.testing.assert_allclose(
        free_plan.trajectory.coeffs, plan.trajectory.coeffs, atol=1e-8 * size
    )

    def free_cost_of(shift):
        context = free.prepare(case)
        return free.objective(free.guesses(context, 1)[0] + shift, context).cost

    shift = 0.3 * np.random.default_rng(0).normal(size=len(free.scale))
    assert_gradient_matches_differences(free_cost_of, shift, step=1e-6, rtol=1e-6)


@pytest.mark.slow
def test_free_durations_never_cost_more_than_equal_ones():
    cases = jax.tree.map(lambda *x: np.concatenate(x), *(rows(name, 4)[0] for name in NAMES))
    equal = pj.plan(PLANNER, cases)
    free = pj.plan(PaperCatch.planner(free_pieces=True), cases)
    assert np.all(free.cost <= equal.cost * (1.0 + 1e-6))
    durations = np.asarray(free.trajectory.durations)
    np.testing.assert_allclose(durations.sum(axis=1), free.times[:, 0], rtol=1e-9)
    # Only limits that hold along the trajectory make unequal durations cheaper: without them the
    # best waypoints lie on one polynomial for any durations. They do hold on the first hard throw.
    np.testing.assert_allclose(durations[0] / durations[0].mean(), 1.0, atol=1e-3)
    assert free.cost[4] < equal.cost[4] * (1.0 - 8e-4) and np.ptp(durations[4]) > 0.05


def test_invalid_sizes_are_rejected():
    with pytest.raises(ValueError, match="num_pieces must be >= 2, got 1"):
        PaperCatch(num_pieces=1)
    case = jax.tree.map(lambda leaf: leaf[0], rows("paper", 1)[0])
    with pytest.raises(ValueError, match="starts must be 1, got 2"):
        PROBLEM.guesses(PROBLEM.prepare(case), 2)
