"""A base that slides along a rail: shifts of the base, slides, and balls met from other places."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_block import SMALL

import planner_jax as pj
from planner_jax.ball.flight import drag_free_flight
from planner_jax.robot.arm import shield_pose
from planner_jax.task.block.rail import Rail, slides_freely
from planner_jax.trajectory.bang_bang import least_times
from planner_jax.trajectory.polynomial import evaluate

# Behind the pole, from where the base may slide both ways.
BEHIND = np.array([0.0, -0.52, 0.858, 0.0, -0.337, 0.0], np.float32)


def drawn(regime="R1", **options):
    return jax.tree.map(np.asarray, pj.block.draw(16, seed=6, regime=regime, **options))


def test_a_shift_of_the_base_is_a_shift_of_the_world():
    """The shield is at the ball, both in the world's frame, and the referee sees no difference."""
    by = np.array([-0.1, 0.2, 0.05])
    cases = drawn(wide=True)
    there = jax.tree.map(np.asarray, pj.block.shifted(cases, by))
    plans = pj.plan(SMALL, there)
    good = pj.solved(plans)
    assert good.sum() > 8
    np.testing.assert_array_equal(pj.block.judge(there, plans).success, good)

    @jax.jit
    @jax.vmap
    def away(case, plan):
        ball = drag_free_flight(case.ball, plan.contact_time, case.gravity)
        _, middle = shield_pose(case.arm, evaluate(plan.motion, plan.contact_time - case.delay))
        return jnp.linalg.norm(ball.pos - (middle + by))

    assert np.max(away(cases, plans)[good]) < 0.101
    back = pj.block.shifted(there, -by)
    for name in ("scene", "ball"):
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5),
            getattr(back, name),
            getattr(cases, name),
        )


@pytest.mark.parametrize("way", [0.1, -2.0])
def test_slides_are_as_quick_as_can_be(way):
    """Without and with coasting."""
    rail = Rail((way,), velocity=2.0, acceleration=10.0)
    least = float(least_times(*(jnp.asarray([value]) for value in (way, 0.0, 2.0, 10.0)))[0])
    assert rail.slide_time(way) == pytest.approx(least, rel=1e-5)
    assert rail.slide_time(0.0) == 0.0
    assert dataclasses.replace(rail, velocity=np.inf, acceleration=np.inf).slide_time(way) == 0.0


def test_a_base_does_not_slide_through_the_pole():
    """From the authors' home the shield is in the way, though it is free beyond the pole."""
    cases = drawn()
    assert not slides_freely(cases, -0.3).any() and slides_freely(cases, 0.3).all()
    beyond = pj.block.shifted(cases, (0.0, -0.5, 0.0))
    assert slides_freely(jax.tree.map(np.asarray, beyond), 0.0).all()
    behind = dataclasses.replace(cases, angles=np.tile(BEHIND, (16, 1)))
    assert slides_freely(behind, -0.3).all()


def test_balls_are_met_from_other_places_if_not_from_where_the_base_waits():
    cases = drawn("R2", delay=0.1)
    alone = pj.plan(SMALL, cases)
    rail = Rail((0.3, 0.2, 0.1), velocity=20.0, acceleration=400.0)
    found = pj.block.plan_on_rail(SMALL, cases, rail)
    before, met = pj.solved(alone), pj.solved(found.plans)
    assert met[before].all() and met.sum() > before.sum()
    assert (found.place[before | ~met] == 0.0).all() and (found.place[met & ~before] > 0.0).all()
    slid = np.array([rail.slide_time(place) for place in found.place])
    np.testing.assert_allclose(found.cases.delay - cases.delay, slid, atol=1e-5)
    np.testing.assert_array_equal(pj.block.judge(found.cases, found.plans).success, met)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"places": (np.inf,)}, r"places must be finite, got \(inf,\)"),
        ({"places": (0.1,), "velocity": 0.0}, "velocity must be > 0, got 0.0"),
        ({"places": (0.1,), "acceleration": -1.0}, "acceleration must be > 0, got -1.0"),
    ],
)
def test_what_is_wrong_with_a_rail_is_named(options, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        Rail(**options)


def test_an_arm_that_moves_cannot_slide():
    cases = dataclasses.replace(drawn(), rates=np.ones((16, 6), np.float32))
    with pytest.raises(ValueError, match="^rates must be 0: the base slides while"):
        pj.block.plan_on_rail(SMALL, cases, Rail((0.1,)))
