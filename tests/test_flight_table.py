"""Tables of a ball's flight: right to 0.1 mm for weak and strong drag, and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import assert_gradient_matches_differences
from scipy.integrate import solve_ivp
from serve import GRAVITY, assert_close, float64

import planner_jax as pj
from planner_jax.ball import flight_table as tables
from planner_jax.ball.flight import BallState, drag_free_flight
from planner_jax.ball.flight_kernel import table_kernel
from planner_jax.ball.spin import SpinningBall, Surroundings, tabulate_spin

ERROR = 1e-4  # [m], greatest error of a table
SHUTTLE = BallState(np.array([4.0, 0.5, 2.0]), np.array([-28.0, 0.0, 24.0])), 0.22
HARDEST = BallState(np.array([4.0, 0.5, 2.0]), np.array([-28.0, 0.0, 24.0])), 0.5
SLOW = BallState(np.array([0.0, 0.0, 3.0]), np.array([0.3, 0.0, 0.0])), 1.0
SMASH = BallState(np.array([0.0, 1.0, 2.5]), np.array([40.0, 5.0, -6.0])), 0.3


@jax.jit
def tabulate(ball, drag):
    horizon = tables.longest_flight(ball, drag, GRAVITY)
    return tables.tabulate_flight(ball, horizon, drag, jnp.asarray(GRAVITY, drag.dtype))


read = jax.jit(jax.vmap(lambda table, time: table.at(time), (None, 0)))


def integrate(ball, drag, times, lift=(0.0, 0.0, 0.0)):
    def rate(_, state):
        vel = state[3:]
        acc = -drag * np.linalg.norm(vel) * vel - [0.0, 0.0, GRAVITY] + np.cross(lift, vel)
        return np.append(vel, acc)

    start, options = np.append(ball.pos, ball.vel), {"rtol": 1e-11, "atol": 1e-11}
    return solve_ivp(rate, (0.0, times[-1]), start, "DOP853", times, **options).y.T


@float64
@pytest.mark.parametrize(
    ("ball", "drag", "dtype"),
    [(*each, np.float64) for each in (SHUTTLE, HARDEST, SLOW, SMASH)] + [(*HARDEST, np.float32)],
)
def test_a_table_is_right_to_a_tenth_of_a_millimetre_until_the_ball_has_landed(ball, drag, dtype):
    assert tables.is_resolved(ball, np.asarray(drag), GRAVITY)
    table = tabulate(jax.tree.map(dtype, ball), dtype(drag))
    end = float(table.times[-1])
    times = end * np.expm1(np.linspace(0.0, 4.0, 301)) / np.expm1(4.0)
    exact, found = integrate(ball, drag, times), read(table, times.astype(dtype))
    np.testing.assert_allclose(found.pos, exact[:, :3], atol=ERROR, rtol=0.0)
    np.testing.assert_allclose(found.vel, exact[:, 3:], atol=5e-3, rtol=0.0)
    assert exact[-1, 2] < 0.0


@float64
def test_a_table_without_drag_is_the_parabola_up_to_a_tenth_after_landing():
    ball = BallState(np.array([1.0, 2.0, 1.5]), np.array([-3.0, 0.5, 4.0]))
    table = tabulate(ball, np.asarray(0.0))
    fall = (4.0 + np.sqrt(16.0 + 2.0 * GRAVITY * 1.5)) / GRAVITY
    assert float(table.times[-1]) == pytest.approx(1.1 * fall, rel=1e-5)
    times = np.linspace(0.0, 1.1 * fall, 77)
    exact = jax.vmap(drag_free_flight, (None, 0, None))(ball, times, GRAVITY)
    assert_close(read(table, times), exact, atol=1e-12)


@float64
@pytest.mark.parametrize("drag", [0.05, 0.5, 1.5])
def test_a_vertical_fall_reaches_its_terminal_speed_by_the_hyperbolic_tangent(drag):
    table = tabulate(BallState(np.array([0.0, 0.0, 9.0]), np.zeros(3)), np.asarray(drag))
    terminal, times = np.sqrt(GRAVITY / drag), np.linspace(0.0, float(table.times[-1]), 60)
    found = read(table, times)
    speed = terminal * np.tanh(GRAVITY * times / terminal)
    height = 9.0 - np.log(np.cosh(GRAVITY * times / terminal)) / drag
    np.testing.assert_allclose(-found.vel[:, 2], speed, atol=1e-3)
    np.testing.assert_allclose(found.pos[:, 2], height, atol=ERROR)
    assert height[-1] < 0.0


@float64
def test_a_table_ends_after_the_landing_of_random_balls():
    random, num = np.random.default_rng(2), 300
    drag, speed = 10.0 ** random.uniform(-3, 0.5, num), 10.0 ** random.uniform(-1, 1.8, num)
    vel = random.normal(size=(num, 3))
    vel *= speed[:, None] / np.linalg.norm(vel, axis=1, keepdims=True)
    pos = np.zeros((num, 3))
    pos[:, 2] = 10.0 ** random.uniform(-2, 1, num)
    ends = tables.longest_flight(BallState(pos, vel), drag, GRAVITY)
    state = np.concatenate([pos, vel], axis=1)
    lowest = pos[:, 2].copy()
    shares = np.expm1(np.linspace(0.0, 6.0, 601)) / np.expm1(6.0)

    def acc(vel):
        return -drag[:, None] * np.linalg.norm(vel, axis=1)[:, None] * vel - [0, 0, GRAVITY]

    for step in np.diff(shares)[:, None, None] * ends[:, None]:
        middle = state[:, 3:] + 0.5 * step * acc(state[:, 3:])
        state = state + step * np.concatenate([middle, acc(middle)], axis=1)
        lowest = np.minimum(lowest, state[:, 2])
    assert (lowest < 0.0).all()


@float64
def test_a_table_of_a_spinning_ball_is_right_to_a_tenth_of_a_millimetre():
    (ball, drag), lift, zero = SHUTTLE, np.array([0.5, 1.5, -1.0]), np.zeros(())
    air = Surroundings(np.asarray(GRAVITY), np.zeros(3), zero, zero, zero, zero, zero)
    spinning = SpinningBall(ball.pos, ball.vel, np.asarray(drag), lift)
    table = jax.jit(tabulate_spin, static_argnums=(3, 4))(spinning, 2.0, air, 36, 3)
    times = np.linspace(0.0, 2.0, 201)
    exact, found = integrate(ball, drag, times, lift), read(table, times)
    np.testing.assert_allclose(found.pos, exact[:, :3], atol=ERROR)


@float64
def test_the_gradient_of_a_table_matches_finite_differences():
    ball, drag = SHUTTLE
    horizon = tables.longest_flight(ball, np.asarray(drag), GRAVITY)

    def somewhere(point):
        ball, drag, gravity, time = point
        table = tables.tabulate_flight(ball, jnp.asarray(horizon), drag, gravity)
        state = table.at(time)
        return jnp.sum(state.pos * jnp.arange(1.0, 4.0)) + jnp.sum(state.vel**2)

    point = ball, np.asarray(drag), np.asarray(GRAVITY), np.asarray(0.83)
    # The times of a table change with ball and drag, and its derivatives take them as constants.
    assert_gradient_matches_differences(somewhere, point, step=1e-5, rtol=1e-4)


@float64
def test_the_highest_point_is_that_of_the_flight():
    for ball, drag in (SHUTTLE, SLOW, SMASH):
        table = tabulate(ball, np.asarray(drag))
        heights = integrate(ball, drag, np.linspace(0.0, float(table.times[-1]), 4001))[:, 2]
        assert float(jax.jit(tables.FlightTable.highest)(table)) == pytest.approx(
            heights.max(), abs=ERROR
        )


def test_a_ball_that_no_table_resolves_is_refused_in_one_line_and_by_a_status():
    with pytest.raises(pj.CaseError, match="^drag must be less for a flight as long and fast"):
        pj.hit.case((0, 0, 2), (-28, 0, 24), (3, 0, 0), drag=30.0)
    with pytest.raises(pj.CaseError, match="^drag must be less"):
        pj.hit.case((0, 0, 2), (-7, 0, 6), (3, 0, 0), spin=(0.0, 9e3, 0.0), ball_radius=0.2)


def kernel_arguments(lanes=32, nodes=12):
    random = np.random.default_rng(5)
    pos, vel = random.uniform(-3.0, 3.0, (2, 3, lanes))
    vel[:, 3] = 0.0  # a ball at rest
    times = np.cumsum(random.uniform(0.01, 0.1, (nodes, lanes)), axis=0)
    args = pos, vel, times - times[0], random.uniform(0.0, 0.3, lanes), np.full(lanes, 9.8)
    return [jnp.asarray(x.astype(np.float32), jnp.float32) for x in args]


def nodes_of_lane(pos, vel, times, drag, gravity):
    step = lambda ball, h: tables.rk4_step(ball, h, drag, gravity)  # noqa: E731
    nodes = tables.integrate_at(step, BallState(pos, vel), times, 2)
    return nodes.pos, nodes.vel


def test_the_kernel_gives_the_same_table():
    args = kernel_arguments()
    found = table_kernel(12, 2, interpret=True)(jax.tree.structure(args), args)
    expected = jax.vmap(nodes_of_lane, in_axes=-1, out_axes=-1)(*args)
    assert_close(tuple(found), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.slow
def test_the_kernel_gives_the_same_derivatives_of_the_table():
    args, moving = kernel_arguments(nodes=6), (1, 3)
    args[1] = args[1].at[:, 3].set(1.0)
    found = table_kernel(6, 2, moving, interpret=True)(None, args)
    slopes = jax.vmap(jax.jacrev(nodes_of_lane, argnums=moving), in_axes=-1, out_axes=-1)
    expected = jax.tree.leaves(jax.jit(slopes)(*args))
    assert_close(list(found), expected, rtol=1e-4, atol=1e-5)
