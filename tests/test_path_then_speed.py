"""Planners that choose a path, then the speed along it: obstacles, drives, unsolvable cases."""

import dataclasses
import functools
import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dubins import dubins, sample_dubins

import planner_jax as pj
from planner_jax.baselines.intercept import path_then_speed
from planner_jax.baselines.intercept import projection as projections
from planner_jax.baselines.intercept.path import path_along, path_beside, path_of_drive
from planner_jax.baselines.intercept.static_paths import count_turns
from planner_jax.benchmarks import intercept_stages
from planner_jax.benchmarks.run import Bench
from planner_jax.plane.make_obstacles import obstacles
from planner_jax.plane.obstacles import separation
from planner_jax.plane.reach import Lattice
from planner_jax.robot.car import pose_at
from planner_jax.task.intercept.problem.clearance import ends_of
from planner_jax.task.intercept.searches import Search

SQUARE = np.array([[-0.2, -0.2], [0.2, -0.2], [0.2, 0.2], [-0.2, 0.2]])


def still(x, y):
    return pj.TurningPath(jnp.array([x, y]), jnp.zeros(2), jnp.array(0.0))


def scene(target=(6.0, 4.0), velocities: Any = 0.0, **settings):
    return pj.intercept.case(still(*target), mover_velocities=velocities, **settings)


EMPTY = scene()
along = jax.jit(path_along)
STRAIGHT = along(np.float32([0.8, 4.0, 0.0]), np.float32(5.05), np.zeros(129, np.float32))
WAVES = np.float32(1.2 * np.sin(np.linspace(0.0, 4.0 * np.pi, 129)))
BENT = along(np.float32([0.8, 2.0, 0.0]), np.float32(7.0), WAVES)


def crossing(rng, path, num):
    at = np.asarray(path.pos)[rng.integers(10, len(path.pos), num)]
    time, angle = rng.uniform(1.0, 9.0, num), rng.uniform(0.0, 2.0 * np.pi, num)
    velocity = rng.uniform(0.1, 0.6, (num, 1)) * np.stack([np.cos(angle), np.sin(angle)], 1)
    corner = np.sort(rng.uniform(0.0, 2.0 * np.pi, (num, 6)), axis=1)
    shape = 0.3 * np.stack([np.cos(corner), np.sin(corner)], -1)
    polygons = at[:, None] - velocity[:, None] * time[:, None, None] + shape
    return obstacles(list(polygons), velocity)


@jax.jit
def least_distance(path, movers, times, stations):
    place = jnp.linspace(0.0, 1.0, len(path.heading)) * path.length
    x, y, heading = (jnp.interp(stations, place, each) for each in (*path.pos.T, path.heading))

    def at(time):
        corners = movers.vertices(time)
        apart = separation(corners, movers.present, x[None], y[None], heading, ends_of(EMPTY.body))
        return jnp.min(apart, axis=0)

    return jax.vmap(at)(times)


def is_inside(blocked, times, stations):
    blocked, (lower, upper) = jax.device_get((blocked, edges_at(blocked, times[:, None])))
    is_now = (blocked.start <= times[:, None]) & (times[:, None] <= blocked.end) & blocked.present
    s = stations[:, None]
    return ((lower[:, None] <= s) & (s <= upper[:, None]) & is_now[:, None]).any(2)


@functools.partial(jax.jit, static_argnames="projection")
def project(path, movers, projection):
    return projections.project_obstacles(path, movers, EMPTY.body, EMPTY.time, projection)


edges_at = jax.jit(lambda blocked, times: blocked.edges_at(times))
overlaps = jax.jit(lambda *x: projections.overlap(*x, EMPTY.body, jnp.zeros(()), 0.0))
limits_along = jax.jit(lambda path: projections.speed_limits(path, EMPTY.body, EMPTY.limits))


@pytest.mark.parametrize("path", [STRAIGHT, BENT], ids=["straight", "bent"])
def test_quadrangles_hold_whatever_the_body_meets_and_little_else(path):
    times = np.linspace(0.0, 10.0, 101, dtype=np.float32)
    stations = np.linspace(0.0, float(path.length), 211, dtype=np.float32)
    held = exact = near = 0
    for seed in range(10):
        movers = crossing(np.random.default_rng(seed), path, 2)
        apart = np.asarray(least_distance(path, movers, times, stations))
        blocked = project(path, movers, projections.Projection(margin=0.0))
        found = is_inside(blocked, times, stations)
        assert not (~found & (apart < -1e-4)).any()
        held, exact = held + found.sum(), exact + (apart < 0.0).sum()
        near += (found & (apart < 0.1)).sum()
    assert exact > 2000
    assert near > 0.85 * held  # straight edges add little beyond 0.1 m


def test_a_square_that_crosses_a_straight_path_blocks_it_just_as_long_as_they_overlap():
    movers = obstacles([SQUARE + [3.0, 2.0]], [0.0, 0.5])
    begin, finish = jax.device_get(overlaps(STRAIGHT, movers))
    x = np.asarray(STRAIGHT.pos)[:, 0]
    meets = (x + 0.35 > 2.8) & (x - 0.05 < 3.2)
    np.testing.assert_allclose(begin[0, meets], (2.0 - 0.325) / 0.5, rtol=1e-5)
    np.testing.assert_allclose(finish[0, meets], (2.0 + 0.325) / 0.5, rtol=1e-5)
    assert (begin[0, ~meets] >= finish[0, ~meets]).all()


@pytest.mark.slow
def test_a_path_that_comes_back_is_blocked_in_two_runs():
    loop = along(np.zeros(3, np.float32), np.float32(5.0), np.full(129, 0.4 * np.pi, np.float32))
    movers = obstacles([SQUARE], [0.0, 1e-3])  # stays at start and end of the loop
    found = project(loop, movers, projections.Projection(runs=2, slabs=1))
    assert np.flatnonzero(found.present).tolist() == [0, 1]
    middle = np.asarray(edges_at(found, np.float32(5.0))).mean(axis=0)
    assert middle[0] < 1.0 and middle[1] > 4.0
    one = project(loop, movers, projections.Projection(runs=1, slabs=1))
    low, high = jax.device_get(edges_at(one, np.float32(5.0)))
    assert low[0] <= 0.0 and high[0] >= 5.0  # one joined run blocks everything between


def test_speed_is_limited_by_lateral_acceleration_and_by_the_steering_rate():
    origin = np.zeros(3, np.float32)
    arc = along(origin, np.float32(2.0), np.full(129, -1.6, np.float32))
    np.testing.assert_allclose(limits_along(arc), np.sqrt(0.8 / 1.6), rtol=1e-6)
    np.testing.assert_allclose(limits_along(STRAIGHT), 1.5)
    step = along(origin, np.float32(0.05), np.float32([0.0, 0.5]))
    np.testing.assert_allclose(limits_along(step), [2.0 / (0.3 * 10.0)], rtol=1e-5)


def test_the_path_of_a_drive_is_the_path_of_the_car():
    rng = np.random.default_rng(1)
    speed = np.append(rng.uniform(0.2, 1.2, 16), 0.0).astype(np.float32)
    curvature = rng.uniform(-1.5, 1.5, 17).astype(np.float32)

    @jax.jit
    def drive_both(*drive):
        return path_of_drive(*drive, 129), pose_at(*drive, drive[1])

    start = np.float32([1.0, 2.0, 0.3])
    path, end = jax.device_get(drive_both(start, np.float32(4.0), speed, curvature))
    np.testing.assert_allclose(path.pos[-1], end[:2], atol=5e-3)
    np.testing.assert_allclose(path.heading[-1], end[2], atol=5e-3)
    driven = np.mean(0.5 * (speed[1:] + speed[:-1])) * 4.0
    np.testing.assert_allclose(path.length, driven, rtol=1e-5)


def test_a_car_drives_beside_arcs_without_a_jump_of_its_curvature():

    @jax.jit
    def beside(start, goal):
        way = dubins(start, goal, jnp.asarray(1.6))
        poses = sample_dubins(way, 129)
        curvatures = jnp.diff(poses[:, 2], append=poses[-1:, 2]) * (128 / way.length)
        most, rate = jnp.asarray(2.0), jnp.asarray(8.0)
        path = path_beside(start, jnp.zeros(()), poses[:, :2], curvatures, way.length, most, rate)
        return poses, curvatures, path

    goal = np.float32([1.5, 1.5, 2.0])
    poses, curvatures, path = jax.device_get(beside(np.zeros(3, np.float32), goal))
    away = np.linalg.norm(path.pos - poses[:, :2], axis=1)
    assert away.max() < 0.06
    assert path.curvature[0] == 0.0 and np.abs(path.curvature).max() <= 2.0
    changes, jumps = (np.diff(each) * 128 / path.length for each in (path.curvature, curvatures))
    assert np.abs(changes).max() <= 8.0 * 1.01 < np.abs(jumps).max()


drive = jax.jit(lambda case, path: STEP.drive(case, path, STEP.problem(case, path)))
STEP = path_then_speed.SpeedStep()


@pytest.mark.slow
def test_a_drive_follows_its_path_and_ends_where_it_ends():
    movers = [SQUARE + [3.0, 2.0]]
    heading = BENT.heading[-1]
    end = np.asarray(BENT.pos[-1]) + 0.15 * np.array([np.cos(heading), np.sin(heading)])
    case = scene(tuple(end), [0.0, 0.4], movers=movers, time=14.0, start=(0.8, 2.0, 0.0))
    plan = drive(case, BENT)
    assert plan.status == pj.Status.CONVERGED, pj.intercept.judge(case, plan).sentence()
    assert pj.intercept.judge(case, plan).success
    times = np.linspace(0.0, 14.0, 141, dtype=np.float32)
    driven = plan.start, plan.time, plan.speed, plan.curvature
    poses = jax.jit(jax.vmap(lambda time: pose_at(*driven, time)))(times)
    away = np.linalg.norm(np.asarray(poses)[:, None, :2] - np.asarray(BENT.pos), axis=2).min(1)
    assert away.max() < 0.5 * 7.0 / 128 + 0.01
    np.testing.assert_allclose(poses[-1, :2], BENT.pos[-1], atol=0.01)


@jax.jit
def ramp_along(path, times):
    setting = EMPTY.movers, EMPTY.body, EMPTY.limits, EMPTY.time, EMPTY.speed
    problem = projections.station_time_problem(path, *setting)
    return path_then_speed.ramp_and_cruise(problem, times)


@pytest.mark.parametrize("length", [3.0, 5.0, 8.0])
def test_constant_speed_is_reached_by_the_shortest_ramp_and_ends_in_time(length):
    times = np.linspace(0.0, 10.0, 1001, dtype=np.float32)
    path = dataclasses.replace(STRAIGHT, length=np.float32(length))
    station, speed = jax.device_get(ramp_along(path, times))
    np.testing.assert_allclose(station[-1], length, rtol=1e-5)
    np.testing.assert_allclose(np.gradient(station, times)[1:-1], speed[1:-1], atol=6e-3)
    rise = np.diff(speed) * 100.0
    assert np.isin(np.round(np.abs(rise), 2), [0.0, 1.0]).sum() >= 999 and speed[0] == 0.5


def test_paths_differ_by_a_turn_just_if_a_wall_is_between_them():
    walls = obstacles([SQUARE + [4.0, 4.0], SQUARE + [4.0, 1.0]])
    start, goal = np.float32([1.0, 4.0]), np.float32([7.0, 4.1])
    turning = jax.jit(count_turns)
    x = np.linspace(1.2, 6.8, 30)
    bend = np.sin((x - 1.0) / 6.0 * np.pi)

    def turns(height):
        points = np.stack([x, 4.0 + height * bend], 1, dtype=np.float32)
        return np.asarray(turning(walls, start, points, goal))

    above, far_above, below = turns(1.0), turns(2.5), turns(-1.0)
    np.testing.assert_array_equal(above, far_above)
    assert abs(above[0] - below[0]) == 1 and above[1] == below[1]


SMALL = {"searches": (Search(4, lattice=Lattice(layers=22)),)}
PLANNER = path_then_speed.lattice(source=path_then_speed.PathSource(drawn=6), **SMALL)
CROSSING = [SQUARE + [3.5, 1.5]]
# This obstacle crosses the whole map, so that no path leads past it.
BARRIER = [[3.9, -0.5], [4.1, -0.5], [4.1, 8.5], [3.9, 8.5]]
SCENES = {
    "free": (scene(), pj.Status.CONVERGED),
    "a mover crosses": (scene(movers=CROSSING, velocities=[0.0, 0.5]), pj.Status.CONVERGED),
    "parked on every path": (scene(movers=[BARRIER]), pj.Status.NO_PATH),
    "a wall across": (scene(walls=[BARRIER]), pj.Status.NO_PATH),
    "parked on the goal": (scene(movers=[SQUARE + [6.0, 4.0]]), pj.Status.BLOCKED),
    "parked on the start": (scene(movers=[SQUARE + [0.8, 4.0]]), pj.Status.BLOCKED),
    "too far for the time": (scene((7.8, 4.0), time=3.0), pj.Status.TOO_FAR),
    "NaN": (dataclasses.replace(scene(), target=still(np.nan, 4.0)), pj.Status.BAD_INPUT),
}


@pytest.fixture(scope="module")
def scenes():
    cases = [jax.tree.map(np.asarray, case) for case, _ in SCENES.values()]
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *cases)
    return batch, jax.device_get(pj.plan(PLANNER, jax.tree.map(jnp.asarray, batch)))


@pytest.mark.parametrize("name", SCENES)
def test_a_case_is_solved_or_has_a_failure_status_and_the_referee_agrees(scenes, name):
    k, status = list(SCENES).index(name), SCENES[name][1]
    case, plan = pj.take(scenes, k)
    assert plan.status == status
    verdict = pj.intercept.judge(case, plan)
    assert verdict.success == (status == pj.Status.CONVERGED), verdict.sentence()


@pytest.mark.slow
def test_the_paper_s_planner_searches_smooths_and_drives(scenes):
    pytest.importorskip("numba", reason="the extra `baselines` is not installed")
    cases = jax.tree.map(jnp.asarray, scenes[0])
    plans = jax.device_get(pj.plan(pj.intercept.planner("paper"), cases))
    assert plans.status.tolist() == [status for _, status in SCENES.values()]
    verdict = pj.intercept.judge(scenes[0], plans)
    np.testing.assert_array_equal(verdict.success, plans.status == pj.Status.CONVERGED)


@pytest.mark.slow
def test_searched_paths_leave_curvature_for_the_path_without_jumps():
    pytest.importorskip("numba", reason="the extra `baselines` is not installed")
    planner, case = pj.intercept.planner("paper"), pj.take(pj.intercept.draw(1, "qu-map", 0), 0)
    poses, curvature, length, is_found = planner.search_path(case)
    assert is_found and 0.69 * 2.0 < np.abs(curvature).max() <= 0.7 * 2.0 + 1e-6
    path = jax.jit(planner.path)(case, poses, curvature, length)
    assert np.abs(path.curvature).max() <= 2.0


@pytest.mark.slow
def test_stages_lose_the_cases_that_the_referee_does_not_accept(tmp_path):
    pytest.importorskip("numba", reason="the extra `baselines` is not installed")
    planner, num = pj.intercept.planner("paper"), 4
    with Bench("intercept_stages", {}, tmp_path / "run") as bench:
        intercept_stages.run(bench, planner, "qu-map", num, 0)
    rows = json.loads((tmp_path / "run" / "rows.json").read_text())
    times = {row["stage"]: row["mean"] for row in rows if row["table"] == "times"}
    parts = sum(times[part] for part in intercept_stages.PARTS[:-1])
    assert parts == pytest.approx(times["total"])
    losses = [row for row in rows if row["table"] == "losses"]
    assert [row["stage"] for row in losses] == list(intercept_stages.PASSED)
    cases = pj.intercept.draw(num, "qu-map", 0)
    accepted = pj.intercept.judge(cases, pj.plan(planner, cases)).success.sum()
    assert num - sum(row["lost"] for row in losses) == losses[-1]["cases"] == accepted > 0
    assert intercept_stages.count_passed(np.array([[True, False, True], [True] * 3])) == [2, 1, 1]
