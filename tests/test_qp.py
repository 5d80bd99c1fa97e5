"""Quadratic programs of constant matrices: the optimality conditions, limit cases and failures."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from planner_jax.baselines.intercept.qp import QpConfig, qp_template, solve_qp
from planner_jax.core.protocol import Status

UNKNOWNS, GIVEN, STILL, ROWS, LANES = 12, 2, 1, 24, 64
RNG = np.random.default_rng(0)
ROOT = RNG.normal(size=(UNKNOWNS, UNKNOWNS - 1))  # the cost alone leaves one direction free
HESSIAN = ROOT @ ROOT.T
EQUALITIES = RNG.normal(size=(GIVEN, UNKNOWNS))
ZEROS = RNG.normal(size=(STILL, UNKNOWNS))
MATRIX = RNG.normal(size=(ROWS, UNKNOWNS))
MATRIX[-1] = -MATRIX[0] - MATRIX[1]  # these three cannot all be positive
TEMPLATE = qp_template(HESSIAN, EQUALITIES, MATRIX, ZEROS)
BOTH = np.concatenate([EQUALITIES, ZEROS])
float64 = pytest.mark.usefixtures("float64")


def draw_programs(lanes=LANES):
    point = RNG.normal(size=(lanes, UNKNOWNS))
    point -= point @ ZEROS.T @ ZEROS / np.sum(ZEROS**2)
    value, width = point @ MATRIX.T, RNG.exponential(0.5, (2, lanes, ROWS))
    width[RNG.random(width.shape) < 0.3] = np.inf
    return point @ EQUALITIES.T, value - width[0], value + width[1]


PROGRAMS = draw_programs()
one = jax.jit(lambda *program: solve_qp(TEMPLATE, *program))
many = jax.jit(jax.vmap(lambda *program: solve_qp(TEMPLATE, *program)))


@pytest.fixture(scope="module")
def solved():
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, many(*PROGRAMS))


def test_solutions_meet_the_optimality_conditions(solved):
    right_side, lower, upper = PROGRAMS
    assert (solved.status == Status.CONVERGED).all() and solved.steps.max() > 5
    np.testing.assert_allclose(solved.point @ EQUALITIES.T, right_side, atol=1e-9)
    np.testing.assert_allclose(solved.point @ ZEROS.T, 0.0, atol=1e-9)
    value, pressure = solved.point @ MATRIX.T, solved.multiplier
    assert (value >= lower - 1e-9).all() and (value <= upper + 1e-9).all()
    np.testing.assert_allclose(value[pressure > 0], lower[pressure > 0], atol=1e-8)
    np.testing.assert_allclose(value[pressure < 0], upper[pressure < 0], atol=1e-8)
    slope = solved.point @ HESSIAN - pressure @ MATRIX
    rest = slope - slope @ np.linalg.pinv(BOTH) @ BOTH
    np.testing.assert_allclose(rest, 0.0, atol=1e-8)
    cost = 0.5 * np.einsum("bi,ij,bj->b", solved.point, HESSIAN, solved.point)
    np.testing.assert_allclose(solved.cost, cost, rtol=1e-9)


def test_single_precision_is_as_cheap_to_a_millionth_and_keeps_the_bounds(solved):
    single = many(*(np.float32(each) for each in PROGRAMS))
    assert single.point.dtype == jnp.float32 and (single.status == Status.CONVERGED).all()
    np.testing.assert_allclose(single.cost, solved.cost, rtol=1e-5, atol=1e-5)
    assert np.max(single.violation) < 1e-5


@float64
def test_the_least_square_sum_on_a_line_beside_a_bound_and_a_row_that_the_line_decides():
    template = qp_template(np.eye(2), [[1.0, 1.0]], [[1.0, 0.0], [1.0, 1.0]])
    lowest = lambda low: solve_qp(template, jnp.ones(1), low, jnp.full(2, jnp.inf))  # noqa: E731
    found = jax.jit(jax.vmap(lowest))(np.array([[2.0, -1.0], [2.0, 1.1]]))
    np.testing.assert_allclose(found.point[0], [2.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(found.multiplier[0], [3.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(found.cost[0], 2.5, atol=1e-12)
    assert list(found.status) == [Status.CONVERGED, Status.INFEASIBLE]


@float64
@pytest.mark.parametrize("given", [0, GIVEN], ids=["no equalities", "equalities"])
def test_a_linear_term_is_a_shift_of_the_unknowns(given):
    square = HESSIAN + np.eye(UNKNOWNS)
    linear, allowed = np.arange(UNKNOWNS) - 5.0, np.full(UNKNOWNS, 0.1)
    bounds = np.abs(MATRIX @ allowed) + 0.3
    shift = np.linalg.solve(square, linear)  # x' Q x / 2 + c' x with x = z - shift
    right = EQUALITIES[:given] @ allowed
    with_term = qp_template(square, EQUALITIES[:given], MATRIX, linear=linear)
    without = qp_template(square, EQUALITIES[:given], MATRIX)
    found = solve_qp(with_term, jnp.asarray(right), jnp.asarray(-bounds), jnp.asarray(bounds))
    moved = MATRIX @ shift
    shifted = (right + EQUALITIES[:given] @ shift, moved - bounds, moved + bounds)
    expected = solve_qp(without, *map(jnp.asarray, shifted))
    assert expected.steps > 0 and found.status == expected.status == Status.CONVERGED
    np.testing.assert_allclose(found.point, expected.point - shift, atol=1e-9)
    np.testing.assert_allclose(found.cost, expected.cost - 0.5 * linear @ shift, atol=1e-9)


@float64
def test_multipliers_are_cost_slopes_and_gradients_match_differences(solved):
    k = int(np.argmax(solved.steps))
    given = tuple(each[k] for each in PROGRAMS)
    weights = RNG.normal(size=UNKNOWNS)

    def cost_and_place(given):
        found = solve_qp(TEMPLATE, *given)
        return jnp.stack([found.cost, found.point @ weights])

    slopes = [np.asarray(each) for each in jax.jit(jax.jacrev(cost_and_place))(given)]
    pressure = solved.multiplier[k]
    np.testing.assert_allclose(slopes[1][0], np.maximum(pressure, 0.0), atol=1e-8)
    np.testing.assert_allclose(slopes[2][0], np.minimum(pressure, 0.0), atol=1e-8)
    for _ in range(3):
        direction = [RNG.normal(size=each.shape) for each in given]
        ahead, behind = (
            one(*(each + h * step for each, step in zip(given, direction, strict=True)))
            for h in (1e-6, -1e-6)
        )
        change = [ahead.cost - behind.cost, (ahead.point - behind.point) @ weights]
        expected = np.stack(change) / 2e-6
        actual = sum(slope @ step for slope, step in zip(slopes, direction, strict=True))
        np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-7)


@float64
def test_every_failure_has_its_status_and_leaves_the_other_lanes_alone(solved):
    right_side, lower, upper = (each.copy() for each in PROGRAMS)
    lower[1, 0], upper[1, 0] = 1.0, 0.5
    right_side[2, 0] = np.nan
    lower[3], upper[3] = -np.inf, np.inf
    lower[3, [0, 1, -1]] = 0.1
    found = many(right_side, lower, upper)
    assert list(found.status[1:4]) == [Status.INFEASIBLE, Status.NON_FINITE, Status.INFEASIBLE]
    np.testing.assert_allclose(found.point[4:], solved.point[4:], atol=1e-10)


@float64
def test_too_few_slots_for_active_bounds_differ_from_no_solution(solved):
    k = int(np.argmax(solved.steps))
    solve = jax.jit(lambda *program: solve_qp(TEMPLATE, *program, QpConfig(active=2)))
    assert solve(*(each[k] for each in PROGRAMS)).status == Status.MAX_STEPS


@pytest.mark.parametrize(
    "matrices, message",
    [
        ((HESSIAN, np.ones((2, UNKNOWNS)), MATRIX), "equalities must be independent"),
        ((0.0 * HESSIAN, EQUALITIES, MATRIX), "hessian must be positive definite"),
    ],
)
def test_invalid_matrices_are_rejected(matrices, message):
    with pytest.raises(ValueError, match=message):
        qp_template(*matrices)
