import dataclasses
import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet as pq
import pytest
from closed_forms import positions_on

import planner_jax as pj
from planner_jax.core.errors import ArgumentError
from planner_jax.optimise.levenberg import LevenbergConfig
from planner_jax.plane.reach import Lattice
from planner_jax.planning.decided import first_choice
from planner_jax.robot.car import pose_at
from planner_jax.sweep.intercept.settings import GroupSettings
from planner_jax.sweep.run import start_sweep
from planner_jax.sweep.sweep import Sweep
from planner_jax.task.group.case import CarState
from planner_jax.task.group.decide import Best, Given, Greedy
from planner_jax.task.group.spec import SUITES, TASK
from planner_jax.task.intercept.default_planner import SpacetimeIntercept
from planner_jax.task.intercept.searches import Search
from planner_jax.task.intercept.suites import SIZE
from tests.trees import as_numpy

# Planners in these tests make one search, so that only one program is compiled.
SEARCH = Search(4, LevenbergConfig(40), lattice=Lattice(layers=22, headings=16))
LEGS = SpacetimeIntercept(meet="early", pieces=12, samples=3, searches=(SEARCH,))


def planner(decide):
    return pj.group.planner(decide=decide, planner=LEGS, patient=LEGS)


def draw(num, seed, count):
    groups = as_numpy(pj.group.draw(num, seed=seed))
    present = np.broadcast_to(np.arange(4) < count, (num, 4))
    return dataclasses.replace(groups, present=present)


def line(*xs, present: Any = True, **settings):
    pos = jnp.array([[x, 4.0] for x in xs])
    path = pj.TurningPath(pos, jnp.zeros_like(pos), jnp.zeros(len(xs)))
    return pj.group.case(path, present=present, **settings)


def test_a_group_is_the_same_in_every_batch():
    whole, again = pj.group.draw(7, seed=5), pj.group.draw(3, seed=5, first=2)
    for a, b in zip(*map(jax.tree.leaves, (whole, again)), strict=True):
        np.testing.assert_array_equal(a[2:5], b)
        assert a.dtype in (np.float32, np.int32, bool)
    pos = vars(pj.group.draw(1).shared.target)["pos"][0, 3]
    np.testing.assert_allclose(pos, [7.109591, 4.838748], rtol=1e-5)


def test_groups_have_two_to_four_targets_that_stay_on_the_map():
    groups, suite = as_numpy(pj.group.draw(40, seed=3)), SUITES["group"]
    assert set(groups.present.sum(axis=1)) == {2, 3, 4}
    assert not (groups.present[:, 1:] & ~groups.present[:, :-1]).any()
    np.testing.assert_array_equal(groups.shared.time, suite.time)
    assert groups.shared.walls.corners.shape[:3] == (40, *suite.wall_room)
    positions = positions_on(groups.shared.target, np.linspace(0.0, suite.time, 100))
    assert positions.min() >= -1e-3 and positions.max() <= SIZE + 1e-3
    turns = groups.shared.target.turn_rate != 0.0
    assert (turns.mean(axis=0) > 0.25).all() and (turns.mean(axis=0) < 0.75).all()


def test_a_leg_has_targets_and_movers_at_its_start_time():
    group = pj.take(draw(1, 2, 4), 0)
    car = CarState(jnp.array([1.0, 2.0, 0.3]), jnp.array(1.2), jnp.array(-0.5))
    leg = group.leg(2, 4.0, car)
    path = jax.tree.map(lambda leaf: leaf[2], group.shared.target)
    np.testing.assert_allclose(leg.target.at(1.5).pos, path.at(5.5).pos, rtol=1e-6)
    np.testing.assert_allclose(leg.time, 11.0)
    later = group.shared.movers.vertices(5.5)
    np.testing.assert_allclose(leg.movers.vertices(1.5), later, atol=1e-5)
    np.testing.assert_array_equal(leg.start, car.pose)
    assert (leg.speed, leg.curvature) == (car.speed, car.curvature)
    assert group.leg(2, 20.0, car).time > 0.0


@pytest.mark.parametrize("decision", [Best(6), Greedy()])
def test_targets_on_a_line_are_met_in_sequence(decision):
    group = line(6.0, 2.0, 3.0, 4.5)
    assert first_choice(decision, group).order.tolist() == [1, 2, 3, 0]
    without = dataclasses.replace(group, present=jnp.array([True, False, True, True]))
    assert first_choice(decision, without).order.tolist() == [2, 3, 0, 1]


def test_best_proposes_every_order_once():
    group = line(6.0, 2.0, 3.0, 4.5, present=[True, False, True, True])
    propose = jax.jit(Best(6).propose)
    three = [(*front, 1) for front in itertools.permutations([0, 2, 3])]
    assert sorted(map(tuple, propose(group).order.tolist())) == three
    two = dataclasses.replace(group, present=jnp.array([True, False, False, True]))
    assert set(map(tuple, propose(two).order.tolist())) == {(0, 3, 1, 2), (3, 0, 1, 2)}


def test_more_targets_than_all_orders_allow_name_the_planner_for_many():
    with pytest.raises(ValueError, match="at most 8, .*the planner direct .*search.*, got 40"):
        Best().propose(pj.take(pj.group.draw(1, "forty", 0), 0))


def test_a_given_order_is_kept_and_must_be_a_permutation():
    group = line(6.0, 2.0, 3.0, present=[True, False, True])
    given = dataclasses.replace(group, order=jnp.array([1, 2, 0], jnp.int32))
    Given().check(given)
    assert first_choice(Given(), given).order.tolist() == [2, 0, 1]
    with pytest.raises(ValueError, match=r"permutation of 0..2, got \[1, 1, 0\] in case 0"):
        Given().check(dataclasses.replace(group, order=jnp.array([1, 1, 0], jnp.int32)))


@pytest.fixture(scope="module")
def planned():
    groups = draw(6, 4, 2)
    time = np.array([15.0] * 5 + [1.0], np.float32)
    groups = dataclasses.replace(groups, shared=dataclasses.replace(groups.shared, time=time))
    return groups, functools.cache(lambda name: pj.plan(planner(name), groups))


DECISIONS = pytest.param("best", marks=pytest.mark.slow), "greedy"


@pytest.mark.parametrize("decide", DECISIONS)
def test_the_referee_confirms_solved_groups(planned, decide):
    groups, plans = planned[0], planned[1](decide)
    verdict = pj.group.judge(groups, plans)
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(plans))
    np.testing.assert_array_equal(verdict.success, pj.are_solved(plans))
    assert verdict.success[:5].sum() >= 4 and plans.status[5] == pj.Status.TOO_FAR
    good = np.flatnonzero(verdict.success)
    assert (vars(verdict)["num_met"][good] == 2).all()
    np.testing.assert_allclose(verdict.meeting_time[good], plans.cost[good], atol=1e-5)
    assert verdict.sentence(int(good[0])).startswith("success: 2 targets are met")
    assert verdict.sentence(5).startswith(verdict.failed_limit[5] + ": leg ")


@pytest.mark.slow
def test_the_best_order_is_no_later_than_the_greedy_one(planned):
    best, greedy = planned[1]("best"), planned[1]("greedy")
    both = pj.are_solved(best) & pj.are_solved(greedy)
    assert pj.are_solved(best).sum() >= pj.are_solved(greedy).sum()
    assert np.all(best.cost[both] <= greedy.cost[both] + 1e-3)
    same = both & (best.order == greedy.order).all(axis=1)
    assert same.any()
    np.testing.assert_allclose(best.cost[same], greedy.cost[same], atol=1e-3)


@pytest.mark.parametrize("decide", DECISIONS)
def test_one_group_is_planned_as_in_a_batch(planned, decide):
    k = int(np.argmax(pj.are_solved(planned[1](decide))))
    one, batch = pj.plan(planner(decide), pj.take(planned[0], k)), pj.take(planned[1](decide), k)
    assert one.status == batch.status and one.order.tolist() == batch.order.tolist()
    np.testing.assert_allclose(one.cost, batch.cost, atol=1e-3)
    assert pj.group.judge(pj.take(planned[0], k), one).success


def test_each_leg_starts_where_the_previous_leg_ends(planned):
    plans = planned[1]("greedy")
    plan = pj.take(plans, int(np.argmax(pj.are_solved(plans))))
    first, second = (pj.take(plan.legs, k) for k in (0, 1))
    end = pose_at(first.start, first.time, first.speed, first.curvature, first.time)
    np.testing.assert_allclose(second.start, end, atol=1e-5)
    assert second.speed[0] == first.speed[-1] and second.curvature[0] == first.curvature[-1]
    np.testing.assert_allclose(plan.begins[1], first.time)
    np.testing.assert_array_equal(plan.legs.time[2:], 0.0)


def test_a_picture_shows_every_meeting_and_the_verdict(planned):
    groups, plans = planned[0], planned[1]("greedy")
    for k in (int(np.argmax(pj.are_solved(plans))), 5):
        axes = pj.show(*pj.take((groups, plans), k)).axes[0]
        verdict = pj.group.judge(*pj.take((groups, plans), k))
        assert axes.get_title(loc="left") == verdict.sentence()
        circles = [line.get_xydata()[0] for line in axes.lines if line.get_markersize() == 13]
        assert len(circles) == vars(verdict)["leg"] + 1
        if verdict.success:
            met = [plans.legs.meeting[k, leg] for leg in (1, 0)]
            np.testing.assert_allclose(circles, met, atol=1e-3)


def test_one_target_is_planned_as_an_interception(planned):
    groups = dataclasses.replace(planned[0], present=np.broadcast_to(np.arange(4) < 1, (6, 4)))
    plans = pj.plan(planner("best"), groups)
    shared = groups.shared
    cars = CarState(shared.start, shared.speed, shared.curvature)
    leg = jax.vmap(lambda group, car: group.leg(0, jnp.float32(0.0), car))
    alone = pj.plan(LEGS, as_numpy(jax.jit(leg)(groups, cars)))
    np.testing.assert_array_equal(plans.status, alone.status)
    solved = pj.are_solved(alone)
    assert solved.sum() >= 4
    np.testing.assert_allclose(plans.cost[solved], alone.time[solved], rtol=1e-6)
    np.testing.assert_allclose(plans.legs.speed[solved, 0], alone.speed[solved], atol=1e-6)
    assert pj.group.judge(groups, plans).success[solved].all()


def change_legs(plans, **changes):
    return dataclasses.replace(plans, legs=dataclasses.replace(plans.legs, **changes))


def test_the_referee_rejects_a_plan_with_a_wrong_leg(planned):
    groups, plans = planned[0], planned[1]("greedy")
    good = np.flatnonzero(pj.are_solved(plans))
    groups, plans = pj.take((groups, plans), good)
    legs = plans.legs
    shorter = np.array([1.0, 0.95, 1.0, 1.0], np.float32)
    aside = np.zeros((4, 3), np.float32)
    aside[1, 0] = 0.01
    faster = legs.speed + 0.01 * (np.arange(4) == 1)[:, None]
    other = plans.order[:, [1, 0, 2, 3]]
    cut = change_legs(plans, time=shorter * legs.time)
    wrong = {
        "a leg that is cut": (cut, 1, {"meeting", "acceleration"}),
        "a leg aside": (change_legs(plans, start=legs.start + aside), 1, {"start"}),
        "a faster leg": (change_legs(plans, speed=faster), 1, {"start"}),
        "the other order": (dataclasses.replace(plans, order=other), 0, {"meeting"}),
        "a target twice": (dataclasses.replace(plans, order=plans.order * 0), 0, {"order"}),
    }
    for name, (broken, leg, limits) in wrong.items():
        verdict = pj.group.judge(groups, broken)
        assert not verdict.success.any(), name
        assert set(verdict.failed_limit) <= limits, name
        if limits != {"order"}:
            np.testing.assert_array_equal(vars(verdict)["leg"], leg)
    one = pj.group.judge(*pj.take((groups, wrong["a leg aside"][0]), 0))
    assert one.sentence().startswith("start: leg 1: the plan starts 0.025 off")


def test_a_sweep_of_groups_has_a_row_for_every_group(monkeypatch, tmp_path):
    small = {"decide": "greedy", "planner": LEGS, "patient": LEGS}
    monkeypatch.setattr(GroupSettings, "planner_options", lambda self: small)
    monkeypatch.setattr(Sweep, "other_planners", lambda *_: {})
    settings = GroupSettings(num=2, seed=4, batch=2, decide="greedy")
    start_sweep(TASK, settings, tmp_path / "run", progress=False)
    rows = pq.read_table(tmp_path / "run" / "plans")
    groups = pj.group.draw(2, seed=4)
    for name, leaf in {"case.present": groups.present, "plan.order": groups.order}.items():
        assert np.shape(rows[name].to_pylist()) == leaf.shape
    assert rows["case.present"].to_pylist() == groups.present.tolist()
    with pytest.raises(ArgumentError, match="^decide must be one of best, greedy, given"):
        GroupSettings(decide="worst")
