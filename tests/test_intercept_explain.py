"""Relaxations that an unsolved interception needs: `pj.intercept.relaxation`."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from planners import ONE_SEARCH

import planner_jax as pj

KNOTS, TIME = 17, 4.0
LIMITS = ("speed", "acceleration", "jerk", "lateral_acceleration", "curvature", "steering_rate")
WALL = [[2.0, 3.5], [3.0, 3.5], [3.0, 3.8], [2.0, 3.8]]


def drive(least=0.6):
    """Return the plan of a car that speeds up, and then turns to the left."""
    ramp = np.linspace(0.0, 1.0, KNOTS)
    return pj.intercept.InterceptPlan(
        cost=jnp.zeros(()),
        violation=jnp.ones(()),
        iterations=jnp.zeros((), jnp.int32),
        status=jnp.full((), pj.Status.INFEASIBLE, jnp.int32),
        start=jnp.array([0.8, 4.0, 0.0]),
        time=jnp.array(TIME),
        speed=jnp.asarray(least + 0.6 * ramp, jnp.float32),
        curvature=jnp.asarray(0.9 * ramp**2, jnp.float32),
        origin=jnp.zeros(2),
        meeting=jnp.zeros(2),
    )


def case_of(**numbers):
    given = {"target": (3.8, 5.3), "tolerance": 2.0, "initial_speed": 0.6, "initial_curvature": 0.0}
    given |= dict.fromkeys(LIMITS, np.inf) | numbers
    still = pj.TurningPath(jnp.array(given.pop("target")), jnp.zeros(2), jnp.array(0.0))
    return pj.intercept.case(still, TIME, **given)


def relax(*given):
    found = pj.intercept.relaxation(*given)
    assert found is not None
    return found


PEAKS = pj.intercept.judge(case_of(), drive())
TIGHT = {
    **{name: {name: 0.96 * float(vars(PEAKS)[f"max_{name}"])} for name in LIMITS},
    "tolerance": {"tolerance": 0.9 * float(PEAKS.miss)},
    "heading_tolerance": {"end_heading": 3.0},
    "end_speed": {"end_speed": (0.0, 1.1)},
    "earliest": {"earliest": 4.5},
    "time": {"time": 3.9},
    "map": {"lower": (1.0, 0.0)},
    "margin": {"walls": [WALL], "margin": 0.1},
    "body": {"walls": [[[2.0, 3.5], [3.0, 3.5], [3.0, 3.9], [2.0, 3.9]]]},
}


def tighten(name):
    case = case_of(**{key: value for key, value in TIGHT[name].items() if key != "time"})
    return dataclasses.replace(case, time=jnp.array(3.9)) if name == "time" else case


@pytest.mark.parametrize("name", TIGHT)
def test_a_plan_is_accepted_for_the_relaxed_case_whose_other_limits_stay(name):
    case, plan = tighten(name), drive()
    assert not pj.intercept.judge(case, plan).success
    found = relax(case, plan)
    assert list(found.changes) == [name] and found.changes[name] > 0.0
    assert pj.intercept.judge(found.case, plan).success
    if name in LIMITS:
        assert f"{name} relaxed by " in found.sentence() and "(4.17%)" in found.sentence()
        assert vars(found.case.limits)[name] == pytest.approx(vars(PEAKS)[f"max_{name}"], rel=1e-6)
    # Half of the relaxation is not enough.
    mean = lambda a, b: np.where(a == b, a, 0.5 * np.asarray(a) + 0.5 * np.asarray(b))  # noqa: E731
    with np.errstate(invalid="ignore"):
        between = jax.tree.map(mean, case, found.case)
    assert not pj.intercept.judge(between, plan).success


def test_reverse_driving_without_a_reverse_gear_needs_one():
    plan = drive(least=-0.2)
    case = dataclasses.replace(
        case_of(), speed=plan.speed[0], target=case_of(target=(1.0, 4.0)).target
    )
    found = relax(case, plan)
    assert found.changes == {"reverse_speed": pytest.approx(0.2)}
    assert found.sentence().endswith("reverse_speed relaxed by 0.2 m/s")
    assert pj.intercept.judge(found.case, plan).success


def test_nothing_is_relaxed_for_a_success_nor_for_a_plan_that_no_limit_admits():
    assert not relax(case_of(), drive()).changes
    assert pj.intercept.relaxation(case_of(start=(0.9, 4.0, 0.0)), drive()) is None
    across = [[2.0, 3.0], [3.0, 3.0], [3.0, 5.0], [2.0, 5.0]]
    assert pj.intercept.relaxation(case_of(walls=[across]), drive()) is None
    with pytest.raises(ValueError, match="case must be one case"):
        pj.intercept.relaxation(pj.intercept.draw(2), drive())


def test_all_broken_limits_are_relaxed_together_and_each_is_needed():
    given = {
        key: value
        for name in (*LIMITS, "tolerance", "margin")
        for key, value in TIGHT[name].items()
    }
    case, plan = case_of(**given), drive()
    found = relax(case, plan)
    assert set(found.changes) == {*LIMITS, "tolerance", "margin"}
    assert pj.intercept.judge(found.case, plan).success
    for name in found.changes:
        if name in LIMITS:
            limits = dataclasses.replace(found.case.limits, **{name: vars(case.limits)[name]})
            less = dataclasses.replace(found.case, limits=limits)
        else:
            less = dataclasses.replace(found.case, **{name: getattr(case, name)})
        failed = str(pj.intercept.judge(less, plan).failed_limit)
        expected = {"tolerance": "meeting", "margin": "wall"}.get(name, name.replace("_", " "))
        assert failed == expected
    assert found.sentence().count(" relaxed by ") == len(found.changes)


@pytest.mark.slow
def test_a_planner_reduces_the_relaxation():
    target = pj.TurningPath(jnp.array([6.0, 4.3]), jnp.zeros(2), jnp.array(0.0))
    planner = pj.intercept.planner(searches=ONE_SEARCH)
    plan = pj.plan(planner, pj.intercept.case(target, 4.62))
    case = pj.intercept.case(target, 4.62, acceleration=0.37)
    assert pj.are_solved(plan) and not pj.intercept.judge(case, plan).success
    found = relax(case, plan)
    less = relax(case, plan, planner)
    assert all(amount < found.changes[name] for name, amount in less.changes.items())
    assert pj.intercept.judge(less.case, less.plan).success
