"""`pj.ball.fit`: flights of spinning balls, their estimates from recordings, and predictions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.ball import spin
from planner_jax.ball.spin import SpinningBall, Surroundings
from planner_jax.benchmarks.compilation import record_programs

NUM, LANES = 20, 64  # Observations and recordings: all fits share two compiled programs.
spin_flight = jax.jit(spin.spin_flight, static_argnames=("bounces", "steps"))
spin_bounce = jax.jit(spin.spin_bounce)
BALL = pj.ball.Ball.sphere(0.0027, 0.04)


def as_floats(x):
    return x if isinstance(x, jax.Array) else np.asarray(x, jnp.zeros(0).dtype)


def air(height=0.0, gravity=9.81, restitution=0.9, friction=0.2, wind=(0.0, 0.0, 0.0)):
    numbers = (gravity, wind, height, restitution, friction, 0.4, 9.0)
    return Surroundings(*map(as_floats, numbers))


def ball(pos, vel, drag=0.0, lift=(0.0, 0.0, 0.0)):
    return SpinningBall(*map(as_floats, (pos, vel, drag, lift)))


def flights(noise=0.001, seed=0, span=0.12, periodic=False):
    """Generate times, observed positions, and true drag, lift and position 0.2 s later."""
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(0.0, span, (LANES, NUM)), axis=1)
    times = np.linspace(times[:, 0], span, NUM, axis=1) if periodic else times
    vel = rng.normal([7.0, 0.0, 1.0], 0.7, (LANES, 3))
    drag = BALL.drag * np.exp(0.1 * rng.normal(size=LANES))
    lift = 0.3 * drag[:, None] * 7.0 * rng.normal(size=(LANES, 3))
    pos = np.broadcast_to([0.0, 0.0, 1.0], (LANES, 3))

    def one(pos, vel, drag, lift, times):
        after = jnp.concatenate([times, jnp.asarray([span + 0.2])])
        return spin_flight(SpinningBall(pos, vel, drag, lift), after, air(), bounces=0, steps=20)[0]

    with jax.enable_x64(True):
        truth = np.asarray(jax.vmap(one)(pos, vel, drag, lift, times))
    return times, truth[:, :-1] + rng.normal(0.0, noise, (LANES, NUM, 3)), drag, lift, truth[:, -1]


def test_without_drag_the_flight_is_a_parabola(float64):
    times = jnp.linspace(0.0, 0.8, 7)
    found, vel = spin_flight(ball([1, 2, 3], [4, 5, 6]), times, air(-9.0), bounces=1, steps=4)
    t = np.asarray(times)[:, None]
    np.testing.assert_allclose(
        found, [1, 2, 3] + t * [4, 5, 6] - t**2 * [0, 0, 4.905], rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(vel[-1], [4, 5, 6 - 9.81 * 0.8], rtol=0, atol=1e-12)


def test_a_vertical_fall_with_drag_and_a_steady_wind_have_closed_forms(float64):
    times, drag, wind = jnp.linspace(0.0, 1.0, 9), 0.14, np.array([3.0, -1.0, 0.0])
    # A ball that moves with the wind falls through the air as a ball at rest in still air does.
    still = ball([0, 0, 0], wind, drag)
    found, _ = spin_flight(still, times, air(-99.0, wind=wind), bounces=0, steps=20)
    terminal = np.sqrt(9.81 / drag)
    fall = -(terminal**2) / 9.81 * np.log(np.cosh(9.81 * np.asarray(times) / terminal))
    np.testing.assert_allclose(found, np.outer(times, wind) + np.outer(fall, [0, 0, 1]), atol=1e-6)


def test_lift_without_drag_turns_the_velocity_at_a_constant_rate(float64):
    times = jnp.linspace(0.0, 0.5, 5)
    start = ball([0, 0, 0], [2, 0, 0], lift=[0, 0, 3])
    _, vel = spin_flight(start, times[-1:], air(gravity=0.0), bounces=0, steps=40)
    np.testing.assert_allclose(vel[-1], [2 * np.cos(1.5), 2 * np.sin(1.5), 0], atol=1e-6)


def test_a_bounce_slides_or_ends_without_slip(float64):
    slow, fast = (spin_bounce(ball([0, 0, 0], [x, 0, -3]), air()) for x in (0.5, 9.0))
    np.testing.assert_allclose(fast.vel, [9 - 0.2 * 1.9 * 3, 0, 2.7])
    np.testing.assert_allclose(slow.vel, [0.6 * 0.5, 0, 2.7])
    assert slow.vel[0] - 9.0 * slow.lift[1] == pytest.approx(0.0, abs=1e-12)  # the slip
    rolling = spin_bounce(ball([0, 0, 0], [0.9, 0, -3], lift=[0, 0.1, 0]), air())
    np.testing.assert_allclose(rolling.vel, [0.9, 0, 2.7])


def test_a_ball_that_is_dropped_returns_to_its_height_times_the_squared_restitution(float64):
    fall = np.sqrt(2.0 / 9.81)
    times = jnp.asarray([fall, fall * 1.9, fall * 2.8, fall * (2.8 + 0.81)])
    found, vel = spin_flight(ball([0, 0, 1], [0, 0, 0]), times, air(), bounces=2, steps=8)
    np.testing.assert_allclose(found[:, 2], [0, 0.81, 0, 0.81**2], atol=1e-9)


def test_gradients_through_a_bounce_equal_finite_differences(float64):
    @jax.jit
    def height(x):
        start = SpinningBall(x[:3], x[3:6], x[6], x[7:10])
        numbers = air(restitution=x[10], friction=x[11])
        return spin_flight(start, jnp.asarray([0.3, 0.6]), numbers, bounces=1, steps=6)[0]

    x = jnp.asarray([0.1, 0.2, 0.5, 5.0, 1.0, -1.0, 0.14, 0.1, -0.2, 0.3, 0.9, 0.2])
    slopes = jax.jit(jax.jacfwd(height))(x)
    for k, step in enumerate(1e-6 * np.eye(12)):
        difference = (height(x + step) - height(x - step)) / 2e-6
        np.testing.assert_allclose(slopes[..., k], difference, rtol=1e-5, atol=1e-7)


def test_fit_recovers_drag_and_lift_of_long_precise_recordings():
    times, seen, drag, lift, _ = flights(noise=1e-4, span=0.6)
    found = pj.ball.fit(times, seen, ball=BALL, noise=1e-4)
    assert np.median(np.abs(found.drag / drag - 1.0)) < 0.01
    across = np.cross(found.lift - lift, [1.0, 0.0, 0.0])
    assert np.median(np.linalg.norm(across, axis=1)) < 0.02
    assert np.median(found.noise) == pytest.approx(1e-4, rel=0.3)


def test_predictions_are_near_and_within_their_intervals_as_often_as_stated():
    times, seen, _, _, truth = flights()
    found = pj.ball.fit(times, seen, ball=BALL).predict(np.full((LANES, 1), 0.32))
    assert np.median(np.linalg.norm(found.pos[:, 0] - truth, axis=1)) < 0.03
    low, high = found.interval(0.9)
    assert 0.85 < np.mean((low[:, 0] < truth) & (truth < high[:, 0])) < 0.99


def test_a_batch_equals_its_flights_and_origin_and_clock_do_not_matter():
    times, seen, *_ = flights()
    many = pj.ball.fit(times, seen, ball=BALL)
    far = np.array([5e5, 4e6, 100.0])
    one = pj.ball.fit(times[3] + 1.7e9, seen[3] + far, ball=BALL)
    np.testing.assert_allclose(one.pos - far, many.pos[3], atol=1e-4)
    np.testing.assert_allclose(one.vel, many.vel[3], atol=5e-3)
    then = one.predict([1.7e9 + 0.3]).pos[0] - far
    np.testing.assert_allclose(then, many.predict([0.3]).pos[3, 0], atol=2e-3)


def test_a_spin_across_the_flight_adds_the_speed_of_the_surface_to_the_drag(float64):
    spinning = ball([0, 0, 0], [4, 0, 0], 0.1, [7, 0, 1 / 3])  # surface: 9 m / 3 s = 3 m/s
    found = spin.spin_acceleration(spinning, air(gravity=0.0))
    np.testing.assert_allclose(found, [-0.1 * 5 * 4, 4 / 3, 0], atol=1e-12)


def test_stamps_that_a_periodic_camera_delays_are_corrected():
    times, seen, _, _, truth = flights(seed=2, periodic=True)
    delays = np.random.default_rng(2).normal(0.0, 0.001, times.shape)  # 7 mm of the path
    off = []
    for stamps in (times, times + delays):
        found = pj.ball.fit(stamps, seen, ball=BALL)
        then = found.predict(np.full((LANES, 1), 0.32))
        off.append(np.median(np.linalg.norm(then.pos[:, 0] - truth, axis=1)))
    assert off[1] < 1.3 * off[0]
    assert np.median(found.stamp_noise) == pytest.approx(0.001, rel=0.3)


def test_outliers_that_come_first_and_absent_observations_do_no_harm():
    times, seen, _, _, truth = flights(seed=1)
    seen[:, :5] = [0.3, 0.3, 0.3]  # a reflection, seen before the ball
    times[:, 8] = np.nan
    found = pj.ball.fit(
        times, np.ma.masked_where(np.isnan(times)[..., None] & [True] * 3, seen), ball=BALL
    )
    assert found.outliers == pytest.approx(5 / 19)
    off = np.linalg.norm(found.predict([0.32]).pos[:, 0] - truth, axis=1)
    assert np.median(off) < 0.06
    smooth = found.smooth()
    assert smooth.pos.shape == (LANES, NUM, 3)
    assert np.median(np.abs(smooth.pos - seen)[:, 9:]) < 0.001


def test_another_number_of_observations_or_of_times_compiles_no_program():
    times, seen, *_ = flights()
    pj.ball.fit(times[0], seen[0], ball=BALL).predict([0.3])
    with record_programs() as programs:
        found = pj.ball.fit(times[0, :17], seen[0, :17], ball=BALL, noise=0.003)
        found.predict(np.linspace(0.2, 0.3, 7))
        pj.ball.fit(times[:9], seen[:9], ball=BALL)
        pj.ball.fit(times[:33, :19], seen[:33, :19], ball=BALL)
    assert not programs


@pytest.mark.slow
def test_a_fit_through_an_observed_bounce_predicts_the_flight_after_it():
    times = np.linspace(0.0, 0.5, 50)
    vel = np.array([3.0, 0.2, -1.0])
    truth = np.asarray(
        spin_flight(
            ball([0, 0, 0.5], vel, BALL.drag, [0, 0.3, 0.1]),
            jnp.asarray([*times, 0.6]),
            air(height=0.02),
            bounces=1,
            steps=20,
        )[0]
    )
    assert truth[20, 2] < 0.2 < truth[-1, 2]  # the bounce is among the observations
    seen = truth[:-1] + np.random.default_rng(0).normal(0.0, 0.001, (50, 3))
    found = pj.ball.fit(times, seen, ball=BALL, floor=0.02)
    then = found.predict([0.6])
    assert np.linalg.norm(then.pos[0] - truth[-1]) < 0.01
    low, high = then.interval(0.99)
    assert np.all((low[0] < truth[-1]) & (truth[-1] < high[0]))
    # The bounce determines the restitution, whose prior has a standard deviation of 0.1.
    assert np.sqrt(found.covariance[12, 12]) < 0.02


@pytest.mark.parametrize(
    "turn",
    [
        lambda p: p * [1.0, 1.0, -1.0],
        lambda p: p[..., [0, 2, 1]],
        lambda p: p[..., [2, 0, 1]] * [-1.0, 1.0, 1.0],
    ],
    ids=["z down", "y up", "x down"],
)
def test_recordings_in_another_frame_are_refused(turn):
    times, seen, *_ = flights()
    rule = "positions must be of (one|a) flight .*"
    with pytest.raises(pj.CaseError, match=rule):
        pj.ball.fit(times, turn(seen), ball=BALL)
    seen[5] = turn(seen[5])  # a single wrong lane
    with pytest.raises(pj.CaseError, match=f"{rule}in lane 5$"):
        pj.ball.fit(times, seen, ball=BALL)


@pytest.mark.slow
def test_recordings_of_slow_balls_in_feet_are_refused():
    times, seen, *_ = flights(noise=0.002, span=0.6)
    pj.ball.fit(times, seen, ball=BALL)
    refused = 0
    for lane in range(LANES):
        try:
            pj.ball.fit(times[lane], seen[lane] / 0.3048, ball=BALL)
        except pj.CaseError as error:
            refused += "positions must be of" in str(error)
    assert refused >= LANES - 1


@pytest.mark.slow
def test_a_prediction_ends_at_the_bounce_after_the_last_simulated_one():
    # A ball without drag falls from 0.5 m, and keeps 0.8 of its speed at each bounce.
    speed, end, at = np.sqrt(9.81), 1.0 / np.sqrt(9.81), np.linspace(0.0, 0.6, 61)
    later = at - end
    height = np.where(later < 0.0, 0.5 - 4.905 * at**2, 0.8 * speed * later - 4.905 * later**2)
    seen = np.stack([0.5 * at, 0.0 * at, height], axis=1)
    seen += np.random.default_rng(0).normal(0.0, 5e-4, seen.shape)
    ball = pj.ball.Ball(drag=1e-3, friction=(1e-3, 1e-3))
    found = pj.ball.fit(at, seen, ball=ball, floor=0.0, noise=5e-4)
    third = end + 2.0 * (0.8 + 0.64) * speed / 9.81
    then = found.predict([third - 0.1, third + 0.1])
    assert then.is_known.tolist() == [True, False]
    assert np.isfinite(then.pos[0]).all() and np.isnan(then.interval(0.9)).all(axis=(0, 2))[1]
    since = third - 0.1 - (end + 1.6 * speed / 9.81)
    assert then.pos[0, 2] == pytest.approx(0.64 * speed * since - 4.905 * since**2, abs=0.03)
    with pytest.raises(pj.ArgumentError, match="positions must be finite, got nan"):
        pj.table_path([0.0, third + 0.1], found.predict([0.0, third + 0.1]).pos)


def test_fit_refuses_what_is_no_recording_of_one_flight():
    times, seen, *_ = flights()
    t, p = times[0], seen[0]
    swapped, equal = t.copy(), t.copy()
    swapped[[3, 4]], equal[4] = t[[4, 3]], t[3]
    for wrong in (swapped, equal):
        with pytest.raises(pj.CaseError, match="times must be strictly increasing"):
            pj.ball.fit(wrong, p)
    with pytest.raises(pj.CaseError, match="positions must be of at least 4 observations"):
        pj.ball.fit(np.where(np.arange(NUM) < 3, t, np.nan), p)
    mixed = np.where(np.arange(NUM)[:, None] % 2, p[:, [1, 0, 2]] + 3.0, p)
    with pytest.raises(pj.CaseError, match="positions must be of one flight in one frame"):
        pj.ball.fit(t, mixed, ball=BALL)
    turning = np.stack([0.1 * np.sin(60 * t), 0.1 * np.cos(60 * t), 1 - 4.905 * t**2], axis=1)
    with pytest.raises(pj.CaseError, match="with the lift and drag of `ball`"):
        pj.ball.fit(t, turning, ball=BALL)
    seen[5, :17] = np.nan
    with pytest.raises(pj.CaseError, match="at least 4 observations in lane 5"):
        pj.ball.fit(times, seen)
    with pytest.raises(pj.ArgumentError, match="ball must be one of unknown, table tennis"):
        pj.ball.fit(t, p, ball="golf")
    found = pj.ball.fit(t, p)
    for late, rule in (
        (-1.0, "at or after the first one, got -1 s"),
        (np.inf, "finite, got inf s"),
        (np.nan, "finite, got nan s"),
        (1e6, "at most .* s after the first one, got 1000000 s"),
    ):
        with pytest.raises(pj.ArgumentError, match=f"times must be {rule}"):
            found.predict([0.3, late])
    for floor in (2.0, 20.0):
        with pytest.raises(pj.CaseError, match=f"floor must be below .* got {floor:g}"):
            pj.ball.fit(t, p, floor=floor)
    with pytest.raises(pj.ArgumentError, match="wind must be finite"):
        pj.ball.fit(t, p, wind=np.array([np.nan, 0.0, 0.0]))
    with pytest.raises(pj.ArgumentError, match="mass must be finite and > 0"):
        pj.ball.Ball.sphere(0.0, 0.04)
