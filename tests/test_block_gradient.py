import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.core.errors import NotOffered
from planner_jax.core.protocol import is_solved
from planner_jax.task.block.problem.flight import flight_of
from planner_jax.task.block.problem.terms import Weights, contact_terms
from planner_jax.trajectory.polynomial import evaluate
from tests.derivatives import double

SMALL = {"pieces": 5, "points": 16, "samples": 10, "checked": 20}
BY = ("ball.pos", "ball.vel", "angles")


def throws(num):
    return jax.tree.map(np.asarray, pj.block.draw(num, "open", seed=4))


@pytest.mark.parametrize("apart", [0.02, 0.3, 1.0])
def test_slopes_of_the_contact_are_the_gradient_of_its_cost(apart, float64):
    cases = throws(4)
    plans = double(pj.plan(pj.block.planner(**SMALL), cases))
    cases = double(cases)

    @jax.vmap
    def compare(case, plan, away):
        angles = evaluate(plan.motion, plan.contact_time - case.delay)
        point = jnp.append(angles, plan.contact_time) + away

        def terms(point):
            return contact_terms(case, flight_of(case), point[:-1], point[-1], Weights())

        rows, slopes, _ = terms(point)
        return rows @ slopes, jax.grad(lambda x: 0.5 * jnp.sum(terms(x)[0] ** 2))(point)

    own, exact = compare(cases, plans, apart * np.random.default_rng(3).normal(size=(4, 7)))
    np.testing.assert_allclose(own, exact, rtol=1e-9, atol=1e-9 * np.abs(exact).max())


def test_brisk_plans_have_no_gradient():
    with pytest.raises(NotOffered, match="brisk have no gradient: use online"):
        pj.gradient(pj.block.planner("brisk"), throws(2), of="contact_time", by="angles")


def aim(plan):
    """Return the sum of the joints' angles at the start of the last piece [rad]."""
    return jnp.sum(plan.motion.coeffs[..., -1, 0, :], axis=-1)


@pytest.mark.slow
def test_gradients_match_differences_of_new_plans():
    planner, cases = pj.block.planner(**SMALL), throws(6)
    found = pj.gradient(planner, cases, of=aim, by=BY)
    assert is_solved(found.plans.status).all()
    assert found.value.dtype == np.float32 and np.all(found.stationarity < 1e-6)
    with jax.enable_x64(True):
        plans = double(found.plans)
        smooth, started = planner.settle(double(cases), lambda *_: plans)
        long = dataclasses.replace(smooth.problem.solver, settled=20)
        smooth = pj.SearchPlanner(dataclasses.replace(smooth.problem, solver=long))
        rng = np.random.default_rng(1)
        for name in BY:
            first, _, rest = name.partition(".")
            part = getattr(started, first)
            away = rng.normal(size=np.shape(getattr(part, rest) if rest else part)[1:])

            def value(step, part=part, first=first, rest=rest, away=away):
                moved = {rest: getattr(part, rest) + step * away} if rest else None
                inner = dataclasses.replace(part, **moved) if moved else part + step * away
                return aim(pj.plan(smooth, dataclasses.replace(started, **{first: inner})))

            expected = (value(1e-4) - value(-1e-4)) / 2e-4
            slope = np.asarray(found.by[name], np.float64) @ away
            np.testing.assert_allclose(slope, expected, rtol=5e-3, atol=1e-3)
