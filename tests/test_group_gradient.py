"""Gradients of groups: a chain of legs, each a minimum that starts where the last one ends."""

import dataclasses

import jax
import numpy as np
import pytest
from test_intercept_group import line

import planner_jax as pj
from planner_jax.benchmarks.gradient_errors import errors_of
from planner_jax.optimise.levenberg import LevenbergConfig
from planner_jax.plane.reach import Lattice
from planner_jax.task.intercept.default_planner import SpacetimeIntercept
from planner_jax.task.intercept.searches import Search

SEARCH = Search(2, LevenbergConfig(40), lattice=Lattice(layers=22, headings=16))
LEGS = SpacetimeIntercept(meet="early", pieces=6, samples=3, searches=(SEARCH,))
BY = ("shared.target.pos", "shared.target.vel", "shared.limits.acceleration", "shared.speed")


@pytest.mark.slow
def test_gradients_of_chained_legs_match_differences_of_new_plans():
    """Lane 0 meets two targets, lane 1 one target, and lane 2 has too little time for any."""
    present = np.array([[True, True], [True, False], [True, True]])
    one = [
        line(2.5, 4.5, present=each, time=t) for each, t in zip(present, (9, 9, 0.3), strict=True)
    ]
    cases = jax.tree.map(lambda *leaves: np.stack(leaves), *one)
    path = cases.shared.target
    moved = dataclasses.replace(path, vel=path.vel + np.array([0.1, -0.2], np.float32))
    shared = dataclasses.replace(cases.shared, target=moved)
    cases = dataclasses.replace(cases, shared=shared)
    planner = pj.group.planner(decide="given", planner=LEGS, patient=LEGS)
    found, errors = errors_of(planner, cases, "cost", BY, seed=1)
    assert pj.are_solved(found.plans).tolist() == [True, True, False]
    assert (errors[:2] < 5e-3).all()
    assert np.isnan(found.by["shared.speed"][2]) and (found.stationarity[:2] < 1e-6).all()
    by_target = found.by["shared.target.pos"]
    assert (np.abs(by_target[0]).max(axis=1) > 0.1).all()
    assert not by_target[1, 1].any()  # the target is absent
    legs = found.plans.legs
    np.testing.assert_allclose(found.plans.begins[:2, 1], legs.time[:2, 0], rtol=1e-5)
    assert found.value == pytest.approx(found.plans.cost, rel=1e-6)
