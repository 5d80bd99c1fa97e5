"""Joint torques of arms: inverse dynamics, slower motions, and plans within limits of torque."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arms import KINDS, ur_like

import planner_jax as pj
from planner_jax.referee.arm_torque import Dynamics
from planner_jax.robot.arm import ArmLimits
from planner_jax.robot.arm_dynamics import (
    USED,
    inverse_dynamics,
    measure_torques,
    sample_states,
    stretch,
)
from planner_jax.robot.arm_file import irb1600
from planner_jax.robot.arm_motion import polynomial
from planner_jax.robot.arm_scene import paper_scene
from planner_jax.task.block.default_planner import OnlineBlock
from planner_jax.task.block.problem.end_poses import end_poses
from planner_jax.task.block.problem.flight import flight_of
from planner_jax.task.block.search.attempts import Search
from planner_jax.task.reach.default_planner import ReachPlan
from planner_jax.task.reach.default_planner import Search as Direct

float64 = pytest.mark.usefixtures("float64")
MASS, LENGTH, SPIN, GRAVITY = 3.0, 0.4, 0.05, 9.81
TURNTABLE = np.where(np.arange(6) == 0, 1.0, np.inf)  # axis 1 is vertical: it carries no weight
MOTION = np.linspace(-0.3, 0.4, 18).reshape(3, 6), np.linspace(0.5, -0.2, 6), 0.2


def with_bodies(arm, seed=0):
    """Return the arm with random masses, centres, inertias and rotors."""
    rng, num = np.random.default_rng(seed), arm.num
    points = rng.normal(size=(num, 8, 3)) * [0.05, 0.1, 0.2]
    squares = np.einsum("lpi,lpj->lij", points, points)
    moments = np.trace(squares, axis1=1, axis2=2)[:, None, None] * np.eye(3) - squares
    bodies = {"mass": rng.uniform(1.0, 5.0, num), "centre": rng.normal(size=(num, 3)) * 0.1}
    armature = rng.uniform(0.0, 0.3, num)
    return dataclasses.replace(arm, **bodies, inertia=moments, armature=armature)


@float64
@pytest.mark.parametrize("kind", KINDS)
def test_torques_are_those_of_the_referees_mujoco_model(kind):
    arm = with_bodies(KINDS[kind])
    states = np.random.default_rng(1).normal(size=(20, 3, arm.num)) * [[1.5], [3.0], [20.0]]
    torques = jax.jit(jax.vmap(lambda q, v, a: inverse_dynamics(arm, q, v, a, GRAVITY)))
    expected = Dynamics(lambda name: getattr(arm, name), GRAVITY).torques(states)
    found = torques(*states.transpose(1, 0, 2))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-8)


def pendulum(arm):
    """Return an arm whose only mass is at the distance `LENGTH` from its horizontal axis 2."""
    only = np.arange(6) == 1
    return dataclasses.replace(
        arm,
        mass=MASS * only,
        centre=only[:, None] * [LENGTH, 0.0, 0.0],
        inertia=only[:, None, None] * SPIN * np.eye(3),
    )


@float64
@pytest.mark.parametrize(("angle", "rate", "rise"), [(0.3, 0.0, 0.0), (-1.1, 4.0, 7.0)])
def test_a_pendulum_has_the_torque_of_its_weight_and_its_moment_of_inertia(angle, rate, rise):
    only = np.arange(6) == 1
    motion = angle * only, rate * only, rise * only
    torque = inverse_dynamics(pendulum(ur_like()), *motion, GRAVITY)[1]
    weight = MASS * GRAVITY * LENGTH * np.cos(angle)
    assert torque == pytest.approx(weight + (SPIN + MASS * LENGTH**2) * rise, rel=1e-12)


@float64
def test_samples_are_on_the_motion_and_see_both_sides_of_a_jump():
    steps, first, lasts = MOTION
    path = polynomial(jnp.zeros(6), jnp.asarray(first), jnp.asarray(steps), jnp.asarray(lasts))
    states = np.stack(sample_states(path, 3), axis=1)
    rises = 2.0 * np.asarray(path.coeffs[:, 2])
    np.testing.assert_allclose(states[:3, 2], rises)
    np.testing.assert_allclose(states[3:6, 2], rises)
    for k, time in enumerate(np.linspace(0.0, lasts, 3)):
        for order in range(3 if k == 1 else 2):
            expected = pj.evaluate(path, time, order)
            np.testing.assert_allclose(states[6 + k, order], expected, rtol=1e-12, atol=1e-12)


@float64
def test_a_weak_arm_moves_just_so_much_slower_that_its_torques_suffice():
    arm, (steps, first, lasts) = with_bodies(ur_like()), MOTION
    path = polynomial(jnp.zeros(6), jnp.asarray(first), jnp.asarray(steps), jnp.asarray(lasts))
    still = np.stack(sample_states(path, 9), axis=1) * [[1.0], [0.0], [0.0]]
    held = Dynamics(lambda name: getattr(arm, name), GRAVITY).torques(still)
    most = 1.2 * np.abs(held).max()

    @jax.jit
    def measure(path, most):
        limits = ArmLimits(None, None, most * jnp.ones(6))
        return measure_torques(arm, limits, GRAVITY, path, 9)

    excess, factor, weak = measure(path, most)
    assert factor > 1.1 and weak < 0.0 < excess
    assert measure(stretch(path, factor), most)[0] == pytest.approx(0.0, abs=1e-9)
    assert measure(stretch(path, 0.999 * factor), most)[0] > 0.0
    assert measure(stretch(path, 2.0 * factor), most)[1] == 1.0
    assert measure(path, 0.8 * most)[2] > 0.0  # the arm cannot stand still


def throw(torque=None):
    """Return a case of a ball that is blocked by a straight motion of an IRB 1600."""
    case = pj.block.case((9.0, 0.5, 0.3), (-8.0, -0.4, 5.4), scene=paper_scene(has_pole=False))
    torque = None if torque is None else jnp.asarray(torque, jnp.float32)
    limits = dataclasses.replace(case.limits, torque=torque)
    return dataclasses.replace(case, limits=limits)


@pytest.mark.slow
@float64
def test_the_slopes_of_excess_torques_are_those_of_differences():
    case = throw(np.full(6, 30.0))
    case = jax.tree.map(lambda leaf: leaf.astype(float) if leaf.dtype.kind == "f" else leaf, case)
    planner = OnlineBlock(pieces=4)
    poses = end_poses(case, flight_of(case), 4, 4)
    point = planner.encode_straight(case, poses, jnp.argmin(poses.effort))
    terms = jax.jit(lambda point: planner._torque_terms(case, point)[0])
    step, (cost, slope, curvature) = 1e-5, terms(point)
    assert cost > 1.0
    for k in (0, 5, 13, len(point) - 1):
        ahead, behind = (terms(point.at[k].add(h))[0] for h in (step, -step))
        expected = float((ahead - behind) / (2.0 * step))
        assert 2.0 * slope[k] == pytest.approx(expected, rel=1e-4, abs=1e-4)
    assert np.linalg.eigvalsh(curvature).min() > -1e-6 * np.linalg.norm(curvature)


@pytest.mark.slow
@pytest.mark.parametrize("brisk", [False, True])
def test_weak_motors_block_with_less_torque_or_report_that_they_are_weak(brisk):
    planner = OnlineBlock(searches=(Search(straight=24, tries=4),), brisk=brisk)
    strong = pj.plan(planner, throw())
    assert pj.are_solved(strong)
    load = pj.block.judge(throw(TURNTABLE), strong).torque_share
    case = throw(0.8 * load * TURNTABLE)
    verdict = pj.block.judge(case, strong)
    assert verdict.failed_limit == "torque" and verdict.failed_excess == pytest.approx(0.25)
    assert "torque: joint 1 needs 25.00% more torque than its limit" in verdict.sentence()
    plan = pj.plan(planner, case)
    verdict = pj.block.judge(case, plan)
    assert pj.are_solved(plan) and verdict.success and verdict.torque_share <= 1.0
    weak = throw(np.full(6, 40.0))
    plan = pj.plan(planner, weak)
    assert not pj.are_solved(plan) and pj.block.judge(weak, plan).failed_limit == "torque"
    assert "motors may be too weak" in pj.block.prospects(weak).sentence()
    assert pj.block.prospects(throw()).torque == 0.0


@pytest.mark.parametrize("gravity", [0.0, 1.62, 9.81])
def test_the_torques_of_an_arm_that_waits_are_of_the_gravity_of_its_case(gravity):
    arm = pendulum(irb1600())
    limits = dataclasses.replace(arm.limits, torque=np.full(6, 50.0))
    case = pj.reach.case(np.zeros(6), angles=np.zeros(6), arm=arm, limits=limits, gravity=gravity)
    waits = pj.PiecewisePolynomial(np.zeros((1, 3, 6)), np.ones(1))
    verdict = pj.reach.judge(case, ReachPlan(0.0, 0.0, 0, 0, motion=waits, goal=0))
    weight = MASS * gravity * LENGTH
    assert verdict.torque_share == pytest.approx(weight / 50.0, rel=1e-6, abs=1e-12)


@pytest.mark.slow
def test_a_motion_to_a_goal_is_slowed_down_until_its_torques_suffice():
    start, goal = (np.array([side, 0.3, -0.3, 0.0, 0.6, 0.0]) for side in (-0.8, 0.8))
    scene = pj.reach.make_scene(floor=-2.0)
    case = pj.reach.case(goal, angles=start, scene=scene)
    plan = pj.plan(pj.reach.planner(), case)

    def limited(torque):
        limits = dataclasses.replace(case.limits, torque=jnp.asarray(torque, jnp.float32))
        return dataclasses.replace(case, limits=limits)

    load = pj.reach.judge(limited(TURNTABLE), plan).torque_share
    weak = limited(0.5 * load * TURNTABLE)
    assert pj.reach.judge(weak, plan).failed_limit == "torque"
    slow = pj.plan(pj.reach.planner(), weak)
    verdict = pj.reach.judge(weak, slow)
    assert pj.are_solved(slow) and verdict.success and verdict.torque_share <= 1.0
    assert verdict.duration == pytest.approx(plan.cost * np.sqrt(2.0 / USED), rel=0.01)
    direct = pj.reach.planner(searches=(Direct(),))
    heavy = limited(np.full(6, 20.0))  # the arm cannot even stand still
    plan = pj.plan(direct, heavy)
    assert not pj.are_solved(plan) and pj.reach.judge(heavy, plan).failed_limit == "torque"
