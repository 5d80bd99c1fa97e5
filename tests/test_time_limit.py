"""Time limits and progress reports of `pj.plan`; tests replace the clock by their own."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import typecheck
from flax import struct
from jax import Array

import planner_jax as pj
from planner_jax.planning import plan as watch
from planner_jax.planning.decided import DecidedPlanner
from tests.trees import assert_same


@struct.dataclass
class Task:
    number: Array  # ()

    @property
    def batch_shape(self):
        return np.shape(self.number)

    def with_choice(self, choice):
        return self.replace(number=self.number + choice)


@dataclasses.dataclass(frozen=True)
class Try(pj.Attempt):
    number: int = 1


def outcome_of(task, attempt):
    excess = task.number - attempt.number
    return pj.Plan(**pj.outcome(1.0 * task.number, excess, stationary=False))


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Rounds(pj.Planner):
    attempts: tuple = (Try(number=1), Try(number=2), Try(number=3))

    def solve(self, case, attempt):
        return outcome_of(case, attempt)


class OnHost(pj.Planner):
    attempts = Rounds().attempts

    def solve_on_host(self, cases, attempt):
        return jax.tree.map(np.asarray, jax.vmap(lambda case: outcome_of(case, attempt))(cases))


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class TwoWays:
    def check(self, cases):
        pass

    def propose(self, case):
        return jnp.zeros(2)

    def rank(self, plans):
        return plans.cost

    def explain(self, case, status):
        return status


@pytest.fixture
def clock(monkeypatch):
    now, reports = [0.0], []
    monkeypatch.setattr(watch, "time", types.SimpleNamespace(monotonic=lambda: now[0]))

    def progress(report):
        reports.append(report)
        now[0] += 1.0

    return types.SimpleNamespace(reports=reports, progress=progress)


NUMBERS = np.array([1.0, 3.0, 0.5, 2.0, 9.0], np.float32)


@pytest.mark.parametrize(
    "planner, arrays",
    [
        (Rounds(), np),
        (Rounds(), jnp),
        (OnHost(), np),
        (DecidedPlanner(Rounds(Rounds().attempts[:2]), TwoWays()), np),
    ],
    ids=["NumPy arrays", "jax arrays", "on the host", "two choices"],
)
def test_no_round_begins_after_its_time_and_what_is_solved_keeps_its_bits(planner, arrays, clock):
    cases = Task(arrays.asarray(NUMBERS))
    free = pj.plan(planner, cases)
    assert free.status[3] == pj.Status.FEASIBLE and free.status[4] == pj.Status.MAX_STEPS
    found = pj.plan(planner, cases, time_limit=1.0, progress=clock.progress)
    late = NUMBERS > 1.0
    assert (np.asarray(found.status)[late] == pj.Status.OUT_OF_TIME).all()
    assert_same(found, free, ~late)


@dataclasses.dataclass(frozen=True)
class Cheaper(Try):
    improves: bool = True


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Improving(pj.Planner):
    attempts: tuple = (Try(number=2), Cheaper(number=1))

    def solve(self, case, attempt):
        cheap = 0.5 if attempt.improves else 1.0
        return dataclasses.replace(outcome_of(case, attempt), cost=cheap * case.number)


@pytest.mark.parametrize(
    "plan_of",
    [pj.plan, jax.jit(pj.solve, static_argnums=0), lambda planner, cases: pj.plan(planner, cases)],
    ids=["NumPy arrays", "compiled", "jax arrays"],
)
def test_an_attempt_that_improves_keeps_the_cheaper_of_two_plans(plan_of, request):
    arrays = np if "NumPy" in request.node.name else jnp
    planner, numbers = Improving(), np.array([0.8, 1.5, 3.0], np.float32)
    plans = plan_of(planner, Task(arrays.asarray(numbers)))
    # The second attempt solves the first case at less cost, and loses the second one.
    np.testing.assert_allclose(plans.cost, [0.4, 1.5, 3.0])
    assert pj.are_solved(plans).tolist() == [True, True, False]
    alone = [float(pj.plan(planner, Task(number)).cost) for number in numbers]
    np.testing.assert_allclose(alone, plans.cost)


def test_solved_cases_are_not_out_of_time(clock):
    limit = {"time_limit": 1.0, "progress": clock.progress}
    cases = Task(np.array([0.8, 1.5, 3.0], np.float32))
    plans = pj.plan(Improving(), cases, **limit)
    assert pj.are_solved(plans).tolist() == [True, True, False]
    assert plans.status[2] == pj.Status.OUT_OF_TIME
    assert pj.are_solved(pj.plan(Improving(), Task(np.float32(0.8)), **limit))


def test_one_case_stops_too(clock):
    found = pj.plan(Rounds(), Task(np.float32(3.0)), time_limit=1.0, progress=clock.progress)
    assert found.status == pj.Status.OUT_OF_TIME
    assert pj.plan(Rounds(), Task(np.float32(3.0)), time_limit=99.0).status == pj.Status.FEASIBLE


def test_chunks_of_a_round_are_not_begun_after_the_time(clock):
    numbers = np.full(32, 2.0, np.float32)
    found = pj.plan(Rounds(), Task(numbers), chunk=16, time_limit=3.5, progress=clock.progress)
    assert (found.status == pj.Status.OUT_OF_TIME).all()
    last = clock.reports[-1]
    assert (last.attempt, last.tried, last.cases) == (2, 0, 32)


def test_all_attempts_are_reported_and_a_report_is_a_line(clock):
    pj.plan(Rounds(), Task(NUMBERS), progress=clock.progress)
    expected = [(1, 0, 5), (1, 5, 5), (2, 0, 3), (2, 3, 3), (3, 0, 2), (3, 2, 2)]
    assert [(one.attempt, one.tried, one.cases) for one in clock.reports] == expected
    assert str(clock.reports[3]) == "attempt 2 of at most 3: 3 of 3 cases tried, after 3.0 s"


@pytest.mark.parametrize(
    "options, error, words",
    [
        (dict(time_limit=-1.0), ValueError, "time_limit must be >= 0 s, got -1"),
        (dict(time_limit=float("nan")), ValueError, "time_limit must be >= 0 s, got nan"),
        (dict(time_limit="1"), TypeError, "time_limit must be a number, got '1'"),
        (dict(progress=3), TypeError, "progress must be callable, such as print, got 3"),
    ],
)
def test_malformed_options_are_refused_in_one_line(options, error, words, monkeypatch):
    monkeypatch.setattr(typecheck, "is_on", False)  # for the library's own checks
    with pytest.raises(error, match=words):
        pj.plan(Rounds(), Task(NUMBERS), **options)


def test_a_compiled_function_has_no_clock():
    with pytest.raises(TypeError, match="time_limit and progress must be left out inside"):
        jax.jit(lambda cases: pj.plan(Rounds(), cases, time_limit=1.0))(Task(NUMBERS))
