"""Drag of the rotors and wind in flatness, limits, samples and referees of hits and catches."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

import planner_jax as pj
from planner_jax.core.protocol import is_solved
from planner_jax.cost.quadrotor import flight_excess, flight_names, relative_excess
from planner_jax.referee import air as judged_air
from planner_jax.referee import quadrotor as referee
from planner_jax.referee.rotors import judge_rotors
from planner_jax.robot.attitude import setpoint_at
from planner_jax.robot.quadrotor import (
    Air,
    RotorLimits,
    add_drag,
    add_drag_rate,
    body_z,
    thrust_in_air,
)
from planner_jax.robot.quadrotor_model import PAPER_HITTER, RotorDrag
from planner_jax.robot.quadrotor_models import PAPER_CATCHER
from planner_jax.sims.loop_state import Loop
from planner_jax.sims.model import World
from planner_jax.sims.robot import Physics, rotation
from planner_jax.sims.robots.quadrotor.reference import reference_at
from planner_jax.sims.robots.quadrotor.robot import Quadrotor
from planner_jax.sims.tasks.hit import HIT_WORLD, fly_hits, volleys
from planner_jax.sweep.quadrotor import air_of, body_rate, sample_motion, thrust_size
from planner_jax.sweep.sweep import first_values
from planner_jax.task.hit.spec import REAL_SCENARIOS
from planner_jax.trajectory.polynomial import PiecewisePolynomial, sample_pieces

float64 = pytest.mark.usefixtures("float64")
GRAVITY = np.array(9.81)
UP = np.array([0.0, 0.0, 1.0])


def air(drag=0.4, thrust_drag=0.9, wind=(2.0, -1.0, 0.5)):
    return Air(np.array(drag), np.array(thrust_drag), np.array(wind))


def bounds(**fields):
    values = {"speed": 5.0, "body_rate": 4.0, "min_height": 0.25, "acceleration": 15.0}
    values |= {"min_thrust": 2.0, "max_thrust": 20.0, "max_tilt": 1.0}
    mixer = PAPER_CATCHER.rotors.mixer
    body = (PAPER_CATCHER.mass, PAPER_CATCHER.inertia, mixer, 0.1, 11.0)
    limits = {name: np.array(value) for name, value in values.items()}
    rotors = RotorLimits(*(np.array(each) for each in body))
    return pj.QuadrotorLimits(**limits, rotors=rotors, **fields)


def path(seed=0, pieces=2):
    coeffs = np.random.default_rng(seed).normal(size=(pieces, 6, 3)) / 1.5 ** np.arange(6)[:, None]
    return PiecewisePolynomial(coeffs, np.full(pieces, 0.4))


def case_of(limits, num=1):
    leaves = {"gravity": GRAVITY, "limits.air.drag": limits.air.drag}
    leaves |= {f"limits.air.{name}": vars(limits.air)[name] for name in ("thrust_drag", "wind")}
    leaves |= {f"limits.rotors.{name}": value for name, value in vars(limits.rotors).items()}
    return {name: np.repeat(np.asarray(leaf)[None], num, 0) for name, leaf in leaves.items()}


@float64
def test_steady_flight_against_wind_tilts_by_the_arc_tangent_of_drag_over_gravity():
    steady = PiecewisePolynomial(np.array([[[0.0, 0.0, 2.0], [3.0, 0.0, 0.0]]]), np.ones(1))
    of = air(0.5, 0.5, (-1.0, 0.0, 0.0))
    points = jax.jit(setpoint_at)((steady, GRAVITY, of, None), np.array(0.3))
    w, x, y, z = points["quat_wxyz"]
    assert 2.0 * np.arctan2(y, w) == pytest.approx(np.arctan(0.5 * 4.0 / GRAVITY), rel=1e-12)
    assert x == z == 0.0 and np.abs(points["body_rate"]).max() < 1e-12
    assert points["thrust"] == pytest.approx(np.hypot(GRAVITY, 2.0), rel=1e-12)


@float64
def test_thrust_gravity_and_drag_add_up_to_the_acceleration():
    rng, of = np.random.default_rng(1), air()
    for _ in range(5):
        vel, acc, jerk = 3.0 * rng.normal(size=(3, 3))
        load = add_drag(of, vel, acc)
        z = np.asarray(body_z(load, GRAVITY))
        drag = 0.4 * np.eye(3) + 0.5 * np.outer(z, z)  # d across the thrust, d_z along it
        force = thrust_in_air(of, vel, load, GRAVITY) * z - GRAVITY * UP - drag @ (vel - of.wind)
        np.testing.assert_allclose(force, acc, atol=1e-12)
        step = 1e-6
        later = add_drag(of, vel + step * acc, acc + step * jerk)
        np.testing.assert_allclose((later - load) / step, add_drag_rate(of, acc, jerk), atol=1e-7)
        pull = lambda v, a, of=of: thrust_in_air(of, v, add_drag(of, v, a), GRAVITY)  # noqa: E731
        check_grads(pull, (vel, acc), order=1, modes=["fwd"], atol=1e-6, rtol=1e-6)


@float64
def test_planner_and_referee_agree_on_thrust_tilt_body_rate_and_rotors_in_wind():
    flown, limits = path(), bounds(air=air())
    nodes = 50
    found = relative_excess(limits, flight_excess(sample_pieces(flown, nodes), GRAVITY, limits))
    most = {}
    for name, excess in zip(flight_names(limits), found, strict=True):
        most[name] = max(most.get(name, -np.inf), float(np.max(excess)))
    case, u = case_of(limits), np.linspace(0.0, 1.0, nodes + 1)
    pieces = referee.pieces_of(flown.coeffs[None], flown.durations[None])
    thrust = judged_air.thrust_along(pieces, case, u)
    measured, _ = judge_rotors(pieces, case, u, 0.01)
    motion = sample_pieces(flown, nodes)
    load = add_drag(limits.air, motion.vel, motion.acc)
    own = thrust_in_air(limits.air, motion.vel, load, GRAVITY)
    np.testing.assert_allclose(np.sort(own)[[0, -1]], [thrust.min(), thrust.max()], rtol=1e-9)
    rotor = max(value for name, value in most.items() if "rotor" in name)
    high = measured["max_rotor_thrust"][0] / 11.0 - 1.0
    low = (0.1 - measured["min_rotor_thrust"][0]) / 11.0
    assert rotor == pytest.approx(max(high, low), rel=1e-4)
    rate = referee.peaks(judged_air.load_pieces(pieces, case), case["gravity"], 400)["body rate"][0]
    assert most["body_rate"] <= np.sqrt(rate[0]) / 4.0 - 1.0 + 1e-9
    assert most["body_rate"] == pytest.approx(np.sqrt(rate[0]) / 4.0 - 1.0, rel=0.02)


@float64
def test_zero_drag_equals_none_and_a_batch_equals_a_loop():
    motion, none, zero = sample_pieces(path(), 20), bounds(), bounds(air=air(0.0, 0.0))
    for own, other in zip(
        flight_excess(motion, GRAVITY, none), flight_excess(motion, GRAVITY, zero), strict=True
    ):
        np.testing.assert_allclose(own, other, rtol=1e-9, atol=1e-9)
    paths = [path(seed) for seed in range(3)]
    coeffs, durations = (np.stack([vars(each)[k] for each in paths]) for k in vars(paths[0]))
    u, case = np.linspace(0.0, 1.0, 9), case_of(bounds(air=air()), 3)
    pieces = referee.pieces_of(coeffs, durations)
    whole = judged_air.thrust_along(pieces, case, u)
    for k in range(3):
        one = {name: leaf[k : k + 1] for name, leaf in case.items()}
        alone = judged_air.thrust_along(pieces.of(slice(k, k + 1)), one, u)[0]
        np.testing.assert_allclose(whole[k], alone, rtol=1e-12)


@float64
def test_curves_and_margins_of_a_plan_have_the_thrust_and_body_rate_in_wind():
    flown, of = path(pieces=1), air()
    motion = sample_motion(flown.coeffs.ravel(), flown.durations, 9, of)
    at = jax.jit(jax.vmap(setpoint_at, ((None, None, None, None), 0)))
    points = at((flown, GRAVITY, of, None), motion.time)
    np.testing.assert_allclose(thrust_size(motion, GRAVITY), points["thrust"], rtol=1e-9)
    rates = np.linalg.norm(points["body_rate"], axis=1)
    np.testing.assert_allclose(body_rate(motion, GRAVITY), rates, rtol=1e-6)
    cases = bounds(air=of).replace(rotors=None)
    stored = air_of(first_values(jax.tree.map(lambda leaf: leaf[None], cases)))
    for name, leaf in vars(of).items():
        np.testing.assert_allclose(vars(stored)[name], leaf, rtol=1e-6)
    assert air_of({}) is None


@pytest.mark.parametrize("wind", [(0.0, 0.0, 0.0), (3.0, -2.0, 1.0)])
def test_a_simulated_robot_hovers_in_wind_by_rotors_against_drag_and_gravity(wind):
    model = dataclasses.replace(PAPER_CATCHER, drag=RotorDrag(0.1, 0.2))
    robot = Quadrotor(model, wind=wind, drag=RotorDrag(0.4, 0.9))
    qpos, qvel, lift = robot.at_rest(jnp.zeros(3), 9.81)
    physics = Physics(qpos, qvel, lift)
    axis = np.asarray(rotation(qpos[3:]))[:, 2]
    np.testing.assert_allclose(np.cross(axis, UP * 9.81 - 0.4 * np.array(wind)), 0.0, atol=1e-5)
    command, forces = robot.drive(physics, lift, 0.002)
    assert command is lift and not np.any(forces[3:])
    force = model.rotors.allocation[0] @ np.asarray(lift) * axis + np.asarray(forces)[:3]
    np.testing.assert_allclose(force, [0.0, 0.0, 1.2 * 9.81], atol=1e-4)


@float64
def test_the_references_of_a_flight_balance_the_drag_that_the_plan_knows():
    flown, of, world = path(pieces=1), air(), World(Quadrotor(PAPER_CATCHER), 9.81)
    at = jax.jit(lambda path, time, air: reference_at(path, time, 0.0, world, air))
    once = jax.jit(setpoint_at)
    for known in (of, None):
        now, later = (at(flown, np.array(0.2 + k * 0.5 * world.timestep), known) for k in (0, 1))
        point = once((flown, GRAVITY, known, None), np.array(0.2 + 0.5 * world.timestep))
        load = now.acc if known is None else now.load
        thrust = np.linalg.norm(load + GRAVITY * UP) + now.thrust_lead  # half a step ahead
        np.testing.assert_allclose(thrust, point["thrust"], rtol=1e-12)
        if known is not None:
            np.testing.assert_allclose(now.load, add_drag(of, now.vel, now.acc), rtol=1e-12)
            slope = (later.load - now.load) / (0.5 * world.timestep)
            np.testing.assert_allclose(slope, now.load_jerk, atol=0.1)
    assert now.load is None


@pytest.mark.slow
def test_hits_in_known_wind_land_as_in_still_air_and_worse_if_plans_ignore_it():
    dragged = dataclasses.replace(PAPER_HITTER, drag=RotorDrag(0.3, 0.5))
    wind = (3.0, 0.0, 0.0)
    served = volleys(4, REAL_SCENARIOS["S.1"], seed=1, robot=dragged, wind=wind)
    world = dataclasses.replace(HIT_WORLD, robot=Quadrotor(dragged, wind=wind))
    known = fly_hits(Loop(world), served)
    assert known.flown.tracking[:, 1].max() < 0.02 and known.miss.max() < 0.05
    served = volleys(4, REAL_SCENARIOS["S.1"], seed=1)
    robot = Quadrotor(PAPER_HITTER, wind=wind, drag=dragged.drag)
    world = dataclasses.replace(HIT_WORLD, robot=robot)
    unknown = fly_hits(Loop(world), served)
    assert (unknown.flown.tracking[:, 1] > 2.0 * known.flown.tracking[:, 1]).all()


def test_wind_without_drag_and_wind_that_no_thrust_holds_are_errors_of_one_line():
    ball = ((-3.0, 0.0, 3.0), (4.0, 0.0, 4.0), (3.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="wind must be left out without rotor_drag"):
        pj.hit.case(*ball, wind=(1.0, 0.0, 0.0))
    with pytest.raises(pj.CaseError, match="thrust at hover") as raised:
        pj.hit.case(*ball, rotor_drag=(0.5, 1.0), wind=(60.0, 0.0, 0.0), max_thrust=20.0)
    assert "\n" not in str(raised.value)
    case = pj.hit.case(*ball, rotor_drag=(0.5, 1.0), wind=(3.0, 0.0, 0.0))
    assert case.limits.air.thrust_drag == 1.0 and pj.hit.case(*ball).limits.air is None


@pytest.mark.slow
@pytest.mark.parametrize("task", [pj.hit, pj.catch])
def test_plans_in_wind_succeed_and_hold_the_air_for_their_samples(task):
    cases = task.draw(4, seed=3)
    blowing = jax.tree.map(lambda leaf: jnp.tile(jnp.asarray(leaf, jnp.float32), (4, 1)), air())
    blowing = dataclasses.replace(
        blowing, drag=blowing.drag[:, 0], thrust_drag=blowing.thrust_drag[:, 0]
    )
    cases = dataclasses.replace(cases, limits=cases.limits.replace(air=blowing))
    plans = pj.plan(task.planner(recovery="brake"), cases)
    solved = is_solved(plans.status)
    assert solved.any()
    assert np.array_equal(np.asarray(task.judge(cases, plans).success), solved)
    points = plans.sample(50.0)
    still = np.asarray(pj.take(plans, int(np.argmax(solved))).sample(50.0).quat_wxyz)[-1]
    tilt = 2.0 * np.arccos(still[0])  # at standstill
    expected = np.arctan2(0.4 * np.hypot(2.0, 1.0), GRAVITY - 0.4 * 0.5)
    assert tilt == pytest.approx(expected, abs=0.02) and np.nanmin(points.thrust) > 0.0
