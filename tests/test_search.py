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
from planner_jax.optimise.rows import list_models, list_rows
from planner_jax.optimise.settings import LbfgsConfig, NewtonConfig, Round
from planner_jax.recovery.case import RecoveryCase
from planner_jax.recovery.planner import RecoveryPlanner
from planner_jax.task.catch.default_planner import ExactCatch
from planner_jax.task.hit.default_planner import ExactHit
from planner_jax.task.rally.default_planner import ExactRally
from tests.jaxpr import equations

MOST = {"hit": 9000, "catch": 6500}  # equations of jit(pj.solve) of one case


@pytest.mark.parametrize("task", MOST)
def test_solve_of_one_case_has_few_equations(task):
    own = getattr(pj, task)
    case = pj.take(own.draw(1), 0)
    jaxpr = jax.make_jaxpr(lambda case: pj.solve(own.planner(), case))(case)
    assert sum(1 for _ in equations(jaxpr.jaxpr)) <= MOST[task]


@pytest.mark.parametrize(
    "planner", [ExactHit(), ExactCatch(), ExactRally()], ids=["hit", "catch", "rally"]
)
def test_rows_list_the_stages_of_all_rounds(planner):
    cases = {ExactHit: pj.hit, ExactCatch: pj.catch, ExactRally: pj.rally}[type(planner)].draw(1)
    attempts = [planner.fit_attempt(each, cases) for each in planner.attempts]
    models = list_models(planner, attempts, cases)
    rows = list_rows(planner, attempts, models)
    assert sum(row.starts for row in rows) == sum(row.writes for row in rows) == len(attempts)
    assert len(rows) >= sum(len(each.all_stages) for each in attempts)
    assert len(set(map(id, models.values()))) <= 2


@pytest.mark.parametrize(
    "change",
    [
        {"rounds": (Round(), Round(improves=True))},
        {"rounds": (Round(solver=NewtonConfig()),)},
        {"rounds": (Round(settings=(("catch_weight", 1.0),)),)},
        {"rounds": (Round(solver=LbfgsConfig(max_steps=0)),)},
    ],
    ids=["improves", "Newton", "another field", "no iterations"],
)
def test_rounds_that_fit_no_table_have_their_own_programs(change):
    cases, planner = pj.catch.draw(1), dataclasses.replace(ExactCatch(), **change)
    assert planner.join_attempts(planner.attempts, cases) is None
    usual = ExactCatch()
    assert usual.join_attempts(usual.attempts, cases) is not None


def test_a_subclass_with_its_own_guesses_has_its_own_programs():
    @jax.tree_util.register_static
    class OwnGuesses(ExactCatch):
        def guesses(self, context, num):
            return super().guesses(context, num)

    assert OwnGuesses().join_attempts(OwnGuesses().attempts, pj.catch.draw(1)) is None


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
    planner = RecoveryPlanner()
    hit = pj.take(pj.hit.draw(1), 0)
    case = RecoveryCase(hit.head_state, np.zeros(3, np.float32), hit.gravity, hit.limits)
    weights = {name: jnp.float32(getattr(planner, name)) for name in planner.weights}
    context = planner.prepare(case)
    point = planner.plain_guesses(context, 1)[0]
    own, other = (
        each.objective(point, context) for each in (planner, planner.with_weights(weights))
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
