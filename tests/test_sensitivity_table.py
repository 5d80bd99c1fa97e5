"""The record of `pj.sensitivity`: names, derivatives, and the table that `str` makes."""

import jax
import numpy as np
import pytest
from test_sensitivity import CURVED, Bowl, BowlProblem

import planner_jax as pj


def bowls(num):
    random = np.random.default_rng(0)
    return Bowl(random.standard_normal((num, 3)), 2.0 + np.arange(num), np.zeros(num, np.int32))


def test_derivatives_of_the_cost_have_the_closed_form(float64):
    cases = bowls(3)
    found = pj.sensitivity(BowlProblem.planner(), cases)
    best = (cases.b + cases.k[:, None] * np.eye(3)[0]) @ np.linalg.inv(CURVED)
    assert list(found.values) == ["cost"] and list(found.case) == ["b", "k"]
    np.testing.assert_allclose(found.by["cost"]["b"], -best, atol=1e-9)
    np.testing.assert_allclose(found.by["cost"]["k"], -best[:, 0], atol=1e-9)
    relative = found.relative("cost")["k"]
    np.testing.assert_allclose(relative, -cases.k * best[:, 0] / found.values["cost"], rtol=1e-6)


def test_the_table_lists_the_largest_relative_sensitivities_first(float64):
    found = pj.sensitivity(BowlProblem.planner(), jax.tree.map(lambda leaf: leaf[2], bowls(3)))
    rows = found.table("cost", 3)
    sizes = [abs(each) for _, each in rows]
    assert sizes == sorted(sizes, reverse=True) and len(rows) == 3
    every = [abs(each) for leaf in found.relative("cost").values() for each in leaf.ravel()]
    assert sizes[0] == max(every)
    lines = str(found).splitlines()
    assert lines[2].split(" | ")[2] == rows[0][0] and len(lines) == 6


def test_rallies_are_refused_by_name():
    rally = pj.task_named("rally")
    with pytest.raises(TypeError, match="does not offer the task rally"):
        pj.sensitivity(rally.planner(), rally.draw(2, seed=2))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "contact", "name"),
    [
        ("hit", "stroke.time", "limits.body_rate"),
        ("catch", "times.0", "net.height"),
    ],
)
def test_every_number_has_the_derivative_of_gradient(task, contact, name):
    home = pj.task_named(task)
    cases = jax.tree.map(np.asarray, home.draw(3, seed=2))
    planner = home.planner()
    found = pj.sensitivity(planner, cases)
    assert {contact, "cost", "margin.speed"} <= set(found.values)
    for number in ("cost", contact):
        of = number if number == "cost" else lambda plan: jax.tree.leaves(first_time(plan))[0]
        alone = pj.gradient(planner, cases, of=of, by=name)
        np.testing.assert_allclose(found.values[number], alone.value, rtol=1e-5)
        np.testing.assert_allclose(found.by[number][name], alone.by[name], rtol=1e-2, atol=1e-5)
    assert contact in str(found)


def first_time(plan):
    return plan.stroke.time if hasattr(plan, "stroke") else plan.times[0]
