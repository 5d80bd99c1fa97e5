"""Second derivatives of the penalties along a trajectory, against automatic differentiation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.cost.along import integrate_along
from planner_jax.cost.along_curvature import block_and_diagonal, columns_columns, curvature_along
from planner_jax.cost.quadrotor import flight_along
from planner_jax.planning.decided import first_choice
from planner_jax.task.catch.decide import Greedy
from planner_jax.task.catch.default_planner import CatchProblem
from planner_jax.task.hit.default_planner import HitProblem
from planner_jax.trajectory.proportional_minco import proportional_minco
from tests.derivatives import double

MAPS = proportional_minco(4, (0.3, 1.0, 1.0))
CASES = {
    "catch": lambda: pj.catch.draw(1, "throws", 1),
    "extra": lambda: pj.hit.case(
        [[0.0, -4.0, 1.5]],
        [[0.0, 4.0, 4.0]],
        [[0.0, -3.0, 0.0]],
        extras=(pj.KeepOut(centre=np.array([0.0, 0.2, 1.0]), radius=np.array(0.7)),),
    ),
}


@pytest.mark.parametrize(
    ("name", "given"),
    [("catch", 4), ("extra", 0), pytest.param("extra", 4, marks=pytest.mark.slow)],
)
def test_all_derivatives_are_those_of_the_integrated_penalties(name, given):
    with jax.enable_x64(True):
        case = double(pj.take(CASES[name](), 0))
        along = flight_along(MAPS, 2, case, 0.03, 0.1)
        columns = jnp.asarray(np.random.default_rng(0).normal(size=(10, 3)))
        theta, parameters = jnp.log(0.2), (case.gravity, case.limits, case.extras)
        power = np.where(np.arange(10) < given, np.arange(10.0), 0.0)[:given, None]

        def penalty(moving, at):
            head = columns[:given] * jnp.exp(at - theta) ** power
            every = jnp.concatenate([head, moving])
            return integrate_along(along, every[None], jnp.exp(at)[None], parameters)[0][0]

        @jax.jit  # one program: compiled one by one, the operations take much longer
        def compare(moving, at):
            found = curvature_along(along, columns, jnp.exp(at), parameters, given)
            block, diagonal = block_and_diagonal(along, found.at_samples, 4, given)
            mine = (
                *(found.penalty, found.by_columns, found.by_theta),
                columns_columns(along, found.at_samples, given),
                *(block, diagonal, found.columns_theta, found.theta_theta),
            )
            slopes = jax.grad(penalty, argnums=(0, 1))(moving, at)
            hessian = jax.hessian(penalty, argnums=(0, 1))(moving, at)
            exact = (
                *(penalty(moving, at), *slopes, hessian[0][0]),
                hessian[0][0][:4, :, :4],
                jnp.einsum("kaka->ka", hessian[0][0][4:, :, 4:]),
                *(hessian[0][1], hessian[1][1]),
            )
            return mine, exact

        pairs = zip(*compare(columns[given:], theta), strict=True)
        for mine, exact in pairs:
            assert np.abs(exact).max() > 0.0
            np.testing.assert_allclose(mine, exact, rtol=1e-9, atol=1e-11 * np.abs(exact).max())


def greedy_catch(suite, num_targets):
    cases = pj.catch.draw(1, suite, 3, num_targets=num_targets)
    return pj.take(first_choice(Greedy(), cases), 0)


PLANS = {  # problem, cases that share one program, end variables of a segment
    "hit": lambda: (
        HitProblem(proportions=(0.2, 0.5, 1.0, 1.0, 1.0, 1.0)),
        [pj.take(pj.hit.draw(1, seed=1), 0)],
        8,
    ),
    "pairs": lambda: (
        CatchProblem(),
        [greedy_catch("parabola2", 2), greedy_catch("throws", 2)],  # one target is absent
        12,
    ),
    "throw": lambda: (CatchProblem(), [greedy_catch("throws", 1)], 12),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hit", "pairs", "throw"])
def test_second_derivatives_of_a_plan_are_those_of_its_objective(name):
    problem, cases, num_own = PLANS[name]()
    segments = cases[0].num_targets if num_own == 12 else 1
    size = segments * len(problem.scale)
    random = np.random.default_rng(2)
    noise, direction = 0.1 * random.normal(size=size), random.normal(size=size)

    @jax.jit
    def compare(case):
        context = problem.prepare(case)
        point = problem.guesses(context, 1)[0] + noise
        evaluation, gradient, products, preconditioner = problem.curvature_at(point, context)
        objective = lambda x: problem.objective(x, context)  # noqa: E731
        cost_and_slopes = jax.value_and_grad(lambda x: objective(x).cost)
        (cost, slopes), change = jax.linearize(cost_and_slopes, point)
        hessian = jax.vmap(lambda unit: change(unit)[1])(jnp.eye(size))
        damping = 2.0 * jnp.abs(hessian).max()
        solved = preconditioner(damping)(jnp.asarray(direction))
        found = (evaluation.cost, evaluation.violation, gradient, products()(direction))
        return found, (cost, objective(point).violation, slopes), hessian, damping, solved

    for case in cases:
        with jax.enable_x64(True):
            found, exact, hessian, damping, solved = jax.device_get(compare(double(case)))
        for mine, expected in zip(found[:2], exact[:2], strict=True):
            np.testing.assert_allclose(mine, expected, rtol=1e-12)
        for mine, expected in zip(found[2:], (exact[2], hessian @ direction), strict=True):
            greatest = np.abs(expected).max()
            np.testing.assert_allclose(mine, expected, rtol=1e-9, atol=1e-11 * greatest)
        kept = np.diag(np.abs(np.diag(hessian)))
        ends = np.arange(size).reshape(segments, -1)[:, -num_own:].ravel()
        kept[np.ix_(ends, ends)] = hessian[np.ix_(ends, ends)]
        kept += damping * np.eye(size)
        assert np.linalg.eigvalsh(kept)[0] > 0.0
        np.testing.assert_allclose(kept @ solved, direction, rtol=2e-6)
