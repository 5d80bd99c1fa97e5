import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.optimise.sensitivity import gradient_at
from planner_jax.plane.reach import Lattice
from planner_jax.plane.target import TurningPath
from planner_jax.task.intercept.plan import make_straight_plan
from planner_jax.task.intercept.searches import Search

BY = ("movers.centre", "walls.centre", "limits.acceleration", "target.vel", "speed")
SMALL = {"pieces": 8, "samples": 3, "searches": (Search(4, lattice=Lattice(layers=22)),)}


def crossing(dtype, wall=0.0):
    target = TurningPath(*(jnp.asarray(x, dtype) for x in ([3.5, 4.4], [0.0, -0.2], 0.0)))
    walls = [np.array([(1.6, 4.0), (2.4, 4.0), (2.0, 5.0)]) + [0.0, wall]]
    movers = {"movers": [[(2.5, 3.1), (3.0, 3.1), (3.0, 3.6), (2.5, 3.6)]]}
    movers |= {"mover_velocities": (0.0, 0.2)}
    return pj.intercept.case(target, 6.0, walls=walls, **movers, curvature=1.0, dtype=dtype)


@functools.cache
def settle(problem):
    return jax.jit(lambda case: problem.guesses(problem.prepare(case), 1)[0])


def move_to_optimum(smooth, case):
    return dataclasses.replace(case, known=settle(smooth)(case))


def optimum_near_straight(planner, case):
    smooth, case = planner.smooth().near(case, make_straight_plan(case, planner.pieces))
    smooth = smooth.problem
    return smooth, move_to_optimum(smooth, case)


@functools.cache
def differentiate(problem, quantity, by, steps):
    options = {"steps": steps, "curvature": "whole"}
    return jax.jit(lambda case: gradient_at(problem, case, case.known, quantity, by, **options))


def move(case, name, by):
    first, _, rest = name.partition(".")
    inner = getattr(case, first)
    new = move(inner, rest, by) if rest else inner + by
    return dataclasses.replace(case, **{first: new})


@pytest.mark.slow
@pytest.mark.parametrize(("meet", "binding"), [("early", "movers"), ("given", "walls")])
def test_gradients_match_differences_of_new_plans(meet, binding, float64):
    planner = pj.intercept.planner(meet=meet, **SMALL)
    smooth, case = optimum_near_straight(planner, crossing(jnp.float64))
    quantity = "time" if meet == "early" else "cost"
    steps = 1 if meet == "early" else 0
    found = differentiate(smooth, quantity, BY, steps)(case)

    @jax.jit
    def value(case):
        point = settle(smooth)(case)
        if meet == "early":
            return smooth.decode(point, smooth.prepare(case)).time
        return smooth.objective(point, smooth.prepare(case)).cost

    assert found.value == pytest.approx(float(value(case)))
    rng = np.random.default_rng(2)
    for name in BY:
        part = functools.reduce(getattr, name.split("."), case)
        direction = jnp.asarray(rng.normal(size=part.shape))
        ends = [value(move(case, name, sign * 1e-4 * direction)) for sign in (1.0, -1.0)]
        difference = (ends[0] - ends[1]) / 2e-4
        along = float(jnp.sum(found.by[name] * direction))
        assert along == pytest.approx(float(difference), rel=1e-3, abs=1e-5), name
    assert np.any(np.abs(found.by[f"{binding}.centre"]) > 1e-2)


@pytest.mark.slow
def test_the_gradient_by_a_distant_obstacle_is_zero(float64):
    planner = pj.intercept.planner(meet="early", **SMALL)
    smooth, case = optimum_near_straight(planner, crossing(jnp.float64, wall=2.0))
    assert not np.any(differentiate(smooth, "time", BY, 1)(case).by["walls.centre"])


@pytest.mark.slow
def test_a_batch_has_gradients_of_its_plans():
    planner = pj.intercept.planner(meet="early", **SMALL)
    cases = pj.intercept.draw(8, "easy", 0)
    found = pj.gradient(planner, cases, of="time", by=["limits.acceleration", "movers.centre"])
    np.testing.assert_allclose(found.value, found.plans.time)
    assert found.by["movers.centre"].shape == cases.movers.centre.shape
    good = pj.are_solved(found.plans)
    by_limit = found.by["limits.acceleration"][good]
    assert good.sum() > 4 and (by_limit < 1e-3).all() and (by_limit < -0.1).any()


@pytest.mark.slow
def test_an_optimal_plan_has_the_same_gradient(float64):
    planner: Any = pj.intercept.planner(meet="early", **SMALL)
    case = crossing(jnp.float64, wall=2.0)

    def time(acceleration):
        limits = dataclasses.replace(case.limits, acceleration=acceleration)
        plan = pj.optimal_plan(planner, dataclasses.replace(case, limits=limits))
        return plan.time, plan

    slope, plan = jax.jit(jax.grad(time, has_aux=True))(case.limits.acceleration)
    assert pj.are_solved(plan)
    smooth, case = planner.settle(case)
    smooth = smooth.problem
    found = differentiate(smooth, "time", BY, 1)(move_to_optimum(smooth, case))
    assert slope == pytest.approx(float(found.by["limits.acceleration"]), rel=1e-3)
