"""One table of pure functions of balls, of targets in the plane, of penalties and of costs.

Each has a value in closed form, which it returns compiled or not, of arrays on the host or on the
device. Its derivatives agree with finite differences, and its results have its arguments' types.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from absl.testing import parameterized

from planner_jax import penalties
from planner_jax.ball import flight
from planner_jax.ball.estimation import (
    EkfModel,
    congruence,
    ekf_init,
    ekf_predict,
    ekf_update,
    solve_definite,
)
from planner_jax.ball.flight import BallState
from planner_jax.ball.linear_drag import linear_drag_flight
from planner_jax.cost import penalty
from planner_jax.plane.target import PolynomialPath, TurningPath
from planner_jax.trajectory.minco import minco

TIME, GRAVITY, DRAG, WIDTH = 0.7, 9.81, 0.3, 0.2
POS, VEL = np.array([0.3, -0.2, 2.0]), np.array([3.0, -4.0, 12.0])  # a speed of 13 m/s
DOWN = np.array([0.0, 0.0, -GRAVITY])
ROOT = np.array([[2.0, 0.3, -0.4], [0.1, 1.5, 0.2], [0.0, -0.3, 1.2]])
SPREAD = np.diag([1.0, 2.0, 3.0])
NODES = np.linspace(0.0, 1.0, 6)
MODEL = EkfModel(drag=0.0, gravity=GRAVITY, acceleration_density=0.0, observation_std=0.1)


class Row(NamedTuple):
    function: Callable
    arguments: tuple
    expected: Any
    order: int = 2  # greatest order of the derivatives that are checked


def turn(pos, vel, rate, time):
    return TurningPath(pos, vel, rate).at(time)


def of_polynomial(coeffs, time):
    return PolynomialPath(coeffs, 0.0 * time).at(time).pos


def after_parabola(a, b):  # of samples of a t - b t^2, which is greatest at t = a / (2 b)
    nodes = NODES.astype(a.dtype)
    return penalty.greatest_by_parabolas(jnp.asarray(a * nodes - b * nodes**2), nodes)


def after_lines(height, slope):  # of a roof whose sides rise and fall by `slope`
    side = jnp.asarray(0.5 - NODES, slope.dtype)
    values, slopes = height - slope * jnp.abs(side), slope * jnp.sign(side)
    return penalty.greatest_by_tangents(values, slopes, jnp.asarray(NODES[1], slope.dtype))


def observe(pos, vel, seen):
    return ekf_update(ekf_init(pos, vel, pos_std=0.1, vel_std=1.0), seen, MODEL).mean


def both(function, *numbers):  # the usual form and the form in SI units, or as printed
    return lambda *arrays: tuple(function(*arrays, *numbers, flag) for flag in (False, True))


def hinges(x):
    smooth = penalties.smooth_hinge(x, WIDTH)
    return smooth, *(penalties.steep_hinge(x, WIDTH, printed) for printed in (True, False))


CORNER = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
DECAY = np.exp(-DRAG * TIME)
FALLING = np.array([2.0, 1.0, -3.0])
ROWS = {
    "acceleration": Row(
        lambda vel: flight.ball_acceleration(vel, DRAG, GRAVITY), (VEL,), DOWN - DRAG * 13.0 * VEL
    ),
    "linear drag": Row(
        lambda pos, vel: linear_drag_flight(BallState(pos, vel), TIME, DRAG, GRAVITY),
        (POS, VEL),
        BallState(
            POS + (VEL - DOWN / DRAG) * (1.0 - DECAY) / DRAG + DOWN / DRAG * TIME,
            DOWN / DRAG + (VEL - DOWN / DRAG) * DECAY,
        ),
    ),
    "no drag": Row(
        lambda pos, vel: flight.rk4_step(BallState(pos, vel), TIME, 0.0, GRAVITY),
        (POS, VEL),
        BallState(POS + VEL * TIME + 0.5 * DOWN * TIME**2, VEL + DOWN * TIME),
    ),
    "impact": Row(
        lambda before, after: flight.solve_impact(before, after, 0.5),
        (FALLING, FALLING + [0.0, 0.0, 9.0]),
        (np.array([0.0, 0.0, 1.0]), (0.5 * -3.0 + 6.0) / 1.5),
    ),
    "congruence": Row(congruence, (ROOT, SPREAD), ROOT @ SPREAD @ ROOT.T),
    "definite": Row(solve_definite, (ROOT @ ROOT.T, ROOT), np.linalg.solve(ROOT @ ROOT.T, ROOT)),
    # Observation and belief have the same deviation, so that the mean is the middle of both.
    "update": Row(observe, (POS, VEL, POS + 0.2), np.append(POS + 0.1, VEL)),
    "turn": Row(
        lambda pos, vel, rate: turn(pos, vel, rate, 0.5 * np.pi / 0.4).pos,
        (np.array([1.0, 2.0]), np.array([0.8, 0.0]), np.array(0.4)),
        np.array([1.0 + 0.8 / 0.4, 2.0 + 0.8 / 0.4]),  # a quarter of a circle of the radius v / w
    ),
    "polynomial": Row(
        of_polynomial,
        (np.array([[1.0, 2.0], [3.0, 4.0], [0.5, 1.0]]), np.array(2.0)),
        np.array([9.0, 14.0]),
    ),
    "below a limit": Row(hinges, (np.array(-0.3),), (0.0, 0.0, 0.0)),
    "above a limit": Row(hinges, (np.array(0.5),), (0.4, 28.133, 28.169)),
    # (mu - x / 2) (x / mu)^3 and x^3 at x = mu / 2
    "at a limit": Row(hinges, (np.array(0.1),), (0.75 * WIDTH / 8.0, 1e-3, 1e-3)),
    "parabola": Row(after_parabola, (np.array(2.6), np.array(2.0)), 2.6**2 / 8.0),
    "roof": Row(after_lines, (np.array(1.4), np.array(3.0)), 1.4),
}
# Excesses and costs of `pj.penalties`, in both forms where there are two.
ROWS |= {
    "speed": Row(both(penalties.speed_excess, 10.0), (VEL,), (0.69, 69.0)),
    "acceleration limit": Row(both(penalties.acceleration_excess, 10.0), (VEL,), (0.69, 69.0)),
    "body rate": Row(  # at hover, jerk / gravity = 4 rad/s
        both(penalties.body_rate_excess, GRAVITY, 2.0),
        (np.zeros(3), np.array([0.0, 4.0 * GRAVITY, 0.0])),
        (3.0, 12.0),
    ),
    "thrust": Row(  # 5 m/s^2
        both(penalties.thrust_excess, GRAVITY, 4.0, 10.0),
        (DOWN + [3.0, 0.0, 4.0],),
        ((1.0 - 25.0 / 16.0, -0.75), (-9.0, -75.0)),
    ),
    "thrust band": Row(
        lambda acc: penalties.thrust_band_excess(acc, GRAVITY, 4.0, 10.0),
        (DOWN + [3.0, 0.0, 4.0],),
        (5.0 - 4.0) * (5.0 - 10.0),
    ),
    "tilt": Row(  # 60 degrees
        lambda acc: penalties.tilt_excess(acc, GRAVITY, np.pi / 6.0),
        (DOWN + [np.sqrt(3.0), 0.0, 1.0],),
        0.5 / (1.0 - np.sqrt(0.75)) - 1.0,
    ),
    "ground": Row(both(penalties.ground_excess, 0.5), (np.array(0.1),), (0.4, 0.24)),
    "trapezoid": Row(
        penalties.trapezoid, (np.array([1.0, 2.0, 4.0]), np.array(0.5)), 0.25 * (0.5 + 2.0 + 2.0)
    ),
    "time": Row(lambda tau: penalties.time_cost(tau, 10.0), (np.log([2.0, 3.0]),), 50.0),
    "apex": Row(
        both(penalties.apex, GRAVITY),
        (POS, VEL),
        (2.0 + 144.0 / (2.0 * GRAVITY), 2.0 + 9.0 / (2.0 * GRAVITY)),
    ),
    "apex limits": Row(
        both(penalties.apex_excess, 2.0, 6.0),
        (np.array(3.0),),
        (np.array([-0.5, -0.5]), np.array([-1.0, -3.0])),
    ),
    "hitting speed": Row(
        both(penalties.hitting_speed_excess),
        (VEL, np.array([2.0, 8.0, 6.0])),
        (np.array([1.25, -0.75, 3.0]), np.array([1.0, -4.0, 6.0])),
    ),
    "net distance": Row(
        lambda pos, axis, ball: penalties.net_distance(pos, axis, ball, 0.5),
        (np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0]), np.array([0.3, 0.4, 1.5])),
        0.5,
    ),
    "net angle": Row(
        lambda axis, vel: penalties.net_angle_excess(axis, vel, np.pi / 3.0),
        (np.array([0.0, 0.0, 1.0]), np.array([3.0, 0.0, -4.0])),
        0.5 - 0.8,
    ),
    "obstacles": Row(
        both(penalties.obstacle_cost, 0.5, 0.1), (np.array([0.1, 0.6, 0.3]),), (20.0, 21.0)
    ),
    "curvature": Row(
        both(penalties.curvature_cost, 0.5, 1.0),
        (CORNER,),
        ((0.5 * np.pi - 0.5) ** 2, 0.5 * np.pi - 0.5),
    ),
    "smoothness": Row(lambda points: penalties.smoothness_cost(points, 2.0), (CORNER,), 0.5),
    # The station t^2 during 2 s, with two pieces.
    "speed energy": Row(
        lambda points: (penalties.speed_energy(points, 2.0), penalties.end_error(points, 3.0)),
        (np.array([[0.0, 0.0, 1.0], [1.0, 2.0, 4.0]]),),
        (8.0, 1.0),
    ),
    "spline": Row(
        lambda points: penalties.spline_cost(penalties.polyline_length(points), 2.0),
        (np.array([[0.0, 0.0], [3.0, 4.0], [3.0, 9.0]]),),
        3.0,
    ),
}
each = parameterized.named_parameters(*((name, name) for name in ROWS))


def as_type(tree, dtype):
    return jax.tree.map(lambda leaf: np.asarray(leaf, dtype), tree)


class TestPureFunctions(chex.TestCase):
    @chex.all_variants(with_pmap=False)
    @each
    def test_a_function_has_its_closed_form_in_every_variant(self, name):
        row = ROWS[name]
        found = self.variant(row.function)(*as_type(row.arguments, np.float32))
        expected = as_type(row.expected, np.float32)
        chex.assert_trees_all_equal_shapes_and_dtypes(found, expected)
        chex.assert_trees_all_close(found, expected, rtol=1e-5, atol=1e-5)

    @each
    def test_results_have_the_types_of_arguments_under_x64(self, name):
        function, arguments, expected, _ = ROWS[name]
        with jax.enable_x64(True):
            for dtype in (np.float32, np.float64):
                found = jax.eval_shape(function, *as_type(arguments, dtype))
                chex.assert_trees_all_equal_shapes_and_dtypes(found, as_type(expected, dtype))

    @each
    @pytest.mark.slow
    def test_derivatives_agree_with_finite_differences(self, name):
        function, arguments, _, order = ROWS[name]
        with jax.enable_x64(True):
            chex.assert_numerical_grads(
                jax.jit(function), as_type(arguments, np.float64), order, atol=1e-5, rtol=1e-5
            )


THREE = np.zeros(3)
# Points at which a length is zero or a limit is met: the ball in the net, free fall, standstill.
EDGES = {
    "net distance": (THREE, THREE, THREE),
    "net angle": (THREE, THREE),
    "body rate": (DOWN, THREE),
    "thrust": (DOWN,),
    "thrust band": (DOWN,),
    "tilt": (DOWN,),
    "curvature": (np.zeros((4, 2)),),
    "spline": (np.zeros((3, 6)),),
    "obstacles": (np.array([0.5, 0.5, 0.5]),),
    "above a limit": (np.array(0.0),),
    "at a limit": (np.array(WIDTH),),
}


@pytest.mark.parametrize("name", EDGES)
def test_gradients_are_finite_where_lengths_vanish_or_limits_are_met(name):
    total = lambda arrays: sum(map(jnp.sum, jax.tree.leaves(ROWS[name].function(*arrays))))  # noqa: E731
    value, slopes = jax.jit(jax.value_and_grad(total))(as_type(EDGES[name], np.float32))
    assert all(np.isfinite(leaf).all() for leaf in (value, *slopes))


def test_penalties_and_their_slopes_are_zero_within_limits():
    straight = np.array([[0.0, 0.0], [1.0, 0.5], [2.0, 1.0]], np.float32)

    @jax.jit
    @jax.value_and_grad
    def total(parts):
        x, distances, points = parts
        cost = penalties.obstacle_cost(distances, 0.5) + penalties.curvature_cost(points, 0.1)
        return sum(hinges(x)) + cost + penalties.smoothness_cost(points)

    value, slopes = total((np.float32(-0.1), np.float32([0.6, 2.0]), straight))
    assert value == 0.0 and not any(map(np.any, slopes))


@pytest.mark.parametrize(
    ("function", "arguments"),
    [
        (solve_definite, (np.eye(2), np.ones((3, 1)))),
        (ekf_predict, (ekf_init(THREE, THREE, pos_std=1.0, vel_std=1.0), np.ones(3), MODEL)),
        (flight.solve_impact, (np.ones((2, 3)), np.zeros((2, 3)), 0.5)),
        (lambda values: penalty.greatest_by_parabolas(values, NODES), (np.ones((6, 1)),)),
        (penalty.greatest_by_tangents, (np.ones(6), np.ones((6, 1)), 0.1)),
        (minco, (np.eye(3), np.eye(3), np.ones((1, 3)), np.ones(1))),
    ],
)
def test_shapes_that_would_broadcast_are_refused(function, arguments):
    with pytest.raises(AssertionError, match="shape|rank"):
        jax.eval_shape(function, *arguments)
