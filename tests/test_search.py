"""The one loop of `pj.solve` over all searches of hits, catches, rallies and recoveries."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.core.protocol import Status, is_solved
from planner_jax.lanes import over_lanes
from planner_jax.lanes.packing import Packing
from planner_jax.optimise import lbfgs
from planner_jax.optimise.settings import Attempt, LbfgsConfig, NewtonConfig
from planner_jax.recovery.case import RecoveryCase
from planner_jax.recovery.planner import RecoveryProblem
from planner_jax.runs.timing import CompileClock
from planner_jax.task.catch.default_planner import CatchProblem
from planner_jax.task.hit.default_planner import HitProblem
from tests.jaxpr import equations

MOST = {"hit": 9000, "catch": 6500}  # equations of jit(pj.solve) of one case


@pytest.mark.parametrize("task", MOST)
def test_solve_of_one_case_has_few_equations(task):
    own = getattr(pj, task)
    case = pj.take(own.draw(1), 0)
    jaxpr = jax.make_jaxpr(lambda case: pj.solve(own.planner(), case))(case)
    assert sum(1 for _ in equations(jaxpr.jaxpr)) <= MOST[task]


PLANNERS = {"hit": HitProblem.planner(), "catch": CatchProblem.planner()}


def tables_of(planner, cases, *, is_whole):
    groups = planner.group_attempts(planner.attempts, cases, is_whole=is_whole)
    return [planner.load(each, cases)[1] for each in groups]


@pytest.mark.parametrize(("task", "programs", "models"), [("hit", 2, 2), ("catch", 2, 1)])
def test_rows_list_the_stages_of_all_rounds(task, programs, models):
    planner, cases = PLANNERS[task], getattr(pj, task).draw(1)
    (table,) = tables_of(planner, cases, is_whole=True)
    rows = table.rows
    assert np.sum(rows.starts) == np.sum(rows.writes) == len(planner.attempts)
    assert len(rows.starts) >= sum(len(each.all_stages) for each in planner.attempts)
    assert len(table.models) == models
    parts = tables_of(planner, cases, is_whole=False)
    assert len(parts) == len(planner.attempts) and parts[0].is_plain
    assert len(parts[-1].models) == models  # apart by their numbers of nodes
    layouts = {(jax.tree.structure(each), each.numbers.shape) for each in parts}
    assert len(layouts) == programs


def test_other_numbers_of_rounds_and_of_the_cost_are_data_of_the_same_program():
    cases, planner = pj.catch.draw(1), CatchProblem.planner()
    first, second, *others = planner.attempts
    solver = dataclasses.replace(second.solver, max_steps=31, tolerance=1e-5)
    longer = dataclasses.replace(second, solver=solver, within=0.1)
    attempts = (first, longer, *others)
    changed = CatchProblem.planner(attempts, margin=0.1, energy_weight=1e-7)
    before, after = (
        each.load(each.group_attempts(each.attempts, cases, is_whole=True)[0], cases)
        for each in (planner, changed)
    )
    assert jax.tree.structure(before) == jax.tree.structure(after)
    assert np.sum(np.asarray(before[1].numbers) != np.asarray(after[1].numbers)) > 4


@pytest.mark.parametrize("kind", [float, np.float32])
def test_weights_of_any_kind_give_way_to_those_of_a_round(kind):
    attempts = Attempt(), Attempt(settings=(("margin", 0.004),))
    planner = CatchProblem.planner(attempts, margin=kind(0.05))
    (table,) = tables_of(planner, pj.catch.draw(1), is_whole=True)
    np.testing.assert_allclose(table.rows.weights["margin"], [0.05, 0.004], rtol=1e-6)


def test_another_margin_compiles_nothing_and_is_kept():
    case, planner = pj.take(pj.catch.draw(1), 0), CatchProblem.planner()
    usual = pj.plan(planner, case)
    with CompileClock() as clock:
        wide = pj.plan(CatchProblem.planner(margin=0.3), case)
    assert not clock.compiled
    assert pj.are_solved(wide) and wide.violation < usual.violation - 0.05


@pytest.mark.parametrize(
    ("attempts", "programs"),
    [
        ((Attempt(), Attempt(improves=True)), 1),
        ((Attempt(), Attempt(solver=NewtonConfig())), 1),
        ((Attempt(), Attempt(settings=(("catch_weight", 1.0),))), 2),
        ((Attempt(), Attempt(solver=LbfgsConfig(max_steps=0))), 1),
    ],
    ids=["improves", "Newton", "another field", "no iterations"],
)
def test_rounds_that_prepare_cases_differently_have_their_own_programs(attempts, programs):
    planner = CatchProblem.planner(attempts)
    assert len(tables_of(planner, pj.catch.draw(1), is_whole=True)) == programs


def test_packed_arrays_are_unpacked_unchanged():
    lanes = {"a": np.arange(12.0).reshape(2, 2, 3), "b": np.array([True, False, True])}
    lanes |= {"c": np.arange(2**24 + 1, 2**24 + 4), "d": np.zeros((0, 3))}
    lanes = jax.tree.map(jnp.asarray, lanes)
    lane = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[:-1], x.dtype), lanes)
    packing = Packing(lane)
    packed = packing.pack(lanes)
    assert [x.shape for x in packed] == [x.shape for x in packing.zeros(3)]
    assert [x.dtype for x in packed] == [x.dtype for x in packing.zeros(3)]
    jax.tree.map(np.testing.assert_array_equal, packing.unpack(packed), lanes)


def test_the_loop_over_pairs_computes_the_direction_of_the_unrolled_recursion():
    rng = np.random.default_rng(0)
    steps, changes, grad = (
        jnp.asarray(rng.normal(size=size), jnp.float32) for size in ((3, 5, 4), (3, 5, 4), (5, 4))
    )
    memory = lbfgs.Memory(steps, changes, 1.0 / jnp.sum(steps * changes, axis=1))
    looped = lbfgs.recur_twice(memory, grad, 2.0, jax.lax.scan, over_lanes)
    by_lane = jax.vmap(lambda *x: lbfgs.search_direction(*x, 2.0), in_axes=-1, out_axes=-1)
    np.testing.assert_allclose(looped, by_lane(memory, grad), rtol=2e-5, atol=1e-6)


def test_weights_in_arrays_give_the_objective_of_constant_weights():
    problem = RecoveryProblem()
    hit = pj.take(pj.hit.draw(1), 0)
    case = RecoveryCase(hit.head_state, np.zeros(3, np.float32), hit.gravity, hit.limits)
    weights = {name: jnp.float32(getattr(problem, name)) for name in problem.weights}
    context = problem.prepare(case)
    point = problem.guesses(context, 1)[0]
    own, other = (
        each.objective(point, context) for each in (problem, problem.with_weights(weights))
    )
    np.testing.assert_allclose(own.cost, other.cost, rtol=1e-5)
    np.testing.assert_allclose(own.violation, other.violation, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["hit", "catch", "rally"])
def test_solve_returns_the_plans_of_plan(task):
    own = getattr(pj, task)
    planner, cases = own.planner(), own.draw(6)
    expected = pj.plan(planner, cases)
    plans = jax.jit(lambda cases: pj.solve(planner, cases))(cases)
    np.testing.assert_array_equal(plans.status, expected.status)
    np.testing.assert_array_equal(plans.iterations, expected.iterations)
    np.testing.assert_allclose(plans.cost, expected.cost, rtol=1e-4)


@pytest.mark.slow
def test_hard_and_bad_cases_of_a_scan_are_planned_as_in_a_batch():
    cases = jax.tree.map(jnp.asarray, pj.hit.draw(12, start="uniform", delay=0.5))
    head = cases.head_state.at[3, 0, 0].set(jnp.nan)
    cases, planner = dataclasses.replace(cases, head_state=head), pj.hit.planner()

    @jax.jit
    def plan_in_turn(cases):
        return jax.lax.scan(lambda _, case: (None, pj.solve(planner, case)), None, cases)[1]

    plans, batch = plan_in_turn(cases), pj.plan(planner, cases)
    assert plans.status[3] == batch.status[3] == Status.BAD_INPUT
    assert abs(is_solved(plans.status).sum() - is_solved(batch.status).sum()) <= 1
