"""Tests of properties that the planners of every task, and of a user's task, must have."""

import dataclasses
import functools
from typing import ClassVar

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxpr import assert_full_precision

import planner_jax as pj
from planner_jax.baselines.parts.lbfgs_lite import LitePlanner
from planner_jax.core import planner as planner_module
from planner_jax.core.outcome import outcome
from planner_jax.core.protocol import BaseAttempt, Plan, is_solved
from planner_jax.core.rules import is_sound
from planner_jax.optimise.planner import SearchPlanner
from planner_jax.task.intercept.default_planner import SpacetimeIntercept
from tests.planners import ENTRIES, NUM, LibraryPlanner, Place, Stand, library, places
from tests.trees import assert_same

# Planners that only slow tests include. They use the same solver as another tested planner, or the
# test module of their task makes the same checks.
LIKE_OTHERS = (
    *("hit bat", "hit bat-fitted", "hit bat-lite-fitted", "hit juggle"),
    *("catch exact", "catch catch"),
    *("intercept lattice", "intercept em", "intercept constant"),
    *("block online", "block brisk", "block direct", "block insat"),
)


def entries(*, only=ENTRIES, on_host=True, slow=()):
    rows = [
        pytest.param(entry, id=name, marks=[pytest.mark.slow] if name in slow else [])
        for name, entry in ENTRIES.items()
        if name in only and (on_host or not entry.on_host)
    ]
    return pytest.mark.parametrize("entry", rows)


every, pure = entries(slow=LIKE_OTHERS), entries(on_host=False, slow=LIKE_OTHERS)
OF_THEIR_OWN = ("hit exact", "intercept spacetime")


def assert_close(ours, theirs, tolerance=1e-3):
    np.testing.assert_array_equal(ours.status, theirs.status)
    ours, theirs = (jax.tree.map(lambda x: np.asarray(x, float), tree) for tree in (ours, theirs))
    sizes = jax.tree.map(lambda x: np.max(np.abs(x), initial=1e-3, where=np.isfinite(x)), theirs)
    ours, theirs = (jax.tree.map(np.divide, tree, sizes) for tree in (ours, theirs))
    chex.assert_trees_all_close(ours, theirs, rtol=0.0, atol=tolerance)


def with_nan(tree, name, k):
    """Return a copy of a batch with NaN in the array `name` of case k."""
    first, _, rest = name.partition(".")
    leaf = getattr(tree, first)
    if rest:
        return dataclasses.replace(tree, **{first: with_nan(leaf, rest, k)})
    leaf = np.array(leaf)
    leaf[k] = np.nan
    return dataclasses.replace(tree, **{first: leaf})


@entries(slow=(*LIKE_OTHERS, "intercept spacetime"))
def test_a_nan_lane_says_so_and_leaves_its_neighbours_bits_alone(entry):
    one = with_nan(entry.batch, entry.broken, 1)
    broken = jax.tree.map(np.array, one)
    for leaf in jax.tree.leaves(broken):
        if np.issubdtype(leaf.dtype, np.floating):
            leaf[3] = np.nan
    found = pj.plan(entry.planner, jax.tree.map(jnp.asarray, broken))
    has_rules = not np.all(is_sound(broken))
    status = pj.Status.BAD_INPUT if has_rules else pj.Status.NON_FINITE
    assert list(found.status[np.array([1, 3])]) == [status] * 2
    assert_same(found, entry.plans, [0, 2, 4, 5])
    if has_rules:  # For NumPy arrays the error names array and case.
        with pytest.raises(pj.CaseError, match=f"^{entry.broken}.* must be finite.*nan in lane 1"):
            pj.plan(entry.planner, one)


@entries(slow=(*LIKE_OTHERS, *OF_THEIR_OWN))
def test_a_batch_is_a_loop_over_its_cases(entry):
    for k in (0, NUM - 1):
        alone = pj.plan(entry.planner, pj.take(entry.batch, k))
        assert alone.status.shape == ()
        assert_close(alone, pj.take(entry.plans, k))


@every
def test_every_status_is_a_status_and_solved_says_which_are_good(entry):
    plans = entry.plans
    assert isinstance(plans, Plan)
    assert plans.status.dtype == plans.iterations.dtype == np.int32
    good = pj.are_solved(plans)
    assert good.dtype == bool and good.shape == (NUM,)
    for k in range(NUM):
        status = pj.Status(plans.status[k])
        assert good[k] == is_solved(status) == pj.are_solved(pj.take(plans, k))
        assert good[k] == (status in (pj.Status.CONVERGED, pj.Status.FEASIBLE))
        assert not good[k] or plans.violation[k] <= 5e-4


@entries(on_host=False, slow=(*LIKE_OTHERS, "intercept spacetime"))
def test_every_matrix_product_asks_for_full_precision(entry, monkeypatch):
    monkeypatch.setattr(planner_module, "has_only_cpu", lambda: False)  # also in what is for a GPU
    planner, case = entry.planner.inner, pj.take(entry.batch, 0)
    for attempt in planner.attempts:
        assert_full_precision(lambda p, case, a=attempt: p.solve(case, a), planner, case)
        solve = lambda p, cases, a=attempt: p.solve_lanes(cases, a)  # noqa: E731
        assert_full_precision(solve, planner, entry.batch)
    if isinstance(planner, SearchPlanner):
        further = planner.with_polish().attempts[0]
        assert_full_precision(lambda p, case: p.solve(case, further), planner, case)
    if planner is not entry.planner:
        assert_full_precision(entry.planner.decision.propose, case)


@pytest.fixture
def forbid_traces(monkeypatch):
    """Return a function after which the programs of a planner must not be traced."""

    def forbid(planner):
        for name in {"solve", "solve_lanes"} & set(dir(planner)):
            untraced = chex.assert_max_traces(getattr(type(planner), name), n=0)
            monkeypatch.setattr(type(planner), name, untraced)

    yield forbid
    chex.clear_trace_counter()


@entries(on_host=False, slow=(*LIKE_OTHERS, "catch mpp"))
def test_a_second_batch_of_the_same_bucket_is_not_traced_again(entry, forbid_traces):
    assert entry.plans is not None  # The batch is planned only once.
    pj.plan(entry.planner, entry.cases(NUM + 3))  # JAX arrays, another batch size
    forbid_traces(entry.planner.inner)
    pj.plan(entry.planner, entry.cases(NUM + 3))
    pj.plan(entry.planner, jax.tree.map(np.asarray, entry.cases(NUM + 2)))
    pj.plan(entry.planner, pj.take(entry.batch, slice(0, 4)))


@pytest.mark.parametrize(
    ("planner", "case", "num"),
    [
        # `num` is the number of compiled programs: attempts need different programs if they have
        # other variables, or several starting points.
        (pj.hit.planner("exact"), pj.hit.draw(1), 2),
        (pj.catch.planner("exact").planner, pj.catch.draw(1), 2),
        (pj.intercept.planner("spacetime"), pj.intercept.draw(1), 2),
        (pj.intercept.planner("quick"), pj.intercept.draw(1), 1),
        (pj.block.planner("online"), pj.block.draw(1), 1),
        (pj.block.planner("brisk"), pj.block.draw(1), 1),
    ],
    ids=["hit", "catch", "intercept", "quick intercept", "block", "brisk block"],
)
def test_the_attempts_of_a_planner_share_programs(planner, case, num):
    loaded = []
    attempts = planner.attempts_for(case)
    for attempt in planner.group_attempts(attempts, case, is_whole=False):
        loaded.append(planner.load(attempt, case)[1])
    layouts = [[(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(each)] for each in loaded]
    programs = zip(map(jax.tree.structure, loaded), map(tuple, layouts), strict=True)
    assert len(set(programs)) == num < len(planner.attempts)


def test_other_arrays_of_the_same_shapes_in_a_planner_are_not_traced_again(forbid_traces):
    cases = places(NUM)
    first = LibraryPlanner(library(1))
    mine = pj.plan(first, cases)
    pj.plan(first, pj.take(cases, 0))
    forbid_traces(first)
    other = LibraryPlanner(library(2))
    theirs = pj.plan(other, cases)
    pj.plan(other, pj.take(cases, 0))
    assert (mine.point != theirs.point).any()
    for plans, planner in ((mine, first), (theirs, other)):
        assert (plans.point[:, None] == planner.points).all(axis=2).any(axis=1).all()


@every
def test_what_comes_back_is_of_the_kind_of_array_that_was_given(entry):
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(entry.plans))
    resident = pj.plan(entry.planner, jax.tree.map(jnp.asarray, entry.batch))
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(resident))
    assert_close(resident, entry.plans)


@entries(on_host=False, slow=(*LIKE_OTHERS, *OF_THEIR_OWN, "catch mpp"))
def test_solve_inside_a_compiled_function_is_plan(entry):
    assert_close(jax.jit(pj.solve)(entry.planner, entry.batch), entry.plans)


@entries(only=("library", "hit juggle", "catch mpp"), slow=("hit juggle", "catch mpp"))
def test_solve_takes_one_case_and_any_transformation_but_a_derivative(entry):
    solve = functools.partial(pj.solve, entry.planner)
    assert_close(jax.jit(solve)(pj.take(entry.batch, 2)), pj.take(entry.plans, 2))
    assert_close(jax.jit(jax.vmap(solve))(entry.batch), entry.plans)
    assert_close(jax.jit(functools.partial(pj.plan, entry.planner))(entry.batch), entry.plans)


@entries(only=("NumPy",))
def test_a_planner_on_the_host_cannot_be_compiled_and_names_the_call_that_it_is_for(entry):
    solve, plan = (functools.partial(call, entry.planner) for call in (pj.solve, pj.plan))
    for call in (solve, jax.jit(solve), jax.jit(plan)):
        with pytest.raises(TypeError, match="^NumpyPlanner works on the host: call pj.plan"):
            call(entry.batch)


@pure
@pytest.mark.parametrize("call", [pj.plan, pj.solve], ids=["plan", "solve"])
def test_a_derivative_is_refused_with_the_names_of_what_has_one(entry, call):
    floats, others = (
        jax.tree.map(lambda x, f=f: x if (x.dtype.kind == "f") == f else None, entry.batch)
        for f in (True, False)
    )

    def cost(floats):
        both = lambda a, b: b if a is None else a  # noqa: E731
        cases = jax.tree.map(both, floats, others, is_leaf=lambda leaf: leaf is None)
        return jnp.sum(call(entry.planner, cases).cost)

    with pytest.raises(TypeError, match=r"pj\.gradient.* pj\.optimal_plan") as caught:
        jax.grad(cost)(floats)
    assert "\n" not in str(caught.value)


@entries(slow=(*LIKE_OTHERS, *OF_THEIR_OWN))
def test_a_gradient_is_there_where_it_is_promised_and_refused_elsewhere(entry):
    planner = entry.planner.inner
    searches_first = isinstance(
        planner, SpacetimeIntercept | LitePlanner
    )  # plans are then settled anew
    if not (isinstance(planner, SearchPlanner) or searches_first):
        with pytest.raises(TypeError, match=rf"\A{type(planner).__name__} minimises nothing.*\Z"):
            pj.gradient(entry.planner, entry.batch, of="cost", by=entry.broken)
        return
    found = pj.gradient(entry.planner, entry.batch, **entry.gradient)
    if not searches_first:  # The search continues from the old plans.
        assert (pj.are_solved(found.plans) | ~pj.are_solved(entry.plans)).all()
    there = np.isfinite(found.residual)
    assert found.residual.shape == found.value.shape == (NUM,)
    by = entry.gradient["by"]
    assert set(found.by) == {by} if isinstance(by, str) else set(by)
    for leaf in jax.tree.leaves(found.by):
        assert leaf.shape[0] == NUM
        np.testing.assert_array_equal(np.isfinite(leaf.reshape(NUM, -1)).all(axis=1), there)
        assert np.isnan(leaf[~there]).all()


@every
def test_plans_are_read_from_a_file_as_they_were_written(entry, tmp_path):
    for plans in (entry.plans, pj.take(entry.plans, 2)):
        path = tmp_path / "plans.npz"
        plans.save(path)
        again = type(plans).load(path)
        assert type(again) is type(plans)
        assert jax.tree.structure(again) == jax.tree.structure(plans)
        assert_same(again, plans, ...)


@every
@pytest.mark.parametrize("call", [pj.plan, pj.solve], ids=["plan", "solve"])
def test_cases_of_another_task_are_refused_in_one_line(entry, call):
    stranger = places(2) if not isinstance(entry.batch, Place) else pj.hit.draw(2)
    wanted, given = type(entry.batch).__name__, type(stranger).__name__
    line = rf"\Acases must be of the class {wanted}, which \w+ plans, got a {given}\Z"
    with pytest.raises(pj.ArgumentError, match=line):
        call(entry.planner, stranger)


@pytest.mark.parametrize("only_cpu", [True, False])
def test_what_is_for_other_devices_is_not_traced_where_there_are_none(only_cpu, monkeypatch):
    monkeypatch.setattr(planner_module, "has_only_cpu", lambda: only_cpu)
    traced = []

    class Doubles(pj.Planner):
        is_sequential = True

        def solve(self, case, attempt):
            return Stand(point=2.0 * case.goal, **outcome(0.0, 0.0))

        def solve_at_once(self, cases, attempt):
            traced.append(cases)
            return jax.vmap(lambda case: self.solve(case, attempt))(cases)

    cases = places(3)
    plans = jax.jit(lambda cases: Doubles().solve_lanes(cases, None))(cases)
    np.testing.assert_array_equal(plans.point, 2.0 * cases.goal)
    assert bool(traced) != only_cpu


@pytest.mark.parametrize("call", [pj.plan, pj.solve], ids=["plan", "solve"])
def test_a_planner_that_is_no_pytree_is_told_how_to_become_one(call):
    @dataclasses.dataclass(frozen=True)
    class Plain(pj.Planner):
        attempts: ClassVar[tuple[BaseAttempt, ...]] = (BaseAttempt(),)

        def solve(self, case, attempt):
            raise AssertionError("it must not come to this")

    with pytest.raises(TypeError, match=r"\APlain must be a pytree: .*register_static.*\Z"):
        call(Plain(), places(2))
