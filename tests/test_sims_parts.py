"""Parts of the simulated world: allocation, control, sensing, scoring, and MJX against MuJoCo."""

import dataclasses
import functools
import re
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from sweeps import quick_hit

import planner_jax as pj
from planner_jax.robot.attitude import flat_attitude
from planner_jax.robot.quadrotor_model import FlightLimits
from planner_jax.sims import sensing as estimation
from planner_jax.sims.launch import await_ball, ready, require_plan, require_world
from planner_jax.sims.loop import predict_balls
from planner_jax.sims.loop_state import Loop, shapes_of_plans
from planner_jax.sims.model import BALL_MASS, at_rest, mujoco_model, place_balls, step
from planner_jax.sims.noise import NOISES, Sensing
from planner_jax.sims.robots.quadrotor.allocation import rotor_thrusts
from planner_jax.sims.robots.quadrotor.control import Gains, RobotState, control, rotation_error
from planner_jax.sims.robots.quadrotor.reference import Reference, with_rest
from planner_jax.sims.robots.quadrotor.robot import Quadrotor
from planner_jax.sims.scenery import machine_parts, outlines
from planner_jax.sims.scoring import Moment, nearest, no_contact, passage
from planner_jax.sims.tasks.catch import CATCH_WORLD
from planner_jax.sims.tasks.catch_ahead import LIMITS, bounds
from planner_jax.sims.tasks.hit import HIT_WORLD, court_parts

NET = CATCH_WORLD.robot.tool
GRAVITY = jnp.float32(9.81)
ROTORS = CATCH_WORLD.robot.model.rotors
LOPSIDED = dataclasses.replace(
    ROTORS, places=((0.14, 0.08), (-0.09, 0.13), (-0.12, -0.09), (0.11, -0.1)), min_thrust=0.3
)
SPARE = 1.0
rotors_of_either = pytest.mark.parametrize("rotors", [ROTORS, LOPSIDED], ids=["cross", "lopsided"])


def thrusts(rotors, thrust, torque):
    return np.asarray(rotor_thrusts(rotors, jnp.float32(thrust), jnp.float32(torque), SPARE))


@rotors_of_either
def test_rotor_thrusts_are_the_inverse_of_the_allocation(rotors):
    found = thrusts(rotors, 12.0, [0.2, -0.1, 0.02])
    np.testing.assert_allclose(rotors.allocation @ found, [12.0, 0.2, -0.1, 0.02], atol=1e-5)


@rotors_of_either
def test_saturated_rotors_keep_roll_and_pitch_and_let_yaw_go_first(rotors):
    found = thrusts(rotors, 12.0, [0.2, -0.1, 5.0])
    assert found.min() > rotors.min_thrust - 1e-6 and found.max() <= rotors.max_thrust
    np.testing.assert_allclose((rotors.allocation @ found)[:3], [12.0, 0.2, -0.1], atol=1e-5)
    weak = thrusts(rotors, 0.5, [0.2, 0.0, 0.0])
    np.testing.assert_allclose((rotors.allocation @ weak)[1:], [0.2, 0.0, 0.0], atol=1e-5)
    assert weak.min() > rotors.min_thrust - 1e-6


def test_every_mode_of_the_cascade_has_a_damping_ratio_of_half_despite_rotor_lag():
    """Check rotor lag, rate, attitude, velocity and position of lateral motion near hover."""
    gains, lag = Gains(), ROTORS.lag
    turn, pull = gains.attitude * gains.velocity, gains.attitude * gains.position
    inner = [gains.attitude, gains.position + turn, pull]
    modes = np.roots([lag, 1.0, gains.rate, *(gains.rate * x for x in inner)])
    assert (-modes.real / np.abs(modes)).min() > 0.5


def test_a_torque_raises_a_weak_thrust_by_at_most_the_spare_thrust():
    found = thrusts(ROTORS, 1.0, [2.0, 0.0, 0.0])
    thrust, roll = (ROTORS.allocation @ found)[:2]
    assert 0.0 < roll < 2.0
    np.testing.assert_allclose(thrust, 1.0 + 4.0 * SPARE, rtol=1e-5)


@pytest.mark.parametrize("part", [0, 1], ids=["angular_acc", "torque_lead"])
def test_a_jump_of_the_planned_angular_acceleration_is_followed_only_up_to_the_bound(part):
    still = jnp.zeros(3)
    robot = RobotState(still, still, jnp.array([1.0, 0.0, 0.0, 0.0]), still)
    exact = dataclasses.replace(CATCH_WORLD, timestep=1e-9)
    robot_model, most = CATCH_WORLD.robot.model, Gains().feedforward[part]

    def torque(size):
        jumps = [still, still]
        jumps[part] = jnp.array([size, 0.0, 0.0])
        reference = Reference(still, still, still, still, jnp.zeros(()), *jumps)
        return ROTORS.allocation @ np.asarray(
            control(robot, reference, robot_model, Gains(), exact)
        )

    turning = robot_model.inertia[0] * most
    weight = 9.81 * robot_model.mass
    np.testing.assert_allclose(torque(0.5 * most), [weight, 0.5 * turning, 0, 0], atol=1e-4)
    np.testing.assert_allclose(torque(30.0 * most), [weight, turning, 0, 0], atol=1e-4)


@rotors_of_either
def test_at_rest_the_rotors_carry_the_robot_without_turning_it(rotors):
    model = dataclasses.replace(CATCH_WORLD.robot.model, rotors=rotors)
    robot = dataclasses.replace(CATCH_WORLD.robot, model=model)
    lift = robot.at_rest(jnp.zeros(3), 9.81)[2]
    wrench = rotors.allocation @ np.asarray(lift)
    np.testing.assert_allclose(wrench, [model.mass * 9.81, 0.0, 0.0, 0.0], atol=1e-5)


@pytest.mark.parametrize(
    ("distance", "thrust", "rate"),
    [(LIMITS[0], 0.5, 3.0), (LIMITS[1], 0.4, 4.5), (LIMITS[2], 0.3, 5.0)],
)
def test_plans_in_flight_stay_within_the_limits_of_the_robot(distance, thrust, rate):
    found = bounds(Loop(CATCH_WORLD), distance)
    np.testing.assert_allclose(list(found.values()), [thrust * 9.81, rate])
    limits = FlightLimits(speed=5.0, body_rate=8.0, thrust=(6.0, 14.0))
    model = dataclasses.replace(CATCH_WORLD.robot.model, limits=limits)
    world = dataclasses.replace(CATCH_WORLD, robot=Quadrotor(model))
    own = bounds(Loop(world), distance)
    assert 6.0 <= own["min_thrust"] < 9.81 and own["body_rate"] <= 8.0
    np.testing.assert_allclose(own["body_rate"], 8.0 * rate / 5.0)


def test_the_flat_body_rate_is_the_rate_of_the_flat_attitude():
    acc = lambda t: jnp.array([4.0 * jnp.sin(3.0 * t), 3.0 * t, 2.0 * t**2])  # noqa: E731

    @jax.jit
    def compare_rates(t, step):
        now, then = (
            flat_attitude(acc(t), jax.jacfwd(acc)(t), jnp.asarray(9.81)) for t in (t, t + step)
        )
        return rotation_error(now[0], then[0]) / step, 0.5 * (now[1] + then[1])

    with jax.enable_x64(True):
        np.testing.assert_allclose(*compare_rates(0.3, 1e-3), atol=1e-3)


def wiggle():
    coeffs = np.zeros((1, 8, 3), np.float32)
    coeffs[0, :, 0] = [0.0, 0.0, 0.0, 0.0, 3.0, -2.0, 0.0, 0.0]
    coeffs[0, :, 2] = [1.0, 0.0, 0.0, 0.0, 1.0, -0.7, 0.0, 0.0]
    return pj.PiecewisePolynomial(jnp.asarray(coeffs), jnp.array([1.0], jnp.float32))


def test_a_trajectory_comes_to_rest_smoothly_after_its_end():
    resting, at = jax.jit(with_rest), jax.jit(pj.evaluate, static_argnums=2)
    path = resting(wiggle())
    end, rest = (np.sum(each.durations) for each in (wiggle(), path))
    for order in range(4):
        before, after = at(wiggle(), end, order), at(path, np.float32(end + 1e-5), order)
        np.testing.assert_allclose(after, before, rtol=2e-3, atol=1e-3)
    more = np.concatenate([wiggle().coeffs, np.zeros((2, 8, 3), np.float32)])
    absent = pj.PiecewisePolynomial(more, np.array([1.0, 0.0, 0.0], np.float32))
    braking = np.asarray(resting(absent).coeffs)[-1]
    np.testing.assert_allclose(braking, np.asarray(path.coeffs)[-1], atol=1e-5)
    for order in (1, 2, 3):
        np.testing.assert_allclose(at(path, rest, order), 0.0, atol=2e-2)


@pytest.fixture(scope="module")
def tracked():
    world, robot = CATCH_WORLD, CATCH_WORLD.robot
    plan = SimpleNamespace(trajectory=wiggle(), air=None, heading=None)
    path = jax.jit(with_rest)(wiggle())

    def one(tilt):
        start = at_rest(world, jnp.array([0.0, 0.0, 1.0]))
        quat = jnp.stack([jnp.cos(tilt / 2), jnp.sin(tilt / 2), 0.0 * tilt, 0.0 * tilt])
        start = start.replace(qpos=start.qpos.at[3:7].set(quat))

        def advance(physics, time):
            references = robot.references(plan, time[None], world)
            reference = jax.tree.map(lambda leaf: leaf[0], references)
            rotors = robot.command(robot.state(physics), reference, world)
            away = jnp.linalg.norm(physics.qpos[:3] - pj.evaluate(path, time))
            return step(world, physics, rotors, jnp.zeros(1)), (away, rotors)

        return jax.lax.scan(advance, start, world.timestep * jnp.arange(400))[1]

    return jax.device_get(jax.jit(jax.vmap(one))(jnp.array([0.0, 1.0])))


@pytest.mark.slow
def test_a_trajectory_is_tracked_within_two_centimetres_and_a_tilt_of_one_radian_ends(tracked):
    level, tilted = tracked[0]
    assert level.max() < 0.02 and tilted.max() < 1.0 and tilted[-1] < 0.1


def test_hover_is_an_equilibrium_and_mjx_agrees_with_mujoco():
    world = CATCH_WORLD
    balls = pj.BallState(jnp.array([[0.5, 0.0, 2.0]]), jnp.array([[1.0, -2.0, 3.0]]))
    drag = jnp.array([0.06])
    still = at_rest(world, jnp.array([0.0, 0.0, 1.0]))
    start = place_balls(world, still, balls, drag, jnp.array([True]))
    late = np.arange(400)[:, None] > 200
    pulses = 0.1 * late * np.sin(0.05 * np.arange(400)[:, None] * np.arange(1, 5))
    rotors = jnp.asarray(np.asarray(start.act) + pulses, jnp.float32)

    def advance(physics, command):
        physics = step(world, physics, command, drag)
        return physics, physics.qpos

    path = jax.jit(lambda physics: jax.lax.scan(advance, physics, rotors)[1])(start)
    np.testing.assert_allclose(path[200, :7], [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0], atol=1e-4)
    model, reference = mujoco_model(world), []
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:] = start.qpos, start.qvel, start.act
    for command in np.asarray(rotors):
        vel = data.qvel[6:]
        data.ctrl[:] = command
        data.qfrc_applied[6:] = -BALL_MASS * 0.06 * np.linalg.norm(vel) * vel
        mujoco.mj_step(model, data)
        reference.append(data.qpos.copy())
    assert np.ptp(np.array(reference)[:, 3:7], axis=0).max() > 0.01  # the quadrotor rotates
    np.testing.assert_allclose(path, reference, atol=1e-4)
    flown = jax.jit(functools.partial(pj.fly, num_steps=100))
    truth = flown(jax.tree.map(lambda x: x[0], balls), 0.8, drag[0], GRAVITY)[0]
    np.testing.assert_allclose(path[-1, 7:], truth.pos, atol=1e-3)


@pytest.mark.parametrize("world", [CATCH_WORLD, HIT_WORLD])
def test_court_and_machine_are_visible_and_touch_nothing(world):
    model = mujoco_model(world)
    standing = np.flatnonzero(model.geom_bodyid == 0)
    assert len(standing) >= 6
    assert not model.geom_contype.any() and not model.geom_conaffinity.any()
    assert model.npair == 0
    assert np.ptp(model.geom_pos[standing], axis=0)[0] > 3.0  # the farthest is the machine
    for part in machine_parts((1.0, 2.0, 0.8), 0.5) + court_parts():
        lines = np.concatenate(outlines(part))
        np.testing.assert_allclose(0.5 * (lines.min(0) + lines.max(0)), part.centre, atol=1e-9)
        assert lines[:, 2].min() > -1e-9


def moments(gap_before, gap_after, aside):
    tool = [jnp.zeros(3)] * 3 + [jnp.array([0.0, 0.0, 1.0])]
    vel = jnp.array([[0.0, 0.0, -5.0]])
    places = (jnp.array([[aside, 0.0, NET.height + gap]]) for gap in (gap_before, gap_after))
    return (Moment(*tool, place, vel) for place in places)


@jax.jit
def contact_of(before, after):
    passes, later = passage(CATCH_WORLD, before, after, 1.0, jnp.zeros(1), jnp.zeros(3))
    return nearest(no_contact(1), passes, later)


@pytest.mark.parametrize(
    ("gaps", "aside", "met"),
    [((0.003, -0.007), 0.1, True), ((0.003, -0.007), 0.13, False), ((-0.007, 0.003), 0.1, False)],
)
def test_a_ball_is_caught_from_above_inside_the_radius_at_the_interpolated_time(gaps, aside, met):
    before, after = moments(*gaps, aside)
    contact = contact_of(before, after)
    assert bool(contact.met[0]) == met
    if gaps[0] > 0.0:
        np.testing.assert_allclose(contact.time, 1.0 + 0.3 * CATCH_WORLD.timestep, rtol=1e-6)
        np.testing.assert_allclose(contact.offset, aside, rtol=1e-5)


def test_the_drag_is_estimated_from_the_lost_energy():
    sensing, true = Sensing(position_std=0.002), jnp.float32(0.0616)
    ball = pj.BallState(jnp.array([4.0, 0.0, 0.8]), jnp.array([-4.0, 0.5, 7.0]))
    flown = jax.jit(functools.partial(pj.fly, num_steps=130))(ball, 1.3, true, GRAVITY)
    path, ahead = flown[1].pos[:120], flown[0].pos
    seen = jax.jit(lambda path: estimation.observe(jax.random.key(0), path, sensing))(path)

    def advance(estimate, now):
        number, at = now
        estimate = estimation.update_estimate(estimate, at, sensing, GRAVITY)
        fresh = estimation.anchor_energy(estimate, GRAVITY)
        later = estimation.with_drag(estimate, GRAVITY)
        return jax.tree.map(lambda a, b: jnp.where(number < 30, a, b), fresh, later), None

    first = estimation.first_estimate(path[0], 1.15 * true)

    @jax.jit
    def estimate_drag(first):
        last = jax.lax.scan(advance, first, (jnp.arange(120), seen))[0]
        return last.drag, estimation.predict(last, 0.1, GRAVITY).pos

    drag, later = estimate_drag(first)
    assert abs(drag / true - 1.0) < 0.06
    np.testing.assert_allclose(later, ahead, atol=0.02)


def test_the_estimate_of_an_awaited_ball_predicts_the_guessed_throw():
    loop = Loop(dataclasses.replace(CATCH_WORLD, num_balls=2), NOISES["lab"], replan=100.0)
    coming = pj.BallState(jnp.array([2.9, 0.1, 2.4]), jnp.array([-3.0, 0.5, 4.0]))

    @jax.jit
    def predict_both(coming):
        flights = ready(loop, jnp.zeros((3, 3)), jax.random.split(jax.random.key(0), 3))
        drag = jnp.full((3, 2), 0.06)
        flights = await_ball(loop, flights, coming, drag, ball=1, ahead=0.8)
        then = [
            jax.vmap(lambda known, ahead=ahead: predict_balls(loop, known, ahead))(estimates)
            for estimates, ahead in ((flights.estimates, 0.8), (flights.earlier, 0.8 + loop.period))
        ]
        return then, flights.estimates.drag

    both, drag = jax.device_get(predict_both(coming))
    for then in both:
        np.testing.assert_allclose(then.pos[:, 1], np.tile(coming.pos, (3, 1)), atol=2e-3)
        np.testing.assert_allclose(then.vel[:, 1], np.tile(coming.vel, (3, 1)), atol=5e-3)
    np.testing.assert_allclose(drag[:, 1], 0.06)


def test_a_missing_observation_is_nan():
    sensing = Sensing(dropout=0.25)
    see = jax.jit(lambda key: estimation.observe(key, jnp.zeros((2000, 3)), sensing))
    seen = see(jax.random.key(1))
    assert abs(np.isnan(seen[:, 0]).mean() - 0.25) < 0.04


BAD = """
Sensing(position_std=-0.1) | position_std must be >= 0, got -0.1
Sensing(dropout=1.0) | dropout must be < 1, got 1
Loop(CATCH_WORLD, replan=-1.0) | replan must be >= 0, got -1
Loop(CATCH_WORLD, replan=30.0) | replan must be a divisor of the observations' 100 Hz, got 30
Loop(CATCH_WORLD, Sensing(rate=300.0)) | rate must be a divisor of 500 Hz, got 300
Loop(CATCH_WORLD, Sensing(latency=0.015)) | latency must be a multiple of the observations' 0.01 s
dataclasses.replace(CATCH_WORLD, num_balls=-1) | num_balls must be >= 0, got -1
""".strip().splitlines()


@pytest.mark.parametrize("row", BAD)
def test_invalid_settings_of_a_flight_are_refused_in_one_line(row):
    call, message = row.split(" | ")
    with pytest.raises(ValueError, match=f"^{re.escape(message)}") as caught:
        eval(call)
    assert "\n" not in str(caught.value)


def test_a_plan_or_world_of_another_robot_is_refused():
    with pytest.raises(ValueError, match="^world must carry a net, got a racket$"):
        require_world(Loop(HIT_WORLD), "net", 1)
    with pytest.raises(ValueError, match="^world must have 2 balls, got 1$"):
        require_world(Loop(CATCH_WORLD), "net", 2)

    @dataclasses.dataclass
    class Plan:
        trajectory: pj.PiecewisePolynomial

    plan = Plan(jax.tree.map(lambda leaf: np.asarray(leaf)[None], wiggle()))
    heads = np.zeros((1, 4, 3))
    with pytest.raises(ValueError, match="^plan must begin where its robot is, got 1.00 m"):
        require_plan(plan, Plan, heads)
    with pytest.raises(ValueError, match="^plan must be of 2 flights, got 1$"):
        require_plan(plan, Plan, np.zeros((2, 4, 3)))


@pytest.mark.slow
def test_shapes_of_plans_are_known_without_planning():
    planner, cases = quick_hit(), pj.hit.draw(2)
    found = jax.eval_shape(functools.partial(pj.solve, planner), cases)
    assert jax.tree.leaves(shapes_of_plans(planner.problem, cases)) == jax.tree.leaves(found)
