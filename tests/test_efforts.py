"""Tests of efforts, which state how long a planner continues to search after all limits hold."""

import pytest

import planner_jax as pj
from planner_jax.core.errors import ArgumentError
from planner_jax.optimise.settings import Stage
from planner_jax.sweep.catch.settings import CatchSettings
from planner_jax.sweep.hit.settings import HitSettings


@pytest.mark.parametrize("task", [pj.hit, pj.catch], ids=["hit", "catch"])
def test_more_effort_is_a_longer_first_round_and_the_default_is_the_planner_itself(task):
    own = task.planner("exact")
    assert task.planner("exact", effort="feasible") == own
    rounds = [task.planner("exact", effort=x).inner.rounds for x in ("feasible", "good", "best")]
    assert len({each[1:] for each in rounds}) == 1
    feasible, good, best = (each[0] for each in rounds)
    assert feasible == own.inner.rounds[0]
    assert good.stages == best.stages == (Stage(feasible.solver),)
    assert isinstance(good.solver, pj.NewtonConfig) and isinstance(best.solver, pj.NewtonConfig)
    assert good.solver.max_steps < best.solver.max_steps


def test_an_effort_that_is_none_and_planners_without_one_are_named():
    with pytest.raises(ValueError, match="effort must be one of feasible, good, best, got 'more'"):
        pj.hit.planner("exact", effort="more")
    for task, name in ((pj.hit, "juggle"), (pj.catch, "mpp")):
        with pytest.raises(ValueError, match="effort must be feasible for a .*, which minimises"):
            task.planner(name, effort="good")
    for kind, name in ((HitSettings, "juggle"), (CatchSettings, "mpp")):
        with pytest.raises(ArgumentError, match=f"effort must be left out for the planner {name}"):
            kind(planner=name, effort="good")
        assert kind(effort="good").planner_options()["effort"] == "good"
