"""Motions of an arm from standstill to standstill among obstacles, and their referee."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.robot.arm_file import irb1600
from planner_jax.task.block.clearance import clearances, clearances_and_slopes
from planner_jax.task.reach import motion, tree
from planner_jax.task.reach.default_planner import BumpSearch, Search, TreeSearch
from tests.derivatives import double

ARM = irb1600()
START, GOAL = (np.array([side, 0.3, -0.3, 0.0, 0.6, 0.0], np.float32) for side in (-0.8, 0.8))
EMPTY = pj.reach.make_scene()
# A box in front of the arm, and a cylinder and a sphere that are beside the motion.
WALL = pj.reach.make_scene(
    boxes=[((0.95, 0.0, 0.9), (0.3, 0.1, 0.5), (0.98, 0.0, 0.0, 0.2))],
    cylinders=[([(-1.5, 0.0, 0.0), (-1.5, 0.2, 1.0)], 0.1)],
    spheres=[((0.0, 0.0, 2.8), 0.2)],
)
DIRECT = pj.reach.planner(searches=(Search(),))
BUMPS = pj.reach.planner(pieces=12, samples=24, worst=6, searches=(BumpSearch(bumps=8),))
TREE = dataclasses.replace(BUMPS, searches=(TreeSearch(rays=400),))


def reach(goal=GOAL, scene=EMPTY, **options):
    return pj.reach.case(goal, angles=options.pop("angles", START), scene=scene, **options)


@functools.cache
def detour(planner):
    case = reach(scene=WALL)
    return case, pj.plan(planner, case)


def least_time(turn):
    """Return the time of the slowest joint: ramps at most, and a constant rate between them."""
    speed, rise = (
        np.asarray(each, float) for each in (ARM.limits.velocity, ARM.limits.acceleration)
    )
    turn = np.abs(turn)
    cruises = turn > speed**2 / rise
    return np.where(cruises, turn / speed + speed / rise, 2.0 * np.sqrt(turn / rise)).max()


def test_a_free_motion_takes_the_time_of_its_slowest_joint():
    for goal in (
        GOAL,
        START + [0.02, 0.0, 0.01, -2.0, 0.3, 4.0],
        START + [0.0, 0.3, 0.0, 0.0, 0.0, 0.0],
    ):
        case = reach(goal)
        plan = pj.plan(DIRECT, case)
        verdict = pj.reach.judge(case, plan)
        assert verdict.success, verdict.sentence()
        assert verdict.duration == pytest.approx(least_time(goal - START), rel=3e-4)
        assert max(verdict.velocity_share, verdict.acceleration_share) <= 1.0


def test_a_motion_to_the_start_itself_takes_no_time():
    case = reach(START)
    plan = pj.plan(DIRECT, case)
    assert pj.reach.judge(case, plan).success
    assert plan.cost < 1e-6


@pytest.mark.parametrize("planner", [BUMPS, pytest.param(TREE, marks=pytest.mark.slow)])
def test_a_box_in_between_is_passed_by_a_longer_motion(planner):
    case, plan = detour(planner)
    verdict = pj.reach.judge(case, plan)
    assert verdict.success, verdict.sentence()
    assert pj.are_solved(plan)
    assert verdict.obstacle_clearance > 0.0
    assert 1.05 * least_time(GOAL - START) < verdict.duration < 3.0 * least_time(GOAL - START)
    assert max(verdict.velocity_share, verdict.acceleration_share) <= 1.0


def test_a_motion_through_a_box_is_rejected_by_planner_and_judge():
    through = pj.plan(DIRECT, reach())
    case = reach(scene=WALL)
    verdict = pj.reach.judge(case, through)
    assert verdict.failed_limit == "obstacle"
    assert "and a box are" in verdict.sentence()
    assert not pj.are_solved(pj.plan(DIRECT, case))


def edit(plan, factor=1.0, **offsets):
    """Return a plan with a faster motion, or with offsets of its first coefficients."""
    coeffs, durations = np.array(plan.motion.coeffs), np.array(plan.motion.durations)
    coeffs *= (factor ** np.arange(3))[:, None]
    coeffs[0, 0, 0] += offsets.get("angle", 0.0)
    path = dataclasses.replace(plan.motion, coeffs=coeffs, durations=durations / factor)
    return dataclasses.replace(plan, motion=path)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("velocity", {"factor": 1.02}),
        ("start", {"angle": 0.01}),
        ("time", {"factor": -1.0}),
    ],
)
def test_the_judge_names_the_limit_that_a_motion_breaks(name, change):
    case = reach(np.array([2.5, 0.3, -0.3, 0.0, 0.6, 0.0]), angles=[-2.5, 0.3, -0.3, 0.0, 0.6, 0.0])
    plan = pj.plan(DIRECT, case)
    assert pj.reach.judge(case, plan).success
    assert pj.reach.judge(case, edit(plan, **change)).failed_limit == name
    other = dataclasses.replace(case, goals=case.goals + 0.1)
    assert pj.reach.judge(other, plan).failed_limit == "goal"


@pytest.mark.parametrize("side", ["start", "goal"])
def test_a_start_or_goal_in_an_obstacle_is_blocked(side):
    inside = np.array([0.0, 0.3, -0.3, 0.0, 0.6, 0.0])
    ends = {"angles": inside} if side == "start" else {"goal": inside}
    assert pj.plan(DIRECT, reach(scene=WALL, **ends)).status == pj.Status.BLOCKED


def test_a_goal_beyond_the_joints_limits_is_out_of_reach():
    assert pj.plan(DIRECT, reach(GOAL + [9.0, 0, 0, 0, 0, 0])).status == pj.Status.OUT_OF_REACH


def test_the_nearest_free_goal_is_reached():
    inside, far = [0.0, 0.3, -0.3, 0.0, 0.6, 0.0], [2.0, 0.3, -0.3, 0.0, 0.6, 0.0]
    near, beyond = [-0.5, 0.3, -0.3, 0.0, 0.6, 0.0], [9.0, 0.3, -0.3, 0.0, 0.6, 0.0]
    case = pj.reach.case(goals=[far, inside, beyond, near], angles=START, scene=WALL)
    plan = pj.plan(DIRECT, case)
    assert plan.goal == 3
    assert pj.reach.judge(case, plan).success


def test_a_batch_has_the_plans_of_its_cases():
    goals = np.stack([GOAL, START, START + np.array([0.5, 0, 0, 0, 0, 0], np.float32)])
    plans = pj.plan(DIRECT, reach(goals))
    assert pj.reach.judge(reach(goals), plans).success.all()
    for k, goal in enumerate(goals):
        plan = pj.plan(DIRECT, reach(goal))
        np.testing.assert_allclose(plans.motion.coeffs[k], plan.motion.coeffs, atol=1e-5)


def test_shapes_are_checked():
    with pytest.raises(ValueError, match="goal must be either goal or goals"):
        pj.reach.case(GOAL, goals=[GOAL])
    with pytest.raises(ValueError, match="goal must have a shape that ends with"):
        pj.reach.case(np.zeros(5))
    with pytest.raises(ValueError, match=r"the radius of capsules\[0\] must be >= 0, got -0.1"):
        pj.reach.make_scene(capsules=[([(0.0, 0.0, 0.0), (0.0, 0.0, 1.0)], -0.1)])


def test_planner_and_judge_measure_the_same_distances():
    case, plan = detour(BUMPS)
    ends = np.asarray(plan.motion.durations)
    path = jax.tree.map(np.asarray, plan.motion)
    shares = np.linspace(0.0, 1.0, 400)
    local = (ends[:, None] * shares)[..., None]
    angles = np.sum([path.coeffs[:, None, k] * local**k for k in range(3)], axis=0).reshape(-1, 6)
    least = float(jnp.min(jax.jit(clearances)(ARM, WALL, angles.astype(np.float32))))
    verdict = pj.reach.judge(case, plan)
    assert min(verdict.obstacle_clearance, verdict.self_clearance) == pytest.approx(least, abs=5e-4)


def test_slopes_of_distances_from_boxes_and_cylinders(float64):
    arm, scene = double((ARM, WALL))
    angles = jnp.asarray(np.random.default_rng(0).uniform(-1.0, 1.0, (8, 6)))
    every = jax.jit(functools.partial(clearances, arm, scene))

    @jax.jit
    def slopes_of(angles):
        return clearances_and_slopes(arm, scene, angles)[1](jnp.arange(8))

    values, slopes, step = every(angles), slopes_of(angles), 1e-6
    for joint in range(6):
        ahead, behind = (every(angles.at[:, joint].add(h)) for h in (step, -step))
        differences = (ahead - behind) / (2.0 * step)
        smooth = np.abs(values) > 1e-3
        # At jumps of the nearest points, the differences are between two slopes.
        off = np.abs(np.where(smooth, slopes[:, joint] - differences, 0.0)) > 1e-5
        assert off.mean() < 0.01


def test_a_path_is_shortened_to_few_straight_lines():
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.1]], np.float32)
    points = np.repeat(corners, 8, axis=0)
    free = lambda states: ~((jnp.abs(states[:, 0]) < 0.2) & (jnp.abs(states[:, 1] - 0.05) < 0.02))  # noqa: E731
    short = np.asarray(tree.shorten(free, jnp.asarray(points), 80, 0))
    np.testing.assert_allclose(short[[0, -1]], points[[0, -1]])
    assert np.linalg.norm(np.diff(short, axis=0), axis=1).sum() < 0.75


def test_steps_lead_to_the_goal_whatever_they_are():
    steps = jnp.asarray(np.random.default_rng(0).normal(size=(11, 6)), jnp.float32)
    knots = motion.steps_knots(motion.end_at(steps, jnp.asarray(GOAL - START)), ARM.limits)
    path = motion.join_knots(jnp.asarray(START), *knots)
    end = pj.evaluate(path, jnp.sum(path.durations))
    np.testing.assert_allclose(end, GOAL, atol=1e-5)
