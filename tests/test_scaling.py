"""Scales of decision variables from a cost's curvature: closed form, independence of units."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.benchmarks.measure_scales import curvature_diagonal, measure_scale
from planner_jax.optimise.settings import Evaluation


@struct.dataclass
class Bowl:
    centre: Array  # (2,)


@dataclasses.dataclass(frozen=True)
class BowlProblem:
    """A problem with a quadratic cost whose second derivatives are 4 and 10^4."""

    scale: tuple[float, ...] = (1.0, 1.0)

    def prepare(self, case):
        return case

    def guesses(self, context, num):
        return jnp.zeros((num, 2))

    def first_guess(self, context):
        return self.guesses(context, 1)[0]

    def objective(self, point, context):
        cost = 0.5 * jnp.sum(residuals(self, point, context) ** 2)
        return Evaluation(cost=cost, violation=-jnp.ones(()))


def residuals(problem, point, context):
    return jnp.array([2.0, 100.0]) * (point * jnp.asarray(problem.scale) - context.centre)


def test_curvature_is_the_diagonal_of_the_gauss_newton_matrix():
    matrix = jnp.array([[1.0, 2.0], [3.0, -1.0], [0.0, 4.0]])
    found = curvature_diagonal(lambda x: matrix @ x, jnp.zeros(2))
    np.testing.assert_allclose(found, np.diag(matrix.T @ matrix), rtol=1e-6)


def test_scale_is_one_over_the_root_of_twice_the_curvature_in_any_unit():
    """`measure_scale` adds the curvatures H at first guess and solution, hence 1 / sqrt(2 H)."""
    cases = Bowl(centre=jnp.array([[1.0, 0.5], [-2.0, 0.1], [0.3, 0.0]]))
    scale = measure_scale(BowlProblem(), cases, residuals, floor=0.0)
    np.testing.assert_allclose(scale, 1.0 / np.sqrt([8.0, 2e4]), rtol=1e-5)
    other = measure_scale(BowlProblem(scale=(30.0, 0.02)), cases, residuals, floor=0.0)
    np.testing.assert_allclose(other, scale, rtol=1e-4)


def test_a_variable_without_curvature_keeps_a_finite_scale():
    flat = lambda *args: residuals(*args) * jnp.array([1.0, 0.0])  # noqa: E731
    cases = Bowl(centre=jnp.ones((2, 2)))
    scale = measure_scale(BowlProblem(), cases, flat, floor=1e-4)
    assert scale[1] == 100.0
