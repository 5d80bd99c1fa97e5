"""The simulated car: tyres, tracking, sensing, scores, and a run from the command line."""

import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import planner_jax as pj
from planner_jax.cli.main import main
from planner_jax.sims.drive import DriveLoop, drive_on, start_drives
from planner_jax.sims.film import draw_flight
from planner_jax.sims.model import step
from planner_jax.sims.noise import PlaneSensing
from planner_jax.sims.robots.car.robot import Car
from planner_jax.sims.robots.car.tyres import tyre_forces
from planner_jax.sims.robots.car.vehicle import Tyres, Vehicle
from planner_jax.sims.scenery import Prism
from planner_jax.sims.settings import InterceptFly
from planner_jax.sims.tasks import intercept as driving
from planner_jax.sims.tasks.catch import CATCH_WORLD
from tests.recordings import recording

CAR = Vehicle()
CURVATURE = 1.3  # [1/m], of the circle in open loop
END, PIECES = 4.0, 20
SHARE = np.linspace(0.0, 1.0, PIECES + 1)
PATHS = {  # speed and curvature at the knots
    "straight": (0.5 + 0.8 * SHARE, 0.0 * SHARE),
    "circle": (1.0 + 0.0 * SHARE, 1.0 + 0.0 * SHARE),
    "slalom": (0.5 + 0.6 * SHARE, 1.2 * np.sin(8.0 * SHARE)),
}
EXACT, NOISY = PlaneSensing(), PlaneSensing(pose_stds=(0.01, 0.01))


def plans(speed, curvature):
    num = len(speed)
    zero, none = jnp.zeros(num), jnp.zeros(num, jnp.int32)
    knots = (jnp.asarray(np.stack(value), jnp.float32) for value in (speed, curvature))
    drive = jnp.zeros((num, 3)), zero + END, *knots, *jnp.zeros((2, num, 2))
    return pj.intercept.InterceptPlan(zero, zero, none, none, *drive)


def drive_paths(sensing):
    loop = DriveLoop(driving.CAR_WORLD, sensing)
    keys = jax.random.split(jax.random.key(3), len(PATHS))
    drives = start_drives(loop, plans(*zip(*PATHS.values(), strict=True)), keys)
    until = np.full(len(PATHS), END, np.float32)  # shares its program with the flights
    for _ in range(2):
        drives, frames = drive_on(driving.CAR_WORLD, drives, until, num_frames=100)
    return jax.device_get((drives.replace(key=None), frames))


@pytest.fixture(scope="module")
def noiseless():
    return drive_paths(EXACT)


@pytest.fixture(scope="module")
def open_loop():
    @jax.jit
    def drive(physics, commands):
        def advance(physics, command):
            physics = step(driving.CAR_WORLD, physics, command, jnp.zeros(0))
            return physics, physics

        return lax.scan(advance, physics, commands)[1]

    start, speed = np.zeros((2, 3), np.float32), np.float32([1.0, 0.5])
    physics = jax.jit(jax.vmap(Car().moving))(start, speed, np.float32([CURVATURE, 0.0]))
    side = np.where(np.arange(400) % 200 < 100, 1.0, -1.0)
    angles = np.stack([np.full(400, np.arctan(CAR.wheelbase * CURVATURE)), side])
    commands = jnp.asarray(np.stack([0.0 * angles, angles], axis=2), jnp.float32)
    return jax.device_get(jax.vmap(drive)(physics, commands))


def tyres_without_sliding(stiffness):
    return Tyres(stiffness, friction=1e6)


def forces(tyres, speed, steering=0.3, sway=0.02):
    vel, vehicle = np.float32([speed, sway, 0.5 * speed]), dataclasses.replace(CAR, tyres=tyres)
    return np.asarray(forces_of(vehicle, vel, np.float32(steering)))


@functools.partial(jax.jit, static_argnums=0)
def forces_of(vehicle, vel, steering):
    return tyre_forces(vehicle, jnp.zeros(3), vel, steering, jnp.zeros(()), 0.005)


@pytest.mark.slow
def test_line_and_slalom_without_noise_are_tracked_within_a_centimetre(noiseless):
    drives, frames = noiseless
    assert (drives.worst_tracking[[0, 2]] < 0.01).all() and not drives.saturated.any()
    apart = np.linalg.norm(frames.pose[..., :2] - frames.wanted, axis=2)
    assert apart.max() <= drives.worst_tracking.max() + 1e-5


@pytest.mark.slow
def test_noise_on_the_pose_is_filtered_and_the_same_seed_gives_the_same_bits():
    first, frames = drive_paths(NOISY)
    again, _ = drive_paths(NOISY)
    np.testing.assert_array_equal(first.physics.qpos, again.physics.qpos)
    assert 0.0 < first.worst_tracking.max() < 0.02
    assert np.isfinite(frames.pose).all()


def test_a_circle_has_the_radius_of_wheelbase_over_tangent(open_loop):
    angle = np.arctan(CAR.wheelbase * CURVATURE)
    vel, poses = open_loop.qvel[0].astype(float), open_loop.qpos[0].astype(float)
    radius = np.hypot(vel[:, 0], vel[:, 1]) / vel[:, 2]
    np.testing.assert_allclose(radius, CAR.wheelbase / np.tan(angle), rtol=1e-4)
    away = np.linalg.norm(poses[:, :2] - [0.0, 1.0 / CURVATURE], axis=1)
    np.testing.assert_allclose(away, CAR.wheelbase / np.tan(angle), rtol=1e-4)


def test_the_steering_angle_changes_no_faster_than_its_limit(open_loop):
    angles = open_loop.act[1, :, 1].astype(float)
    rates = np.abs(np.diff(angles)) / driving.CAR_WORLD.timestep
    assert rates.max() <= CAR.steering_rate * (1.0 + 1e-4)
    assert rates.max() >= CAR.steering_rate * (1.0 - 1e-3)
    assert np.abs(angles).max() <= CAR.steering * (1.0 + 1e-6)


def test_stiff_tyres_act_like_tyres_without_slip():
    stiff = forces(tyres_without_sliding(1e6), 1.0)
    np.testing.assert_allclose(stiff, forces(None, 1.0), rtol=1e-3, atol=1e-3)
    soft = forces(tyres_without_sliding(5.0), 1.0)
    assert np.abs(soft - forces(None, 1.0)).max() > 1.0


def test_the_slower_the_car_the_less_its_tyres_slip():
    def relative_slip(speed):
        held = forces(None, speed, sway=0.02 * speed)
        slipping = forces(tyres_without_sliding(5.0), speed, sway=0.02 * speed)
        return np.linalg.norm(slipping - held) / np.linalg.norm(held)

    shares = [relative_slip(speed) for speed in (0.1, 0.4, 1.5)]
    assert shares == sorted(shares) and shares[0] < 0.3 < shares[2]


def test_friction_bounds_the_lateral_force_of_a_tyre():
    most = Tyres().friction * sum(CAR.loads)
    pushed = forces(Tyres(), 1.5, steering=0.5, sway=1.0)
    assert np.hypot(*pushed[:2]) <= most * (1.0 + 1e-5)
    assert np.hypot(*forces(None, 1.5, steering=0.5, sway=1.0)[:2]) > most


def test_contacts_of_planned_poses_equal_those_of_the_referee():
    cases = pj.intercept.draw(6, "hard", 1)
    speed, curvature = np.full((6, PIECES + 1), 0.6), np.tile(0.6 * np.sin(6.0 * SHARE), (6, 1))
    plan = plans(speed, curvature).replace(start=cases.start, time=cases.time)
    setpoints = plan.sample(400.0)
    poses = np.concatenate([setpoints.pos, setpoints.heading[..., None]], axis=2).astype(float)
    flown = driving.Driven(
        times=setpoints.time,
        poses=poses,
        **{"wanted": poses[..., :2], "meeting": np.asarray(cases.time, float)},
        **{"tracking": np.zeros((6, 2)), "saturation": np.zeros((6, 2))},
        **{"plans": np.ones(6, int), "paths": np.zeros((6, len(setpoints.time), 0, 2))},
    )
    found, verdict = driving.score(cases, plan, flown), pj.intercept.judge(cases, plan)
    # Both take the least clearance over samples, at different times: the body moves by 1.5 mm
    # between two setpoints.
    for name, error in (("wall_clearance", 1e-3), ("mover_clearance", 1e-3), ("miss", 2e-4)):
        np.testing.assert_allclose(getattr(found, name), getattr(verdict, name), atol=error)
    assert found.touched.any() and not found.touched.all()
    assert not found.success.any()


@pytest.mark.slow
def test_predictions_use_only_observations_that_have_arrived():
    loop = DriveLoop(driving.CAR_WORLD, dataclasses.replace(EXACT, target_std=0.1, latency=0.05))
    seen = driving.meetings("easy", 2, seed=4, observation_rate=1.0)
    options = {"known_target": False, "predict_movers": True}
    of = jax.jit(functools.partial(driving.predict_scene, loop, **options))
    path, movers = jax.device_get(of(seen, np.float32(3.04)))
    later = dataclasses.replace(seen, target=seen.target + 9.0 * (seen.times > 2.5)[..., None])
    np.testing.assert_array_equal(path.pos, of(later, np.float32(3.04))[0].pos)
    assert np.abs(path.pos - of(later, np.float32(3.06))[0].pos).max() > 0.1
    truth = pj.intercept.case(seen.cases.target, seen.cases.time).target
    place = jax.jit(jax.vmap(lambda one: one.at(3.04).pos))(truth)
    assert np.linalg.norm(path.pos - place, axis=1).max() < 0.2
    there = seen.cases.movers.centre + 3.04 * seen.cases.movers.velocity
    off = np.linalg.norm(movers.centre - there, axis=2)[seen.cases.movers.present]
    assert 0.0 < off.max() < 0.2


@dataclasses.dataclass
class StraightOn(pj.Planner):
    case_type = pj.intercept.InterceptCase
    attempts = (pj.Attempt(),)
    solved: int
    starts: list = dataclasses.field(default_factory=list)

    def solve_on_host(self, cases, attempt):
        self.starts.append(cases.start)
        ahead = np.stack([np.cos(cases.start[:, 2]), np.sin(cases.start[:, 2])], axis=1)
        goal = cases.target.pos - cases.start[:, :2]
        way = np.sum(goal * ahead, axis=1) - cases.body.length / 2.0 + cases.body.rear_overhang
        last = 2.0 * way / cases.time - cases.speed
        status = pj.Status.CONVERGED if len(self.starts) <= self.solved else pj.Status.INFEASIBLE
        speed = np.float32(cases.speed[:, None] * (1.0 - SHARE) + last[:, None] * SHARE)
        plan = plans(speed, 0.0 * speed)
        plan = plan.replace(start=cases.start, time=cases.time, meeting=cases.target.pos)
        states = np.full(len(way), status, np.int32)
        return jax.tree.map(np.asarray, plan.replace(status=states))


@pytest.mark.slow
@pytest.mark.parametrize("solved", [1, 2])
def test_a_new_plan_starts_at_the_estimated_pose_and_is_driven_if_it_is_solved(solved):
    start = np.array([[0.8, 2.0, 0.0], [0.8, 4.0, 0.0], [0.8, 6.0, 0.0]], np.float32)
    goal = start[:, :2] + np.float32([[2.0, 0.0], [2.5, 0.0], [3.0, 0.0]])
    still = pj.TurningPath(pos=goal, vel=0.0 * goal, turn_rate=np.zeros(3, np.float32))
    cases = jax.tree.map(np.asarray, pj.intercept.case(still, np.full(3, END), start=start))
    movers = np.zeros((3, 1, 1, 2), np.float32)
    seen = driving.Meetings(np.arange(3), cases, np.zeros((3, 1)), goal[:, None], movers)
    planner, loop = StraightOn(solved), DriveLoop(driving.CAR_WORLD, NOISY)
    options = {"replan": 0.5, "planner": planner, "known_target": True}
    flights = driving.fly_intercepts(loop, seen, 5, **options)
    assert flights.flown.plans.tolist() == [solved] * 3
    assert flights.success.all() and flights.miss.max() < 0.03
    first, again = planner.starts
    np.testing.assert_allclose(first, start)
    there = flights.flown.poses[:, 100]
    assert 1e-5 < np.abs(again - there).max() < 0.02  # estimated pose
    assert flights.flown.meeting == pytest.approx(END, rel=1e-5)


def test_another_robot_or_car_is_refused_in_one_line():
    with pytest.raises(ValueError, match="^world must hold a car, got a Quadrotor$"):
        DriveLoop(CATCH_WORLD)
    with pytest.raises(ValueError, match="^timestep must be 0.005, got 0.002$"):
        DriveLoop(dataclasses.replace(driving.CAR_WORLD, timestep=0.002))
    with pytest.raises(TypeError, match="^robot must carry a tool, got a Car$"):
        _ = driving.CAR_WORLD.carrier
    cases = pj.intercept.draw(1, "easy")
    with pytest.raises(ValueError, match="^wheelbase must be the same in plan and simulated car"):
        driving.require_car(dataclasses.replace(CAR, wheelbase=0.25), cases)


def test_a_prism_moves_at_constant_velocity_and_its_mesh_has_sides_and_top():
    square = np.array([(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)])
    prism = Prism(square, 0.5, "#FFFFFF", (0.3, -0.1))
    base, top, *sides = prism.outlines(10.0)
    np.testing.assert_allclose(base[0], [3.0, -1.0, 0.0])
    assert (top[:, 2] == 0.5).all() and len(sides) == 4
    vertices, faces = prism.mesh()
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    np.testing.assert_allclose(area, 2.0 + 6.0 * 0.5)


def test_a_picture_shows_walls_movers_and_the_predicted_path(tmp_path):
    kept = recording()
    way = np.zeros((1, kept.time.shape[1], 9, 3))
    way[..., 0] = np.linspace(2.0, 3.0, 9)
    pose = np.concatenate([kept.robot[..., :2], 0.0 * kept.robot[..., :1]], axis=2)
    kept = dataclasses.replace(kept, robot=pose, expected=way)
    path = tmp_path / "drive.png"
    draw_flight(path, InterceptFly(suite="hard").flight(), kept, 0)
    assert path.read_bytes()[1:4] == b"PNG"


@pytest.mark.slow
def test_the_reachable_set_begins_at_the_start_and_avoids_walls():
    task = InterceptFly(suite="hard", seed=2).flight()
    layers, cases = task.reachable(1), pj.intercept.draw(1, "hard", 2, first=1)
    times = [time for time, _ in layers]
    assert times == sorted(times) and times[-1] == pytest.approx(float(cases.time[0]), rel=1e-5)
    start, cell = np.asarray(cases.start[0, :2]), 8.0 / 64
    ahead = start + [times[0] * float(cases.speed[0]), 0.0]
    assert np.abs(layers[0][1] - ahead).max() < 1.5 * cell
    assert len(layers[-1][1]) > len(layers[0][1])


@pytest.mark.slow
def test_two_hard_cases_are_driven_from_the_command_line(tmp_path, capsys):
    out = tmp_path / "run"
    command = ["fly", "intercept", "--suite", "hard", "--num", "2", "--seed", "2", "--out"]
    assert main([*command, str(out)]) == 0
    assert "of 2 flights met the target within 0.3 m" in capsys.readouterr().out
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["kind"] == "fly intercept" and manifest["summary"]["tracking_worst"] < 0.05
    assert (out / "figures" / "flight.png").exists()
    page = (out / "index.html").read_text()
    assert main(["report", str(out)]) == 0
    assert (out / "index.html").read_text() == page
