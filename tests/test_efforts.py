"""Tests of efforts, which state how long a planner continues to search after all limits hold."""

import jax
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.core.choices import EFFORTS
from planner_jax.core.errors import ArgumentError
from planner_jax.optimise.settings import Stage
from planner_jax.sweep.block.settings import BlockSettings
from planner_jax.sweep.catch.settings import CatchSettings
from planner_jax.sweep.hit.settings import HitSettings
from planner_jax.task.block.default_planner import OnlineBlock


@pytest.mark.parametrize("task", [pj.hit, pj.catch], ids=["hit", "catch"])
def test_more_effort_is_a_longer_first_round_and_the_default_is_the_planner_itself(task):
    own = task.planner("exact")
    assert task.planner("exact", effort="feasible") == own
    attempts = [
        task.planner("exact", effort=x).inner.attempts for x in ("feasible", "good", "best")
    ]
    assert len({each[1:] for each in attempts}) == 1
    feasible, good, best = (each[0] for each in attempts)
    assert feasible == own.inner.attempts[0]
    assert good.stages == best.stages == (Stage(feasible.solver),)
    assert isinstance(good.solver, pj.NewtonConfig) and isinstance(best.solver, pj.NewtonConfig)
    assert good.solver.max_steps < best.solver.max_steps


def test_an_effort_that_is_none_and_planners_without_one_are_named():
    with pytest.raises(ValueError, match="effort must be one of feasible, good, best, got 'more'"):
        pj.hit.planner("exact", effort="more")
    for task, name in ((pj.hit, "juggle"), (pj.catch, "mpp"), (pj.block, "direct")):
        with pytest.raises(ValueError, match="effort must be feasible for a .*, which minimises"):
            task.planner(name, effort="good")
    for kind, name in ((HitSettings, "juggle"), (CatchSettings, "mpp")):
        with pytest.raises(ArgumentError, match=f"effort must be left out for the planner {name}"):
            kind(planner=name, effort="good")
        assert kind(effort="good").planner_options()["effort"] == "good"
    assert BlockSettings(effort="best").planner_options()["effort"] == "best"


def test_more_effort_compares_more_motions_of_blocks_for_longer():
    own = OnlineBlock()
    assert pj.block.planner(effort="feasible") == own == own.with_effort("feasible")
    good, best = (own.with_effort(effort) for effort in ("good", "best"))
    assert own.settling == 0 < good.settling < best.settling
    search, last = best.searches
    assert last == good.searches[-1] and last not in own.searches
    assert search.tries == max(each.first + each.tries for each in own.searches)
    assert search.solver.max_steps == best.settling
    assert pj.block.planner("brisk", effort="best") == pj.block.planner(effort="best", brisk=True)


def test_more_effort_of_interceptions_improves_the_plans_of_less_effort():
    own = pj.intercept.planner()
    for effort in ("good", "best"):
        attempts = pj.intercept.planner(effort=effort).attempts
        num = len(own.attempts)
        assert attempts[:num] == own.attempts
        assert attempts[num].improves and attempts[num].tries_all
        assert not any(each.improves for each in attempts[num + 1 :])


@pytest.mark.slow
def test_a_good_plan_never_costs_more_than_a_feasible_one_under_a_limit_of_jerk():
    wall = [(3.0, 3.2), (3.6, 3.2), (3.6, 5.0), (3.0, 5.0)]
    costs = []
    for x, y, jerk in ((6.0, 4.0, 0.5), (7.2, 6.8, 0.3), (6.0, 3.0, 0.2)):
        path = pj.TurningPath(*(np.array(each, np.float32) for each in ((x, y), (0, 0), 0.0)))
        case = pj.intercept.case(path, walls=[wall], jerk=jerk)
        plans = [pj.plan(pj.intercept.planner(effort=each), case) for each in EFFORTS[:2]]
        assert all(pj.are_solved(each) and pj.intercept.judge(case, each).success for each in plans)
        costs.append([float(each.cost) for each in plans])
    feasible, good = np.array(costs).T
    assert (good <= feasible).all() and (good < 0.7 * feasible).any()


@pytest.mark.slow
def test_more_effort_blocks_the_same_balls_at_less_cost():
    cases = jax.tree.map(np.asarray, pj.block.draw(12, "pole", 4))
    plans = [pj.plan(pj.block.planner(effort=each), cases) for each in EFFORTS]
    success = np.array([pj.block.judge(cases, each).success for each in plans])
    np.testing.assert_array_equal(success, [pj.are_solved(each) for each in plans])
    both = success.all(axis=0)
    assert both.sum() >= 8
    costs = np.array([each.cost[both] for each in plans])
    assert (costs[2] <= 1.01 * costs[0]).all()
    assert np.median(costs[0] / costs[2]) < 1.1
