import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.ball.flight import BallState, drag_free_flight
from planner_jax.core.plan_files import leaves_by_name
from planner_jax.optimise.levenberg import LevenbergConfig
from planner_jax.referee.arm_clearance import KINDS
from planner_jax.referee.arm_clearance import clearances as referee_clearances
from planner_jax.referee.ball_in_box import entry_time as body_entry_time
from planner_jax.robot.arm import REGIMES, reach_of
from planner_jax.robot.arm_clearance import (
    clearances,
    clearances_and_slopes,
    least_clearances,
    num_of_obstacles,
)
from planner_jax.robot.arm_file import irb1600
from planner_jax.robot.arm_motion import angles_at, polynomial, profiles, step_weights
from planner_jax.robot.arm_scene import make_scene, paper_scene
from planner_jax.runs.timing import CompileClock
from planner_jax.sweep.block.settings import REGIMES as SWEPT
from planner_jax.task.block.default_planner import OnlineBlock
from planner_jax.task.block.problem.end_poses import end_poses
from planner_jax.task.block.problem.flight import entry_time, flight_of
from planner_jax.task.block.problem.terms import contact_terms
from planner_jax.task.block.search.attempts import Search, read_learned_starts
from planner_jax.task.block.search.least_squares import rank_poses
from planner_jax.trajectory.polynomial import evaluate
from tests.derivatives import double
from tests.trees import as_numpy

SMALL = OnlineBlock(
    pieces=6, points=10, searches=(Search(straight=12, tries=3, solver=LevenbergConfig(8)),)
)
# A planner that tries only straight motions of the joints. Its program for a single case compiles
# much faster than a program for a batch.
BRISK = dataclasses.replace(SMALL, searches=(Search(straight=60, tries=0),), brisk=True)


def throw(**options):
    return pj.block.case((9.0, 0.5, 0.3), (-8.0, -0.4, 5.4), **options)


def test_a_throw_is_the_same_wherever_a_batch_begins():
    many, one = pj.block.draw(6, seed=3), pj.block.draw(1, seed=3, first=4)
    np.testing.assert_array_equal(many.ball.pos[4], one.ball.pos[0])
    np.testing.assert_array_equal(many.ball.vel[4], one.ball.vel[0])


@pytest.mark.parametrize(("suite", "farthest"), [("pole", 12.0), ("open", 12.0), ("short", 8.0)])
def test_balls_come_into_both_boxes_past_the_pole(suite, farthest):
    cases = pj.block.draw(100, suite)
    flights = jax.jit(jax.vmap(flight_of))(cases)
    assert flights.comes.all()
    away = np.linalg.norm(cases.ball.pos[:, :2], axis=1)
    assert (away >= 6.0).all() and (away <= farthest).all()
    assert np.all(cases.scene.capsule_radius > 0.0) == (suite != "open")
    at = jax.jit(jax.vmap(jax.vmap(drag_free_flight, (None, 0, None))))
    times = np.linspace(0.0, 1.0, 400)[None] * flights.latest[:, None]
    path = at(cases.ball, times, cases.gravity).pos
    gaps = np.linalg.norm(path[..., :2] - np.array([[[0.806, 0.0]]]), axis=-1)
    assert suite == "open" or gaps.min() > 0.099


def test_a_ball_gets_into_a_box_when_it_is_there(float64):
    box = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), paper_scene().outer)

    def entry(pos, vel):
        ball = BallState(pos=jnp.asarray(pos), vel=jnp.asarray(vel))
        return entry_time(box, ball, jnp.asarray(9.81))

    assert entry((5.0, 0.2, 1.0), (-8.0, 0.0, 1.0)) == (pytest.approx(0.5), True)
    fall = pytest.approx(np.sqrt(4.0 / 9.81))
    assert entry((0.0, 0.0, 3.85), (0.0, 0.0, 0.0)) == (fall, True)
    assert not entry((5.0, 3.0, 1.0), (-8.0, 0.0, 1.0))[1]  # The ball passes the box.
    assert not entry((5.0, 0.0, 1.0), (8.0, 0.0, 1.0))[1]  # The ball flies away.
    assert not entry((5.0, 0.0, 0.1), (-8.0, 0.0, 0.0))[1]  # The ball comes from below.


def test_steps_add_up_to_the_integral_of_rates():
    shares, rates = tuple(np.linspace(0.0, 1.0, 23)), np.random.default_rng(0).normal(size=8)
    fine = np.linspace(0.0, 1.0, 70001)
    values = np.interp(fine, np.linspace(0.0, 1.0, 8), rates)
    integral = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1])) / 70000])
    first, steps = step_weights(7, shares)
    found = first * rates[0] + steps @ rates[1:]
    np.testing.assert_allclose(found, np.interp(shares, fine, integral), atol=1e-8)


def test_polynomials_are_the_same_motion(float64):
    start, first, *steps = jnp.asarray(np.random.default_rng(1).normal(size=(7, 6)))
    shares, duration, steps = tuple(np.linspace(0.0, 1.0, 11)), 0.7, jnp.stack(steps)

    @jax.jit
    def both(start, first, steps):
        motion = polynomial(start, first, steps, jnp.asarray(duration))
        times = duration * jnp.asarray(shares)
        angles, rates = (jax.vmap(lambda t, k=k: evaluate(motion, t, k))(times) for k in (0, 1))
        return angles, angles_at(start, first, steps, shares), rates

    of_pieces, of_sums, rates = both(start, first, steps)
    np.testing.assert_allclose(of_pieces, of_sums, atol=1e-12)
    np.testing.assert_allclose(rates[0], first / duration)
    np.testing.assert_allclose(rates[-1], steps[-1] / duration)


@pytest.mark.parametrize("ends_at_rest", [True, False])
def test_profiles_turn_by_one(ends_at_rest):
    shapes = profiles(10, ends_at_rest)
    assert shapes @ step_weights(10, (1.0,))[1][0] == pytest.approx(np.ones(len(shapes)))
    assert np.all((shapes[:, -1] == 0.0) == ends_at_rest)


def test_the_arm_is_clear_at_home_and_not_when_it_reaches_into_the_pole():
    arm, scene = as_numpy((irb1600(), paper_scene()))
    compiled = jax.jit(lambda angles, scene: clearances(arm, scene, angles[None])[:, 0])
    at = lambda *given: np.asarray(compiled(*given))  # noqa: E731
    home, num = at(arm.home, scene), num_of_obstacles(arm, scene)
    ahead = np.array([0.0, 0.9, 0.0, 0.0, 0.0, 0.0], np.float32)
    assert home.min() > 0.003 and home.size > num
    assert at(ahead, scene)[:num].min() < 0.0 < at(ahead, scene)[num:].min()
    assert at(ahead, as_numpy(paper_scene(has_pole=False))).min() > 0.0


@pytest.mark.slow
def test_an_arm_that_starts_nearer_than_the_margin_is_planned_with_the_margin_that_remains():
    gap_at = jax.jit(lambda scene: least_clearances(irb1600(), scene, irb1600().home[None])[0])
    near, far = 0.0, 1.0  # [m], factors of the pole's place; the arm touches the nearer pole
    for _ in range(30):
        share = 0.5 * (near + far)
        scene = as_numpy(paper_scene(pole=(0.1, 0.8 * share)))
        near, far = (near, share) if gap_at(scene) > 1.4e-3 else (share, far)
    assert 0.0 < gap_at(scene) < 0.5 * OnlineBlock.margin
    usual = pj.block.draw(16, "open", 3)
    cases = pj.block.case(usual.ball.pos, usual.ball.vel, scene=scene)
    plans = pj.plan(pj.block.planner(), cases)
    verdict = pj.block.judge(cases, plans)
    assert verdict.success[np.asarray(pj.are_solved(plans))].all()
    assert verdict.success.sum() > 4
    told = pj.block.prospects(pj.take(cases, 0)).sentence()
    assert told.endswith("and the arm starts 1.4 mm from a body")


def make_shelf():
    return make_scene(
        boxes=[((0.75, 0.75, 0.9), (0.1, 0.1, 0.1), (0.9, 0.1, 0.4, 0.0))],
        spheres=[((0.7, -0.6, 1.3), 0.06)],
        capsules=[([(0.806, y, -0.48), (0.806, y, 2.5)], 0.05) for y in (-0.35, 0.0)],
        cylinders=[([(0.5, 0.9, 0.0), (0.9, 0.9, 0.1)], 0.05)],
        meshes=[(np.eye(4, 3), 0.3, (0.8, -0.9, 0.6), (1.0, 0.0, 0.2, 0.0))],
        floor=-0.48,
    )


@pytest.mark.slow
def test_balls_are_blocked_among_two_poles_a_box_a_sphere_a_cylinder_and_a_mesh():
    usual = pj.block.draw(40, "open", 3, wide=True)
    cases = pj.block.case(usual.ball.pos, usual.ball.vel, wide=True, scene=make_shelf())
    plans = pj.plan(pj.block.planner(), cases)
    verdict, bare = pj.block.judge(cases, plans), pj.block.judge(cases, pj.plan(SMALL, usual))
    np.testing.assert_array_equal(verdict.success, pj.are_solved(plans))
    assert verdict.success.mean() > 0.8 > bare.success.mean()
    assert "obstacle" in bare.failed_limit


def test_a_ball_with_a_radius_and_a_rounded_body_are_touched_when_the_referee_says():
    usual = pj.block.draw(60, "open", 3)
    person = make_scene(protected_capsule=([(0.0, 0.0, 1.2), (0.0, 0.0, 0.3)], 0.3))
    bent = make_scene(protected_capsule=([(0.3, 0.2, 1.1), (-0.2, -0.2, 0.3)], 0.2))
    of_flights = jax.jit(jax.vmap(flight_of))
    for scene, radius in ((None, 0.05), (person, 0.0), (person, 0.04), (bent, 0.04)):
        ball = usual.ball
        cases = pj.block.case(ball.pos, ball.vel, scene=scene, ball_radius=radius)
        flight = of_flights(cases)
        leaves = {name: np.asarray(leaf, float) for name, leaf in leaves_by_name(cases).items()}
        with np.errstate(invalid="ignore"):
            entry = body_entry_time(leaves, 0.0)
        np.testing.assert_array_equal(flight.comes, np.isfinite(entry))
        comes = np.asarray(flight.comes)
        assert comes.any() and np.all(comes) == (scene is None)
        if scene is bent:  # throws at such a body meet it
            aimed = pj.block.draw(60, "open", 3, scene=bent)
            assert np.all(of_flights(dataclasses.replace(cases, ball=aimed.ball)).comes)
        np.testing.assert_allclose(np.asarray(flight.latest)[comes], entry[comes], atol=2e-4)


def test_throws_at_a_scene_hit_its_body_and_miss_its_obstacles():
    ends = [(0.0, 0.0, 0.3), (0.0, 0.0, 1.1)]
    shelf = {"boxes": [((2.0, 0.0, 1.0), (0.1, 2.0, 2.0), (1.0, 0.0, 0.0, 0.0))]}
    bare, full = (make_scene(protected_capsule=(ends, 0.3), **each) for each in ({}, shelf))
    cases, fewer = (pj.block.draw(20, "open", 3, scene=scene) for scene in (bare, full))
    flights = jax.jit(jax.vmap(flight_of))
    assert flights(cases).comes.all() and flights(fewer).comes.all()
    assert not np.array_equal(cases.ball.pos, fewer.ball.pos)
    wall = make_scene(boxes=[((1.5, 0.0, 0.8), (0.1, 9.0, 9.0), (1.0, 0.0, 0.0, 0.0))])
    with pytest.raises(ValueError, match="scene must be reached by one of 2000 random throws"):
        pj.block.draw(1, "open", 3, scene=wall)


@pytest.mark.slow
def test_balls_with_a_radius_are_blocked_before_they_touch_a_person():
    scene = make_scene(protected_capsule=([(0.0, 0.0, 0.3), (0.0, 0.0, 1.1)], 0.35))
    usual = pj.block.draw(40, "open", 3, scene=scene)
    ball = usual.ball
    cases = pj.block.case(ball.pos, ball.vel, wide=True, scene=scene, ball_radius=0.05)
    plans = pj.plan(pj.block.planner(), cases)
    verdict = pj.block.judge(cases, plans)
    np.testing.assert_array_equal(verdict.success, pj.are_solved(plans))
    assert verdict.success.mean() > 0.85 and np.abs(verdict.height).max() < 1e-3


def with_outline(half):
    """Return the IRB 1600 with a smaller rectangular outline for balls; the plate is the same."""
    corners = np.array([(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)], np.float32)
    return dataclasses.replace(irb1600(), shield_corners=corners * np.float32(half))


@pytest.mark.slow
@pytest.mark.parametrize("half", [(0.03, 0.15), (0.15, 0.03)])
def test_balls_meet_a_narrow_shield_within_its_outline(half):
    cases = pj.block.draw(60, "pole", 5, wide=True, arm=with_outline(half))
    plans = pj.plan(pj.block.planner(), cases)
    verdict = pj.block.judge(cases, plans)
    np.testing.assert_array_equal(verdict.success, pj.are_solved(plans))
    assert verdict.success.mean() > 0.85 and verdict.miss.max() > 0.031


@pytest.mark.slow
def test_clearances_change_with_the_joints_as_their_slopes_say(float64):
    arm, scene = jax.tree.map(jnp.asarray, (irb1600(), paper_scene()))
    angles = jnp.asarray(np.random.default_rng(1).uniform(arm.lower, arm.upper, (20, 6)))

    @jax.jit
    def both(angles):
        each = jax.jacfwd(lambda angles: clearances(arm, scene, angles[None])[:, 0])
        expected = jnp.moveaxis(jax.vmap(each)(angles), 0, -1)
        own, slopes_at = clearances_and_slopes(arm, scene, angles)
        return clearances(arm, scene, angles), own, slopes_at(jnp.arange(20)), expected

    values, own, found, expected = both(angles)
    np.testing.assert_allclose(own, values, atol=1e-12)
    assert found.shape == expected.shape == (values.shape[0], 6, 20)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_no_pose_is_freer_than_the_referee_says(float64):
    rng, num = np.random.default_rng(3), 2000
    arm, scene = irb1600(), paper_scene()
    moved = {"floor": rng.uniform(-0.6, -0.3, num)}
    for name, most in (("capsule_ends", 1.2), ("beam_ends", 0.3)):
        moved[name] = getattr(scene, name) + rng.uniform(-most, most, (num, 1, 1, 3))
    angles = rng.uniform(arm.lower, arm.upper, (num, 6))
    case = pj.block.case(np.full((num, 3), 9.0), np.ones(3), angles=angles)
    case = double(dataclasses.replace(case, scene=dataclasses.replace(case.scene, **moved)))
    each = jax.jit(jax.vmap(lambda case: clearances(case.arm, case.scene, case.angles[None])[:, 0]))
    least = each(case).min(axis=1)
    leaves = {name: np.asarray(leaf, float) for name, leaf in leaves_by_name(case).items()}
    angles = np.asarray(case.angles, float).T[:, :, None]
    kinds = referee_clearances(leaves, arm, angles, np.ones((num, 1), bool))
    distances = np.array([kinds[kind][0] for kind in KINDS])
    theirs = distances.min(axis=0)
    assert (theirs[least >= OnlineBlock().margin] > -1e-3).all()  # the referee's tolerance
    free = theirs > 0.01
    np.testing.assert_allclose(least[free], theirs[free], atol=6e-3)
    nearest = np.array([kinds[kind][2] for kind in KINDS])[distances.argmin(axis=0), np.arange(num)]
    assert {"link 1", "link 2", "link 3"} <= {name[:6] for name in nearest[theirs < 0.0]}


def test_end_poses_meet_the_ball(float64):
    case = throw(dtype=jnp.float64)

    @jax.jit
    def solve(case):
        flight = flight_of(case)
        poses = end_poses(case, flight, 10, 6)
        of_pose = jax.vmap(lambda q, t: contact_terms(case, flight, q, t, SMALL.weights)[2])
        return poses, of_pose(poses.angles, poses.time)

    poses, excess = solve(case)
    there = np.isfinite(poses.effort)
    assert there.sum() > 10 and (excess[there] < 0.0).all()
    np.testing.assert_allclose(poses.angles[:, 5], case.angles[5])


@pytest.mark.slow
@pytest.mark.parametrize(("regime", "half"), [("R1", 0.15), ("R2", 0.15), ("R2", 0.001)])
def test_slopes_of_least_squares_are_those_of_the_cost(regime, half, float64):
    """Let joints move at the start and the contact be too late, so that no residual is zero."""
    case = throw(
        regime=regime,
        rates=(0.3, -0.2, 0.1, 0.2, -0.4, 0.5),
        arm=with_outline(half),
        dtype=jnp.float64,
    )
    flight = flight_of(case)
    poses = end_poses(case, flight, SMALL.points, SMALL.pieces)
    nearest = rank_poses(poses, 1, 1.0 - SMALL.slack)[0]
    start = SMALL.encode_straight(case, poses, nearest)
    rng = np.random.default_rng(0)
    point = start + jnp.asarray(rng.normal(0.0, 0.02, start.shape)).at[-1].set(0.0)
    point = point.at[-1].set(flight.latest + 0.01)
    model = jax.jit(lambda point: SMALL.model(point, case, flight))
    gradient = 2.0 * np.asarray(model(point).gradient)
    shifts = 1e-6 * np.eye(point.size)
    slopes = [(model(point + s).cost - model(point - s).cost) / 2e-6 for s in shifts]
    np.testing.assert_allclose(gradient, slopes, atol=2e-2 * np.abs(gradient).max())


@pytest.mark.slow
def test_claims_are_confirmed_by_the_referee():
    planner = pj.block.planner()
    for regime, wide, least in (("R1", True, 0.95), ("R2", False, 0.8), ("R3", False, 0.9)):
        cases = pj.block.draw(60, seed=5, regime=regime, wide=wide)
        plans = pj.plan(planner, cases)
        verdict: Any = pj.block.judge(cases, plans)
        assert verdict.success.mean() >= least
        np.testing.assert_array_equal(verdict.success, pj.are_solved(plans))
    one = pj.plan(planner, pj.take(cases, 3))
    assert one.status == plans.status[3]
    np.testing.assert_allclose(one.contact_time, plans.contact_time[3], atol=1e-4)


def test_plans_of_a_batch_say_what_became_of_each_ball():
    cases = jax.tree.map(np.array, pj.block.draw(8, seed=8, regime="R1", wide=True))
    cases.ball.vel[1, 0] *= -1.0  # The ball flies away from the arm.
    cases.ball.pos[2] = np.nan
    cases.scene.floor[6] = 0.5  # The floor is above the shield.
    for box in (cases.scene.inner, cases.scene.outer):  # The arm cannot reach them.
        box.lower[7, 2] += 4.0
        box.upper[7, 2] += 4.0
    cases.ball.pos[7, 2] += 4.0
    plans = jax.device_get(pj.plan(SMALL, jax.tree.map(jnp.asarray, cases)))
    verdict: Any = pj.block.judge(cases, plans)
    names = [pj.Status(status).name for status in plans.status[[1, 2, 6, 7]]]
    assert names == ["OUT_OF_REACH", "BAD_INPUT", "BLOCKED", "OUT_OF_REACH"]
    assert verdict.failed_limit[2] == "not finite" and not verdict.success[6]
    others = [0, 3, 4, 5]
    assert pj.are_solved(plans)[others].sum() >= 3
    np.testing.assert_array_equal(verdict.success[others], pj.are_solved(plans)[others])
    setpoints = plans.sample(100.0)
    np.testing.assert_allclose(setpoints.angles[0, 0], cases.angles[0], atol=1e-6)


def test_more_starting_points_than_are_stored_are_drawn_like_the_stored_ones():
    ranks, bumps = read_learned_starts()
    assert len(ranks) == 15
    for num in (20, 48):
        more, drawn = read_learned_starts(num)
        np.testing.assert_array_equal(more[:15], ranks)
        np.testing.assert_array_equal(drawn[:15], bumps)
        np.testing.assert_array_equal(drawn, read_learned_starts(60)[1][:num])
        assert len(more) == len(drawn) == num and more.max() == ranks.max()
    many = read_learned_starts(5000)[1][15:]
    np.testing.assert_allclose(many.mean(axis=0), bumps.mean(axis=0), atol=0.05)
    np.testing.assert_allclose(many.std(axis=0), bumps.std(axis=0), rtol=0.05)


@pytest.mark.slow
def test_drawn_starting_points_lead_to_plans():
    late = Search(
        straight=0, tries=33, first=15, kept=33, in_turn=False, solver=LevenbergConfig(12)
    )
    planner = dataclasses.replace(SMALL, searches=(late,))
    case = jax.tree.map(np.asarray, pj.take(pj.block.draw(1, seed=3), 0))
    plan = pj.plan(planner, case)
    assert pj.are_solved(plan) and pj.block.judge(case, plan).success


@pytest.mark.slow
def test_detours_from_the_best_plan_lead_to_further_plans():
    last = pj.block.planner(effort="good").attempts[-1]
    assert isinstance(last, Search) and last.detours and last.within is not None
    assert last not in pj.block.planner().attempts
    case = jax.tree.map(np.asarray, pj.take(pj.block.draw(1, "pole", 977, first=276), 0))
    for detours in (0, last.detours):
        planner = OnlineBlock(searches=(dataclasses.replace(last, detours=detours),))
        plan = pj.plan(planner, case)
        assert pj.are_solved(plan) == (detours > 0)
    assert pj.block.judge(case, plan).success


@pytest.mark.slow
def test_a_batch_on_a_gpu_is_solved_where_its_cases_are_one_by_one():
    straight = Search(straight=12, tries=0)
    bent = Search(straight=0, tries=4, kept=2, in_turn=False, solver=LevenbergConfig(8, trial=3))
    planner = dataclasses.replace(SMALL, searches=(straight, bent))
    cases = pj.block.draw(12, "pole", seed=5)
    run = jax.jit(lambda attempt, cases: planner.solve_at_once(cases, attempt))
    for attempt in planner.searches:
        plans = jax.tree.map(np.array, run(planner.load_attempt(attempt, cases), cases))
        alone = dataclasses.replace(planner, searches=(attempt,))
        solved = pj.are_solved(plans)
        one_by_one = [pj.are_solved(pj.plan(alone, pj.take(cases, k))) for k in range(12)]
        np.testing.assert_array_equal(solved, one_by_one)
        verdict: Any = pj.block.judge(cases, plans)
        assert 2 <= solved.sum() <= 11 and verdict.success[solved].all()


def test_brisk_motions_end_before_the_ball_is_there():
    cases = jax.tree.map(np.array, pj.block.draw(8, seed=8))
    cases.ends_at_rest[4] = False
    plans, singles = pj.plan(SMALL, cases), [pj.plan(BRISK, pj.take(cases, k)) for k in range(8)]
    quick = jax.tree.map(lambda *leaves: np.stack(leaves), *singles)
    some = pj.are_solved(quick)
    np.testing.assert_array_equal(some, pj.are_solved(plans))
    assert some.sum() >= 4 and some[4]
    verdict: Any = pj.block.judge(cases, quick)
    assert verdict.success[some].all()
    durations = quick.motion.durations.sum(axis=1)
    np.testing.assert_allclose(quick.cost[some], durations[some], rtol=1e-5)
    np.testing.assert_allclose(durations[4], quick.contact_time[4], rtol=1e-5)
    rests = some & (np.arange(8) != 4)
    assert np.all(durations[rests] < quick.contact_time[rests])
    assert np.all(durations[rests] < plans.motion.durations.sum(axis=1)[rests])
    rates = np.abs(quick.motion.coeffs[:, :, 1]) / cases.limits.velocity[:, None]
    rises = 2.0 * np.abs(quick.motion.coeffs[:, :, 2]) / cases.limits.acceleration[:, None]
    share = np.maximum(rates.max(axis=(1, 2)), rises.max(axis=(1, 2)))
    np.testing.assert_allclose(share[rests], 1.0 - SMALL.slack, rtol=1e-4)


def boxes(half):
    """Return the scene whose outer box is a cube around the origin with edges of 2 `half` [m]."""
    scene = paper_scene()
    lower, upper = (np.full(3, side * half, np.float32) for side in (-1.0, 1.0))
    outer = dataclasses.replace(scene.outer, lower=lower, upper=upper)
    return dataclasses.replace(scene, outer=outer)


BARE = dataclasses.replace(
    irb1600(), capsule_ends=np.zeros((0, 2, 3)), capsule_radius=np.zeros(0), capsule_link=()
)


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        (throw, {"regime": "R9"}, "regime must be one of R1, R2, R3, got 'R9'"),
        (throw, {"delay": -0.1}, "delay must be >= 0, got -0.1"),
        (throw, {"gravity": 0.0}, "gravity must be > 0, got 0"),
        (throw, {"angles": (0.0, 1.0)}, r"angles must have a .* ends with \(6,\), got \(2,\)"),
        (
            throw,
            {"angles": (0.0, 5.0, 0.0, 0.0, 0.0, 0.0)},
            "angles must be >= arm.lower and <= arm.upper, got 5",
        ),
        (throw, {"scene": boxes(0.3)}, "scene.inner.lower must be >= scene.outer.lower, got -0.4"),
        (throw, {"arm": BARE}, "arm must be one with a capsule around at least one link, got none"),
        (pj.block.draw, {"num": 0}, "num must be >= 1, got 0"),
        (pj.block.draw, {"num": 1, "suite": "x"}, "suite must be one of pole, .*, got 'x'"),
    ],
)
def test_an_error_in_a_case_or_a_draw_is_named(make, options, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        make(**options)
    assert tuple(REGIMES) == SWEPT


def test_an_arm_has_limits_of_its_own_and_no_regime_of_another_arm():
    arm = irb1600()
    slow = dataclasses.replace(arm.limits, velocity=0.5 * arm.limits.velocity)
    foreign = dataclasses.replace(arm, limits=slow)
    case = throw(arm=foreign)
    np.testing.assert_array_equal(case.limits.velocity, slow.velocity)
    np.testing.assert_array_equal(throw(limits=slow).limits.velocity, slow.velocity)
    assert case.ends_at_rest
    with pytest.raises(ValueError, match="regime must be left out for an arm with limits of its"):
        throw(arm=foreign, regime="R1")


@pytest.mark.slow
def test_after_a_warm_up_no_case_waits_for_the_compiler():
    planner, hard = pj.block.planner(), throw()
    easy = pj.block.case(hard.ball.pos, hard.ball.vel, scene=paper_scene(has_pole=False))
    pj.warm_up(planner, easy)
    with CompileClock() as clock:
        assert pj.plan(planner, easy).iterations == 0
        assert pj.plan(planner, hard).iterations > 0
    assert clock.seconds == 0.0
    with pytest.raises(ValueError, match="case must be one case, got batch shape"):
        pj.warm_up(planner, pj.block.draw(2))


def test_throws_at_another_arm_are_scaled_to_its_reach():
    arm = irb1600()
    small = dataclasses.replace(arm, origin=0.5 * arm.origin, shield_centre=0.5 * arm.shield_centre)
    cases, usual = pj.block.draw(4, "pole", arm=small), pj.block.draw(4, "pole")
    np.testing.assert_allclose(reach_of(small), 0.5 * reach_of(arm), rtol=1e-6)
    np.testing.assert_allclose(cases.scene.inner.upper, 0.5 * usual.scene.inner.upper, rtol=1e-6)
    ends, of_usual = cases.scene.capsule_ends, usual.scene.capsule_ends
    np.testing.assert_allclose(ends, 0.5 * of_usual, rtol=1e-6)
    flight = jax.jit(jax.vmap(flight_of))(cases)
    assert flight.comes.all()
    with pytest.raises(ValueError, match="size must be finite and > 0"):
        paper_scene(size=0.0)
