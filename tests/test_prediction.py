"""A ball's predicted path: cubic interpolation between stored states, and its derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from convergence import observed_order
from derivatives import assert_gradient_matches_differences
from serve import DRAG, GRAVITY, assert_close, float64, serve

from planner_jax.ball import prediction
from planner_jax.ball.flight import BallState, drag_free_flight, rk4_step

HORIZON, NUM_NODES = 1.5, 13  # ten intervals of 0.15 s between time 0 and the horizon
RESOLUTION = 0.15

# Compiled functions that tests share. `many_targets` takes an array of times (T,).
predict = jax.jit(functools.partial(prediction.predict_path, num_nodes=NUM_NODES))
many_targets = jax.jit(jax.vmap(prediction.target_at, in_axes=(None, 0)))
step_once = jax.jit(rk4_step)
drag_free = jax.jit(jax.vmap(drag_free_flight, in_axes=(None, 0, None)))


@jax.jit
def target_and_rate(table, time):
    return jax.jvp(lambda t: prediction.target_at(table, t), (time,), (jnp.ones_like(time),))


def path(drag=DRAG, dtype=np.float64):
    return predict(serve(dtype=dtype), dtype(HORIZON), dtype(drag), dtype(GRAVITY))


def table_of(function, resolution, num_nodes=NUM_NODES):
    times = resolution * (np.arange(num_nodes) - 1.0)
    nodes = [function(t) for t in times]
    pos, vel = (np.array(rows) for rows in zip(*nodes, strict=True))
    return prediction.PathTable(pos=pos, vel=vel, resolution=np.asarray(resolution))


def swing(t):
    t = t + 1.0
    pos = np.array([np.sin(t), np.cos(2.0 * t), np.exp(-t)])
    return pos, np.array([np.cos(t), -2.0 * np.sin(2.0 * t), -np.exp(-t)])


@float64
def test_nodes_are_runge_kutta_steps_from_one_before_the_start_to_one_past_the_horizon():
    table = jax.tree.map(np.asarray, path())
    assert table.pos.shape == table.vel.shape == (NUM_NODES, 3)
    np.testing.assert_allclose(prediction.horizon_of(table), HORIZON, rtol=1e-15)
    state = step_once(serve(), -RESOLUTION, DRAG, GRAVITY)
    assert_close((table.pos[0], table.vel[0]), (state.pos, state.vel), rtol=1e-14)
    state = serve()
    for k in range(1, NUM_NODES):
        assert_close((table.pos[k], table.vel[k]), (state.pos, state.vel), rtol=1e-13)
        state = step_once(state, RESOLUTION, DRAG, GRAVITY)


@float64
def test_the_kernel_reproduces_quadratics_and_reads_nodes_exactly():
    u = np.linspace(0.0, 1.0, 11)
    weights = np.asarray(jax.jit(jax.vmap(prediction.convolution_weights))(u))
    nodes = np.arange(-1.0, 3.0)
    for power in range(3):
        np.testing.assert_allclose(weights @ nodes**power, u**power, atol=1e-15)
    np.testing.assert_allclose(weights[[0, -1]], [[0, 1, 0, 0], [0, 0, 1, 0]], atol=1e-15)


@float64
def test_a_drag_free_path_is_exact_at_any_time():
    times = np.linspace(0.0, HORIZON, 41)
    state = many_targets(path(drag=0.0), times)
    assert_close(state, drag_free(serve(), times, GRAVITY), atol=1e-13)


@float64
def test_interpolation_converges_with_order_three():
    """Check position and velocity; the order is given in [Keys1981]."""
    resolutions = np.array([0.08, 0.04, 0.02])
    errors = []
    for resolution in resolutions:
        times = np.linspace(2.0, 7.0, 41) * resolution
        exact = [np.array(x) for x in zip(*map(swing, times), strict=True)]
        state = many_targets(table_of(swing, resolution), times)
        errors.append([np.abs(state.pos - exact[0]).max(), np.abs(state.vel - exact[1]).max()])
    for error in np.transpose(errors):
        assert float(observed_order(resolutions, error)) == pytest.approx(3.0, abs=0.3)


def test_a_path_in_float32_is_right_to_some_micrometres(float64):
    times = np.linspace(-0.2, HORIZON + 0.2, 41)
    single = many_targets(path(dtype=np.float32), times.astype(np.float32))
    assert single.pos.dtype == single.vel.dtype == np.float32
    assert_close(single, many_targets(path(), times), atol=1e-5)


@float64
@pytest.mark.parametrize("node", range(1, 10))
def test_value_and_slope_are_continuous_across_every_node(node):
    table = table_of(swing, RESOLUTION)
    before, at, after = (target_and_rate(table, node * RESOLUTION + e) for e in (-1e-9, 0.0, 1e-9))
    assert_close(before, at, atol=1e-7)
    assert_close(after, at, atol=1e-7)
    pos, vel = swing(node * RESOLUTION)
    assert_close(at[0], BallState(pos=pos, vel=vel), atol=1e-14)


@float64
@pytest.mark.parametrize(("end", "outwards", "later"), [(0.0, -1.0, 0.4), (HORIZON, 1.0, 2.0)])
def test_at_both_ends_the_value_is_continuous_and_the_target_keeps_its_velocity(
    end, outwards, later
):
    table = path()
    inside, at, outside, far = (
        target_and_rate(table, end + outwards * e) for e in (-1e-9, 0.0, 1e-9, later)
    )
    assert_close(inside[0], at[0], atol=1e-7)
    assert_close(outside[0], at[0], atol=1e-7)
    for rate in (inside[1], at[1]):
        np.testing.assert_allclose(rate.pos, outside[1].pos, atol=0.05)
    np.testing.assert_array_equal(outside[1].pos, outside[0].vel)
    np.testing.assert_array_equal(outside[1].vel, 0.0)
    np.testing.assert_allclose(far[0].vel, at[0].vel, rtol=1e-14)
    np.testing.assert_allclose(far[0].pos, at[0].pos + at[0].vel * outwards * later, rtol=1e-14)


def somewhere_on_the_path(point):
    ball, drag, gravity, time = point
    table = prediction.predict_path(ball, HORIZON, drag, gravity, num_nodes=5)
    state = prediction.target_at(table, time)
    return jnp.sum(state.pos * jnp.arange(1.0, 4.0)) + jnp.sum(state.vel**2)


@float64
@pytest.mark.parametrize("position", [0.4, 1.0, 1.99, 2.5])  # in nodes; the last is outside
def test_the_gradient_in_ball_drag_gravity_and_time_matches_finite_differences(position):
    point = (serve(), DRAG, GRAVITY, position * HORIZON / 2.0)
    assert_gradient_matches_differences(somewhere_on_the_path, point, step=1e-6, rtol=1e-6)
