"""Speed along a path: plans avoid blocked times and distances, keep limits, cost the least."""

import dataclasses

import jax
import numpy as np
import pytest
from derivatives import assert_gradient_matches_differences

from planner_jax.baselines.intercept.speed import (
    SPEED_PLANNERS,
    plan_speed,
    speed_bounds,
    speed_matrices,
)
from planner_jax.benchmarks.qp_peers import clarabel_solver
from planner_jax.benchmarks.speed_problems import speed_problems
from planner_jax.core.protocol import Status
from planner_jax.trajectory.bezier import bernstein, hodograph

NUM = 32
TRAPEZOID = SPEED_PLANNERS["trapezoid"]
many = jax.jit(jax.vmap(plan_speed))
PROBLEMS = speed_problems(NUM)
# The speed limit is lower in the middle third of every second problem.
LIMIT = np.repeat(PROBLEMS.speed_limit, 3, axis=1)
LIMIT[::2, 1] = 0.9
PROBLEMS = dataclasses.replace(PROBLEMS, speed_limit=LIMIT)


@pytest.fixture(scope="module")
def plans():
    return jax.tree.map(np.asarray, many(PROBLEMS))


def dense(points, horizon, order, times):
    pieces, degree = points.shape[1], points.shape[2] - 1
    position = times / horizon * pieces
    piece = np.minimum(position.astype(int), pieces - 1)
    rows = bernstein(degree - order, position - piece) @ hodograph(degree, order, pieces)
    value = np.einsum("mi,bmi->bm", rows, points.astype(float)[:, piece])
    return value / horizon**order


TIMES = np.linspace(0.0, 10.0, 10001)


def clearance(problems, station):
    blocked = problems.blocked
    time = TIMES[:, None, None]
    share = (time - blocked.start) / (blocked.end - blocked.start)
    lower, upper = (
        edge[..., 0] + share * (edge[..., 1] - edge[..., 0])
        for edge in (blocked.lower.astype(float), blocked.upper.astype(float))
    )
    away = np.maximum(lower - station.T[..., None], station.T[..., None] - upper)
    is_met = (share >= 0.0) & (share <= 1.0) & blocked.present
    return np.where(is_met, away, np.inf).min(axis=(0, 2))


def test_plans_avoid_polygons_at_every_millisecond_and_meet_every_limit(plans):
    solved = plans.status == Status.CONVERGED
    assert solved.mean() > 0.9 and (plans.violation[solved] < 1e-5).all()
    station, speed, acceleration = (
        dense(plans.curve.points, 10.0, order, TIMES)[solved] for order in range(3)
    )
    away = clearance(jax.tree.map(lambda leaf: leaf[solved], PROBLEMS), station)
    assert (away > 0.9 * TRAPEZOID.margin).all() and np.median(away) < 0.1
    assert speed.min() > -1e-4 and np.abs(acceleration).max() < 2.0
    part = np.clip((station / 2.0).astype(int), 0, 2)
    limit = np.take_along_axis(PROBLEMS.speed_limit[solved], part, axis=1)
    assert (speed <= limit + 1e-4).all() and (limit == np.float32(0.9)).any()
    np.testing.assert_allclose(station[:, 0], 0.0, atol=1e-6)
    np.testing.assert_allclose(station[:, -1], 6.0, atol=1e-5)
    np.testing.assert_allclose(speed[:, 0], 0.5, atol=1e-5)
    np.testing.assert_allclose(acceleration[:, 0], 0.0, atol=1e-4)


def test_pieces_join_up_to_the_acceleration_whose_squared_integral_is_the_cost(plans):
    before = dense(plans.curve.points, 10.0, 2, np.arange(1, 10) - 1e-9)
    after = dense(plans.curve.points, 10.0, 2, np.arange(1, 10) + 1e-9)
    np.testing.assert_allclose(before, after, atol=1e-4)
    squared = dense(plans.curve.points, 10.0, 2, TIMES) ** 2
    np.testing.assert_allclose(plans.cost, np.trapezoid(squared, TIMES), rtol=1e-3, atol=1e-6)


def test_problems_without_a_solution_have_a_status_and_do_not_change_others(plans):
    problems = jax.tree.map(np.array, PROBLEMS)
    problems.blocked.lower[3], problems.blocked.upper[3] = -1.0, 7.0
    problems.initial_speed[4] = np.nan
    problems.initial_acceleration[5] = 2.5  # above the limit from the first moment
    found = many(problems)
    assert list(found.status[3:6]) == [Status.NO_PATH, Status.NON_FINITE, Status.INFEASIBLE]
    np.testing.assert_array_equal(found.curve.points[6:], plans.curve.points[6:])


@pytest.mark.slow
@pytest.mark.usefixtures("float64")
def test_the_gradient_of_the_cost_matches_finite_differences():
    case = jax.tree.map(lambda leaf: leaf[1], speed_problems(4, dtype=np.float64))
    plan = jax.tree.map(np.asarray, jax.jit(plan_speed)(case))
    assert plan.status == Status.CONVERGED and plan.iterations >= 1

    def cost(leaves):
        blocked = dataclasses.replace(case.blocked, lower=leaves[0], upper=leaves[1])
        problem = dataclasses.replace(case, initial_speed=leaves[2], blocked=blocked)
        return plan_speed(problem).cost

    leaves = case.blocked.lower, case.blocked.upper, case.initial_speed
    assert_gradient_matches_differences(cost, leaves, step=1e-7, rtol=1e-5)


def test_no_other_solver_finds_a_cheaper_curve_in_the_same_corridor(plans):
    pytest.importorskip("clarabel", reason="the extra `peers` is not installed")
    solve = clarabel_solver(speed_matrices(TRAPEZOID))
    bounds = jax.jit(jax.vmap(lambda *args: speed_bounds(*args, TRAPEZOID)))
    programs = map(np.asarray, bounds(PROBLEMS, plans.reference))
    peers = [solve(*program) for program in zip(*programs, strict=True)]
    solved = np.array([peer.solved for peer in peers])
    np.testing.assert_array_equal(solved, plans.status == Status.CONVERGED)
    cost = np.array([peer.cost for peer in peers])[solved] * 6.0**2 / 10.0**3
    np.testing.assert_allclose(plans.cost[solved], cost, rtol=1e-4, atol=1e-7)


@pytest.mark.slow
def test_the_planners_of_the_table_differ_in_cost():
    problems = speed_problems(64)
    planned = {}
    for name, planner in SPEED_PLANNERS.items():
        found = jax.jit(jax.vmap(lambda p, planner=planner: plan_speed(p, planner)))(problems)
        away = clearance(problems, dense(np.asarray(found.curve.points), 10.0, 0, TIMES))
        planned[name] = np.asarray(found.status == Status.CONVERGED), away, np.asarray(found.cost)
    for name in ("trapezoid", "trapezoid-edges", "rectangle"):
        solved, away, _ = planned[name]
        assert (away[solved] > 0.0).all()
    everywhere = np.all([planned[name][0] for name in planned], axis=0)
    mean = {name: cost[everywhere].mean() for name, (_, _, cost) in planned.items()}
    order = ["trapezoid", "trapezoid-edges", "em", "rectangle"]
    assert sorted(mean, key=mean.__getitem__) == order
    assert planned["trapezoid"][0].mean() > planned["trapezoid-edges"][0].mean()
