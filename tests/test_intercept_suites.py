from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import positions_on

from planner_jax.core.protocol import take
from planner_jax.referee.clearance import clearances
from planner_jax.referee.intercept import referee_intercepts
from planner_jax.sims.prediction.polynomial_fit import fit_polynomial
from planner_jax.task.intercept import suites
from planner_jax.task.intercept.api import draw, observe
from planner_jax.task.intercept.plan import InterceptPlan
from planner_jax.task.intercept.searches import earliest_arrival
from planner_jax.task.intercept.spec import SUITES
from tests.trees import as_numpy

NUM, SEED = 24, 3
PLAIN = [name for name, suite in SUITES.items() if not (suite.is_maze or suite.wall_boxes)]

each_suite = pytest.mark.parametrize("name", SUITES)


@pytest.fixture(scope="module")
def batches():
    with jax.enable_x64(True):
        batches = {
            name: suites.draw_with_counts(name, NUM, SEED, dtype=jnp.float64) for name in SUITES
        }
        return {name: replace(each, cases=as_numpy(each.cases)) for name, each in batches.items()}


def least_distance(group, points, time=0.0):
    leaves = {name: getattr(group, name) for name in ("velocity", "corners", "present")}
    leaves["centre"] = group.centre + time * group.velocity
    leaves["velocity"] = 0.0 * group.velocity
    poses = np.concatenate([points, np.zeros_like(points[..., :1])], axis=2)
    times = np.zeros(points.shape[:2])
    return clearances(leaves, np.zeros((len(points), 2)), times, poses)[0]


@each_suite
def test_a_case_is_the_same_in_every_batch(name):
    whole, again = as_numpy((draw(7, name, 5), draw(3, name, 5, first=2)))
    for a, b in zip(*map(jax.tree.leaves, (whole, again)), strict=True):
        np.testing.assert_array_equal(a[2:5], b)
        assert a.dtype in (np.float32, bool)
    assert (whole.start[:, 1] != np.asarray(draw(7, name, 6).start)[:, 1]).all()


def test_a_suite_depends_on_its_name_and_the_seed_alone():
    for name, expected in (("hard", 5.625709), ("maze", 4.843411)):
        np.testing.assert_allclose(np.asarray(draw(1, name, 0).start)[0, 1], expected, rtol=1e-5)
    np.testing.assert_allclose(draw(2, "rush", 0).time, [4.8589745, 5.8846154], rtol=1e-5)


@each_suite
def test_shapes_follow_the_suite_and_starts_the_paper(batches, name):
    cases, suite = batches[name].cases, SUITES[name]
    assert suite.description.endswith(".") and cases.batch_shape == (NUM,)
    for group, room in ((cases.walls, suite.wall_room), (cases.movers, suite.mover_room)):
        assert group.corners.shape == (NUM, *room, 2)
        assert group.present.shape == (NUM, room[0])
    if suite.spare is None:
        np.testing.assert_array_equal(cases.time, suite.time)
    start = cases.start
    assert (start[:, [0, 2]] == [0.8, 0.0]).all() and (cases.speed == 0.5).all()
    assert start[:, 1].min() >= 1.0 and start[:, 1].max() <= 7.0 and np.ptp(start[:, 1]) > 4.0
    np.testing.assert_array_equal(cases.upper, np.full((NUM, 2), suites.SIZE))
    np.testing.assert_allclose(cases.body.middle, suites.BODY_MIDDLE)


@each_suite
def test_numbers_of_obstacles_are_in_their_ranges_and_all_occur(batches, name):
    cases, suite = batches[name].cases, SUITES[name]
    for group, (fewest, most) in ((cases.movers, suite.num_movers), (cases.walls, suite.num_walls)):
        if not (suite.is_maze and group is cases.walls):
            assert set(group.present.sum(axis=1)) == set(range(fewest, most + 1))
        for leaf in (group.centre, group.corners, group.velocity):
            assert not leaf[~group.present].any()
    assert not cases.walls.velocity.any()


@pytest.mark.parametrize("name", PLAIN)
def test_polygons_are_convex_and_their_sizes_in_range(batches, name):
    cases = batches[name].cases
    for group, fewest, radius in (*((cases.walls, 3, (0.2, 0.8)), (cases.movers, 4, (0.2, 0.4))),):
        present, corners = group.present, group.corners
        edge = np.roll(corners, -1, axis=2) - corners
        num_corners = np.sum(np.any(np.abs(edge) > 1e-12, axis=3), axis=2)
        np.testing.assert_array_equal(np.unique(num_corners[present]), range(fewest, 7))
        for other in np.moveaxis(corners, 2, 0):
            away = other[:, :, None] - corners
            turn = edge[..., 0] * away[..., 1] - edge[..., 1] * away[..., 0]
            assert turn.min() > -1e-12  # every corner is left of every edge
        a, b, c = np.moveaxis(corners[present][:, :3], 1, 0)
        sides = [np.linalg.norm(each, axis=1) for each in (a - b, b - c, c - a)]
        area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
        around = sides[0] * sides[1] * sides[2] / (4.0 * area)  # radius of the circle
        assert radius[0] - 1e-9 <= around.min() and around.max() <= radius[1] + 1e-9
        assert np.ptp(around) > 0.8 * (radius[1] - radius[0])


@pytest.mark.parametrize("name", [name for name in SUITES if not SUITES[name].mover_boxes])
def test_movers_cross_the_straight_line_at_the_time_of_a_drive_at_constant_speed(batches, name):
    cases, suite = batches[name].cases, SUITES[name]
    present, velocity = cases.movers.present, cases.movers.velocity
    speed = np.linalg.norm(velocity, axis=2)[present]
    low, high = suite.mover_speed
    assert low <= speed.min() and speed.max() <= high and np.ptp(speed) > 0.7 * (high - low)
    start, end = cases.start[:, :2], positions_on(cases.target, suite.time)
    gap, closing = cases.movers.centre - start[:, None], velocity
    closing = closing - (end - start)[:, None] / suite.time
    when = -np.sum(gap * closing, axis=2) / np.sum(closing**2, axis=2)
    miss = np.linalg.norm(gap + when[..., None] * closing, axis=2)[present]
    assert miss.max() < 0.2  # of the mean of the corners, near the middle of their circle


@each_suite
def test_targets_stay_on_the_map_and_off_the_walls(batches, name):
    cases, suite = batches[name].cases, SUITES[name]
    path = positions_on(cases.target, np.linspace(0.0, suite.time, 400))
    assert path.min() >= -1e-3 and path.max() <= suites.SIZE + 1e-3
    assert least_distance(cases.walls, path).min() > 0.0
    if any(suite.control):
        mean = np.linalg.norm(path[:, -1] - path[:, 0], axis=1) / suite.time
        assert 0.2 <= mean.min() and mean.max() <= 0.5
        return
    speed = np.linalg.norm(cases.target.vel, axis=1)
    assert 0.2 <= speed.min() and speed.max() <= 0.5
    rate = np.abs(cases.target.turn_rate)
    turns = rate > 0.0
    assert 0.25 * NUM < turns.sum() < 0.75 * NUM
    assert 0.03 <= rate[turns].min() and rate.max() <= 0.1


@each_suite
def test_start_and_meeting_are_clear(batches, name):
    cases, suite = batches[name].cases, SUITES[name]
    start = (cases.start[:, :2] + [suites.BODY_MIDDLE, 0.0])[:, None]
    end = positions_on(cases.target, np.array([suite.time]))
    assert least_distance(cases.walls, start).min() >= 0.35
    assert least_distance(cases.movers, start).min() >= 0.35
    assert least_distance(cases.walls, end).min() >= 0.4
    assert least_distance(cases.movers, end, suite.time).min() >= 0.4
    assert end.min() >= 0.3 - 1e-9 and end.max() <= suites.SIZE - 0.3 + 1e-9


def test_a_rush_ends_half_a_second_after_the_first_layer_that_meets_the_target(batches):
    cases, suite = batches["rush"].cases, SUITES["rush"]
    assert replace(suite, description="", spare=None) == replace(SUITES["hard"], description="")
    steps = (cases.time - 0.5) / (10.0 / 19.5) - 0.5  # 19 layers of 6 cells of 0.125 m at 1.5 m/s
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert steps.min() >= 1.0 and steps.max() <= 19.0 and np.ptp(steps) > 5.0
    with jax.enable_x64(True):
        full, arrival = replace(cases, time=np.full(NUM, suite.time)), jax.jit(earliest_arrival)
        arrivals = np.array([arrival(take(full, k)) for k in range(3)])
    np.testing.assert_allclose(cases.time[:3], arrivals + 0.5)
    end = positions_on(cases.target, cases.time[:, None])
    assert end.min() >= 0.0 and end.max() <= suites.SIZE
    assert least_distance(cases.walls, end).min() >= 0.4
    assert least_distance(cases.movers, end, cases.time[:, None, None]).min() >= 0.4


@each_suite
def test_a_car_that_brakes_at_once_stops_before_every_wall(batches, name):
    cases = batches[name].cases
    blank = dict.fromkeys(("cost", "violation", "iterations", "status", "meeting"), np.zeros(NUM))
    speed = np.tile([0.5, 0.0, 0.0], (NUM, 1))
    drive = {"start": cases.start, "time": np.ones(NUM), "speed": speed, "curvature": 0.0 * speed}
    plans = InterceptPlan(**drive, **blank, origin=cases.origin)
    verdict = referee_intercepts(cases, plans)
    assert verdict.wall_clearance.min() > 0.0
    assert set(verdict.failed_limit) <= {"mover", "meeting"}


def test_controls_change_the_velocity_by_0_4_m_per_s_from_the_first_observation(batches, float64):
    cases = batches["qu-curve"].cases
    times, positions = observe(cases, 0, noise=0.0, until=10.0)
    changes = np.diff(positions, 2, axis=1)
    np.testing.assert_allclose(changes, np.tile([0.0, 0.4], (NUM, 23, 1)), atol=1e-9)
    # A polynomial of degree 2 is through the whole seconds, and between them at most u / 8 apart.
    with jax.numpy_dtype_promotion("standard"):
        fit = jax.vmap(lambda seen: fit_polynomial(times[:15], seen, 2))(positions[:, :15])
    for ahead, error in ((10.0, 0.0), (9.5, 0.05)):
        found = jax.vmap(lambda path, t=ahead: path.at(t).pos)(fit)
        off = np.abs(found - positions_on(cases.target, np.array([ahead]))[:, 0])
        np.testing.assert_allclose(off, np.tile([0.0, error], (NUM, 1)), atol=1e-6)


def test_the_map_has_the_same_walls_and_movers_in_every_case(batches):
    cases, suite = batches["qu-map"].cases, SUITES["qu-map"]
    for group, boxes in ((cases.walls, suite.wall_boxes), (cases.movers, suite.mover_boxes)):
        for number, (*box, velocity_x, velocity_y) in enumerate((*b, 0.0, 0.0)[:6] for b in boxes):
            corners = group.centre[:, number, None] + group.corners[:, number]
            np.testing.assert_allclose(corners.min(axis=1), np.tile(box[:2], (NUM, 1)))
            np.testing.assert_allclose(corners.max(axis=1), np.tile(box[2:], (NUM, 1)))
            velocity = np.tile([velocity_x, velocity_y], (NUM, 1))
            np.testing.assert_array_equal(group.velocity[:, number], velocity)


def test_a_mazes_walls_have_one_gap_each_and_dead_ends_before_them(batches):
    cases = batches["maze"].cases
    counts = set()
    for k in range(NUM):
        corners = cases.walls.centre[k, :, None] + cases.walls.corners[k]
        corners = corners[cases.walls.present[k]]
        low, high = corners.min(axis=1), corners.max(axis=1)
        is_arm = high[:, 0] - low[:, 0] > 0.2 + 1e-9
        across = np.unique(np.round(high[~is_arm, 0], 9))
        counts.add(len(across))
        end = positions_on(cases.target, 15.0)[k]
        assert end[0] > across[0]
        for right in across:
            pieces = ~is_arm & np.isclose(high[:, 0], right)
            assert low[pieces, 1].min() == 0.0 and high[pieces, 1].max() == suites.SIZE
            gap = low[pieces, 1].max(), high[pieces, 1].min()
            assert 0.7 - 1e-9 <= gap[0] - gap[1] <= 1.1 + 1e-9
            arms = is_arm & np.isclose(high[:, 0], right - 0.2)
            assert arms.sum() == (2 if right - 0.1 > 2.5 else 0)
            if arms.any():
                first, second = low[arms, 1].max(), high[arms, 1].min()
                assert 0.8 - 1e-9 <= first - second <= 1.4 + 1e-9
                assert low[arms, 1].min() >= gap[0] - 1e-9 or high[arms, 1].max() <= gap[1] + 1e-9
    assert counts == {2, 3}


@each_suite
def test_every_rejected_draw_has_a_cause(batches, name):
    draws, rejected = batches[name].draws, batches[name].rejected
    assert tuple(rejected) == suites.CAUSES
    np.testing.assert_array_equal(sum(rejected.values()), draws - 1)
    assert 0.01 < NUM / draws.sum() < 0.5
    assert rejected["target off the map"].sum() > 0.3 * draws.sum()


def plain_draw(**changes):
    box = np.array([[-0.1, -4.0], [0.1, -4.0], [0.1, 3.6], [-0.1, 3.6], [-0.1, 3.6], [-0.1, 3.6]])
    mover = np.array([[-0.2, -0.2], [0.2, -0.2], [0.2, 0.2], [-0.2, 0.2]])
    draw = {
        "start": [0.8, 4.0],
        "meeting": [5.0, 4.0],
        "pos": [7.0, 4.0],
        "angle": np.pi,
        "speed": 0.2,
        "rate": 0.0,
        "walls": [[3.0, 4.0] + box, [9.0, 9.0] + 0.0 * box],
        "walls present": [True, False],
        "movers": [[3.0, 7.0] + mover],
        "movers present": [True],
        "time": 10.0,
        "reached": True,
        "velocity": [[0.1, -0.2]],
    }
    return {name: np.array(leaf)[None] for name, leaf in (draw | changes).items()}


def wall(x, y):
    corners = 0.1 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, 1], [-1, 1]])
    return {"walls": np.stack([[x, y] + corners] * 2)}


def mover(x, y, velocity):
    return {"movers": plain_draw()["movers"][0] + [x - 3.0, y - 7.0], "velocity": [velocity]}


def causes_of(draws):
    stacked = {k: np.concatenate([each[k] for each in draws]) for k in draws[0]}
    return [(*suites.CAUSES, "")[index] for index in suites.first_cause(SUITES["hard"], stacked)]


def test_every_cause_of_rejection_is_found():
    draws = {
        "": plain_draw(),
        "target off the map": plain_draw(pos=[8.1, 4.0]),
        "start near a wall": plain_draw(**wall(0.95, 4.44)),
        "meeting near a wall": plain_draw(**wall(5.0, 3.51)),
        "target through a wall": plain_draw(**wall(6.0, 4.14)),
        "mover at the start": plain_draw(**mover(0.95, 4.54, [0.0, 1.0])),
        "mover at the meeting": plain_draw(**mover(5.0, 7.0, [0.0, -0.25])),
        "too far": plain_draw(start=[-11.0, 4.0]),
        "no way": plain_draw(walls=plain_draw()["walls"][0] * [1.0, 1.1]),
        "out of reach": plain_draw(reached=False),
    }
    assert tuple(draws) == ("", *suites.CAUSES)
    assert causes_of(list(draws.values())) == list(draws)


def test_draws_that_are_just_far_enough_are_accepted():
    draws = [
        plain_draw(pos=[7.9, 4.0]),
        plain_draw(**wall(0.95, 4.46)),
        plain_draw(**wall(5.0, 3.49)),
        plain_draw(**wall(6.0, 4.16)),
        plain_draw(**mover(0.95, 4.56, [0.0, 1.0])),
        plain_draw(**mover(5.0, 7.0, [0.0, -0.235])),
        plain_draw(**mover(5.0, 4.0, [0.0, 0.07])),  # gone when the target is there
        plain_draw(**mover(5.0, 7.0, [0.0, -0.25]), time=9.0),  # not there yet
    ]
    assert not any(causes_of(draws))


def test_observations_are_positions_of_the_target_with_noise():
    cases = as_numpy(draw(200, "easy", 1))
    times, positions = observe(cases, 4)
    np.testing.assert_array_equal(times, np.arange(-14.0, 1.0))
    assert positions.shape == (200, 15, 2)
    noise = positions - positions_on(cases.target, times)
    assert np.abs(noise.mean()) < 0.01 and noise.std() == pytest.approx(0.1, rel=0.05)
    some, again = observe(jax.tree.map(lambda leaf: leaf[3:5], cases), 4, first=3)
    np.testing.assert_array_equal(again, positions[3:5])
    times, longer = observe(cases, 4, until=9.5)
    np.testing.assert_array_equal(times, np.arange(-14.0, 10.0))
    np.testing.assert_allclose(longer[:, :15], positions, atol=1e-6)
    times, exact = observe(cases, 4, noise=0.0, count=3, interval=0.5)
    np.testing.assert_array_equal(times, [-1.0, -0.5, 0.0])
    np.testing.assert_allclose(exact, positions_on(cases.target, times), atol=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"count": 0}, "count must be >= 1, got 0"),
        ({"interval": 0.0}, "interval must be finite and > 0, got 0"),
        ({"until": -1.0}, "until must be finite and >= 0, got -1"),
    ],
)
def test_bad_arguments_of_observations_are_named_in_one_line(options, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        observe(draw(1), 0, **options)
