"""Drawings of one planned interception."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

import planner_jax as pj
from planner_jax.core.errors import ArgumentError
from planner_jax.task.intercept.drawing import find_outlines, instants

L_SHAPE = [(3, 5), (5, 5), (5, 6), (4, 6), (4, 7), (3, 7)]
MOVER = [(6.0, 1.0), (6.5, 1.0), (6.5, 1.5), (6.0, 1.5)]


@pytest.fixture(scope="module")
def drive():
    """A case, and a plan that drives straight to its target at 1 m/s for 4 s."""
    target = pj.TurningPath(jnp.array([4.95, 1.0]), jnp.zeros(2), jnp.array(0.0))
    case = pj.intercept.case(
        target, 4.0, start=(0.8, 1.0, 0.0), initial_speed=1.0, walls=[L_SHAPE], movers=[MOVER]
    )
    plan = pj.intercept.InterceptPlan(
        cost=jnp.array(0.0),
        violation=jnp.array(0.0),
        iterations=jnp.array(0),
        status=jnp.array(0),
        start=case.start,
        time=case.time,
        speed=jnp.ones(9),
        curvature=jnp.zeros(9),
        origin=case.origin,
        meeting=jnp.array([4.95, 1.0]),
    )
    return case, plan


def stack(*parts):
    """Return a batch of cases or plans."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts)


def test_a_plan_is_drawn_with_walls_bodies_and_the_verdict(drive):
    axes = pj.intercept.draw_plan(*drive)
    assert axes.get_title(loc="left").startswith("success: the body's middle is ")
    assert axes.get_xlim() == (0.0, 8.0) and axes.get_ylim() == (0.0, 8.0)
    found = [c for c in axes.collections if isinstance(c, PolyCollection)]
    assert [len(c.get_paths()) for c in found[:2]] == [2, 2]  # outline and filling of both parts
    bodies = [
        np.asarray(c.get_paths()[0].vertices)[:4].mean(axis=0) for c in found if c.get_zorder() == 5
    ]
    expected = [(0.95 + time, 1.0) for time in instants(4.0, 6)]
    np.testing.assert_allclose(bodies, expected, atol=1e-5)
    assert axes.figure.axes[1].get_ylabel() == "speed of the car [m/s]"


def test_times_of_a_target_at_standstill_and_of_the_car_are_on_opposite_sides(drive):
    axes = pj.intercept.draw_plan(*drive)
    heights = {each.get_text(): each.xyann[1] for each in axes.texts if each.xy[0] > 4.9}
    assert heights == {"0 s": -13.0, "4 s": 13.0}


def test_circles_absent_movers_and_a_map_without_bounds_are_drawn():
    square = 0.5 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    case = pj.intercept.case(
        pj.TurningPath(np.float32([4.95, 1.0]), np.zeros(2, np.float32), np.float32(0.0)),
        4.0,
        start=(0.8, 1.0, 0.0),
        initial_speed=1.0,
        walls=[pj.intercept.Circle(3.0, 2.5, 0.7)],
        movers=[square],
        mover_paths=[([0.0, 1.0], [[3.0, -2.0, 0.0], [3.0, -1.0, 0.5]])],
        lower=-np.inf,
        upper=np.inf,
    )
    still = find_outlines(case.walls, 0.0)[0]
    np.testing.assert_allclose(np.linalg.norm(still - [3.0, 2.5], axis=1), 0.7, rtol=1e-5)
    cos, sin = np.cos(0.25), np.sin(0.25)
    turned = square @ [[cos, sin], [-sin, cos]] + [3.0, -1.5]
    np.testing.assert_allclose(find_outlines(case.movers, 0.5)[0][:4], turned, atol=1e-5)
    assert np.isnan(find_outlines(case.movers, 1.1)[0]).all()
    knots = {"speed": jnp.ones(9), "curvature": jnp.zeros(9)}
    none = {name: jnp.array(0) for name in ("iterations", "status")}
    numbers = {name: jnp.array(0.0) for name in ("cost", "violation")}
    rest = {"start": case.start, "time": case.time, "meeting": jnp.array([4.95, 1.0])}
    plan = pj.intercept.InterceptPlan(**numbers, **none, **knots, **rest, origin=case.origin)
    axes = pj.intercept.draw_plan(case, plan)
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    assert left < 0.8 < 4.95 < right < 10.0 and low < 1.0 < high < 10.0


def test_a_case_of_a_batch_is_drawn_by_its_index_and_says_what_fails(drive):
    case, plan = drive
    fast = dataclasses.replace(plan, speed=2.0 * plan.speed)
    cases, plans = (stack(*pair) for pair in ((case, case), (plan, fast)))
    axes = Figure().subplots()
    assert pj.intercept.draw_plan(cases, plans, axes, index=1) is axes
    assert "speed" in axes.get_title(loc="left")
    assert any(line.get_marker() == "X" for line in axes.lines)


def test_speeds_in_reverse_have_colours_of_their_own(drive):
    case, plan = drive
    speed = jnp.linspace(-0.5, 1.0, 9)
    axes = pj.intercept.draw_plan(case, dataclasses.replace(plan, speed=speed))
    assert axes.figure.axes[1].get_ylim() == pytest.approx((-0.5, 1.0))


def test_a_missing_or_wrong_index_and_other_objects_are_rejected(drive):
    case, plan = drive
    cases, plans = (stack(each, each) for each in drive)
    for index in (None, 2, -1):
        with pytest.raises(ArgumentError, match="index must be a case of the batch, from 0 to 1"):
            pj.intercept.draw_plan(cases, plans, index=index)
    with pytest.raises(ArgumentError, match="index must be None for one case, got 0"):
        pj.intercept.draw_plan(case, plan, index=0)
    with pytest.raises(TypeError, match="plans must be a InterceptPlan"):
        pj.intercept.draw_plan(case, case)


def test_a_notebook_shows_the_plan_with_the_verdict(drive):
    figure = pj.show(*drive)
    assert figure.axes[0].get_title(loc="left") == pj.intercept.judge(*drive).sentence()
    assert figure._repr_png_()[1:4] == b"PNG"


def test_only_one_case_of_a_task_with_pictures_is_shown(drive):
    batch = stack(drive[0], drive[0])
    with pytest.raises(ArgumentError, match=r"got a InterceptCase of batch shape \(2,\)"):
        pj.show(batch, drive[1])
    with pytest.raises(ArgumentError, match="got a InterceptPlan$"):
        pj.show(drive[1], drive[1])
