import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from convergence import observed_order
from derivatives import assert_gradient_matches_differences
from scipy.integrate import solve_ivp
from serve import DRAG, GRAVITY, LINEAR_DRAG, SERVE_POS, SERVE_VEL, assert_close, float64, pick
from serve import serve as ball

from planner_jax.ball import flight
from planner_jax.ball.flight import BallState, fly
from planner_jax.ball.linear_drag import linear_drag_flight
from planner_jax.perception.drag import specific_energy

WEIGHT = np.array([0.0, 0.0, -GRAVITY])

step_once = jax.jit(flight.rk4_step)
fly_eight_steps = jax.jit(functools.partial(fly, num_steps=8))
drag_free = jax.jit(flight.drag_free_flight)
linear_drag = jax.jit(linear_drag_flight)
apex_and_slope = jax.jit(jax.value_and_grad(flight.drag_free_apex))
fall = functools.partial(jax.value_and_grad, argnums=(0, 1, 2), has_aux=True)
fall_and_slope = jax.jit(fall(flight.drag_free_fall_time))


@jax.jit
def linear_drag_and_rates(ball, duration, drag):
    fly_on = functools.partial(linear_drag_flight, gravity=GRAVITY)
    state, in_time = jax.jvp(lambda t: fly_on(ball, t, drag), (duration,), (jnp.ones(()),))
    _, in_drag = jax.jvp(lambda k: fly_on(ball, duration, k), (drag,), (jnp.ones(3),))
    return state, in_time, in_drag


def fly_steps(start, duration, drag=DRAG, *, num=32):
    for _ in range(num):
        start = step_once(start, duration / num, drag, GRAVITY)
    return start


def integrate(acceleration, duration):
    """Integrate the serve's flight by SciPy with a tolerance of 1e-13; return the final state."""
    change = lambda _, state: np.concatenate([state[3:], acceleration(state[3:])])  # noqa: E731
    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13}
    states = solve_ivp(change, (0.0, duration), np.array(SERVE_POS + SERVE_VEL), **options).y
    return BallState(pos=states[:3, -1], vel=states[3:, -1])


def with_quadratic_drag(vel):
    return WEIGHT - DRAG * np.linalg.norm(vel) * vel


def test_a_ball_feels_its_weight_and_a_drag_against_its_velocity():

    def accelerate(vel):
        acceleration = flight.ball_acceleration(vel, 0.1, GRAVITY)
        return acceleration, acceleration

    moving = np.array([3.0, 4.0, 12.0], np.float32)
    both = jax.jit(jax.vmap(jax.jacfwd(accelerate, has_aux=True)))
    jacobian, acceleration = both(np.stack([moving, 0.0 * moving]))
    np.testing.assert_allclose(acceleration, [WEIGHT - 1.3 * moving, WEIGHT], rtol=1e-6)
    np.testing.assert_array_equal(jacobian[1], np.zeros((3, 3)))  # not NaN at rest


@float64
def test_one_runge_kutta_step_without_drag_is_the_closed_form():
    after = step_once(ball(), 1.3, 0.0, GRAVITY)
    assert_close(after, drag_free(ball(), 1.3, GRAVITY), rtol=1e-14)


@float64
def test_runge_kutta_converges_with_order_four_to_the_flight_that_scipy_finds():
    exact = integrate(with_quadratic_drag, 1.8)
    nums = [4, 8, 16, 32]
    errors = [np.linalg.norm(fly_steps(ball(), 1.8, num=n).pos - exact.pos) for n in nums]
    assert float(observed_order(1.8 / np.array(nums), errors)) == pytest.approx(4.0, abs=0.2)
    assert errors[-1] < 1e-6


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_flight_is_its_steps_and_its_path_holds_the_ball_after_each(float64, dtype):
    final, path = fly_eight_steps(ball(dtype=dtype), 1.6, DRAG, GRAVITY)
    assert path.pos.dtype == path.vel.dtype == dtype
    tolerance = 8.0 * np.finfo(dtype).eps
    final, path = jax.tree.map(np.asarray, (final, path))
    state = ball(dtype=dtype)
    for k in range(8):
        state = step_once(state, 0.2, DRAG, GRAVITY)
        assert_close(pick(path, k), state, rtol=tolerance, atol=tolerance)
    assert_close(pick(path, 7), final, rtol=0.0)


def test_a_flight_in_float32_is_right_to_some_micrometres():
    exact = integrate(with_quadratic_drag, 1.8)
    np.testing.assert_allclose(fly_steps(ball(dtype=np.float32), 1.8).pos, exact.pos, atol=5e-6)


@float64
def test_a_negative_duration_flies_back():
    there, _ = fly_eight_steps(ball(), 0.8, DRAG, GRAVITY)
    back, _ = fly_eight_steps(there, -0.8, DRAG, GRAVITY)
    assert_close(back, ball(), atol=1e-5)


@float64
def test_energy_decays_with_drag_and_is_kept_without():
    for drag, kept in ((0.0, True), (DRAG, False)):
        _, path = fly_eight_steps(ball(), 1.6, drag, GRAVITY)
        balls = zip(*map(np.asarray, (path.pos, path.vel)), strict=True)
        energy = np.array([specific_energy(BallState(*each), GRAVITY) for each in balls])
        assert np.ptp(energy) < 1e-12 * energy[0] if kept else np.all(np.diff(energy) < 0.0)


@float64
def test_flight_gradient_matches_finite_differences():

    def landing(args):
        final, _ = fly(*args, num_steps=2)
        return jnp.sum(final.pos * jnp.arange(1.0, 4.0)) + jnp.sum(final.vel**2)

    assert_gradient_matches_differences(landing, (ball(), 1.1, DRAG, GRAVITY))


@float64
def test_linear_drag_is_the_flight_that_scipy_finds():
    exact = integrate(lambda vel: WEIGHT - LINEAR_DRAG * vel, 1.6)
    assert_close(linear_drag(ball(), 1.6, LINEAR_DRAG, GRAVITY), exact, atol=1e-11)


@float64
def test_linear_drag_goes_over_into_the_drag_free_flight():
    free = drag_free(ball(), 1.6, GRAVITY)
    assert_close(linear_drag(ball(), 1.6, np.zeros(3), GRAVITY), free, rtol=1e-15)
    drags = np.array([1e-2, 1e-4, 1e-6])
    ends = [linear_drag(ball(), 1.6, np.full(3, k), GRAVITY).pos for k in drags]
    errors = [np.linalg.norm(end - free.pos) for end in ends]
    assert float(observed_order(drags, errors)) == pytest.approx(1.0, abs=0.01)


@float64
def test_the_slope_in_linear_drag_at_no_drag_is_the_first_term_of_its_series():
    """Differentiate s = s_0 + v t + g t^2/2 - K (v t^2/2 + g t^3/6) + ... by the drag K."""
    t = 1.6
    _, _, slope = linear_drag_and_rates(ball(), t, np.zeros(3))
    expected = -(ball().vel * t**2 / 2.0 + WEIGHT * t**3 / 6.0)
    np.testing.assert_allclose(slope.pos, expected, rtol=1e-14)


@float64
@pytest.mark.parametrize("product", [0.5, -0.5])  # K t at which the formula changes
def test_linear_drag_and_its_slopes_have_no_jump_where_the_formula_changes(product):
    below, above = (
        linear_drag_and_rates(ball(), 1.0, np.full(3, product * (1.0 + e))) for e in (-1e-13, 1e-13)
    )
    assert_close(below, above, rtol=1e-11)


def test_linear_drag_is_exact_to_rounding_in_float32_however_small_it_is():
    for drag in (1e-6, 1e-3, 0.3, 0.32, 3.0):
        exact = integrate(lambda vel, drag=drag: WEIGHT - drag * vel, 1.6)
        state = linear_drag(ball(dtype=np.float32), 1.6, np.full(3, drag, np.float32), GRAVITY)
        assert state.pos.dtype == np.float32
        assert_close(state, exact, atol=5e-6)


@float64
def test_a_long_flight_ends_at_the_terminal_velocity():
    final = fly_steps(ball(), 10.0, 0.3)
    np.testing.assert_allclose(final.vel, [0.0, 0.0, -np.sqrt(GRAVITY / 0.3)], atol=1e-6)
    final = linear_drag(ball(), 10.0, np.full(3, 20.0), GRAVITY)
    np.testing.assert_allclose(final.vel, WEIGHT / 20.0, atol=1e-12)


@float64
def test_the_apex_is_the_highest_point_of_the_path():
    times = np.linspace(0.0, 2.0, 20001)
    heights = SERVE_POS[2] + SERVE_VEL[2] * times - 0.5 * GRAVITY * times**2
    apex, slope = apex_and_slope(ball(), GRAVITY)
    assert float(apex) == pytest.approx(heights.max(), abs=1e-7)
    np.testing.assert_allclose(slope.vel, [0.0, 0.0, SERVE_VEL[2] / GRAVITY], rtol=1e-14)


@float64
@pytest.mark.parametrize("vz", [-3.0, 0.0, 1e-9])
def test_a_falling_ball_is_highest_now_and_the_apex_has_no_kink(vz):
    apex, slope = apex_and_slope(ball(vel=(1.0, 0.0, vz)), GRAVITY)
    assert apex == SERVE_POS[2]
    np.testing.assert_allclose(slope.vel, 0.0, atol=1e-9)


@float64
@pytest.mark.parametrize("height", [0.0, 2.0, 3.5])
def test_a_ball_falls_through_the_plane_at_the_fall_time(height):
    (time, reached), slopes = fall_and_slope(ball(), height, GRAVITY)
    there = drag_free(ball(), float(time), GRAVITY)
    assert reached and there.vel[2] < 0.0
    np.testing.assert_allclose(there.pos[2], height, atol=1e-12)
    np.testing.assert_allclose(slopes[1], 1.0 / there.vel[2], rtol=1e-12)


@pytest.mark.parametrize(("height", "vz"), [(2.25, 1.0), (2.25, 2.0), (2.25, -6.0), (2.0, -6.0)])
def test_a_plane_that_is_not_reached_is_flagged_with_a_finite_gradient(height, vz):
    start = ball(vel=(0.0, 0.0, vz), dtype=np.float32)
    (time, reached), slopes = fall_and_slope(start, height, 8.0)
    assert not reached and time == 0.0
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slopes))


@float64
def test_batch_equals_loop():
    durations, drags = np.array([1.8, 0.5, -0.2]), np.array([DRAG, 0.0, 0.3])
    # The balls are a served ball, one at rest, and a falling one.
    positions = np.array([SERVE_POS, (0.0, 0.0, 0.0), (-1.0, 2.0, 0.3)])
    balls = BallState(positions, np.array([SERVE_VEL, (0.0, 0.0, 0.0), (0.0, -20.0, 1.0)]))
    linear_drags = drags[:, None] * LINEAR_DRAG
    axes = (0, 0, 0, None)
    many = jax.jit(jax.vmap(functools.partial(fly, num_steps=8), axes))
    many_linear = jax.jit(jax.vmap(linear_drag_flight, axes))
    together = many(balls, durations, drags, GRAVITY)
    together = together, many_linear(balls, durations, linear_drags, GRAVITY)
    for k in range(3):
        alone = fly_eight_steps(pick(balls, k), float(durations[k]), float(drags[k]), GRAVITY)
        one = linear_drag(pick(balls, k), float(durations[k]), linear_drags[k], GRAVITY)
        assert_close(pick(together, k), (alone, one), rtol=1e-13)
