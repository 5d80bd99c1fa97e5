"""Measured scales: a closed form, and the independence of the unit that a task happened to use."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.optimise.evaluation import Evaluation
from planner_jax.optimise.scaling import curvature_diagonal, measure_scale


@struct.dataclass
class Bowl:
    centre: Array  # (2,)


@dataclasses.dataclass(frozen=True)
class BowlPlanner:
    """Quadratic with curvatures 4 and 10^4 in natural units."""

    scale: tuple[float, ...] = (1.0, 1.0)

    def prepare(self, case):
        return case

    def guesses(self, context, num):
        return jnp.zeros((num, 2))

    def residuals(self, point, context):
        return jnp.array([2.0, 100.0]) * (point * jnp.asarray(self.scale) - context.centre)

    def objective(self, point, context):
        cost = 0.5 * jnp.sum(self.residuals(point, context) ** 2)
        return Evaluation(cost=cost, violation=-jnp.ones(()))


def test_curvature_is_the_diagonal_of_the_gauss_newton_matrix():
    matrix = jnp.array([[1.0, 2.0], [3.0, -1.0], [0.0, 4.0]])
    found = curvature_diagonal(lambda x: matrix @ x, jnp.zeros(2))
    np.testing.assert_allclose(found, np.diag(matrix.T @ matrix), rtol=1e-6)


def test_scale_is_one_over_the_root_of_twice_the_curvature():
    """Guess and solution are both counted, so a constant curvature H gives 1 / sqrt(2 H)."""
    cases = Bowl(centre=jnp.array([[1.0, 0.5], [-2.0, 0.1], [0.3, 0.0]]))
    scale = measure_scale(BowlPlanner(), cases, floor=0.0)
    np.testing.assert_allclose(scale, 1.0 / np.sqrt([8.0, 2e4]), rtol=1e-5)


def test_scale_does_not_depend_on_the_one_it_was_measured_with():
    cases = Bowl(centre=jnp.array([[1.0, 0.5], [-2.0, 0.1]]))
    first = measure_scale(BowlPlanner(), cases)
    second = measure_scale(BowlPlanner(scale=(30.0, 0.02)), cases)
    np.testing.assert_allclose(first, second, rtol=1e-4)


def test_a_variable_without_curvature_keeps_a_finite_scale():
    @dataclasses.dataclass(frozen=True)
    class Flat(BowlPlanner):
        def residuals(self, point, context):
            return super().residuals(point, context) * jnp.array([1.0, 0.0])

    scale = measure_scale(Flat(), Bowl(centre=jnp.ones((2, 2))), floor=1e-4)
    assert scale[1] == 100.0
