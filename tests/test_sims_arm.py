"""The simulated arm: standstill, tracking, scores of blocks, and a run of flights."""

import dataclasses
import json
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from arms import KINDS as ARMS
from arms import mjcf_of
from test_block_library import make_library

import planner_jax as pj
from planner_jax.baselines.block.library.file import save_library
from planner_jax.cli.main import main
from planner_jax.core import GRAVITY
from planner_jax.core.errors import ArgumentError
from planner_jax.referee.arm_clearance import KINDS
from planner_jax.robot.arm import shield_pose
from planner_jax.robot.arm_file import irb1600
from planner_jax.robot.arm_motion import polynomial, profiles
from planner_jax.robot.arm_scene import FLOOR
from planner_jax.robot.arm_shield import Shield
from planner_jax.sims.block_settings import BlockFly
from planner_jax.sims.execution import FRAME, TIMESTEP, Executed, execute
from planner_jax.sims.film import draw_flight
from planner_jax.sims.launch import flight_keys
from planner_jax.sims.model import World, mjcf
from planner_jax.sims.perception.observation import eye, see
from planner_jax.sims.perception.receding import Decided
from planner_jax.sims.robot import rotation
from planner_jax.sims.robots.arm.control import Course, reference_at
from planner_jax.sims.robots.arm.drives import IDEAL, TORQUES, Drives
from planner_jax.sims.robots.arm.robot import ShieldArm
from planner_jax.sims.scenery import box_solid, capsule_solid
from planner_jax.sims.tasks.block_flights import (
    BLOCK_ARM,
    BLOCK_WORLD,
    Budget,
    Throws,
    courses_of,
    fly_blocks,
    require_arm,
    score,
    throws,
)
from planner_jax.sims.tasks.block_shown import ground_of, scenery
from planner_jax.sims.tasks.intercept import CAR_WORLD
from planner_jax.sims.view import Viewer

HOME, LANES = np.asarray(irb1600().home), 4  # all batches are of one size: one program
TURN = np.array([-0.4, -0.5, 0.4, 0.6, -0.5, 0.8])  # [rad], of a motion without collisions
MOVING = 0.5  # [s], duration of a motion


def motion(turn, duration=MOVING, ends_at_rest=True):
    shape = profiles(10, ends_at_rest)[-1]
    steps = jnp.asarray(shape[:, None] * turn, jnp.float32)
    return polynomial(jnp.asarray(HOME), jnp.zeros(6), steps, jnp.float32(duration))


def batch(*trees):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def plans(*motions, contact, status=None):
    num = len(motions)
    none: Any = np.zeros(num, np.float32)
    states: Any = np.zeros(num, np.int32) if status is None else np.array(status, np.int32)
    contacts: Any = np.full(num, contact, np.float32)
    outcome = none, none, none.astype(np.int32), states
    return pj.block.BlockPlan(*outcome, motion=batch(*motions), contact_time=contacts)


STILL = motion(0.0 * TURN)
MOTIONS = (STILL, motion(TURN), motion(-0.3 * TURN), motion(0.6 * TURN, ends_at_rest=False))


def execute_motions(drives=IDEAL, **options):
    begin: Any = np.full(LANES, 0.05, np.float32)
    braking: Any = np.full((LANES, 6), 30.0, np.float32)
    courses = Course(motion=batch(*MOTIONS), begin=begin, braking=braking)
    since, until = np.full(LANES, 0.05), np.full(LANES, 0.05 + MOVING)
    options = {"since": since, "until": until, "end": 0.8, "drives": drives, **options}
    return courses, execute(BLOCK_WORLD, courses, flight_keys(0, np.arange(LANES)), **options)


@pytest.fixture(scope="module")
def ideal():
    return execute_motions()


@pytest.mark.slow
def test_a_plan_is_tracked_within_a_milliradian_by_ideal_drives(ideal):
    _, flown = ideal
    assert np.abs(flown.angles[0] - HOME).max() < 1e-5  # the home, against gravity
    assert flown.torque_rms[0, 1] > 100.0  # [N m], load of joint 2 at home
    assert np.abs(flown.angles - flown.wanted).max() < 1e-3
    assert flown.error_worst.max() < 1e-3 and flown.error_rms[1:].min() > 0.0
    assert np.abs(flown.angles[1, -1] - HOME - TURN).max() < 1e-3
    assert flown.tracking[:, 1].max() < 1e-3
    assert (flown.saturation == 0.0).all()


@pytest.mark.slow
def test_joints_that_turn_when_a_plan_ends_are_braked(ideal):
    courses, flown = ideal
    end = 0.05 + MOVING
    at = np.searchsorted(flown.times, end)
    rates = (flown.angles[3, at] - flown.angles[3, at - 2]) / (2.0 * FRAME)
    assert np.abs(rates).min() > 0.5
    assert np.abs(flown.last_rates).max() < 1e-3
    there = HOME + 0.6 * TURN + 0.5 * np.sign(rates) * rates**2 / 30.0
    assert np.abs(flown.angles[3, -1] - there).max() < 0.02


def test_a_reference_is_smooth_where_a_plan_begins_and_its_rates_are_slopes():
    course = Course(MOTIONS[3], jnp.float32(0.05), jnp.full(6, 30.0))
    times = jnp.linspace(0.0, 0.8, 1601)
    reference = jax.jit(jax.vmap(lambda time: reference_at(course, time)))(times)
    step = float(times[1])
    slopes = np.gradient(np.asarray(reference.angles, float), step, axis=0)
    assert np.abs(slopes - reference.rates)[1:-1].max() < 0.03  # at a jump in acceleration
    rises = np.diff(np.asarray(reference.rates, float), axis=0) / step
    assert np.median(np.abs(rises - reference.accelerations[:-1])) < 0.02


@pytest.mark.slow
def test_torque_limits_are_active_and_not_exceeded():
    small = tuple(0.2 * torque for torque in TORQUES)
    _, flown = execute_motions(Drives(torques=small))
    assert (flown.torque_worst <= np.array(small) * (1.0 + 1e-6)).all()
    assert flown.saturation[1, :2].max() > 0.05
    assert flown.error_worst[1].max() > 1e-2
    assert flown.error_worst[0].max() < 1e-4  # the limits suffice for a standstill


@pytest.mark.slow
def test_a_late_plan_is_tracked_as_exactly_as_a_plan_in_time(ideal):
    late = 0.02
    _, flown = execute_motions(Drives(latency=0.5 * late), late=0.5 * late)
    frames = round(late / FRAME)
    apart = flown.angles[:, frames:] - ideal[1].angles[:, :-frames]
    assert np.abs(apart).max() < 1e-3
    assert flown.error_worst.max() < 1e-3
    assert flown.tracking[1, 1] > 0.01


@pytest.mark.slow
def test_noise_lag_and_mass_errors_hardly_matter_and_a_seed_gives_the_same_bits():
    drives = Drives(lag=0.005, angle_std=1e-4, rate_std=0.01, mass_error=0.05)
    _, flown = execute_motions(drives)
    _, again = execute_motions(drives)
    np.testing.assert_array_equal(flown.angles, again.angles)
    assert 1e-4 < flown.error_worst.max() < 1e-2
    assert flown.tracking[:, 1].max() < 2e-3


@pytest.fixture
def seven(tmp_path):
    """Return the options of an arm of seven joints in a file, with a shield of 1.5 kg."""
    own = ARMS["seven joints"]
    limits = {"position": np.stack([own.lower, own.upper], 1).tolist(), "torque": 50.0}
    files = {"limits.yaml": {"velocity": 2.0, "acceleration": 9.0, **limits}}
    files["shield.yaml"] = {"radius": 0.2, "position": [0.0, 0.0, 0.3], "mass": 1.5}
    for name, fields in files.items():
        (tmp_path / f"arm.{name}").write_text(json.dumps(fields))
    body = '<site name="shield"'
    ball = '<geom type="sphere" size=".02" mass="0"/>'
    (tmp_path / "arm.xml").write_text(mjcf_of(own).replace(body, ball + body))
    names = {"arm": "arm.xml", "shield": "arm.shield.yaml"}
    return {name: str(tmp_path / file) for name, file in names.items()} | {"tip": "shield"}


def test_an_arm_of_a_file_is_simulated_as_mujoco_reads_it(seven):
    flight = BlockFly(num=1, torque=0.5, **seven).flight()
    robot, own = flight.robot, ARMS["seven joints"]
    assert robot.noise_shape == (2, 7) and flight.drives.torques == (25.0,) * 7
    model, read = (
        mujoco.MjModel.from_xml_string(text)
        for text in (mjcf(World(robot, GRAVITY, num_balls=0)), mjcf_of(own))
    )
    np.testing.assert_allclose(model.body_mass[-7:], [1.0] * 6 + [2.5])
    angles = np.linspace(0.3, 0.9, 7) * own.upper
    states = [mujoco.MjData(each) for each in (model, read)]
    for each, state in zip((model, read), states, strict=True):
        state.qpos[:] = angles
        mujoco.mj_forward(each, state)
    here, there = states
    site, turn = there.site_xpos[0], there.site_xmat[0].reshape(3, 3)
    raised = [0.0, 0.0, robot.base_height]
    np.testing.assert_allclose(robot.place(angles), site + 0.3 * turn[:, 2] + raised, atol=1e-6)
    plate = model.geom("shield").id
    face = here.geom_xpos[plate] + 0.005 * here.geom_xmat[plate, ::3]
    np.testing.assert_allclose(face, robot.place(angles), atol=1e-6)
    places = robot.places(angles)
    assert len(places) == len(robot.shapes()) == 9
    np.testing.assert_allclose(places[7][0], here.xpos[-1], atol=1e-6)
    (plate,) = robot.shapes()[-1].solids
    rim = places[-1][0] + plate.corners @ rotation(places[-1][1], np).T
    away = np.linalg.norm(rim - robot.place(angles), axis=1)
    assert 0.2 - 1e-6 < away.min() and away.max() < 0.201


def test_solids_of_a_scene_are_drawn_where_they_are():
    turned = (0.9, 0.3, 0.2, 0.0)
    scene = pj.block.make_scene(
        boxes=[((0.7, -0.8, 1.0), (0.2, 0.1, 0.3), turned)],
        spheres=[((1.0, 0.8, 0.5), 0.1)],
        protected_capsule=([(0.0, 0.0, 0.3), (0.0, 0.0, 1.2)], 0.3),
    )
    parts = scenery(irb1600(np.float64), scene)
    raised = -ground_of(scene)
    assert ground_of(scene) == FLOOR and ground_of(pj.block.make_scene(floor=-0.3)) == -0.3
    inner, _, _, ball, box = parts
    np.testing.assert_allclose(inner.size, (0.6, 0.6, 1.5), atol=1e-6)
    ball, box = (np.array(each.corners) - [0.0, 0.0, raised] for each in (ball, box))
    np.testing.assert_allclose(np.linalg.norm(ball - [1.0, 0.8, 0.5], axis=1), 0.1, atol=1e-6)
    edges = np.linalg.norm(box[:, None] - box[None], axis=2)
    assert len(box) == 8 and edges.max() == pytest.approx(np.linalg.norm((0.2, 0.1, 0.3)), rel=1e-5)
    assert np.unique(edges.round(5))[1:4] == pytest.approx((0.1, 0.2, np.hypot(0.1, 0.2)), rel=1e-3)


def throw_at_shield(places, speed=8.0):
    turn, middle = map(np.asarray, shield_pose(irb1600(), jnp.asarray(HOME)))
    goal = middle + np.asarray(places) @ turn[:, 1:].T
    vel = np.tile(-speed * turn[:, 0], (len(places), 1))
    return pj.block.case(goal - 0.5 * vel, vel, gravity=1e-6)


def score_standstill(cases, angles, end=0.8):
    times = FRAME * np.arange(round(end / FRAME) + 1)
    num = len(cases.gravity)
    held = np.broadcast_to(angles, (num, times.size, 6)).astype(float)
    nothing, none = np.zeros((num, 6)), np.zeros(num)
    flown = Executed(times, held, held, np.zeros((num, 2)), *[nothing] * 6)
    cases = jax.tree.map(np.asarray, cases)
    return score(cases, plans(*[STILL] * num, contact=0.5), flown, Budget(*[none] * 6))


@pytest.mark.slow
def test_a_ball_on_the_shield_is_blocked_and_one_beside_it_is_not():
    places = [(0.0, 0.0), (0.1, -0.14), (0.16, 0.0), (0.0, -0.5)]
    found = score_standstill(throw_at_shield(places), HOME)
    assert found.blocked.tolist() == [True, True, False, False]
    assert found.success.tolist() == found.blocked.tolist()
    np.testing.assert_allclose(found.miss, np.linalg.norm(places, axis=1), atol=1e-4)
    disc = dataclasses.replace(irb1600(), shield_corners=np.array(Shield(radius=0.17).outline))
    cases = dataclasses.replace(throw_at_shield(places), arm=batch(*[disc] * len(places)))
    assert score_standstill(cases, HOME).blocked.tolist() == [True, False, True, False]
    # The ball touches the shield's face when the ball's centre is one radius (5 cm) away.
    np.testing.assert_allclose(found.contact[:2], 0.5 - 0.05 / 8.0, atol=1e-4)
    assert np.isnan(found.contact[2:]).all() and np.isnan(found.contact_pos[2:]).all()


@pytest.mark.slow
def test_a_ball_that_comes_from_behind_or_too_late_is_not_blocked():
    from_behind = throw_at_shield([(0.0, 0.0)], speed=-8.0)
    assert not score_standstill(from_behind, HOME).blocked.any()
    cases = throw_at_shield([(0.0, 0.0)])
    far = np.full((1, 3), 50.0)
    everywhere = dataclasses.replace(cases.scene.inner, lower=-far, upper=far)
    inside = dataclasses.replace(cases, scene=dataclasses.replace(cases.scene, inner=everywhere))
    found = score_standstill(inside, HOME)
    assert not found.blocked.any() and np.isnan(found.miss).all()


@pytest.mark.slow
def test_an_arm_that_runs_into_the_pole_does_not_succeed():
    ahead = np.array([0.0, 1.0, -0.6, 0.0, 0.0, 0.0])
    turn, middle = map(np.asarray, shield_pose(irb1600(), jnp.asarray(ahead)))
    vel = -8.0 * turn[:, 0]
    found = score_standstill(pj.block.case([middle - 0.5 * vel], [vel], gravity=1e-6), ahead)
    assert found.blocked.all() and found.touched.all() and not found.success.any()
    assert found.nearest[0].endswith(" and capsule 1, obstacle") and found.clearance[0] < -0.01


@pytest.mark.slow
def test_clearances_of_an_exact_execution_equal_the_clearances_of_the_referee():
    cases = throws("pole", LANES, 3).cases
    plan = plans(*MOTIONS, contact=MOVING)
    verdict = pj.block.judge(cases, plan)
    least = np.min([getattr(verdict, f"{kind}_clearance") for kind in KINDS], axis=0)
    course = courses_of(cases, plan)
    times = FRAME * np.arange(round(MOVING / FRAME) + 1)
    at = jax.jit(jax.vmap(jax.vmap(lambda c, t: reference_at(c, t).angles, (None, 0)), (0, None)))
    angles = np.asarray(at(course, times.astype(np.float32)), float)
    nothing = np.zeros((LANES, 6))
    flown = Executed(times, angles, angles, np.zeros((LANES, 2)), *[nothing] * 6)
    found = score(cases, plan, flown, Budget(*[np.zeros(LANES)] * 6))
    np.testing.assert_allclose(found.clearance, least, atol=1e-3)
    assert found.clearance.min() < found.clearance.max()


@pytest.mark.slow
def test_the_parts_of_the_time_budget_add_up_and_a_late_plan_starts_late():
    cases = throws("open", LANES, 1, regime="R1", delay=0.15)
    seconds = np.array([0.01, 0.05, 0.07, 0.02])
    plan = plans(*MOTIONS, contact=0.15 + MOVING, status=[0, 0, 0, 2])
    found = fly_blocks(BLOCK_WORLD, cases, plan=plan, seconds=seconds, planning_budget=0.05)
    budget = found.budget
    np.testing.assert_allclose(budget.sense, 0.1, atol=1e-6)
    np.testing.assert_allclose(budget.wait, [0.04, 0.0, 0.0, 0.03], atol=1e-6)
    np.testing.assert_allclose(budget.stand[:3], [0.0, 0.0, -0.02], atol=1e-6)
    assert found.planned.tolist() == [True, True, True, False]
    at = np.searchsorted(found.flown.times, 0.15 + 0.5 * MOVING)
    off = np.abs(found.flown.angles - found.flown.wanted)[:, at].max(axis=1)
    assert off[1] < 1e-3 and off[2] > 5e-3
    assert np.abs(found.flown.angles[3] - HOME).max() < 1e-4  # without a plan it stays
    inside = budget.flight[:, None] + np.array([-1e-3, 1e-3])
    box, ball = cases.cases.scene.inner, cases.cases.ball
    places = ball.pos[:, None] + ball.vel[:, None] * inside[..., None]
    places[..., 2] -= 0.5 * 9.81 * inside**2
    within = ((places > box.lower[:, None]) & (places < box.upper[:, None])).all(axis=2)
    assert within.tolist() == [[False, True]] * LANES


@pytest.mark.slow
def test_arms_that_observe_their_balls_execute_the_motions_they_decided():
    cases = throws("open", LANES, 1, regime="R1", delay=0.15)
    plan = plans(*MOTIONS, contact=0.15 + MOVING)
    sights = [see(cases.cases, eye(std=std), 0.1) for std in (0.02, 1e-5)]
    decided = Decided(
        cases=jax.tree.map(jnp.asarray, cases.cases),
        plans=plan,
        fits=batch(*[sight.fits for sight in sights]),
        start=jnp.zeros(LANES),
        motions=2 + jnp.arange(LANES),
    )
    found = fly_blocks(BLOCK_WORLD, cases, decided=decided, planning_budget=0.05)
    known = fly_blocks(BLOCK_WORLD, cases, plan=plan, planning_budget=0.05)
    np.testing.assert_array_equal(found.flown.angles, known.flown.angles)
    np.testing.assert_array_equal(found.miss, known.miss)
    assert found.motions.tolist() == [2, 3, 4, 5] and known.motions.tolist() == [1] * LANES
    assert (found.last_fit_error < 1e-3).all() and (found.fit_error > 5e-3).all()
    assert np.isnan(known.fit_error).all() and np.isnan(known.last_fit_error).all()
    np.testing.assert_allclose(found.budget.plan + found.budget.wait, 0.05, atol=1e-6)


def test_solids_of_capsules_and_boxes_are_closed_with_outward_normals():
    first, second = np.array([0.1, 0.2, 0.3]), np.array([0.1, 0.5, 0.3])
    for solid, volume in (
        (capsule_solid(first, second, 0.1), np.pi * 0.1**2 * (0.3 + 4.0 / 3.0 * 0.1)),
        (capsule_solid(first, first, 0.1), 4.0 / 3.0 * np.pi * 0.1**3),
        (box_solid(first, first + [0.1, 0.2, 0.4]), 0.1 * 0.2 * 0.4),
    ):
        a, b, c = (solid.corners[solid.triangles[:, k]] - first for k in range(3))
        own = np.sum(a * np.cross(b, c)) / 6.0
        assert 0.85 * volume < own <= volume * (1.0 + 1e-9)


def test_shapes_are_placed_at_the_links():
    robot = ShieldArm(base_height=0.4)
    places = robot.places(HOME)
    assert len(places) == len(robot.shapes()) == 8
    turn, middle = map(np.asarray, shield_pose(irb1600(), jnp.asarray(HOME)))
    place, quat = places[-1]
    np.testing.assert_allclose(rotation(quat, np), turn, atol=1e-5)
    rim = place + robot.shapes()[-1].lines[-1][:-1] @ turn.T
    np.testing.assert_allclose(rim.mean(axis=0), middle + [0.0, 0.0, 0.4], atol=1e-5)
    shield = robot.place(np.tile(HOME, (2, 3, 1)))
    np.testing.assert_allclose(shield[1, 2], rim.mean(axis=0), atol=1e-5)


@pytest.fixture(scope="module")
def recorded():
    task = BlockFly(num=LANES).flight()
    places = [(0.05, 0.0)] + [(0.0, 0.3)] * (LANES - 1)
    cases = Throws(np.arange(LANES), jax.tree.map(np.asarray, throw_at_shield(places)))
    plan = plans(*[STILL] * LANES, contact=0.5)
    flights = fly_blocks(BLOCK_WORLD, cases, plan=plan)
    return task, flights, task.recording(cases, flights, np.arange(LANES))


@pytest.mark.slow
def test_a_recording_shows_the_ball_until_and_after_its_block(recorded, tmp_path):
    task, flights, kept = recorded
    draw_flight(tmp_path / "block.png", task, kept, 0)
    assert (tmp_path / "block.png").read_bytes()[1:4] == b"PNG"
    assert flights.blocked.tolist() == [True, False, False, False]
    path, met = kept.balls[0, :, 0], kept.met[0, 0]
    there = np.isfinite(path[:, 0])  # the path starts and ends at the floor
    steps = np.diff(path[there & (kept.time[0] < met)], axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 0.08, rtol=1e-3)
    after = np.diff(path[there & (kept.time[0] > met)], axis=0)
    # The ball rebounds from the contact along its path at half the speed.
    assert len(steps) > 5 and len(after) > 5
    np.testing.assert_allclose(after, np.tile(-0.5 * steps[0], (len(after), 1)), atol=1e-3)
    at = np.searchsorted(kept.time[0], met)
    assert np.linalg.norm(path[at - 1 : at + 1] - kept.contact[0, 0], axis=1).max() < 0.08
    assert np.isnan(kept.met[1:]).all()


@pytest.mark.slow
def test_the_viewer_places_the_links_of_the_arm(recorded):
    pytest.importorskip("viser")
    task, _, kept = recorded
    viewer = Viewer(task, kept, port=0)
    try:
        viewer.time.value = 0.3
        there = BLOCK_ARM.places(kept.robot[0, viewer.sample])
        for shown, (place, _) in zip(viewer.robot, there, strict=True):
            np.testing.assert_allclose(shown.position, place, atol=1e-6)
    finally:
        viewer.close()


@pytest.mark.slow
def test_observed_balls_are_blocked_from_the_command_line(tmp_path, capsys):
    out = tmp_path / "run"
    command = ["fly", "block", "--num", "4", "--regime", "R1", "--suite", "open", "--wide"]
    assert main([*command, "--perception", "--replan", "10", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "the first fit of the flight was" in said and "anew at 10 Hz" in said
    summary = json.loads((out / "manifest.json").read_text())["summary"]
    assert summary["motions"] >= 4 and summary["blocked"] >= 3
    assert summary["last_fit_error_median"] < summary["fit_error_median"]
    assert (out / "figures" / "budget.png").exists()


@pytest.mark.slow
def test_an_arm_of_a_file_blocks_balls_from_the_command_line(tmp_path, seven, capsys):
    out = tmp_path / "run"
    options = [word for name, value in seven.items() for word in (f"--{name}", value)]
    command = ["fly", "block", "--num", "4", "--suite", "open", "--wide", "--encoders", "none"]
    assert main([*command, *options, "--out", str(out)]) == 0
    assert "Limits of the arm's file, wide" in capsys.readouterr().out
    summary = json.loads((out / "manifest.json").read_text())["summary"]
    assert summary["successes"] == summary["planned"] > 0 and len(summary["error_rms"]) == 7
    assert max(summary["error_rms"]) < 0.01


def test_flights_take_a_library_of_their_limits_and_scene_alone(tmp_path):
    path = tmp_path / "a.lib"
    save_library(path, make_library(regime="R1"))
    assert BlockFly(planner=f"library:{path}", regime="R1").flight().settings.regime == "R1"
    others: list[Any] = [{"regime": "R2"}, {"regime": "R1", "suite": "open"}]
    for options in others:
        with pytest.raises(ArgumentError, match="^library must be of the cases' arm, limits and"):
            BlockFly(planner=f"library:{path}", **options).flight()
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ArgumentError, match="^library must be a whole file"):
        BlockFly(planner=f"library:{path}", regime="R1").flight()
    with pytest.raises(ArgumentError, match="^planner must name its file, as in library:FILE"):
        BlockFly(planner="library")


def test_another_robot_arm_or_time_is_refused_in_one_line():
    cases = throws("open", 1, delay=0.1)
    with pytest.raises(ValueError, match="^world must hold an arm, got a Car$"):
        fly_blocks(CAR_WORLD, cases)
    with pytest.raises(ValueError, match="^timestep must be 0.001, got 0.002$"):
        carried = dataclasses.replace(BLOCK_WORLD, timestep=2.0 * TIMESTEP)
        nothing: Any = (None, None)
        execute(carried, *nothing, since=np.zeros(1), until=np.zeros(1), end=1.0)
    with pytest.raises(ValueError, match=r"^torques must be 6 numbers, got \(1.0, 2.0\)$"):
        fly_blocks(
            BLOCK_WORLD, cases, drives=Drives(torques=(1.0, 2.0)), plan=plans(STILL, contact=0.5)
        )
    rule = "planning_budget must be >= 0 and <= the delay 0.1, got 0.2"
    with pytest.raises(ValueError, match=f"^{rule}$"):
        fly_blocks(BLOCK_WORLD, cases, planning_budget=0.2)
    heavy = dataclasses.replace(cases.cases.arm, mass=2.0 * cases.cases.arm.mass)
    with pytest.raises(ValueError, match="^mass must be the same in plan and simulated arm$"):
        require_arm(BLOCK_WORLD, dataclasses.replace(cases.cases, arm=heavy))
    with pytest.raises(ValueError, match="^torques must be numbers > 0, got "):
        Drives(torques=(1.0, -2.0))
