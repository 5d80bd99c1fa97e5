"""Paths of targets in space: balls, swings, tables of positions, and classes of the user."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import assert_gradient_matches_differences
from flax import struct
from jax import Array
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline, CubicSpline

import planner_jax as pj

HORIZON = 2.0
GRAVITY = 9.81
POS, VEL = np.array([3.0, -0.2, 2.5]), np.array([-2.5, 0.3, 4.0])
TIMES = np.array([0.0, 0.02, 0.3, 0.9, 1.6])


def ball_path(drag):
    ball = pj.BallState(jnp.asarray(POS), jnp.asarray(VEL))
    return pj.BallPath(ball, jnp.asarray(drag), jnp.asarray(GRAVITY))


def harmonic_path():
    return pj.HarmonicPath(*map(jnp.asarray, (POS, VEL, [0.0, 0.3, 0.8], 2.1, 0.7)))


@jax.jit
def states(path, times):
    return jax.vmap(path.at)(times)


def test_a_ball_obeys_its_equation_of_motion(float64):
    drag = np.array([0.5, 0.0, 3.0])

    def rate(_, state):
        return np.concatenate([state[3:], -drag * state[3:] - [0.0, 0.0, GRAVITY]])

    start = np.concatenate([POS, VEL])
    flown = solve_ivp(rate, (0.0, TIMES[-1]), start, t_eval=TIMES, rtol=1e-10, atol=1e-12).y.T
    found = states(ball_path(drag), TIMES)
    np.testing.assert_allclose(found.pos, flown[:, :3], atol=1e-8)
    np.testing.assert_allclose(found.vel, flown[:, 3:], atol=1e-8)


@pytest.mark.parametrize("drag", [0.0, 1e-9])
def test_a_ball_without_drag_flies_a_parabola(float64, drag):
    found, t = states(ball_path(np.full(3, drag)), TIMES), TIMES[:, None]
    pull = np.array([0.0, 0.0, -GRAVITY])
    np.testing.assert_allclose(found.pos, POS + VEL * t + 0.5 * pull * t**2, atol=1e-7)
    np.testing.assert_allclose(found.vel, VEL + pull * t, atol=1e-7)


def test_a_swing_returns_after_a_period_except_for_its_drift(float64):
    path, period = harmonic_path(), 2.0 * np.pi / 2.1
    now, later = states(path, TIMES), states(path, TIMES + period)
    np.testing.assert_allclose(later.pos, now.pos + VEL[None] * period, atol=1e-12)
    np.testing.assert_allclose(later.vel, now.vel, atol=1e-12)
    np.testing.assert_allclose(now.pos[0], POS + np.sin(0.7) * path.amplitude, atol=1e-12)


PATHS = {
    "drag": lambda: ball_path(np.array([0.5, 0.0, 3.0])),
    "no drag": lambda: ball_path(np.zeros(3)),
    "harmonic": harmonic_path,
}


@pytest.mark.parametrize("name", PATHS)
def test_the_velocity_is_the_derivative_of_the_position(float64, name):
    path = PATHS[name]()
    by_time = jax.jit(jax.vmap(jax.jacfwd(lambda time: path.at(time).pos)))(TIMES)
    np.testing.assert_allclose(by_time, states(path, TIMES).vel, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", ["no drag", "harmonic"])
def test_gradients_by_every_leaf_are_finite_at_time_zero_and_without_drag(name):
    total = lambda path, time: jnp.sum(path.at(time).pos) + jnp.sum(path.at(time).vel)  # noqa: E731
    slopes = jax.jit(jax.grad(total, argnums=(0, 1)))(PATHS[name](), jnp.zeros(()))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))


def test_a_case_can_be_made_inside_a_compiled_function():
    ball = pj.BallState(jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    path = pj.BallPath(ball, drag=jnp.zeros((1, 3)), gravity=jnp.full(1, 9.81))
    scale = jax.jit(lambda speed: pj.catch.case(path, np.ones(1), speed=3.0).limits.speed * speed)
    assert scale(2.0) == 6.0


def swing(times, order=0):
    phase = np.array([0.0, 0.7, 1.9]) + 0.5 * order * np.pi
    return 1.3**order * np.sin(1.3 * np.asarray(times)[:, None] + phase)


def uneven(num):
    steps = np.where(np.arange(num - 1) % 2, 1.0, 2.0)
    return np.append(0.0, np.cumsum(steps)) / steps.sum() * (HORIZON + 0.1) - 0.1


@pytest.mark.parametrize("given", [False, True], ids=["positions", "with velocities"])
def test_the_table_equals_the_spline_within_its_error(given, float64):
    times, at = uneven(17), np.linspace(0.0, HORIZON, 301)
    values = [swing(times)] + [swing(times, 1)] * given
    spline = CubicHermiteSpline(times, *values) if given else CubicSpline(times, *values)
    for error in (1e-3, 1e-5):
        table = pj.table_path(times, *values, error=error, dtype=jnp.float64)
        found = states(table, at)
        assert np.abs(found.pos - spline(at)).max() <= error
        assert np.abs(found.vel - spline(at, 1)).max() <= 10.0 * error


def test_errors_are_of_fourth_and_third_order(float64):
    at = np.linspace(0.0, HORIZON, 301)
    errors = []
    for num in (9, 17, 33):
        found = states(pj.table_path(uneven(num), swing(uneven(num)), nodes=4000, dtype=float), at)
        errors.append([np.abs(found.pos - swing(at)).max(), np.abs(found.vel - swing(at, 1)).max()])
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert (orders[:, 0] > 3.5).all() and (orders[:, 1] > 2.5).all(), orders


def test_leading_axes_become_axes_of_the_leaves_and_of_a_case():
    times = np.linspace(0.0, HORIZON, 12)
    positions = swing(times) + np.arange(6.0).reshape(2, 3, 1, 1) + [0.0, 0.0, 3.0]
    table = pj.table_path(times, positions)
    assert table.pos.shape[:2] == table.resolution.shape == (2, 3)
    cases = pj.catch.case(table, np.full((2, 3), HORIZON))
    assert cases.batch_shape == (2,) and cases.num_targets == 3


@pytest.mark.parametrize("given", [False, True], ids=["positions", "with velocities"])
def test_a_table_of_traced_positions_equals_the_table_of_their_numbers(given, float64):
    times = uneven(9)
    values = [swing(times)] + [swing(times, 1)] * given
    table = lambda *values: pj.table_path(times, *values, nodes=24, dtype=jnp.float64)  # noqa: E731
    traced, usual = jax.jit(table)(*values), table(*values)
    np.testing.assert_allclose(traced.pos, usual.pos, atol=1e-12)
    np.testing.assert_allclose(traced.vel, usual.vel, atol=1e-12)


def test_masked_positions_are_refused():
    positions = np.ma.array(swing(uneven(9)), mask=False)
    pj.table_path(uneven(9), positions)
    positions[3, 1] = np.ma.masked
    with pytest.raises(pj.ArgumentError, match="positions must be numbers, got masked_array"):
        pj.table_path(uneven(9), positions)


def test_the_path_can_be_differentiated_by_its_positions(float64):
    times = uneven(8)

    def value(positions):
        table = pj.table_path(times, positions, nodes=24, dtype=jnp.float64)
        state = table.at(jnp.asarray(0.77))
        return jnp.sum(jnp.sin(state.pos) + jnp.cos(state.vel))

    assert_gradient_matches_differences(value, swing(times), step=1e-6, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(times=[0.1, 0.5, 0.7, 1.0]), "times must begin at 0, .* got 0.1 to 1 s"),
        (dict(times=np.zeros((2, 4))), r"times must have the shape \(K,\) .* got \(2, 4\)"),
        (dict(positions=np.zeros((3, 3))), r"positions must have .* 4, 3\), got \(3, 3\)"),
        (dict(positions=np.full((4, 3), np.nan)), "positions must be finite, got nan"),
        (dict(velocities=np.zeros((2, 4, 3))), r"velocities must have .* got \(2, 4, 3\)"),
        (dict(nodes=4), "nodes must be >= 5, got 4"),
        (dict(error=0.0), "error must be finite and > 0, got 0"),
        (dict(positions=1e9 * np.eye(4)[:, :3]), "error must be >= .* got 0.001"),
    ],
)
def test_a_malformed_table_is_rejected_in_one_line(change, message):
    table = dict(times=[0.0, 0.2, 0.6, 1.0], positions=np.zeros((4, 3)))
    with pytest.raises(ValueError, match=f"^{message}"):
        pj.table_path(**table | change)


@struct.dataclass
class Falling:
    start: pj.BallState
    gravity: Array  # () [m/s^2]

    def at(self, time):
        fall = jnp.array([0.0, 0.0, -0.5]) * self.gravity * time**2
        return self.start.pos + self.start.vel * time + fall


@struct.dataclass
class Lying(Falling):
    def at(self, time):
        return pj.BallState(super().at(time), jnp.zeros(3))


@pytest.mark.parametrize("own", [Falling, Lying])
def test_the_referee_uses_only_the_positions_of_a_class_of_the_user(own):
    rng = np.random.default_rng(3)
    start = pj.BallState(rng.normal(size=(2, 2, 3)), rng.normal(size=(2, 2, 3)))
    gravity = np.full((2, 2), 9.81)
    known = pj.BallPath(start, np.zeros((2, 2, 3)), gravity)
    cases = jax.tree.map(np.asarray, pj.catch.case(known, np.full((2, 2), 1.5)))
    zero = np.zeros(2, np.float32)
    plans = pj.catch.CatchPlan(
        trajectory=pj.PiecewisePolynomial(rng.normal(size=(2, 4, 8, 3)), np.full((2, 4), 0.3)),
        gravity=cases.gravity,
        order=np.array([[0, 1], [1, 0]]),
        decided_times=np.zeros((2, 2)),
        times=np.array([[0.6, 1.2]] * 2),
        **pj.pending(zero) | {"status": zero.astype(int), "iterations": zero.astype(int)},
    )
    exact = pj.catch.judge(cases.replace(targets=known), plans)
    found = pj.catch.judge(cases.replace(targets=own(start, gravity)), plans)
    np.testing.assert_allclose(found.net_distance, exact.net_distance, rtol=1e-9)
    np.testing.assert_allclose(found.angle, exact.angle, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["table", "own"])
def test_targets_of_the_user_are_caught_and_judged(kind):
    start = pj.BallState(np.float32([[1.5, 0.3, 2.5]]), np.float32([[-1.2, 0.1, 2.0]]))
    own = Falling(start, np.full(1, 9.81, np.float32))
    times = np.linspace(-0.1, 1.2, 40)[:, None]
    thrown = start.pos + start.vel * times + np.array([0.0, 0.0, -4.905]) * times**2
    targets = own if kind == "own" else pj.table_path(times[:, 0], thrown[None])
    case = pj.catch.case(targets, np.ones(1))
    found = pj.plan(pj.catch.planner("exact"), case)
    verdict = pj.catch.judge(case, found)
    assert verdict.success, verdict.sentence()
    truth = pj.catch.judge(case.replace(targets=own), found)
    np.testing.assert_allclose(truth.net_distance, verdict.net_distance, atol=1e-3)
