import jax
import jax.numpy as jnp
import numpy as np
import pytest

from planner_jax.core.protocol import Status
from planner_jax.optimise.implicit import newton_refine, optimal_plan
from planner_jax.optimise.settings import Evaluation
from planner_jax.task.hit.default_planner import HitProblem
from planner_jax.task.hit.suites import generate_serves, to_cases

PLANNER = HitProblem.planner()

MOVES = {
    "drag": lambda s, d: s.replace(drag=s.drag + d),
    "racket_height": lambda s, d: s.replace(racket_height=s.racket_height + d),
    "target": lambda s, d: s.replace(target=s.target.at[0].add(d)),
    "restitution": lambda s, d: s.replace(restitution=s.restitution + d),
    "speed limit": lambda s, d: s.replace(limits=s.limits.replace(speed=s.limits.speed + d)),
    "rate limit": lambda s, d: s.replace(limits=s.limits.replace(body_rate=s.limits.body_rate + d)),
    "start": lambda s, d: s.replace(head_state=s.head_state.at[0, 1].add(d)),
}


def numbers(case):
    plan = optimal_plan(PLANNER, case)
    return jnp.stack([plan.cost, plan.stroke.time, *plan.stroke.ball_pos]), plan.status


@pytest.fixture(scope="module")
def study():
    with jax.enable_x64(True):
        batch = to_cases(generate_serves(8, 3), delay=0.4, limit_scale=0.7, dtype=jnp.float64)

        def solve(case, move, distance):
            return numbers(jax.tree.map(lambda a, b: a + distance * b, case, move))

        along = jax.jit(lambda s, move: jax.jvp(lambda d: solve(s, move, d), (0.0,), (1.0,)))
        return [jax.tree.map(lambda leaf, k=k: leaf[k], batch) for k in (1, 3)], along


@pytest.mark.slow
@pytest.mark.parametrize("name", MOVES)
def test_gradients_match_differences_of_optima(study, name):
    lanes, along = study
    with jax.enable_x64(True):
        for case in lanes:
            unit = jax.tree.map(lambda a, b: a - b, MOVES[name](case, 1.0), case)
            (value, status), (slope, _) = along(case, unit)
            assert status == Status.CONVERGED
            step = 1e-4 if name == "drag" else 1e-3
            ahead = along(MOVES[name](case, step), unit)[0][0]
            behind = along(MOVES[name](case, -step), unit)[0][0]
            numeric = (ahead - behind) / (2 * step)
            scale = np.maximum(np.abs(value), [1e-12, 1.0, 1.0, 1.0, 1.0])
            np.testing.assert_allclose(slope / scale, numeric / scale, rtol=2e-3, atol=2e-4)


def test_newton_finds_the_minimum_of_a_curved_valley_and_stands_still_at_a_minimum(float64):
    def objective(x):
        cost = 100.0 * (x[1] - x[0] ** 2) ** 2 + (1.0 - x[0]) ** 2
        return Evaluation(cost=cost, violation=-jnp.ones(()))

    refine = jax.jit(lambda x: newton_refine(objective, x, max_steps=60, stationarity=1e-12))
    point, slope = refine(np.array([0.7, 0.5]))
    np.testing.assert_allclose(point, 1.0, rtol=1e-9)
    assert slope <= 1e-12
    point, slope = refine(np.ones(2))
    assert (point == 1.0).all() and slope == 0.0
