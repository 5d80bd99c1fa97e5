"""Invalid cases of a batch, such as with NaN, are found and change no plan of other cases."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.core.rules import all_ruled, is_sound, part_at
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.robot.arm_scene import paper_scene
from planner_jax.task.catch.decide import MOST_SEARCHED

TASKS = ("hit", "catch", "intercept", "block")
SOUND = jax.jit(is_sound)
# Planners that decide the order and times of catches replace these arrays without reading them, so
# bad values in them have no effect.
REPLACED = ("order", "times")
BAD = (np.nan, np.inf, -np.inf, -1.0, 0.0, 1e6)


@functools.cache
def draw_three(name):
    return jax.tree.map(np.asarray, pj.task_named(name).draw(3))


def poisons(case):
    """Return the names of a case's arrays, each with a value that is invalid for the array."""
    found = []
    for ruled in all_ruled(jax.tree.map(np.asarray, case)):
        for value in BAD:
            if ruled.value.dtype.kind == "f" or np.isfinite(value):
                bad = np.full_like(ruled.value, value)
                if bad.size and not ruled.rule.holds(bad, ruled.part).all():
                    found.append((ruled.name, value))
    return list(dict.fromkeys(found))


def poison(cases, lanes, spared=()):
    """Return a copy of a batch with an invalid number in some cases, in NumPy arrays.

    Args:
        cases: a batch.
        lanes: indices of the cases to change. Each gets the next of the values from `poisons`.
        spared: names of arrays that are not changed.
    """
    paths, tree = jax.tree_util.tree_flatten_with_path(cases)
    leaves = {
        jax.tree_util.keystr(path, simple=True, separator="."): np.array(leaf)
        for path, leaf in paths
    }
    bad = [(name, value) for name, value in poisons(pj.take(cases, 0)) if name not in spared]
    for k, lane in enumerate(lanes):
        name, value = bad[k % len(bad)]
        leaves[name][lane] = value
    return jax.tree.unflatten(tree, list(leaves.values()))


def compare(task, num, every, seed):
    """Plan a valid batch and a batch with invalid cases; count marked cases and changed plans.

    Args:
        task: specification of the task.
        num: number of cases.
        every: number N; one of every N cases is made invalid.
        seed: seed of the cases.
    """
    cases, planner = task.draw(num, seed=seed), task.planner(**task.bench)
    lanes = np.arange(every // 2, num, every)
    others = np.setdiff1d(np.arange(num), lanes)
    spared = REPLACED if isinstance(planner, DecidedPlanner) else ()
    broken = jax.tree.map(jnp.asarray, poison(cases, lanes, spared))
    sound, found = jax.device_get((pj.plan(planner, cases), pj.plan(planner, broken)))
    same = np.ones(num, bool)
    for ours, theirs in zip(jax.tree.leaves(sound), jax.tree.leaves(found), strict=True):
        alike = (ours == theirs) | ((ours != ours) & (theirs != theirs))
        same &= alike.reshape(num, -1).all(axis=1)
    return {
        "poisoned": lanes.size,
        "marked": int((found.status[lanes] == pj.Status.BAD_INPUT).sum()),
        "others": others.size,
        "unchanged": int(same[others].sum()),
        "marked_others": int((found.status[others] == pj.Status.BAD_INPUT).sum()),
    }


def with_all_limits(robot):
    limits = dataclasses.replace(robot.limits, acceleration=15.0, thrust=(3.0, 18.0))
    return dataclasses.replace(robot, limits=limits)


@pytest.mark.parametrize("name", TASKS)
def test_a_table_names_arrays_of_its_case_and_every_rule_can_be_broken(name):
    robots = {"hit": "x500", "catch": "x500-net"}
    options = {"robot": with_all_limits(pj.robot_named(robots[name]))} if name in robots else {}
    if name == "block":
        rod = [[0.0, 0.0, -9.0], [0.0, 0.0, -8.0]], 0.1
        box = (0.0, 0.0, -9.0), (0.1, 0.1, 0.1), (1.0, 0.0, 0.0, 0.0)
        far = vars(pj.reach.make_scene(boxes=[box], cylinders=[rod]))
        solid = {key: far[key] for key in far if key.startswith(("box_", "cylinder_"))}
        options = {"scene": dataclasses.replace(paper_scene(), **solid)}
    drawn = pj.task_named(name).draw(1, **options) if options else draw_three(name)
    case = pj.take(jax.tree.map(np.asarray, drawn), 0)
    present = [field for field in type(case).rules if part_at(case, field.name) is not None]
    places = {place for place, _ in poisons(case)}
    assert places >= {field.name for field in present if field.kind is np.floating}


@pytest.mark.parametrize("name", TASKS)
def test_every_broken_rule_marks_its_lane_alone_in_both_forms(name):
    cases = draw_three(name)
    bad = poisons(pj.take(cases, 0))
    whole = jax.tree.map(lambda leaf: np.repeat(leaf[:1], 2 * len(bad), axis=0), cases)
    lanes = np.arange(0, 2 * len(bad), 2)
    broken = poison(whole, lanes)
    expected = np.arange(2 * len(bad)) % 2 == 1
    np.testing.assert_array_equal(is_sound(broken), expected)
    np.testing.assert_array_equal(SOUND(broken), expected)
    assert is_sound(whole).all()


@pytest.mark.parametrize("name", TASKS)
def test_the_host_names_field_rule_value_and_lane(name):
    cases = draw_three(name)
    for place, value in poisons(pj.take(cases, 0))[::5]:
        broken = jax.tree.map(np.array, cases)
        part_at(broken, place)[1] = value
        with pytest.raises(pj.CaseError) as caught:
            pj.require_sound(broken)
        line = str(caught.value)
        assert "\n" not in line and line.endswith("in lane 1") and " must be " in line
        assert line.startswith(place) or "<" in line


def test_orders_of_forty_targets_differ_and_of_too_many_are_refused():
    def crowd(num):
        places = np.random.default_rng(0).uniform(-2.0, 2.0, (num, 3)).astype(np.float32) + 3.0
        still = np.zeros((num, 3), np.float32)
        path = pj.BallPath(pj.BallState(places, still), still, still[:, 0])
        return pj.catch.case(path, np.full(num, 200.0))

    choice = jax.jit(pj.catch.Best(width=8).propose)(crowd(40))
    orders = np.asarray(choice.order).tolist()
    assert all(sorted(order) == list(range(40)) for order in orders)
    assert len(set(map(tuple, orders))) > 1 and np.asarray(choice.taken).all()
    with pytest.raises(ValueError, match=f"^targets must be at most {MOST_SEARCHED} of a case"):
        pj.catch.Best().propose(crowd(MOST_SEARCHED + 1))


def test_groups_of_too_many_targets_are_refused():
    still = np.ones((9, 2), np.float32)
    group = pj.group.case(pj.TurningPath(still, 0.0 * still, still[:, 0]))
    with pytest.raises(ValueError, match="^targets must be at most 8, because all orders"):
        pj.group.planner().decision.propose(group)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "num"), [("hit", 20_000), ("catch", 2_000)])
def test_poisoned_lanes_are_marked_and_all_others_keep_their_bits(name, num):
    found = compare(pj.task_named(name), num, 100, 1)
    assert found["marked"] == found["poisoned"] == num // 100
    assert found["marked_others"] == 0
    assert found["unchanged"] == found["others"]
