"""Thrusts of rotors along a motion: closed forms, and two independent derivations.

The planners derive the thrusts from the snap, the referee from differences of angular velocities.
"""

import dataclasses
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from sweeps import quick_hit

import planner_jax as pj
from planner_jax.referee.rotors import rotor_thrusts as judged_thrusts
from planner_jax.robot.attitude import flat_attitude
from planner_jax.robot.quadrotor import RotorLimits
from planner_jax.robot.quadrotor_model import (
    NET,
    RACKET,
    FlightLimits,
    Rotors,
    Tool,
    place_in_cross,
)
from planner_jax.robot.rotor_thrusts import rotor_thrusts

GRAVITY = 9.81
MODEL = pj.QuadrotorModel(
    name="small",
    mass=0.8,
    inertia=(0.003, 0.004, 0.006),
    rotors=Rotors(((0.1, 0.08), (-0.09, 0.1), (-0.1, -0.09), (0.11, -0.1)), max_thrust=4.5),
    tool=Tool(RACKET, 0.07, 0.1),
    limits=FlightLimits(speed=6.0, body_rate=6.0, thrust=(0.2 * GRAVITY, 1.9 * GRAVITY)),
)
ROTORS = RotorLimits(
    *map(np.array, (MODEL.mass, MODEL.inertia, MODEL.rotors.mixer)), np.array(0.0), np.array(4.5)
)

float64 = pytest.mark.usefixtures("float64")


@float64
def test_in_hover_the_rotors_carry_the_weight_without_a_torque():
    still = np.zeros(3)
    found = np.array(rotor_thrusts(still, still, still, GRAVITY, ROTORS))
    wrench = MODEL.rotors.allocation @ found
    np.testing.assert_allclose(wrench, [MODEL.mass * GRAVITY, 0.0, 0.0, 0.0], atol=1e-12)


@float64
def test_in_a_plane_the_torque_is_the_inertia_times_the_angle_s_second_derivative():
    x = np.polynomial.Polynomial([0.0, 2.0, -1.0, 3.0, 0.5])  # acceleration along x
    time, step = 0.4, 1e-4
    angle = lambda t: np.arctan2(x(t), GRAVITY)  # noqa: E731
    bend = (angle(time + step) - 2.0 * angle(time) + angle(time - step)) / step**2
    motion = [np.array([x.deriv(k)(time) if k else x(time), 0.0, 0.0]) for k in range(3)]
    wrench = MODEL.rotors.allocation @ np.array(rotor_thrusts(*motion, GRAVITY, ROTORS))
    thrust = MODEL.mass * np.hypot(x(time), GRAVITY)
    torque = [0.0, MODEL.inertia[1] * bend, 0.0]
    np.testing.assert_allclose(wrench, [thrust, *torque], atol=1e-6)


HEXACOPTER = dataclasses.replace(
    MODEL,
    inertia=(0.003, 0.004, 0.006, 2e-4, -5e-4, 3e-4),
    rotors=Rotors(place_in_cross(0.3, 6), max_thrust=4.5),
)


@float64
@pytest.mark.parametrize("model", [MODEL, HEXACOPTER], ids=["4 rotors", "6 rotors, products"])
def test_planner_and_referee_find_the_same_thrusts(model):
    coeffs = np.random.default_rng(0).normal(size=(3, 4, 2, 8))  # tilt and turn
    coeffs *= np.array([1, 1, 2, 2, 1, 1, 0.5, 0.5])
    times = np.broadcast_to(np.linspace(0.0, 0.8, 9), (4, 2, 9))
    batch = np.ones(4)
    mixer, inertia = model.rotors.mixer, np.array(model.inertia)
    rotors = dataclasses.replace(ROTORS, inertia=inertia, mixer=mixer)
    body = batch * model.mass, batch[:, None] * inertia, np.stack([mixer] * 4)
    found = judged_thrusts(coeffs, times, batch * GRAVITY, *body)
    for lane, piece, sample in np.ndindex(4, 2, 9):
        axes = [np.polynomial.Polynomial(axis) for axis in coeffs[:, lane, piece]]
        time = times[lane, piece, sample]
        motion = [np.array([axis.deriv(k)(time) for axis in axes]) for k in (2, 3, 4)]
        planned = np.array(rotor_thrusts(*motion, GRAVITY, rotors))
        np.testing.assert_allclose(found[lane, piece, sample], planned, rtol=1e-6, atol=1e-6)


@float64
def test_the_torque_of_a_turn_is_the_change_of_angular_momentum():
    """The world's angular momentum is  R I w , with the matrix I of products, too."""
    coeffs = np.random.default_rng(1).normal(size=(3, 8))
    axes, step = [np.polynomial.Polynomial(axis) for axis in coeffs], 1e-4

    def momentum(time):
        acc, jerk = (jax.numpy.array([axis.deriv(k)(time) for axis in axes]) for k in (2, 3))
        turn, rate = flat_attitude(acc, jerk, jax.numpy.array(GRAVITY))
        return np.array(turn @ HEXACOPTER.inertia_matrix @ rate), np.array(turn)

    change = (momentum(0.3 + step)[0] - momentum(0.3 - step)[0]) / (2.0 * step)
    motion = [np.array([axis.deriv(k)(0.3) for axis in axes]) for k in (2, 3, 4)]
    own = HEXACOPTER.rotors
    rotors = dataclasses.replace(ROTORS, inertia=np.array(HEXACOPTER.inertia), mixer=own.mixer)
    wrench = own.allocation @ np.array(rotor_thrusts(*motion, GRAVITY, rotors))
    np.testing.assert_allclose(wrench[1:], momentum(0.3)[1].T @ change, rtol=1e-5, atol=1e-7)


@pytest.fixture(scope="module")
def hits():
    weak = dataclasses.replace(MODEL.rotors, max_thrust=3.4)
    robot = dataclasses.replace(MODEL, rotors=weak)
    drawn = pj.hit.draw(16, seed=2)
    cases = pj.hit.case(drawn.ball.pos, drawn.ball.vel, drawn.target, robot=robot)
    return jax.tree.map(np.asarray, (drawn, cases))


@pytest.mark.slow
def test_plans_keep_to_what_the_rotors_can_do(hits):
    _, cases = hits
    plans = pj.plan(quick_hit(), cases)
    verdict, rotors = pj.hit.judge(cases, plans), cases.limits.rotors
    np.testing.assert_array_equal(verdict.success, pj.are_solved(plans))
    assert verdict.success.mean() > 0.9
    kept = verdict.success
    assert (verdict.max_rotor_thrust <= rotors.max_thrust * 1.001)[kept].all()
    assert (verdict.min_rotor_thrust >= rotors.min_thrust - 0.001 * rotors.max_thrust)[kept].all()


@pytest.mark.parametrize(("name", "off"), [("high", -0.1), ("low", 0.1)])
def test_a_rotor_beyond_its_bound_fails_by_name(hits, name, off):
    (drawn, others), bound = hits, "max" if name == "high" else "min"
    plans = pj.plan(quick_hit(), drawn)
    strong = dataclasses.replace(others.limits.rotors, max_thrust=np.full(16, 9.0, np.float32))
    cases = dataclasses.replace(drawn, limits=dataclasses.replace(drawn.limits, rotors=strong))
    verdict = pj.hit.judge(cases, plans)
    done = verdict.success
    assert done.any()
    thrust = (getattr(verdict, f"{bound}_rotor_thrust") + off).astype(np.float32)
    rotors = dataclasses.replace(cases.limits.rotors, **{f"{bound}_thrust": thrust})
    tight = dataclasses.replace(cases, limits=dataclasses.replace(cases.limits, rotors=rotors))
    found = pj.hit.judge(tight, plans)
    assert (found.failed_limit[done] == f"rotor {name}").all(), found.failed_limit
    excess = 0.1 / np.asarray(rotors.max_thrust)
    np.testing.assert_allclose(found.failed_excess[done], excess[done], rtol=1e-2)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"mass": 2.0}, "4 x rotors.max_thrust must be > the weight of 19.6 N, got 18 N"),
        ({"mass": -1.0}, "mass must be > 0, got -1"),
        ({"inertia": (0.1, 0.0, 0.1)}, "inertia must be > 0, got 0"),
        ({"inertia": (0.1, 0.1)}, r"inertia must be 3 or 6 numbers, got \(0.1, 0.1\)"),
    ],
)
def test_a_robot_that_cannot_be_is_refused_in_one_line(changed, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        dataclasses.replace(MODEL, **changed)


def test_rotors_in_one_line_a_net_and_a_name_do_not_hit():
    with pytest.raises(ValueError, match="^rotors.places must let them turn the body"):
        Rotors(((0.1, 0.0), (0.05, 0.0), (-0.05, 0.0), (-0.1, 0.0)), max_thrust=4.0)
    where = np.zeros((3,)), np.ones((3,)), np.zeros((3,))
    net = dataclasses.replace(MODEL, tool=Tool(NET, 0.2, 0.1))
    with pytest.raises(ValueError, match="^robot must carry a racket, got 'small' with a net$"):
        pj.hit.case(*where, robot=net)
    with pytest.raises(TypeError, match="^robot must be a QuadrotorModel, .*, got 'small'$"):
        pj.hit.case(*where, robot="small")  # type: ignore[arg-type]


def test_a_robot_s_limits_are_those_of_the_case_where_none_are_given():
    case = pj.hit.case(np.zeros(3), np.ones(3), np.zeros(3), robot=MODEL, speed=3.0)
    assert case.limits.speed == np.float32(3.0) and case.limits.body_rate == np.float32(6.0)
    assert case.limits.acceleration is None
    assert case.limits.max_thrust == np.float32(1.9 * GRAVITY)
    assert case.racket_height == np.float32(0.07)
    assert case.racket_radius == np.float32(MODEL.tool.radius)
    own = pj.hit.case(np.zeros(3), np.ones(3), np.zeros(3), robot=MODEL, racket_radius=0.2)
    assert own.racket_radius == np.float32(0.2)
    net = dataclasses.replace(MODEL, tool=Tool(NET, 0.2, 0.1), limits=FlightLimits(5.0, 5.0))
    of_ball = SimpleNamespace(**vars(pj.catch.draw(1)))
    catch = pj.catch.case(of_ball.targets, of_ball.horizon, robot=net)
    np.testing.assert_allclose(catch.limits.max_thrust, 4 * 0.95 * 4.5 / 0.8, rtol=1e-6)
