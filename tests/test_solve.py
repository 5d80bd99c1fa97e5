"""`pj.plan` with a toy planner: new searches for unsolved cases, padded batches and statuses."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from jax import Array

import planner_jax as pj
from planner_jax.core.protocol import Plan, Status, is_solved
from planner_jax.optimise.settings import Attempt, Evaluation, LbfgsConfig, Stage
from planner_jax.planning import batch
from tests.trees import assert_same


@struct.dataclass
class Well:
    goal: Array  # ()

    @property
    def batch_shape(self):
        return np.shape(self.goal)


@struct.dataclass
class Reached(Plan):
    point: Array


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class WellProblem(pj.Problem):
    attempts = (
        Attempt(1, LbfgsConfig(max_steps=40, step_cap=0.2)),
        Attempt(2, LbfgsConfig(max_steps=40, step_cap=0.2)),
    )

    def prepare(self, case):
        return case

    def guesses(self, context, num):
        return jnp.array([[0.0], [4.0]])[:num]

    def objective(self, point, context):
        away = jnp.sum((point - context.goal) ** 2)
        ridge = 50.0 * jnp.exp(-20.0 * jnp.sum((point - 2.0) ** 2))
        return Evaluation(cost=away + ridge, violation=jnp.sqrt(away) - 0.05)

    def decode(self, point, context):
        return Reached(point=point, **pj.pending(self.objective(point, context).violation))


GOALS = np.array([0.5, 3.5, -1.0, 4.5, 1.0], np.float32)


def test_lanes_unsolved_in_one_round_are_solved_in_the_next():
    first = pj.plan(WellProblem.planner(attempts=WellProblem.attempts[:1]), Well(GOALS))
    both = pj.plan(WellProblem.planner(), Well(GOALS))
    assert list(is_solved(first.status)) == [True, False, True, False, True]
    assert is_solved(both.status).all()
    np.testing.assert_allclose(both.point[:, 0], GOALS, atol=0.05)
    np.testing.assert_array_equal(both.point[[0, 2, 4]], first.point[[0, 2, 4]])


def keep_starts(keep):
    short, long = (LbfgsConfig(max_steps=num, step_cap=0.2) for num in (3, 40))
    return WellProblem.planner(attempts=(Attempt(2, long, stages=(Stage(short, keep=keep),)),))


@pytest.mark.parametrize("keep", [1, 5])
def test_the_starts_that_a_stage_keeps_are_those_that_cost_least_by_then(keep):
    plans = pj.plan(keep_starts(keep), Well(GOALS))
    assert is_solved(plans.status).all()
    np.testing.assert_allclose(plans.point[:, 0], GOALS, atol=0.05)
    for lane, goal in enumerate(GOALS):
        alone = pj.plan(keep_starts(keep), Well(goal))
        np.testing.assert_allclose(alone.point, plans.point[lane], rtol=1e-5, atol=1e-5)
        assert alone.status == plans.status[lane]
        assert alone.iterations == plans.iterations[lane] > 3


def test_a_start_whose_cost_is_not_finite_is_the_last_to_be_kept():
    @jax.tree_util.register_static
    class Cliff(WellProblem):
        def guesses(self, context, num):
            return jnp.array([[jnp.nan], [context.goal]])[:num]

    plans = pj.plan(Cliff.planner(attempts=keep_starts(1).attempts), Well(GOALS))
    np.testing.assert_allclose(plans.point[:, 0], GOALS, atol=0.05)


def test_a_stage_that_keeps_no_starts_and_a_round_within_no_violation_are_refused():
    rule = r"^keep must be (a whole number|>= 1), got"
    for keep in (0, -1, 1.5, True):
        with pytest.raises((TypeError, ValueError), match=rule):
            Stage(LbfgsConfig(), keep=keep)
    for within in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="^within must be "):
            Attempt(within=within)
    with pytest.raises(TypeError, match="^within must be "):
        Attempt(within="near")


def test_chunks_and_padding_change_nothing():
    goals = np.linspace(-1.0, 5.0, 41).astype(np.float32)
    whole = pj.plan(WellProblem.planner(), Well(goals))
    chunked = pj.plan(WellProblem.planner(), Well(goals), chunk=16)
    np.testing.assert_array_equal(whole.status, chunked.status)
    np.testing.assert_allclose(whole.point, chunked.point, rtol=1e-5, atol=1e-5)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ShiftedWellProblem(WellProblem):
    """A problem whose goal is shifted by a number that may differ from lane to lane."""

    shift: Array | float = 0.0

    def prepare(self, case):
        return Well(case.goal + self.shift)


def test_vmap_of_solve_is_one_batch():
    goals = jnp.linspace(-1.0, 5.0, 24, dtype=jnp.float32)
    solve = functools.partial(pj.solve, WellProblem.planner())
    expected = jax.jit(solve)(Well(goals))
    assert_same(jax.jit(jax.vmap(solve))(Well(goals)), expected)
    by_two = jax.jit(lambda cases: jax.vmap(jax.vmap(solve))(cases))(Well(goals.reshape(4, 6)))
    of_batches = jax.jit(jax.vmap(solve))(Well(goals.reshape(4, 6)))
    for found in (by_two, of_batches):
        assert_same(jax.tree.map(lambda x: x.reshape(24, *x.shape[2:]), found), expected)


def test_vmap_over_planners_or_over_nothing_of_a_case():
    shifts, case = np.float32([0.0, 0.5, 2.5]), Well(jnp.float32(1.0))
    by_shift = lambda shift, case: pj.solve(ShiftedWellProblem.planner(shift=shift), case)  # noqa: E731
    found = jax.jit(jax.vmap(by_shift, (0, None)))(shifts, case)
    for k, shift in enumerate(shifts):
        plan = by_shift(shift, case)
        np.testing.assert_allclose(found.point[k], plan.point, rtol=1e-5)
        assert found.status[k] == plan.status
    both = jax.jit(jax.vmap(lambda x: (x, pj.solve(WellProblem.planner(), case))))(shifts)[1]
    np.testing.assert_array_equal(both.status, pj.solve(WellProblem.planner(), case).status)


def test_quick_options_are_of_this_jax_and_change_no_plan():
    solve, cases = functools.partial(pj.solve, WellProblem.planner()), Well(jnp.asarray(GOALS))
    quick = jax.jit(solve, compiler_options=pj.quick_options())
    plans = [function(cases) for function in (quick, jax.jit(solve))]
    np.testing.assert_array_equal(plans[0].status, plans[1].status)
    np.testing.assert_allclose(plans[0].point, plans[1].point, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("nums", "least"), [((2, 9, 16), 16), ((17, 60, 128), 128)])
def test_a_plan_has_the_same_bits_at_any_place_of_batches_that_share_a_program(nums, least):
    goals = np.random.default_rng(3).permutation(np.linspace(-1.0, 5.0, least)).astype(np.float32)
    whole = pj.plan(WellProblem.planner(), Well(goals))
    assert len(set(is_solved(whole.status))) == 2  # late searches are made, too
    for num in nums:
        some = np.random.default_rng(num).permutation(least)[:num]
        found = pj.plan(WellProblem.planner(), Well(goals[some]))
        assert_same(found, jax.tree.map(lambda leaf, some=some: leaf[some], whole))


def test_all_chunks_are_computed_in_the_callers_type_of_numbers():
    goals = np.pi / 4.0 * np.linspace(-1.0, 1.0, 64)
    with jax.enable_x64(True):
        found = pj.plan(WellProblem.planner(), Well(goals), chunk=16).point[:, 0]
    assert found.dtype == np.float64
    assert (found != found.astype(np.float32)).all()  # no number has passed through float32


@pytest.mark.parametrize("kind", [int, np.int32, np.asarray, jnp.asarray])
def test_a_status_is_known_from_its_number_of_any_kind(kind):
    assert Status(kind(5)) is Status.OUT_OF_REACH
    with pytest.raises(ValueError, match="is not a valid Status"):
        Status(kind(len(Status)))


def test_unsolvable_lanes_keep_the_least_violation_found():
    @jax.tree_util.register_static
    @dataclasses.dataclass(frozen=True)
    class Hopeless(WellProblem):
        def objective(self, point, context):
            found = super().objective(point, context)
            return Evaluation(found.cost, found.violation + 1.0)

    found = pj.plan(Hopeless.planner(), Well(GOALS))
    assert not is_solved(found.status).any()
    np.testing.assert_allclose(found.violation, 0.95, atol=0.02)


@pytest.mark.parametrize("apart", [False, True], ids=["in host memory", "as on a GPU"])
def test_arrays_on_a_device_stay_there_and_give_the_same_plans(apart, monkeypatch):
    if apart:
        monkeypatch.setattr(batch, "is_cpu", lambda device: False)
    goals = np.linspace(-1.0, 5.0, 41).astype(np.float32)
    host = pj.plan(WellProblem.planner(), Well(goals), chunk=16)
    resident = pj.plan(WellProblem.planner(), Well(jnp.asarray(goals)), chunk=16)
    for plans, kind in ((resident, jax.Array), (host, np.ndarray)):
        assert all(isinstance(leaf, kind) for leaf in jax.tree.leaves(plans))
    assert_same(resident, host)


def test_a_later_round_takes_only_what_is_unsolved(monkeypatch):
    monkeypatch.setattr(batch, "is_cpu", lambda device: False)
    sizes = []

    def note_size(function):
        def noting(planner, attempt, device, cases, before, **options):
            sizes.append(cases.goal.size)
            return function(planner, attempt, device, cases, before, **options)

        return noting

    monkeypatch.setattr(batch, "solve_on_device", note_size(batch.solve_on_device))
    goals = np.full(300, 0.5, np.float32)
    goals[[7, -1]] = 3.5
    assert is_solved(pj.plan(WellProblem.planner(), Well(jnp.asarray(goals))).status).all()
    assert sorted(sizes[:2]) == [128, 256] and sizes[2:] == [16]


def retry_within(within):
    first, second = WellProblem.attempts
    return WellProblem.planner(attempts=(first, dataclasses.replace(second, within=within)))


@pytest.mark.parametrize("kind", ["host", "as on a GPU", "one by one", "compiled"])
def test_a_round_leaves_alone_what_is_farther_off_than_it_says(kind, monkeypatch):
    goals = np.array([0.5, 3.8, 3.4, 4.5], np.float32)  # all but the first behind the ridge

    def plan_goals(planner):
        if kind == "one by one":
            plans = [pj.plan(planner, Well(goal)) for goal in goals]
            return jax.tree.map(lambda *leaves: np.stack(leaves), *plans)
        if kind == "compiled":
            return jax.jit(lambda goals: pj.solve(planner, Well(goals)))(goals)
        if kind == "as on a GPU":
            monkeypatch.setattr(batch, "is_cpu", lambda device: False)
            return pj.plan(planner, Well(jnp.asarray(goals)))
        return pj.plan(planner, Well(goals))

    first = plan_goals(WellProblem.planner(attempts=WellProblem.attempts[:1]))
    near = plan_goals(retry_within(2.0))
    assert (np.asarray(first.violation) <= 2.0).tolist() == [True, False, True, False]
    assert is_solved(np.asarray(near.status)).tolist() == [True, False, True, False]
    points = (np.asarray(plans.point)[[1, 3]] for plans in (near, first))
    np.testing.assert_array_equal(*points)
    assert is_solved(np.asarray(plan_goals(retry_within(None)).status)).all()


def test_a_round_behind_one_that_had_nothing_to_try_is_made():
    first, second = WellProblem.attempts
    planner = WellProblem.planner(
        attempts=(first, dataclasses.replace(second, within=1e-3), second)
    )
    for goals in (GOALS, jnp.asarray(GOALS)):
        assert is_solved(np.asarray(pj.plan(planner, Well(goals)).status)).all()
    assert is_solved(pj.plan(planner, Well(GOALS[1])).status)


def test_wrong_batches_are_refused():
    with pytest.raises(ValueError, match="batch shape"):
        pj.plan(WellProblem.planner(), Well(np.zeros((2, 3), np.float32)))

    @struct.dataclass
    class Pair(Well):
        other: Array

    with pytest.raises(ValueError, match=r"cases.other must have 5 lanes, got shape \(3,\)"):
        pj.plan(WellProblem.planner(), Pair(GOALS, np.zeros(3, np.float32)))
