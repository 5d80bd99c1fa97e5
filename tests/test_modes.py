"""Options of JAX under which users work: every task has the same plans under each of them.

JAX can compute in double precision, look for NaN and for leaked tracers, and forbid implicit
conversions and axes. Float32 cases are planned in float32 under `jax_enable_x64`, too.
"""

import contextlib
import dataclasses
import functools
import itertools
import pkgutil
from typing import ClassVar

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from jax import Array, lax
from test_task_reach import reach

import planner_jax as pj
from planner_jax import task
from planner_jax.core.errors import NotOffered
from planner_jax.core.outcome import outcome
from planner_jax.core.protocol import BaseAttempt, Plan
from planner_jax.core.tasks import all_tasks
from planner_jax.planning.programs import program_key
from tests.trees import as_numpy, assert_same

CPU = jax.devices("cpu")[0]
MODES = {
    "x64": {"jax_enable_x64": True},
    "no NaN": {"jax_debug_nans": True},
    "strict types": {"jax_numpy_dtype_promotion": "strict"},
    "strict ranks": {"jax_numpy_rank_promotion": "raise"},
    "no leaks": {"jax_check_tracer_leaks": True},
}
PACKAGES = {each.name for each in pkgutil.iter_modules(task.__path__) if each.ispkg}
TASKS = sorted(PACKAGES | set(all_tasks()))
EASY = {"reach": reach}  # functions that make a case for which the first search suffices
QUICK = {"hit x64", "hit strict types", "hit strict ranks"}  # rows of default tests


@contextlib.contextmanager
def options(mode):
    usual = {name: getattr(jax.config, name) for name in mode}
    for name, value in mode.items():
        jax.config.update(name, value)
    yield
    for name, value in usual.items():
        jax.config.update(name, value)


@functools.cache
def problem(name):
    """Return the default planner of a task, one case, and its plan."""
    home = getattr(pj, name)
    case = EASY[name]() if name in EASY else pj.take(home.draw(1), 0)
    return home.planner(), case, pj.plan(home.planner(), case)


ROWS = [
    pytest.param(*row, marks=[] if " ".join(row) in QUICK else [pytest.mark.slow])
    for row in itertools.product(TASKS, MODES)
]


@pytest.mark.parametrize(("name", "mode"), ROWS)
def test_every_task_has_the_same_plan_under_every_mode(name, mode):
    planner, case, usual = problem(name)
    with options(MODES[mode]):
        found = pj.plan(planner, case)
    chex.assert_trees_all_equal_shapes_and_dtypes(found, usual)
    chex.assert_trees_all_close(found, usual, rtol=1e-5, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_the_program_of_a_float32_batch_is_the_same_under_x64(name):
    planner, case, _ = problem(name)
    batch = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), case)
    programs = []
    for is_double in (False, True):
        with options({"jax_enable_x64": is_double}):
            try:
                programs.append(str(jax.make_jaxpr(pj.solve)(planner, batch)))
            except NotOffered:
                pytest.skip(f"the planner of {name} works on the host")
    assert programs[0] == programs[1]
    assert "f64" not in programs[0]


@struct.dataclass
class Line:
    goal: Array  # (), wanted position

    @property
    def batch_shape(self):
        return np.shape(self.goal)


@struct.dataclass
class Point(Plan):
    at: Array  # (), nearest permitted position


PERMITTED = np.array([0.1, 0.7])  # NumPy's default precision, as constants of a module often have


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Nearest(pj.Planner):
    """A planner whose branches have the same type only if it computes in the cases' precision."""

    attempts: ClassVar[tuple[BaseAttempt, ...]] = (BaseAttempt(1),)
    case_type: ClassVar[type] = Line

    def solve(self, case: Line, attempt: BaseAttempt) -> Point:
        permitted = PERMITTED.copy()  # JAX 0.10 remembers the first precision of a constant
        away = jnp.abs(permitted - case.goal[None])
        snap = lambda: jnp.sum(jnp.where(away == jnp.min(away), permitted, 0.0))  # noqa: E731
        at = lax.cond(case.goal > 0.0, snap, lambda: case.goal)
        return Point(at=at, **outcome(jnp.abs(at - case.goal), at - 1.0, stationary=True))


def lines(dtype, num=24):
    return Line(np.linspace(-1.0, 1.0, num).astype(dtype))


def nearest(goal):
    snapped = PERMITTED[np.argmin(np.abs(PERMITTED - goal[:, None]), axis=1)]
    return np.where(goal > 0.0, snapped, goal)


@pytest.mark.parametrize("chunk", [None, 5], ids=["one call", "threads"])
def test_precision_follows_the_cases_while_x64_is_switched_on_and_off(chunk):
    planner, expected = Nearest(), nearest(lines(float).goal)
    for _ in range(2):
        single = pj.plan(planner, lines(np.float32), chunk=chunk)
        assert single.at.dtype == np.float32
        np.testing.assert_allclose(single.at, expected, rtol=1e-6)
        with options({"jax_enable_x64": True}):
            assert_same(pj.plan(planner, lines(np.float32), chunk=chunk), single)
            assert_same(pj.plan(planner, pj.take(lines(np.float32), 20)), pj.take(single, 20))
            double = pj.plan(planner, lines(np.float64), chunk=chunk)
            pure = jax.jit(pj.solve)(planner, lines(np.float32))
        assert double.at.dtype == np.float64
        np.testing.assert_array_equal(double.at, expected)
        assert_same(as_numpy(pure), single)


def test_threads_know_programs_of_each_precision_apart():
    keys = set()
    for is_double in (False, True):
        with options({"jax_enable_x64": is_double}):
            keys.add(program_key(Nearest(), BaseAttempt(1), 16, lines(np.float32), CPU, False))
    assert len(keys) == 2
