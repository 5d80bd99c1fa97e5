"""Motions of an arm from standstill to standstill among obstacles, and their referee."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import planner_jax as pj
from planner_jax.robot.arm import shield_pose
from planner_jax.robot.arm_clearance import clearances, clearances_and_slopes
from planner_jax.robot.arm_file import irb1600
from planner_jax.task.reach import shortcut, tree
from planner_jax.task.reach.default_planner import ReachPlan, Search, TreeSearch
from planner_jax.task.reach.motion import join_knots, pad_knots, straight_knots
from planner_jax.trajectory.polynomial import PiecewisePolynomial
from tests.derivatives import double
from tests.trees import as_numpy, assert_same

ARM = irb1600()
START, GOAL = (np.array([side, 0.3, -0.3, 0.0, 0.6, 0.0], np.float32) for side in (-0.8, 0.8))


def make_scene(middle):
    """Return a scene of a box, and of a cylinder and a sphere that are beside the motion."""
    return pj.reach.make_scene(
        boxes=[(middle, (0.3, 0.1, 0.5), (0.98, 0.0, 0.0, 0.2))],
        cylinders=[([(-1.5, 0.0, 0.0), (-1.5, 0.2, 1.0)], 0.1)],
        spheres=[((0.0, 0.0, 2.8), 0.2)],
    )


FREE, WALL = make_scene((-1.5, 0.0, 2.5)), make_scene((0.95, 0.0, 0.9))
DIRECT = pj.reach.planner(searches=(Search(),))
TREE = pj.reach.planner(searches=(TreeSearch(rays=400, shortcuts=100),))


def reach(goal=GOAL, scene=FREE, **options):
    goals = np.broadcast_to(goal, (4, 6))  # all cases share one program
    return pj.reach.case(goals=goals, angles=options.pop("angles", START), scene=scene, **options)


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


@pytest.mark.slow
def test_a_box_in_between_is_passed_by_a_longer_motion():
    case = reach(scene=WALL)
    plan = pj.plan(TREE, case)
    verdict = pj.reach.judge(case, plan)
    assert verdict.success, verdict.sentence()
    assert pj.are_solved(plan)
    assert verdict.obstacle_clearance > 0.0
    assert 1.05 * least_time(GOAL - START) < verdict.duration < 2.0 * least_time(GOAL - START)
    assert max(verdict.velocity_share, verdict.acceleration_share) <= 1.0


def test_a_motion_through_a_box_is_rejected_by_planner_and_judge():
    through = pj.plan(DIRECT, reach())
    case = reach(scene=WALL)
    verdict = pj.reach.judge(case, through)
    assert verdict.failed_limit == "obstacle"
    assert "and box 1 are" in verdict.sentence()
    assert not pj.are_solved(pj.plan(DIRECT, case))


def test_a_picture_has_the_verdict_and_shows_arm_and_obstacles():
    case, plan = reach(scene=WALL), pj.plan(DIRECT, reach())
    figure = pj.show(case, plan)
    assert figure.get_suptitle() == pj.reach.judge(case, plan).sentence()
    _, side, rates = figure.axes
    low, high = side.get_ylim()
    assert -1.0 < low < 0.0 and 3.0 < high < 4.0  # from the base to the sphere, without a floor
    assert len(rates.lines) == 6
    with pytest.raises(pj.ArgumentError, match="case must be one case of hit, catch"):
        pj.show(plan, plan)


def test_a_mesh_is_judged_as_its_hull_and_planned_as_the_box_around_it():
    through = pj.plan(DIRECT, reach())
    corners = [(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]
    pose = (0.95, 0.0, 0.9), (0.98, 0.0, 0.0, 0.2)
    of_box = pj.reach.make_scene(boxes=[(pose[0], (0.3, 0.1, 0.5), pose[1])])
    of_mesh = pj.reach.make_scene(meshes=[(np.multiply(corners, [0.3, 0.1, 0.5]), 0.5, *pose)])
    one, two = (pj.reach.judge(reach(scene=scene), through) for scene in (of_box, of_mesh))
    assert "and mesh 1 are" in two.sentence(0) and not two.success.any()
    np.testing.assert_allclose(two.obstacle_clearance, one.obstacle_clearance, atol=1e-5)
    solid = of_mesh.without_meshes()
    np.testing.assert_allclose(solid.box_middle, of_box.box_middle, atol=1e-6)
    axes = [Rotation.from_quat(np.roll(s.box_turn[0], -1)).as_matrix() for s in (of_box, solid)]
    same = np.abs(axes[0].T @ axes[1])  # the edges in another order
    np.testing.assert_allclose(of_box.box_half[0] @ same, solid.box_half[0], atol=1e-5)


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
    weak = dataclasses.replace(case.limits, torque=np.where(np.arange(6) == 1, 20.0, np.inf))
    verdict = pj.reach.judge(dataclasses.replace(case, limits=weak), plan)
    assert verdict.failed_limit == "torque" and verdict.failed_part == "joint_2"


@pytest.mark.parametrize("side", ["start", "goal"])
def test_a_start_or_goal_in_an_obstacle_is_blocked(side):
    inside = np.array([0.0, 0.3, -0.3, 0.0, 0.6, 0.0])
    ends = {"angles": inside} if side == "start" else {"goal": inside}
    case = reach(scene=WALL, **ends)
    plan = pj.plan(DIRECT, case)
    assert plan.status == pj.Status.BLOCKED
    told = pj.reach.judge(case, plan).sentence()
    assert f"no motion is free: at the {side} the shield and box 1 are" in told


def test_a_goal_beyond_the_joints_limits_is_out_of_reach_without_a_search():
    case = reach(GOAL + [9.0, 0, 0, 0, 0, 0])
    plan = pj.plan(DIRECT, case)
    assert plan.status == pj.Status.OUT_OF_REACH
    assert "joint_1 is 6.66 rad beyond its limit at every goal" in (
        pj.reach.judge(case, plan).sentence()
    )
    assert not TreeSearch().is_due(plan)


def test_an_arm_whose_base_is_a_capsule_is_judged():
    num = ARM.num
    point = np.tile([[0.0, 0.0, 0.1]], (2, 1)).astype(np.float32)
    arm = dataclasses.replace(ARM, base_box=point, base_pairs=(1,))
    rods = [([(0.0, 0.0, 3.0), (0.0, 0.0, 4.0)], 0.0)]  # a radius of 0 is judged, too
    case = pj.reach.case(START, angles=START, arm=arm, scene=pj.reach.make_scene(capsules=rods))
    coeffs = np.concatenate([START[None], np.zeros((2, num), np.float32)])[None]
    path = PiecewisePolynomial(coeffs=coeffs, durations=np.ones(1, np.float32))
    still = ReachPlan(motion=path, goal=0, cost=1.0, violation=0.0, iterations=0, status=1)
    still = jax.tree.map(np.asarray, still)
    verdict = pj.reach.judge(case, still)
    assert verdict.success, verdict.sentence()
    turn, face = map(np.asarray, shield_pose(ARM, START))
    middle = face - 0.005 * turn[:, 0]  # of the plate
    inside = dataclasses.replace(arm, base_box=np.stack([middle, middle]))
    verdict = pj.reach.judge(dataclasses.replace(case, arm=inside), still)
    assert verdict.failed_limit == "self" and "the base" in verdict.sentence()


def test_the_nearest_free_goal_is_reached():
    inside, far = [0.0, 0.3, -0.3, 0.0, 0.6, 0.0], [2.0, 0.3, -0.3, 0.0, 0.6, 0.0]
    near, beyond = [-0.5, 0.3, -0.3, 0.0, 0.6, 0.0], [9.0, 0.3, -0.3, 0.0, 0.6, 0.0]
    case = pj.reach.case(goals=[far, inside, beyond, near], angles=START, scene=WALL)
    plan = pj.plan(DIRECT, case)
    assert plan.goal == 3
    assert pj.reach.judge(case, plan).success


@pytest.mark.slow
def test_a_batch_has_the_plans_of_its_cases():
    goals = np.stack([GOAL, START, START + np.array([0.5, 0, 0, 0, 0, 0], np.float32)])
    cases = pj.reach.case(goals=np.repeat(goals[:, None], 4, axis=1), angles=START, scene=FREE)
    plans = pj.plan(DIRECT, cases)
    assert pj.reach.judge(cases, plans).success.all()
    for k, goal in enumerate(goals):
        plan = pj.plan(DIRECT, reach(goal))
        np.testing.assert_allclose(plans.motion.coeffs[k], plan.motion.coeffs, atol=1e-5)


def test_shapes_are_checked():
    with pytest.raises(ValueError, match="goal must be either goal or goals"):
        pj.reach.case(GOAL, goals=[GOAL])
    with pytest.raises(ValueError, match="goal must have a shape that ends with"):
        pj.reach.case(np.zeros(5))
    with pytest.raises(ValueError, match=r"capsules\[0\].radius must be >= 0, got -0.1"):
        pj.reach.make_scene(capsules=[([(0.0, 0.0, 0.0), (0.0, 0.0, 1.0)], -0.1)])


def test_planner_and_judge_measure_the_same_distances():
    case = reach()
    plan = pj.plan(DIRECT, case)
    ends = np.asarray(plan.motion.durations)
    path = jax.tree.map(np.asarray, plan.motion)
    shares = np.linspace(0.0, 1.0, 400)
    local = (ends[:, None] * shares)[..., None]
    angles = np.sum([path.coeffs[:, None, k] * local**k for k in range(3)], axis=0).reshape(-1, 6)
    least = float(jnp.min(jax.jit(clearances)(ARM, FREE, angles.astype(np.float32))))
    verdict = pj.reach.judge(case, plan)
    assert min(verdict.obstacle_clearance, verdict.self_clearance) == pytest.approx(least, abs=5e-4)


@pytest.mark.slow
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
    short = np.asarray(jax.jit(lambda points: tree.shorten(free, points, 80, 0))(points))
    np.testing.assert_allclose(short[[0, -1]], points[[0, -1]])
    assert np.linalg.norm(np.diff(short, axis=0), axis=1).sum() < 0.75


@pytest.fixture(scope="module")
def joined():
    """Return 200 pairs of states of the arm's joints, and the fastest motions between them."""
    rng = np.random.default_rng(0)
    speed = np.asarray(ARM.limits.velocity)
    turn = rng.uniform(-1.0, 1.0, (200, 6)).astype(np.float32)
    before, after = rng.uniform(-0.7, 0.7, (2, 200, 6)).astype(np.float32) * speed
    join = jax.jit(jax.vmap(lambda *each: shortcut.join(each[0], each[1], each[2], ARM.limits)))
    return turn, before, after, *map(np.asarray, join(turn, before, after))


def test_a_shortcut_joins_two_states_within_the_limits(joined):
    turn, before, after, durations, rates, is_within = joined
    turned = 0.5 * durations[..., None] * (rates[:, 1:] + rates[:, :-1])
    np.testing.assert_allclose(turned.sum(axis=1)[is_within], turn[is_within], atol=2e-5)
    np.testing.assert_array_equal(rates[:, 0], before)
    np.testing.assert_array_equal(rates[:, -1], after)
    assert np.mean(is_within) > 0.5
    assert (np.abs(rates[is_within]) <= 1.001 * np.asarray(ARM.limits.velocity)).all()
    long = (durations > 1e-3)[..., None] & is_within[:, None, None]
    rise = np.diff(rates, axis=1) / np.maximum(durations, 1e-3)[..., None]
    assert (np.abs(np.where(long, rise, 0.0)) <= 1.001 * np.asarray(ARM.limits.acceleration)).all()


def test_a_joint_turns_at_its_limits_in_a_shortcut(joined):
    *_, durations, rates, is_within = joined
    rise = np.abs(np.diff(rates, axis=1)) / np.maximum(durations, 1e-3)[..., None]
    shares = rise / np.asarray(ARM.limits.acceleration), np.abs(rates[:, 1:]) / ARM.limits.velocity
    fastest = np.where(durations > 1e-3, np.maximum(*shares).max(axis=2), 1.0).min(axis=1)
    assert np.mean(fastest[is_within] > 0.99) > 0.95


def test_shortcuts_avoid_what_is_not_free_and_save_time():
    # Two joints move around a square that is not free.
    limits = dataclasses.replace(ARM.limits, velocity=np.ones(2), acceleration=np.ones(2))
    corners = np.array([[-1.0, 0.0], [-1.0, 1.2], [1.0, 1.2], [1.0, 0.0]], np.float32)
    stops = jax.jit(lambda corners: pad_knots(*straight_knots(corners, limits), 48))(corners)
    shares = np.linspace(0.0, 1.0, 200)

    @jax.jit
    def angles_of(path):
        times = shares * jnp.sum(path.durations)
        return jax.vmap(lambda time: pj.evaluate(path, time))(times)

    def is_free(path):
        return ~jnp.any(jnp.max(jnp.abs(angles_of(path)), axis=1) < 0.6)

    fast = jax.jit(lambda knots: shortcut.hasten(is_free, corners[0], knots, limits, 300, 0))
    path = as_numpy(jax.jit(join_knots)(corners[0], *fast(stops)))
    angles = np.asarray(angles_of(path))
    np.testing.assert_allclose(angles[[0, -1]], np.asarray(corners)[[0, -1]], atol=1e-4)
    assert np.abs(angles).max(axis=1).min() > 0.59
    assert np.sum(path.durations) < 0.7 * np.sum(stops[0])
    assert (np.abs(2.0 * path.coeffs[:, 2]) <= 1.001).all()


def test_trees_find_a_path_through_a_gap():
    # The second coordinate must be near 0.8 where the first one is near 0.
    free = lambda states: (jnp.abs(states[:, 0]) > 0.1) | (jnp.abs(states[:, 1] - 0.8) < 0.05)  # noqa: E731
    start, goal = jnp.array([-1.0, -1.0]), jnp.array([[1.0, -1.0]])
    bounds = (-1.0 * jnp.ones(2), jnp.ones(2))
    find = jax.jit(lambda rays: tree.find_path(free, start, goal, bounds, rays, 0, 1024))
    points, is_found, rays = map(np.asarray, find(1000))
    assert is_found
    assert 1 < rays < 1000
    np.testing.assert_allclose(points[[0, -1]], [[-1.0, -1.0], [1.0, -1.0]])
    steps = np.linspace(points[:-1], points[1:], 50).reshape(-1, 2)
    assert np.mean(jax.jit(free)(steps)) > 0.99
    assert not find(1)[1]


def test_drawn_motions_start_and_end_free_on_both_sides_of_the_box():
    cases = pj.reach.draw(200, seed=3)
    states = np.concatenate([cases.angles[:, None], cases.goals], axis=1)
    apart = jax.jit(jax.vmap(lambda case, at: clearances(case.arm, case.scene, at)))
    assert (np.asarray(apart(cases, states)) > 0.0).all()
    assert (states[:, 0, 0] < -1.0).all() and (states[:, 1, 0] > 1.0).all()
    later = pj.reach.draw(2, "pillar", 3, first=5)
    assert_same(later, pj.take(cases, slice(5, 7)))
