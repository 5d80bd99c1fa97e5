import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import positions_on

import planner_jax as pj
from planner_jax.planning.decided import first_choice
from planner_jax.sweep.intercept.settings import GroupSettings
from planner_jax.task.group.decide import Greedy, Search
from planner_jax.task.group.order import Departure, end_times, improve, make_table, meet
from planner_jax.task.group.suites import WIDE
from tests.trees import as_numpy

tables, ends_of = jax.jit(make_table), jax.jit(end_times, static_argnums=4)


def few(group, num):
    target = jax.tree.map(lambda leaf: leaf[:num], group.shared.target)
    shared = dataclasses.replace(group.shared, target=target)
    return dataclasses.replace(
        group, shared=shared, present=group.present[:num], order=group.order[:num]
    )


def departure(group):
    start = group.shared.start
    toward = jnp.stack([jnp.cos(start[2]), jnp.sin(start[2])])
    return Departure(start[:2] + group.shared.body.middle * toward, toward, jnp.float32(0.0))


def test_forty_targets_and_movers_stay_on_the_map():
    groups, again = as_numpy(pj.group.draw(3, "forty", 5)), pj.group.draw(1, "forty", 5, first=2)
    np.testing.assert_array_equal(groups.shared.target.pos[2:], again.shared.target.pos)
    assert groups.present.shape == (3, 40) and groups.present.all()
    positions = positions_on(groups.shared.target, np.linspace(0.0, 200.0, 300))
    assert positions.min() >= 0.29 and positions.max() <= WIDE - 0.29
    movers = groups.shared.movers
    assert movers.present.shape == (3, 40) and movers.present.all()
    poses = movers.track.poses
    assert poses.min() >= 0.0 and poses.max() <= WIDE
    steps = np.linalg.norm(np.diff(poses[..., :2], axis=2), axis=-1)
    assert steps.max() <= 0.6 + 1e-4 and np.median(steps) >= 0.1
    gap = np.linalg.norm(poses[:, :, 0, :2] - groups.shared.start[:, None, :2], axis=-1)
    assert (gap - movers.radius).min() >= 0.8


def test_suites_of_many_targets_have_a_planner_and_a_decision_of_their_own():
    task = pj.task_named("group")
    chosen = [GroupSettings(suite=suite).of(task) for suite in (None, "forty")]
    assert [(each.planner, each.decide) for each in chosen] == [
        ("spacetime", "best"),
        ("direct", "search"),
    ]
    own = GroupSettings(suite="forty", planner="spacetime", decide="greedy").of(task)
    assert (own.planner, own.decide) == ("spacetime", "greedy")


def test_a_point_meets_a_target_where_both_arrive():
    path = pj.TurningPath(jnp.array([3.0, 1.0]), jnp.array([0.1, 0.4]), jnp.array(0.1))
    at, pos = meet(path, jnp.array([0.0, 0.0]), jnp.float32(2.0), jnp.float32(1.5))
    np.testing.assert_allclose(np.linalg.norm(pos), 1.5 * (at - 2.0), rtol=1e-4)
    np.testing.assert_allclose(pos, path.at(at).pos)


def test_estimated_ends_are_those_of_drives_one_after_another():
    group = few(pj.take(pj.group.draw(1, "forty", 2), 0), 5)
    table, start, speed = tables(group), departure(group), group.shared.limits.speed
    straight = dataclasses.replace(table, delay=jnp.float32(0.0))
    orders = jnp.array([[0, 1, 2, 3, 4], [3, 1, 0, 4, 2]])
    ends = ends_of(group, straight, start, orders, 0)
    for order, end in zip(np.asarray(orders), ends, strict=True):
        at, place = jnp.float32(0.0), start.position
        for target in order:
            path = jax.tree.map(lambda leaf, k=target: leaf[k], group.shared.target)
            at, place = meet(path, place, at, speed)
        np.testing.assert_allclose(end, at, rtol=5e-3)
    assert (ends_of(group, table, start, orders, 0) > ends).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_search_of_orders_is_near_the_best_of_all(seed):
    group = few(pj.take(pj.group.draw(1, "forty", seed), 0), 6)
    table, start = tables(group), departure(group)
    orders = jnp.array(list(itertools.permutations(range(6))))
    every = ends_of(group, table, start, orders, 0)
    ends = {}
    for decision in (Greedy(), Search()):
        order = first_choice(decision, group).order
        assert sorted(order.tolist()) == list(range(6))
        ends[type(decision)] = float(ends_of(group, table, start, order[None], 0)[0])
    assert every.min() - 1e-3 <= ends[Search] <= 1.1 * every.min()
    assert ends[Search] <= ends[Greedy] + 1e-3


def test_a_search_keeps_the_front_of_an_order_and_absent_targets_last():
    group = few(pj.take(pj.group.draw(1, "forty", 4), 0), 6)
    group = dataclasses.replace(group, present=jnp.arange(6) != 2)
    order = first_choice(Search(), group).order.tolist()
    assert order[-1] == 2 and sorted(order) == list(range(6))
    given = jnp.array([4, 0, 5, 1, 3, 2])
    better = improve(group, tables(group), departure(group), given, 2, 10).tolist()
    assert better[:2] == [4, 0] and better[-1] == 2


@pytest.mark.slow
def test_the_referee_confirms_plans_of_forty_targets():
    groups = as_numpy(pj.group.draw(3, "forty", 1))
    plans = pj.plan(pj.group.planner("direct", decide="search"), groups)
    verdict = pj.group.judge(groups, plans)
    solved = pj.are_solved(plans)
    np.testing.assert_array_equal(verdict.success, solved)
    assert solved.any() and (verdict.num_met[solved] == 40).all()
    np.testing.assert_allclose(verdict.meeting_time[solved], plans.cost[solved], atol=1e-3)


@pytest.mark.slow
def test_a_direct_plan_of_few_targets_is_confirmed():
    group = as_numpy(few(pj.take(pj.group.draw(1, "forty", 1), 0), 3))
    group = dataclasses.replace(group, present=np.array([True, False, True]))
    given = dataclasses.replace(group, order=np.array([0, 2, 1], np.int32))
    plan = pj.plan(pj.group.planner("direct", decide="given", moves=0), given)
    assert plan.order.tolist() == [0, 2, 1] and plan.legs.time[2] == 0.0
    verdict = pj.group.judge(given, plan)
    assert verdict.success and verdict.num_met == 2
    np.testing.assert_allclose(plan.cost, plan.begins[1] + plan.legs.time[1], rtol=1e-6)
    late = dataclasses.replace(given, shared=dataclasses.replace(given.shared, time=np.float32(1)))
    plan = pj.plan(pj.group.planner("direct", decide="given", moves=0), late)
    assert not pj.are_solved(plan) and not pj.group.judge(late, plan).success


@pytest.mark.slow
@pytest.mark.parametrize("trials", [1, 2])
def test_a_direct_plan_with_too_few_trials_for_its_targets_is_unsolved(trials):
    group = as_numpy(few(pj.take(pj.group.draw(1, "forty", 1), 0), 3))
    plan = pj.plan(pj.group.planner("direct", decide="given", trials=trials), group)
    assert plan.status == pj.Status.MAX_STEPS and plan.legs.time[2] == 0.0
    verdict = pj.group.judge(group, plan)
    assert not verdict.success and verdict.num_met == trials
