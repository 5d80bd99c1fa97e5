"""Selection of plans: feasible before infeasible, then by cost, or else by violation."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from planner_jax.core.decision import index_of_best
from planner_jax.core.protocol import Plan, Status, is_better, select, select_into

GOOD, BAD = Status.FEASIBLE, Status.MAX_STEPS


def plans(*rows, xp=np):
    status, *numbers = zip(*rows, strict=True)
    cost, violation = xp.asarray(numbers, xp.float32)
    return Plan(cost, violation, xp.arange(len(rows)), xp.asarray(status, xp.int32))


CASES = [  # later, before, whether the later one is selected
    ((GOOD, 9.0, 0.0), (BAD, 1.0, 0.1), True),
    ((BAD, 1.0, 0.1), (GOOD, 9.0, 0.0), False),
    ((GOOD, 1.0, 0.0), (GOOD, 2.0, -0.5), True),
    ((GOOD, 2.0, -0.5), (GOOD, 2.0, 0.0), False),
    ((BAD, 9.0, 0.1), (BAD, 1.0, 0.2), True),
    ((BAD, 1.0, 0.2), (BAD, 9.0, 0.2), False),
    ((BAD, 1.0, np.nan), (BAD, 1.0, 0.2), False),
    ((BAD, 1.0, 0.2), (BAD, 1.0, np.nan), True),
]


@pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])
def test_a_later_plan_is_selected_where_it_is_better(xp):
    later, before, expected = zip(*CASES, strict=True)
    later, before = plans(*later, xp=xp), plans(*before, xp=xp)
    np.testing.assert_array_equal(is_better(later, before), expected)
    selected = select(later, before)
    np.testing.assert_array_equal(selected.cost, np.where(expected, later.cost, before.cost))
    np.testing.assert_array_equal(select(later, before, False).cost, before.cost)


def test_plans_on_the_host_are_changed_in_place_and_only_in_the_lanes_that_were_tried():
    before = plans(*[(BAD, 5.0, 0.5)] * 4)
    later = plans((GOOD, 1.0, 0.0), (BAD, 2.0, 0.9), (GOOD, 3.0, 0.0))  # the last one fills up
    assert select_into(before, later, np.array([1, 3])).cost is before.cost
    assert before.cost.tolist() == [5.0, 1.0, 5.0, 5.0]


def test_a_tolerance_and_a_share_decide_what_is_feasible_and_what_is_cheaper():
    of = lambda violation, cost: SimpleNamespace(violation=violation, cost=cost)  # noqa: E731
    options = {"tolerance": 0.01, "share": 0.95}
    assert is_better(of(0.005, 0.9), of(0.0, 1.0), **options)
    assert not is_better(of(0.005, 0.96), of(0.0, 1.0), **options)
    assert not is_better(of(0.02, 0.1), of(0.01, 1.0), **options)


def test_of_several_plans_of_a_case_the_cheapest_that_keeps_limits_is_the_best():
    rows = plans((BAD, 0.0, 0.1), (GOOD, 1e6 + 1.0, 0.0), (GOOD, 1e6, 0.0), (BAD, -1.0, np.nan))
    assert index_of_best(rows) == 2
    assert index_of_best(rows, np.array([0.0, 1.0, 2.0, 3.0])) == 1  # by another cost
    assert index_of_best(plans((BAD, 0.0, np.inf), (BAD, 9.0, 0.2), (BAD, 1.0, 0.3))) == 1
