import dataclasses
import sys

import jax
import numpy as np
import pytest
from dubins import dubins

from planner_jax.baselines.intercept.hybrid_astar import HybridAstar, hybrid_astar
from planner_jax.plane.make_obstacles import obstacles
from planner_jax.plane.obstacles import distances, separation

pytest.importorskip("numba", reason="needs the extra baselines")
from planner_jax.baselines.intercept import hybrid_astar_kernels as kernels  # noqa: E402

CURVATURE, BODY, MIDDLE = 2.0, (-0.05, 0.35, 0.125), 0.15
CAR_AND_MAP = {"curvature": CURVATURE, "body": BODY, "lower": (0.0, 0.0), "upper": (8.0, 8.0)}
START = np.array([0.8, 4.0, 0.0])
DEFAULT = HybridAstar()


def box(left, low, right, high):
    return [(left, low), (right, low), (right, high), (left, high)]


# Three walls that form a dead end, which is open towards the car's start.
TRAP = [box(4.0, 2.5, 4.2, 5.5), box(2.6, 2.5, 4.0, 2.7), box(2.6, 5.3, 4.0, 5.5)]


def find_path(meeting, polygons=(), end_heading=None, start=START, **settings):
    chosen = dataclasses.replace(DEFAULT, **settings)
    options = {"end_heading": end_heading, "settings": chosen}
    return hybrid_astar(start, meeting, obstacles(polygons), **CAR_AND_MAP, **options)


def rear(meeting, heading):
    direction = np.array([np.cos(heading), np.sin(heading)])
    return np.append(meeting - MIDDLE * direction, heading)


lengths_of = jax.jit(jax.vmap(lambda start, goal: dubins(start, goal, CURVATURE).length))


def dubins_from(starts, goals):
    """Return the lengths (N,) [m] of Dubins paths to poses (N, 3), from poses (3,) or (N, 3)."""
    with jax.enable_x64(True):
        return np.asarray(lengths_of(np.broadcast_to(starts, goals.shape), goals))


@jax.jit
def gaps(poses, walls):
    x, y, heading = poses.T
    return separation(walls.vertices(0.0), walls.present, x[None], y[None], heading, BODY)


def least_length(start, meeting):
    goals = [rear(meeting, heading) for heading in 2.0 * np.pi * np.arange(720) / 720]
    return dubins_from(start, np.stack(goals)).min()


def assert_drivable(path, meeting, polygons=(), start=START):
    assert path.found and not path.blocked
    x, y, heading = path.poses.T
    np.testing.assert_allclose(path.poses[0], start, atol=1e-12)
    middle = path.poses[:, :2] + MIDDLE * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    np.testing.assert_allclose(middle[-1], meeting, atol=1e-9)
    assert (middle >= 0.0).all() and (middle <= 8.0).all()
    assert (np.abs(path.curvature) <= CURVATURE * (1.0 + 1e-12)).all()
    spacing = path.length / (len(x) - 1)
    assert (np.abs(np.diff(heading)) <= CURVATURE * spacing + 1e-9).all()
    assert (np.hypot(np.diff(x), np.diff(y)) <= spacing + 1e-9).all()
    half = 0.5 * (heading[1:] + heading[:-1])
    aside = np.cos(half) * np.diff(y) - np.sin(half) * np.diff(x)
    assert (np.abs(aside) <= 0.25 * CURVATURE * spacing**2).all()
    many = np.resize(np.float32(path.poses), (256, 3))  # repeated to a fixed size, for one program
    assert len(x) <= 256 and gaps(many, obstacles(polygons)).min() > 0.0
    least = np.hypot(x[-1] - x[0], y[-1] - y[0])
    assert path.cost >= path.length >= least - 1e-9


@pytest.fixture(scope="module")
def pairs():
    rng = np.random.default_rng(0)
    return rng.uniform([-2.0, -2.0, -np.pi], [2.0, 2.0, np.pi], (2, 400, 3))


def test_the_closed_form_to_a_pose_is_dubins_of_the_library(pairs):
    starts, goals = pairs
    lengths = np.empty((6, 3))
    ours = [
        kernels.least_length(start, kernels.Goal(goal, True), 0.0, CURVATURE, lengths)
        for start, goal in zip(starts, goals, strict=True)
    ]
    np.testing.assert_allclose(ours, dubins_from(starts, goals), atol=1e-9)


def test_the_closed_form_to_a_point_is_the_least_over_all_headings(pairs):
    lengths = np.empty((6, 3))
    places = np.concatenate([pairs[1][:40, :2], 0.3 * pairs[1][40:80, :2]])
    for place in places:
        goal = kernels.Goal(np.append(place, 0.0), False)
        ours = kernels.least_length(np.zeros(3), goal, 0.0, CURVATURE, lengths)
        goals = np.stack([np.append(place, angle) for angle in np.linspace(0.0, 2 * np.pi, 720)])
        theirs = dubins_from(np.zeros(3), goals).min()
        assert ours <= theirs + 1e-9
        assert ours == pytest.approx(theirs, abs=5e-3)


def test_distances_are_those_of_the_library_up_to_their_cap():
    walls = obstacles([*TRAP, [(1.0, 1.0), (1.9, 1.2), (1.4, 2.0)]])
    corners = np.asarray(walls.vertices(0.0), float)
    field = kernels.distance_field(
        corners, np.asarray(walls.present), np.array([-0.2, -0.2]), 0.1, (84, 84), 0.4
    )
    nodes = -0.2 + 0.1 * np.arange(84)
    x, y = (np.float32(each).reshape(1, -1) for each in np.meshgrid(nodes, nodes, indexing="ij"))
    far = jax.jit(distances)(np.float32(corners), walls.present, x, y)[0]
    np.testing.assert_allclose(field.ravel(), np.minimum(far, 0.4).min(axis=0), atol=1e-5)


@pytest.mark.parametrize("end_heading", [None, 2.5])
def test_without_walls_the_path_is_the_shortest_to_within_a_primitive(end_heading):
    rng = np.random.default_rng(1)
    for meeting in rng.uniform(2.0, 6.0, (8, 2)):
        path = find_path(meeting, (), end_heading)
        assert_drivable(path, meeting)
        if end_heading is None:
            least = least_length(START, meeting)
        else:
            goal = rear(meeting, end_heading)
            least = dubins_from(START, goal[None])[0]
            np.testing.assert_allclose(path.poses[-1], goal, atol=2.0 * np.pi + 1e-9)
            assert np.cos(path.poses[-1, 2] - end_heading) == pytest.approx(1.0, abs=1e-12)
        assert least - 1e-4 <= path.length <= least + 0.1745


@pytest.mark.parametrize("end_heading", [None, 0.0])
def test_the_search_leaves_the_trap(end_heading):
    meeting = np.array([6.5, 4.0])
    path = find_path(meeting, TRAP, end_heading, slack=0.05)
    assert_drivable(path, meeting, TRAP)
    assert path.length > 1.05 * least_length(START, meeting)


def test_more_slack_costs_more_and_no_more_than_allowed():
    exact, loose = (find_path((6.5, 4.0), TRAP, slack=slack) for slack in (0.0, 0.5))
    assert loose.expansions < exact.expansions
    assert loose.cost <= 1.5 * exact.cost


def test_a_start_in_the_trap_finds_a_path_out():
    start, meeting = np.array([2.8, 3.9, 0.0]), np.array([6.5, 4.0])
    path = find_path(meeting, TRAP, start=start)
    assert_drivable(path, meeting, TRAP, start)


def test_walls_all_around_leave_no_path():
    ring = [box(5.0, 3.0, 7.0, 3.2), box(5.0, 4.8, 7.0, 5.0)]
    ring += [box(5.0, 3.2, 5.2, 4.8), box(6.8, 3.2, 7.0, 4.8)]
    path = find_path((6.0, 4.0), ring, max_expansions=3000)
    assert not path.found and not path.blocked
    assert path.length == path.cost == np.inf
    assert path.poses.shape == (DEFAULT.poses, 3) and np.isnan(path.poses).all()


def test_the_search_ends_after_so_many_expansions():
    path = find_path((6.5, 4.0), TRAP, max_expansions=20)
    assert path.expansions == 20 and not path.found


@pytest.mark.parametrize("meeting", [(4.1, 4.0), (8.3, 4.0)])
def test_a_goal_in_a_wall_or_off_the_map_is_blocked(meeting):
    path = find_path(meeting, TRAP)
    assert path.blocked and not path.found and path.expansions == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": (0.0, 0.0)}, r"start must be \(3,\) and finite"),
        ({"meeting": (np.nan, 0.0)}, r"meeting must be \(2,\) and finite"),
        ({"upper": (0.0, 8.0)}, "upper must be > lower"),
        ({"curvature": 0.0}, "curvature must be > 0"),
        ({"body": (0.4, 0.3, 0.1)}, "body must be"),
        ({"end_heading": np.inf}, "end_heading must be finite"),
        ({"settings": HybridAstar(cell=-0.1)}, "cell must be > 0"),
        ({"settings": HybridAstar(slack=-0.1)}, "slack must be >= 0"),
        ({"settings": HybridAstar(headings=3)}, "headings must be >= 8"),
    ],
)
def test_arguments_out_of_range_are_rejected(change, message):
    given = {"start": START, "meeting": (6.0, 4.0), "walls": obstacles([]), **CAR_AND_MAP}
    with pytest.raises(ValueError, match=message):
        hybrid_astar(**(given | change))


def test_without_numba_the_error_names_the_extra(monkeypatch):
    monkeypatch.delitem(sys.modules, "planner_jax.baselines.intercept.hybrid_astar_kernels")
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install .*\[baselines\]'"):
        find_path((6.0, 4.0))
