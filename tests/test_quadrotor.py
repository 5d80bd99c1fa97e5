"""Quadrotors: flatness by the Hopf fibration, and setpoints of plans."""

import dataclasses

import jax
import numpy as np
import pytest
from derivatives import assert_gradient_matches_differences
from flown_plans import matrices

import planner_jax as pj
from planner_jax.cost.quadrotor import overturn_excess
from planner_jax.referee.quadrotor import body_rate_squared as exact_rate_squared
from planner_jax.robot import quadrotor
from planner_jax.robot.attitude import tilt_quaternion
from planner_jax.runs.timing import CompileClock
from planner_jax.trajectory.polynomial import PiecewisePolynomial

GRAVITY = 9.81
UP = np.array([0.0, 0.0, 1.0])
MOTION = np.array([[2.0, -3.0, 1.5, 4.0], [-4.0, 6.0, 2.0, -1.0], [1.0, 2.0, -6.0, 3.0]])
FIELDS = ("pos", "vel", "acc", "jerk", "quat_wxyz", "body_rate", "thrust")

float64 = pytest.mark.usefixtures("float64")

tilt, overturn = jax.jit(tilt_quaternion), jax.jit(overturn_excess)
rate_squared = jax.jit(quadrotor.body_rate_squared)
axis = jax.jit(quadrotor.body_z)
basis = jax.jit(jax.vmap(quadrotor.tangent_basis))
rate_and_gradient = jax.jit(jax.value_and_grad(quadrotor.body_rate_squared, argnums=(0, 1)))


def acceleration(time, order=0):
    return np.array([np.polynomial.Polynomial(row).deriv(order)(time) for row in MOTION])


def hopf_rotations(z):
    """Return attitudes (K, 3, 3) of the Hopf fibration at zero heading for body z axes (K, 3)."""
    quat = np.stack([1.0 + z[:, 2], -z[:, 1], z[:, 0], np.zeros(len(z))], axis=1)
    return matrices(quat / np.sqrt(2.0 * (1.0 + z[:, 2:])))


def attitude(time):
    thrust = acceleration(time) + GRAVITY * UP
    return hopf_rotations(thrust[None] / np.linalg.norm(thrust))[0]


@float64
def test_the_thrust_carries_the_weight_and_the_body_axis_follows_it():
    acc = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 4.0 - GRAVITY], [0.0, 0.0, -2.0 * GRAVITY]])
    np.testing.assert_allclose(quadrotor.net_thrust(acc, GRAVITY), acc + GRAVITY * UP, rtol=1e-15)
    expected = [[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, 0.0, -1.0]]
    np.testing.assert_allclose(axis(acc, GRAVITY), expected, atol=1e-15)


def test_recoveries_tilt_by_40_degrees_unless_the_limits_or_the_start_say_otherwise():
    numbers = {"speed": 5.0, "body_rate": 5.0, "min_height": 0.25}
    limits = pj.QuadrotorLimits(**{name: np.full(3, value) for name, value in numbers.items()})
    start = np.tile(np.array([np.sqrt(3.0), 0.0, 1.0]), (3, 1))  # a thrust tilted by 60 degrees
    start = start * np.array([[0.0], [1.0], [-1.0]]) + (1e-9 - GRAVITY) * UP
    gravity = np.full(3, GRAVITY)
    for fields, usual in (
        ({}, 40.0),
        ({"recovery_tilt": 80.0}, 80.0),
        ({"max_tilt": 35.0}, 35.0),
        ({"recovery_tilt": 80.0, "max_tilt": 70.0}, 70.0),
    ):
        of = limits.replace(**{name: np.full(3, np.radians(x)) for name, x in fields.items()})
        found = of.of_recovery(start[:, None] * np.array([[0.0], [0.0], [1.0], [0.0]]), gravity)
        expected = np.maximum([10.0, 70.0, 130.0], usual)
        expected = np.minimum(expected, fields.get("max_tilt", 180.0))
        np.testing.assert_allclose(np.degrees(found.max_tilt), expected, rtol=1e-6)
        assert found.recovery_tilt is None and found.speed is limits.speed


def test_singular_attitudes_are_finite_the_axis_in_free_fall_and_the_basis_straight_down():
    x, y = basis(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], np.float32))
    np.testing.assert_array_equal([x[0], y[0]], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert np.all(np.isfinite(x)) and np.all(np.isfinite(y))
    fall = np.array([0.0, 0.0, -GRAVITY], np.float32)
    assert not np.any(axis(fall[None], np.float32(GRAVITY)))
    jacobian = jax.jit(jax.jacfwd(quadrotor.body_z))(fall, np.float32(GRAVITY))
    assert np.all(np.isfinite(jacobian))


@float64
def test_the_basis_and_the_normal_are_the_right_handed_hopf_frame_of_zero_heading():
    normals = np.random.default_rng(0).normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    frames = np.stack([*basis(normals), normals], axis=-1)
    np.testing.assert_allclose(frames, hopf_rotations(normals), atol=1e-13)
    identities = np.tile(np.eye(3), (50, 1, 1))
    np.testing.assert_allclose(np.swapaxes(frames, 1, 2) @ frames, identities, atol=1e-13)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0, rtol=1e-13)


@float64
@pytest.mark.parametrize("time", [0.0, 0.3, 0.7, 1.1])
def test_the_body_rate_is_that_of_the_turning_attitude(time):
    step = 1e-5
    turning = attitude(time).T @ (attitude(time + step) - attitude(time - step)) / (2.0 * step)
    np.testing.assert_allclose(turning, -turning.T, atol=1e-8)
    omega = np.array([turning[2, 1], turning[0, 2], turning[1, 0]])
    squared = rate_squared(acceleration(time), acceleration(time, 1), GRAVITY)
    np.testing.assert_allclose(squared, omega @ omega, rtol=1e-8)


@float64
@pytest.mark.parametrize("acc", [(0.0, 0.0, 0.0), (3.0, -5.0, 2.0), (4.0, 1.0, -12.0)])
def test_the_gradient_of_the_body_rate_matches_finite_differences(acc):
    point = (np.array(acc), np.array([20.0, -7.0, 11.0]), GRAVITY)
    squared = lambda point: quadrotor.body_rate_squared(*point)  # noqa: E731
    assert_gradient_matches_differences(squared, point, rtol=1e-6)


@pytest.mark.parametrize(
    "thrust", [(0, 0, GRAVITY), (1e-4, 0, 1e-5), (0, 0, 0), (1e-3, 0, -5.0), (0, 0, -5.0)]
)
@pytest.mark.parametrize("jerk", [(0.0, 0.0, 0.0), (30.0, -20.0, 10.0)])
def test_value_and_gradient_are_finite_wherever_the_thrust_points(thrust, jerk):
    acc = (np.array(thrust) - GRAVITY * UP).astype(np.float32)
    value, gradient = rate_and_gradient(acc, np.array(jerk, np.float32), np.float32(GRAVITY))
    assert np.isfinite(value) and value >= 0.0
    assert all(np.all(np.isfinite(leaf)) for leaf in gradient)


def plan_of(coeffs, durations):
    coeffs, durations = np.asarray(coeffs, float), np.asarray(durations, float)
    blank = np.zeros(coeffs.shape[:-3])
    return quadrotor.QuadrotorPlan(
        *(blank, blank, blank.astype(np.int32), blank.astype(np.int32)),
        trajectory=pj.PiecewisePolynomial(coeffs=coeffs, durations=durations),
        gravity=np.full(coeffs.shape[:-3], GRAVITY),
    )


def hover(duration=0.5):
    coeffs = np.zeros((2, 8, 3))
    coeffs[:, 0] = [1.0, -2.0, 1.5]
    return plan_of(coeffs, [0.4 * duration, 0.6 * duration])


def curve(seed=0, duration=0.8):
    coeffs = np.random.default_rng(seed).normal(size=(1, 8, 3))
    return plan_of(coeffs / np.array([1, 1, 1, 2, 6, 24, 60, 120])[:, None], [duration])


def batch(*plans):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *plans)


def test_a_hover_is_upright_at_rest_and_carries_its_weight():
    found = hover().sample(100.0)
    np.testing.assert_allclose(found.time, np.arange(51) / 100.0)
    np.testing.assert_allclose(found.pos, np.tile([1.0, -2.0, 1.5], (51, 1)))
    np.testing.assert_allclose(found.quat_wxyz, np.tile([1.0, 0.0, 0.0, 0.0], (51, 1)), atol=1e-7)
    np.testing.assert_allclose(found.thrust, GRAVITY, rtol=1e-6)
    for name in ("vel", "acc", "jerk", "body_rate"):
        np.testing.assert_array_equal(getattr(found, name), np.zeros((51, 3)))


def test_derivatives_and_attitude_are_those_of_the_flown_path(float64):
    rate = 2000.0
    found = curve().sample(rate)
    differences = lambda x: (x[2:] - x[:-2]) * (0.5 * rate)  # noqa: E731
    for low, high in (("pos", "vel"), ("vel", "acc"), ("acc", "jerk")):
        derivative = differences(getattr(found, low))
        np.testing.assert_allclose(derivative, getattr(found, high)[1:-1], atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(found.quat_wxyz, axis=1), 1.0, rtol=1e-12)
    np.testing.assert_array_equal(found.quat_wxyz[:, 3], 0.0, "the heading is zero")
    turned = matrices(found.quat_wxyz)
    pull = found.acc + GRAVITY * UP
    np.testing.assert_allclose(turned[:, :, 2] * found.thrust[:, None], pull, atol=1e-9)
    # R^T dR/dt is the cross-product matrix of the rate in the body frame.
    spin = np.einsum("kji,kjl->kil", turned[1:-1], differences(turned))
    rates = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    assert np.abs(found.body_rate).min(axis=0).max() > 0.0 and np.abs(rates).max() > 0.5
    np.testing.assert_allclose(found.body_rate[1:-1], rates, atol=1e-4)


@pytest.mark.parametrize(
    ("acc", "jerk", "attitude"),
    [
        ((0.0, 0.0, -GRAVITY), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
        ((0.0, 0.0, -GRAVITY), (20.0, 0.0, 5.0), (1.0, 0.0, 0.0, 0.0)),
        ((0.0, 0.0, -2.0 * GRAVITY), (0.0, 30.0, 0.0), (0.0, 0.0, 1.0, 0.0)),
        ((0.0, 3.0, -GRAVITY), (0.0, 0.0, -2.0), (0.5**0.5, -(0.5**0.5), 0.0, 0.0)),
        ((1e-4, 0.0, -GRAVITY - 3.0), (-1.0, 0.5, 0.0), None),
    ],
)
def test_in_free_fall_and_upside_down_attitudes_are_unit_and_rates_finite(acc, jerk, attitude):
    coeffs = hover().trajectory.coeffs.astype(np.float32)
    coeffs[:, 2], coeffs[:, 3] = 0.5 * np.float32(acc), np.float32(jerk) / 6.0
    found = plan_of(coeffs, np.float32([0.2, 0.3])).sample(100.0)
    np.testing.assert_allclose(np.linalg.norm(found.quat_wxyz, axis=1), 1.0, atol=1e-6)
    assert all(np.isfinite(getattr(found, name)).all() for name in FIELDS)
    up = matrices(found.quat_wxyz)[:, :, 2]
    np.testing.assert_allclose(up * found.thrust[:, None], found.acc + GRAVITY * UP, atol=1e-4)
    if attitude is not None:
        np.testing.assert_allclose(found.quat_wxyz[0], attitude, atol=1e-6)


def test_yaws_of_other_conventions_follow_from_the_attitude():
    R = np.moveaxis(hopf_rotations(axis(acceleration(0.1)[None], GRAVITY))[0], 1, 0)
    seen, ahead = np.arctan2(R[0, 1], R[0, 0]), np.arctan2(-R[1, 0], R[1, 1])
    x = np.cross([-np.sin(seen), np.cos(seen), 0.0], R[2])  # of PX4
    y = np.cross(R[2], [np.cos(ahead), np.sin(ahead), 0.0])  # of [Lee2010]
    for found, own in ((x, R[0]), (y, R[1])):
        np.testing.assert_allclose(found / np.linalg.norm(found), own, atol=1e-6)
    assert abs(seen) > 0.01 and abs(seen - ahead) > 0.02


def test_each_plan_of_a_batch_is_sampled_up_to_its_own_end():
    plans = batch(curve(0, 0.8), curve(1, 0.35))
    together = plans.sample(20.0)
    assert together.time.shape == (17,)
    for k, num in enumerate((17, 8)):  # the second plan ends at 0.35 s, its eighth sample
        alone = pj.take(plans, k).sample(20.0)
        np.testing.assert_array_equal(alone.time, together.time[:num])
        for name in FIELDS:
            leaf = getattr(together, name)
            assert leaf.shape[:2] == (2, 17)
            assert np.isfinite(leaf[k, :num]).all() and np.isnan(leaf[k, num:]).all()
            np.testing.assert_allclose(getattr(alone, name), leaf[k, :num], rtol=1e-6, atol=1e-6)


def test_other_lengths_rates_and_batches_compile_nothing():
    curve(0).sample(20.0), batch(curve(0), curve(1)).sample(20.0)
    with CompileClock() as clock:
        for k in range(80):
            assert curve(0, 0.5 + 0.01 * k).sample(10.0 * (k + 1)).time.size > 1
        many = batch(*(curve(k, 0.5 + 0.01 * k) for k in range(70))).sample(100.0)
    assert not clock.compiled
    last = curve(69, 1.19).sample(100.0)
    assert many.pos.shape == (70, last.time.size, 3)
    np.testing.assert_allclose(last.pos, many.pos[69], rtol=1e-6, atol=1e-6)


def test_batches_of_plans_with_recoveries_compile_nothing_more():
    both = [curve(k).replace(recovery=curve(k + 9, 0.4).trajectory) for k in range(5)]
    batch(*both[:2]).sample(20.0)
    with CompileClock() as clock:
        found = batch(*both).sample(30.0)
    assert not clock.compiled
    np.testing.assert_allclose(found.pos[3, :36], both[3].sample(30.0).pos[:36], rtol=1e-5)


@pytest.mark.parametrize("rate", [10.0, 60.0, 100.0, 1000.0])
def test_the_last_sample_is_the_end_where_the_end_is_one(rate):
    short = jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == float else x, hover(0.7))
    assert short.sample(rate).time[-1] == pytest.approx(0.7)
    assert np.isfinite(short.sample(rate).thrust).all()


def test_a_plan_that_is_not_finite_is_nan_beside_its_neighbours():
    plans = batch(curve(0), curve(1))
    plans.trajectory.durations[1] = np.nan
    found = plans.sample(20.0)
    assert np.isfinite(found.pos[0]).all() and np.isnan(found.pos[1]).all()


def test_setpoints_of_a_planned_hit_begin_at_the_head_and_end_at_the_impact():
    case = pj.take(pj.hit.draw(1), 0)
    plan = pj.plan(pj.hit.planner("juggle", nodes=6), case)
    found = plan.sample(1000.0)
    assert {f.name for f in dataclasses.fields(found)} == {"time", *FIELDS}
    np.testing.assert_allclose(found.pos[0], case.head_state[0], atol=1e-5)
    assert plan.stroke.time - 2e-3 < found.time[-1] <= plan.stroke.time + 1e-6
    np.testing.assert_allclose(found.thrust[0], case.gravity, rtol=1e-5)


@pytest.mark.parametrize("attitude", [(0, 1, 0, 0), (0, 0.6, 0.8, 0), (0, -1, 0, 0)])
def test_a_start_exactly_upside_down_is_sampled_with_its_given_attitude(attitude):
    case = pj.hit.case((4, 0.5, 2), (-7, 0, 6), (3, 0, 0), start_attitude=attitude)
    acc = np.asarray(case.head_state)[2]
    np.testing.assert_allclose(acc, [0.0, 0.0, -2.0 * case.gravity], atol=1e-4)
    found = np.asarray(tilt(acc, case.gravity))
    np.testing.assert_allclose(found * np.sign(found @ attitude), attitude, atol=1e-5)


def with_jerk(acc, jerk):
    coeffs = np.zeros((1, 8, 3))
    coeffs[0, 2:4] = acc / 2.0, jerk / 6.0
    return PiecewisePolynomial(coeffs, np.ones(1))


@float64
@pytest.mark.parametrize("least", [1e-3, 0.5])
def test_a_moment_of_little_thrust_between_samples_has_its_body_rate(least):
    """Let the thrust, of constant jerk, be least at 0.37 s: there it turns at |jerk| / |thrust|."""
    jerk = np.array([8.0, 3.0, -1.0])
    thrust = least * np.cross(jerk, [0.0, 0.0, 1.0]) / np.hypot(*jerk[:2])
    acc = thrust - 0.37 * jerk - np.array([0.0, 0.0, GRAVITY])
    limits = pj.take(pj.hit.draw(1, dtype=np.float64), 0).limits
    exact = np.linalg.norm(jerk) / least / float(limits.body_rate) - 1.0
    assert overturn(with_jerk(acc, jerk), GRAVITY, limits) == pytest.approx(exact, rel=1e-6)


@float64
def test_a_passage_near_upside_down_between_samples_exceeds_the_limit_of_the_body_rate():
    """Let the thrust pass the downward vertical at the distance 1e-3 rad, at 0.5 rad/s."""
    acc, jerk = np.array([0.01, -1.85, -10.0 - GRAVITY]), np.array([0.0, 5.0, 0.0])
    limits = pj.take(pj.hit.draw(1, dtype=np.float64), 0).limits
    found = lambda acc: overturn(with_jerk(acc, jerk), GRAVITY, limits)  # noqa: E731
    exact = np.sqrt(exact_rate_squared(GRAVITY, acc + 0.37 * jerk, jerk))
    assert exact == pytest.approx(1000.0, rel=1e-3)
    assert found(acc) == pytest.approx(float(exact / limits.body_rate) - 1.0, rel=1e-2)
    upright = float(5.0 / GRAVITY / limits.body_rate) - 1.0
    assert found(acc * [0.0, 1.0, 0.0]) == pytest.approx(upright, rel=1e-6)
    assert found(acc + [60.0, 0.0, 0.0]) < -0.9
