"""Setpoints of plans for a quadrotor: hover, a flown plan, batches, and rates that are none."""

import dataclasses

import jax
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.robot.quadrotor import QuadrotorPlan

GRAVITY = 9.81
FIELDS = ("pos", "vel", "acc", "jerk", "quat_wxyz", "body_rate", "thrust")


def made(coeffs, durations):
    """A plan, or a batch, in float64 where that is enabled."""
    coeffs, durations = np.asarray(coeffs, float), np.asarray(durations, float)
    blank = np.zeros(coeffs.shape[:-3])
    return QuadrotorPlan(
        cost=blank,
        violation=blank,
        iterations=blank.astype(np.int32),
        status=blank.astype(np.int32),
        trajectory=pj.PiecewisePolynomial(coeffs=coeffs, durations=durations),
        gravity=np.full(coeffs.shape[:-3], GRAVITY),
    )


def hover(duration=0.5):
    coeffs = np.zeros((2, 8, 3))
    coeffs[:, 0] = [1.0, -2.0, 1.5]
    return made(coeffs, [0.4 * duration, 0.6 * duration])


def curve(seed=0, duration=0.8):
    """One piece of degree 7 that turns and tilts without losing its thrust."""
    coeffs = np.random.default_rng(seed).normal(size=(1, 8, 3))
    return made(coeffs / np.array([1, 1, 1, 2, 6, 24, 60, 120])[:, None], [duration])


def batch(*plans):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *plans)


def rotation(quat):
    """Body to world (K, 3, 3) of unit quaternions (K, 4), by the book."""
    w, x, y, z = quat.T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        axis=-2,
    )


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
    np.testing.assert_allclose(differences(found.pos), found.vel[1:-1], atol=1e-4)
    np.testing.assert_allclose(differences(found.vel), found.acc[1:-1], atol=1e-4)
    np.testing.assert_allclose(differences(found.acc), found.jerk[1:-1], atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(found.quat_wxyz, axis=1), 1.0, rtol=1e-12)
    turned = rotation(found.quat_wxyz)
    pull = found.acc + np.array([0.0, 0.0, GRAVITY])
    np.testing.assert_allclose(turned[:, :, 2] * found.thrust[:, None], pull, atol=1e-9)
    # R^T dR/dt is the cross-product matrix of the rate in the body frame.
    spin = np.einsum("kji,kjl->kil", turned[1:-1], differences(turned))
    rates = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    assert np.abs(found.body_rate).min(axis=0).max() > 0.0 and np.abs(rates).max() > 0.5
    np.testing.assert_allclose(found.body_rate[1:-1], rates, atol=1e-4)


def test_attitude_is_that_of_no_heading():
    """The quaternion of the Hopf fibration at zero heading has no part along the body's z."""
    np.testing.assert_array_equal(curve().sample(20.0).quat_wxyz[:, 3], 0.0)


def test_a_batch_ends_lane_by_lane():
    found = batch(curve(0, 0.8), curve(1, 0.35)).sample(20.0)
    assert found.time.shape == (17,)
    for name in FIELDS:
        leaf = getattr(found, name)
        assert leaf.shape[:2] == (2, 17)
        assert np.isfinite(leaf[0]).all() and np.isfinite(leaf[1, :8]).all()
        assert np.isnan(leaf[1, 8:]).all(), "the second ends at 0.35 s, its eighth sample"


def test_one_plan_is_its_lane():
    plans = batch(curve(0, 0.8), curve(1, 0.35))
    together = plans.sample(20.0)
    for k, num in enumerate((17, 8)):
        alone = pj.take(plans, k).sample(20.0)
        np.testing.assert_array_equal(alone.time, together.time[:num])
        for name in FIELDS:
            np.testing.assert_allclose(
                getattr(alone, name), getattr(together, name)[k, :num], rtol=1e-6, atol=1e-6
            )


@pytest.mark.parametrize("rate", [10.0, 60.0, 100.0, 1000.0])
def test_the_last_sample_is_the_end_where_the_end_is_one(rate):
    """Also where the sum of the durations in float32 is a little short of it."""
    short = jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == float else x, hover(0.7))
    assert short.sample(rate).time[-1] == pytest.approx(0.7)
    assert np.isfinite(short.sample(rate).thrust).all()


def test_a_plan_that_is_not_finite_is_nan_beside_its_neighbours():
    plans = batch(curve(0), curve(1))
    plans.trajectory.durations[1] = np.nan
    found = plans.sample(20.0)
    assert np.isfinite(found.pos[0]).all() and np.isnan(found.pos[1]).all()


@pytest.mark.parametrize("rate", [0.0, -3.0, np.nan])
def test_a_rate_must_be_positive(rate):
    with pytest.raises(ValueError, match=f"^rate must be finite and > 0, got {rate:g}$"):
        hover().sample(rate)


def test_setpoints_of_a_planned_hit_begin_at_the_head_and_end_at_the_impact():
    case = pj.take(pj.hit.draw(1), 0)
    plan = pj.plan(pj.hit.planner("juggle", nodes=6), case)
    found = plan.sample(1000.0)
    assert {f.name for f in dataclasses.fields(found)} == {"time", *FIELDS}
    np.testing.assert_allclose(found.pos[0], case.head_state[0], atol=1e-5)
    assert plan.stroke.time - 2e-3 < found.time[-1] <= plan.stroke.time + 1e-6
    np.testing.assert_allclose(found.thrust[0], case.gravity, rtol=1e-5)
