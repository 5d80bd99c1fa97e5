"""Random states of a quadrotor at time 0: distinct, within the limits, and equal for equal keys."""

import chex
import jax
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.task.catch.suites import draw_by_key

SUITES = (("catch", "throws"), ("catch", "rush6"), ("catch", "swarm12"), ("hit", "court"))


def draw(name, num=64, **options):
    cases = pj.task_named(name[0]).draw(num, name[1], 3, **options)
    return jax.tree.map(np.asarray, cases)


@pytest.mark.parametrize("name", SUITES, ids="-".join)
def test_random_states_are_distinct_and_within_the_limits(name):
    cases, hovering = draw(name, starts="random"), draw(name)
    states, limits = cases.head_state, cases.limits
    assert len({each.tobytes() for each in states}) == 64
    assert not hovering.head_state[:, 1:].any()
    assert np.ptp(hovering.head_state, axis=0).max() == 0.0
    size = np.linalg.norm(states, axis=2)
    thrust = np.linalg.norm(states[:, 2] + [0.0, 0.0, 9.81], axis=1)
    assert size[:, 1].max() <= 2.0 and not states[:, 3].any()
    assert np.abs(states[:, 0, :2] - hovering.head_state[:, 0, :2]).max() <= 1.0
    assert states[:, 0, 2].min() >= 0.8 and states[:, 0, 2].max() <= 2.0
    tilt = np.arccos((states[:, 2, 2] + 9.81) / thrust)
    assert 0.4 < tilt.max() <= np.pi / 6 + 1e-5
    assert thrust.min() >= 0.69 * 9.81 and thrust.max() <= 1.31 * 9.81
    if limits.acceleration is not None:
        assert (size[:, 2] <= limits.acceleration).all()
    chex.assert_trees_all_equal(cases.replace(head_state=0), hovering.replace(head_state=0))


@pytest.mark.parametrize("scale", [1.0, 0.2])
def test_the_referee_finds_no_start_beyond_a_limit(scale):
    cases = draw(("catch", "hard"), starts="random", limit_scale=scale)
    limits = cases.limits
    thrust = np.linalg.norm(cases.head_state[:, 2] + [0.0, 0.0, 9.81], axis=1)
    assert (np.linalg.norm(cases.head_state[:, 1], axis=1) <= limits.speed).all()
    assert (thrust >= limits.min_thrust).all() and (thrust <= limits.max_thrust).all()
    plans = pj.plan(pj.catch.planner(), cases)
    verdict = pj.catch.judge(cases, plans)
    solved = pj.are_solved(plans)
    assert solved.sum() >= (48 if scale == 1.0 else 0) and verdict.success[solved].all()


def test_a_part_of_a_batch_has_the_states_of_the_whole():
    whole, part = (
        draw(("hit", "S.2"), 20, starts="random"),
        draw(("hit", "S.2"), 5, starts="random", first=9),
    )
    chex.assert_trees_all_equal(part, jax.tree.map(lambda leaf: leaf[9:14], whole))


def test_states_by_key_have_the_moments_of_drawn_states():
    drawn = draw(("catch", "hexagon6"), 4096, starts="random").head_state
    draw_some = jax.jit(draw_by_key, static_argnums=(1, 2, 3))
    with jax.numpy_rank_promotion("allow"):  # the suites' functions are also for NumPy
        by_key = draw_some(jax.random.key(1), 4096, "hexagon6", "random")
    for moment in (np.mean, np.std):
        both = [moment(np.asarray(each), axis=0) for each in (drawn, by_key.head_state)]
        np.testing.assert_allclose(*both, atol=0.1)


@pytest.mark.parametrize("task", ["hit", "catch"])
def test_an_unknown_kind_of_start_is_named(task):
    with pytest.raises(ValueError, match="starts must be one of hover, random, got 'moving'"):
        pj.task_named(task).draw(1, starts="moving")
