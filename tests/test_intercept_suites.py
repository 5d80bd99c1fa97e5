"""The named suites of interceptions: what their module says of them holds for every draw."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from planner_jax.core.protocol import take
from planner_jax.referee.clearance import clearances
from planner_jax.referee.intercept import referee_intercepts
from planner_jax.task.intercept.api import draw, observe
from planner_jax.task.intercept.plan import InterceptPlan
from planner_jax.task.intercept.searches import earliest_arrival
from planner_jax.task.intercept.spec import SUITES
from planner_jax.task.intercept.suites import (
    BODY_MIDDLE,
    CAUSES,
    SIZE,
    drawn,
    first_cause,
)

NUM, SEED = 24, 3
PLAIN = [name for name, suite in SUITES.items() if not suite.is_maze]

each_suite = pytest.mark.parametrize("name", SUITES)


@pytest.fixture(scope="module")
def batches():
    """What is drawn of every suite, in double precision."""
    with jax.enable_x64(True):
        found = {name: drawn(name, NUM, SEED, dtype=jnp.float64) for name in SUITES}
        return {name: replace(each, cases=numpy(each.cases)) for name, each in found.items()}


def arrays(tree):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]


def numpy(tree):
    return jax.tree.map(np.asarray, tree)


def places(target, times):
    """Where (B, M, 2) the targets are at times (M,) or (B, M): chords of arcs, by hand."""
    half = 0.5 * np.asarray(target.turn_rate)[:, None] * times
    (x, y), chord = np.asarray(target.vel).T[..., None], times * np.sinc(half / np.pi)
    way = [np.cos(half) * x - np.sin(half) * y, np.sin(half) * x + np.cos(half) * y]
    return np.asarray(target.pos)[:, None] + np.stack([chord * each for each in way], axis=2)


def least_distance(group, points, time=0.0):
    """Of points (B, M, 2) from obstacles at one time, by the referee's separating axes."""
    leaves = {name: getattr(group, name) for name in ("velocity", "corners", "present")}
    leaves["centre"] = group.centre + time * group.velocity
    leaves["velocity"] = 0.0 * group.velocity
    poses = np.concatenate([points, np.zeros_like(points[..., :1])], axis=2)
    times = np.zeros(points.shape[:2])
    return clearances(leaves, np.zeros((len(points), 2)), times, poses)[0]


def corner_numbers(group):
    """How many corners (B, N) are not repeated."""
    corners = np.asarray(group.corners)
    same = np.all(np.isclose(corners, np.roll(corners, -1, axis=2), atol=1e-12), axis=3)
    return np.sum(~same, axis=2)


@each_suite
def test_a_case_is_the_same_in_every_batch(name):
    whole, again = draw(7, name, 5), draw(3, name, 5, first=2)
    for a, b in zip(arrays(whole), arrays(again), strict=True):
        np.testing.assert_array_equal(a[2:5], b)
        assert a.dtype in (np.float32, bool)
    other = draw(7, name, 6)
    assert (np.asarray(whole.target.pos) != np.asarray(other.target.pos)).all()


def test_a_suite_is_a_matter_of_its_name_and_the_seed_alone():
    """One number of two suites: a change here is a change of published cases."""
    np.testing.assert_allclose(draw(1, "hard", 0).start[0, 1], 5.625709, rtol=1e-5)
    np.testing.assert_allclose(draw(1, "maze", 0).start[0, 1], 4.843411, rtol=1e-5)
    np.testing.assert_allclose(draw(2, "rush", 0).time, [4.8589745, 5.8846154], rtol=1e-5)


@each_suite
def test_shapes_are_those_of_the_suite_and_starts_those_of_the_paper(batches, name):
    cases, suite = batches[name].cases, SUITES[name]
    assert suite.description.endswith(".") and cases.batch_shape == (NUM,)
    for group, room in ((cases.walls, suite.wall_room), (cases.movers, suite.mover_room)):
        assert group.corners.shape == (NUM, *room, 2)
        assert group.present.shape == (NUM, room[0])
    if suite.spare is None:
        np.testing.assert_array_equal(cases.time, suite.time)
    start = np.asarray(cases.start)
    assert (start[:, [0, 2]] == [0.8, 0.0]).all() and (cases.speed == 0.5).all()
    assert start[:, 1].min() >= 1.0 and start[:, 1].max() <= 7.0 and np.ptp(start[:, 1]) > 4.0
    np.testing.assert_array_equal(cases.upper, np.full((NUM, 2), SIZE))
    np.testing.assert_allclose(cases.body.middle, BODY_MIDDLE)


@each_suite
def test_there_are_as_many_obstacles_as_promised_and_all_counts_occur(batches, name):
    cases, suite = batches[name].cases, SUITES[name]
    num_movers = np.asarray(cases.movers.present).sum(axis=1)
    assert set(num_movers) == set(range(suite.num_movers[0], suite.num_movers[1] + 1))
    if not suite.is_maze:
        num_walls = np.asarray(cases.walls.present).sum(axis=1)
        assert set(num_walls) == set(range(suite.num_walls[0], suite.num_walls[1] + 1))
    assert not np.asarray(cases.walls.velocity).any()
    for group in (cases.walls, cases.movers):
        absent = ~np.asarray(group.present)
        for leaf in (group.centre, group.corners, group.velocity):
            assert not np.asarray(leaf)[absent].any()


@pytest.mark.parametrize("name", PLAIN)
def test_polygons_are_convex_and_of_their_sizes(batches, name):
    cases = batches[name].cases
    for group, (fewest, radius) in (
        (cases.walls, (3, (0.2, 0.8))),
        (cases.movers, (4, (0.2, 0.4))),
    ):
        present, corners = np.asarray(group.present), np.asarray(group.corners)
        np.testing.assert_array_equal(np.unique(corner_numbers(group)[present]), range(fewest, 7))
        edge = np.roll(corners, -1, axis=2) - corners
        for other in np.moveaxis(corners, 2, 0):
            away = other[:, :, None] - corners
            turn = edge[..., 0] * away[..., 1] - edge[..., 1] * away[..., 0]
            assert turn.min() > -1e-12, "every corner is left of every edge"
        a, b, c = np.moveaxis(corners[present][:, :3], 1, 0)
        sides = [np.linalg.norm(each, axis=1) for each in (a - b, b - c, c - a)]
        area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
        around = sides[0] * sides[1] * sides[2] / (4.0 * area)  # of the circle through three
        assert radius[0] - 1e-9 <= around.min() and around.max() <= radius[1] + 1e-9
        assert np.ptp(around) > 0.8 * (radius[1] - radius[0])


@each_suite
def test_movers_cross_the_straight_line_when_an_even_drive_is_there(batches, name):
    cases, suite = batches[name].cases, SUITES[name]
    present, velocity = cases.movers.present, cases.movers.velocity
    speed = np.linalg.norm(velocity, axis=2)[present]
    low, high = suite.mover_speed
    assert low <= speed.min() and speed.max() <= high and np.ptp(speed) > 0.7 * (high - low)
    start, end = cases.start[:, :2], places(cases.target, np.array([suite.time]))[:, 0]
    gap, closing = cases.movers.centre - start[:, None], velocity
    closing = closing - (end - start)[:, None] / suite.time
    when = -np.sum(gap * closing, axis=2) / np.sum(closing**2, axis=2)
    miss = np.linalg.norm(gap + when[..., None] * closing, axis=2)[present]
    assert miss.max() < 0.2, "the mean of the corners is that near the middle of their circle"


@each_suite
def test_targets_stay_on_the_map_and_off_the_walls(batches, name):
    cases, suite = batches[name].cases, SUITES[name]
    path = places(cases.target, np.linspace(0.0, suite.time, 400))
    assert path.min() >= -1e-3 and path.max() <= SIZE + 1e-3
    assert least_distance(cases.walls, path).min() > 0.0
    speed = np.linalg.norm(cases.target.vel, axis=1)
    assert 0.2 <= speed.min() and speed.max() <= 0.5
    rate = np.abs(cases.target.turn_rate)
    turns = rate > 0.0
    assert 0.25 * NUM < turns.sum() < 0.75 * NUM
    assert 0.03 <= rate[turns].min() and rate.max() <= 0.1


@each_suite
def test_start_and_meeting_are_clear(batches, name):
    cases, suite = batches[name].cases, SUITES[name]
    start = (np.asarray(cases.start)[:, :2] + [BODY_MIDDLE, 0.0])[:, None]
    end = places(cases.target, np.array([suite.time]))
    assert least_distance(cases.walls, start).min() >= 0.35
    assert least_distance(cases.movers, start).min() >= 0.35
    assert least_distance(cases.walls, end).min() >= 0.4
    assert least_distance(cases.movers, end, suite.time).min() >= 0.4
    assert end.min() >= 0.3 - 1e-9 and end.max() <= SIZE - 0.3 + 1e-9


def test_a_rush_ends_half_a_second_after_the_first_layer_that_meets_its_target(batches):
    cases, suite = batches["rush"].cases, SUITES["rush"]
    assert replace(suite, description="", spare=None) == replace(SUITES["hard"], description="")
    steps = (cases.time - 0.5) / (10.0 / 19.5) - 0.5  # 19 layers of 6 cells of 0.125 m at 1.5 m/s
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert steps.min() >= 1.0 and steps.max() <= 19.0 and np.ptp(steps) > 5.0
    with jax.enable_x64(True):
        full = replace(cases, time=np.full(NUM, suite.time))
        first = jax.jit(earliest_arrival)
        arrivals = np.array([first(take(full, k)) for k in range(3)])
    np.testing.assert_allclose(cases.time[:3], arrivals + 0.5)
    end = places(cases.target, cases.time[:, None])
    assert end.min() >= 0.0 and end.max() <= SIZE
    assert least_distance(cases.walls, end).min() >= 0.4
    assert least_distance(cases.movers, end, cases.time[:, None, None]).min() >= 0.4


@each_suite
def test_a_car_that_brakes_at_once_stops_before_every_wall(batches, name):
    cases = batches[name].cases
    blank = dict.fromkeys(("cost", "violation", "iterations", "status", "meeting"), np.zeros(NUM))
    speed = np.tile([0.5, 0.0, 0.0], (NUM, 1))
    time = np.full(NUM, 1.0)
    plans = InterceptPlan(
        start=cases.start, time=time, speed=speed, curvature=np.zeros_like(speed), **blank
    )
    verdict = referee_intercepts(cases, plans)
    assert verdict.wall_clearance.min() > 0.0
    assert set(verdict.failed_limit) <= {"mover", "meeting"}


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
        end = places(cases.target, np.array([15.0]))[k, 0]
        assert end[0] > across[0]
        for right in across:
            pieces = ~is_arm & np.isclose(high[:, 0], right)
            assert low[pieces, 1].min() == 0.0 and high[pieces, 1].max() == SIZE
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
def test_every_draw_is_accepted_or_has_its_cause(batches, name):
    found = batches[name]
    assert tuple(found.rejected) == CAUSES
    np.testing.assert_array_equal(sum(found.rejected.values()), found.draws - 1)
    assert 0.01 < NUM / found.draws.sum() < 0.5
    assert found.rejected["target off the map"].sum() > 0.3 * found.draws.sum()


def plain_draw(**changes):
    """A draw in which nothing is wrong: a target that comes from the right to (5, 4)."""
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
    """A small wall instead of the one that leaves a gap of 0.4 m at the map's edge."""
    corners = 0.1 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, 1], [-1, 1]])
    return {"walls": np.stack([[x, y] + corners] * 2)}


def mover(x, y, velocity):
    return {"movers": plain_draw()["movers"][0] + [x - 3.0, y - 7.0], "velocity": [velocity]}


def test_every_cause_is_told_by_its_name():
    ends = {
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
    assert tuple(ends) == ("", *CAUSES)
    names = (*CAUSES, "")
    drawn = {k: np.concatenate([each[k] for each in ends.values()]) for k in ends[""]}
    found = [names[place] for place in first_cause(SUITES["hard"], drawn)]
    assert found == list(ends)


def test_nothing_is_wrong_with_what_is_just_far_enough():
    far = [
        plain_draw(pos=[7.9, 4.0]),
        plain_draw(**wall(0.95, 4.46)),
        plain_draw(**wall(5.0, 3.49)),
        plain_draw(**wall(6.0, 4.16)),
        plain_draw(**mover(0.95, 4.56, [0.0, 1.0])),
        plain_draw(**mover(5.0, 7.0, [0.0, -0.235])),
        plain_draw(**mover(5.0, 4.0, [0.0, 0.07])),  # gone when the target is there
        plain_draw(**mover(5.0, 7.0, [0.0, -0.25]), time=9.0),  # not there yet
    ]
    drawn = {k: np.concatenate([each[k] for each in far]) for k in far[0]}
    np.testing.assert_array_equal(first_cause(SUITES["hard"], drawn), len(CAUSES))


def test_observations_are_of_the_targets_way_with_noise():
    cases = numpy(draw(200, "easy", 1))
    times, positions = observe(cases, 4)
    np.testing.assert_array_equal(times, np.arange(-14.0, 1.0))
    assert positions.shape == (200, 15, 2)
    noise = positions - places(cases.target, times)
    assert np.abs(noise.mean()) < 0.01 and noise.std() == pytest.approx(0.1, rel=0.05)
    some, again = observe(jax.tree.map(lambda leaf: leaf[3:5], cases), 4, first=3)
    np.testing.assert_array_equal(again, positions[3:5])
    times, longer = observe(cases, 4, until=9.5)
    np.testing.assert_array_equal(times, np.arange(-14.0, 10.0))
    np.testing.assert_allclose(longer[:, :15], positions, atol=1e-6)
    times, exact = observe(cases, 4, noise=0.0, count=3, interval=0.5)
    np.testing.assert_array_equal(times, [-1.0, -0.5, 0.0])
    np.testing.assert_allclose(exact, places(cases.target, times), atol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "options", "says"),
    [
        ((3, "storms", 0), {}, "suite must be one of easy, medium, .*, rush, got 'storms'"),
        ((0, "easy", 0), {}, "num must be >= 1, got 0"),
        ((3, "easy", -1), {}, "seed must be >= 0, got -1"),
        ((3, "easy", 0), {"first": -1}, "first must be >= 0, got -1"),
    ],
)
def test_bad_arguments_are_named_in_one_line(arguments, options, says):
    with pytest.raises(ValueError, match=says) as caught:
        draw(*arguments, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"count": 0}, "count must be >= 1, got 0"),
        ({"noise": -0.1}, "noise must be >= 0, got -0.1"),
        ({"interval": 0.0}, "interval must be > 0, got 0"),
        ({"first": -2}, "first must be >= 0, got -2"),
        ({"until": -1.0}, "until must be >= 0, got -1"),
    ],
)
def test_bad_observations_are_named_in_one_line(options, says):
    with pytest.raises(ValueError, match=says):
        observe(draw(1, "easy", 0), 0, **options)
