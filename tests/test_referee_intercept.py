"""The referee of interceptions, an independent check of plans, on plans in closed form."""

import math
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from referees import add, checks, edit, failure, tree
from scipy.integrate import solve_ivp

from planner_jax.plane.target import (
    ControlledPath,
    LaterPath,
    PointState,
    PolynomialPath,
    TurningPath,
)
from planner_jax.referee.clearance import clearances
from planner_jax.referee.intercept import InterceptVerdict, referee_intercepts, target_positions_of
from planner_jax.task.intercept.api import position_setting

LENGTH, WIDTH, WHEELBASE, REAR = 0.4, 0.25, 0.3, 0.05
MIDDLE, FRONT = 0.5 * LENGTH - REAR, LENGTH - REAR  # ahead of the rear axle
START = (0.8, 4.0, 0.0)
TIME, SPEED, KNOTS = 5.0, 0.8, 11
H = TIME / (KNOTS - 1)  # duration of a piece


def square(x, y, half, sense=1):
    return np.array([x, y]) + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])[::sense]


def group(polygons=(), velocities=(), room=(3, 6)):
    centre, corners = np.full((room[0], 2), np.nan), np.full((*room, 2), np.nan)
    velocity = np.full((room[0], 2), np.nan)
    for k, polygon in enumerate(polygons):
        centre[k] = np.mean(polygon, axis=0)
        corners[k] = np.asarray(polygon)[np.minimum(np.arange(room[1]), len(polygon) - 1)]
        corners[k] -= centre[k]
        velocity[k] = velocities[k] if velocities else 0.0
    present = np.arange(room[0]) < len(polygons)
    leaves = {"centre": centre, "corners": corners, "velocity": velocity, "present": present}
    leaves |= {name: np.where(present, 0.0, np.nan) for name in ("radius", "growth")}
    return {name: leaf[None] for name, leaf in leaves.items()}


def good(
    speed: Any = SPEED,
    curvature: Any = 0.0,
    time=TIME,
    start: Any = START,
    end=None,
    walls: Any = (),
    movers: Any = ((), ()),
):
    """Return arrays (1, ...) of a case and a plan by name: a car drives to its target.

    The default end is the end of a straight drive at constant speed.
    """
    start = np.asarray(start, float)
    speed, curvature = (np.broadcast_to(each, KNOTS).astype(float) for each in (speed, curvature))
    ahead = np.array([math.cos(start[2]), math.sin(start[2])])
    end = start[:2] + (speed[0] * time + MIDDLE) * ahead if end is None else np.asarray(end)
    leaves = {
        **{"plan.start": start, "plan.time": time, "plan.speed": speed},
        **{"plan.curvature": curvature, "start": start, "time": time},
        **{"speed": speed[0], "curvature": curvature[0], "tolerance": 0.05},
        **{"end_heading": 0.0, "heading_tolerance": math.pi, "end_speed": (0.0, math.inf)},
        **{"region": np.zeros((4, 2)), "earliest": 0.0, "margin": 0.0, "map_heading": 0.0},
        **{"origin": (5e5, -7.0), "plan.origin": (5e5, -7.0)},
        **{"lower": (0.0, 0.0), "upper": (8.0, 8.0), "target.pos": end - [0.0, 0.3 * time]},
        **{"target.vel": (0.0, 0.3), "target.turn_rate": 0.0},
        **{"body.length": LENGTH, "body.width": WIDTH},
        **{"body.wheelbase": WHEELBASE, "body.rear_overhang": REAR},
        **{"limits.speed": 1.5, "limits.acceleration": 1.0, "limits.curvature": 2.0},
        **{"limits.lateral_acceleration": 0.8, "limits.steering_rate": 2.0},
        **{"limits.reverse_speed": 0.0, "limits.jerk": math.inf},
    }
    leaves = {name: np.array(leaf, float)[None] for name, leaf in leaves.items()}
    for name, (polygons, velocities) in {"walls": (walls, ()), "movers": movers}.items():
        leaves |= {f"{name}.{k}": leaf for k, leaf in group(polygons, velocities).items()}
    return leaves


def judge(leaves, **options) -> InterceptVerdict:
    case = tree(leaves)
    case.movers = SimpleNamespace(**{"track": None, **vars(case.movers)})
    return referee_intercepts(case, case.plan, **options)


assert_good, assert_fails = checks(judge)


def test_a_straight_drive_meets_its_target():
    verdict = assert_good(good())
    assert verdict.failed_limit[0] == "" and np.isnan(verdict.failed_time[0])
    assert verdict.max_speed[0] == SPEED and verdict.meeting_time[0] == TIME
    assert verdict.miss[0] < 1e-12
    for name in ("max_acceleration", "rms_acceleration", "max_curvature", "max_steering_rate"):
        assert getattr(verdict, name)[0] == 0.0
    assert np.isposinf(verdict.wall_clearance[0]) and np.isposinf(verdict.mover_clearance[0])
    assert verdict.nearest_wall[0] == verdict.nearest_mover[0] == -1
    assert "from the target after 5 s" in verdict.sentence(0)


@pytest.mark.parametrize("seed", range(3))
def test_the_end_of_any_plan_is_where_integration_puts_it(seed):
    random = np.random.default_rng(seed)
    speed, curvature = random.uniform(0.0, 1.5, KNOTS), random.uniform(-2.0, 2.0, KNOTS)
    start, time = random.uniform([1, 1, -3], [7, 7, 3]), random.uniform(4.0, 12.0)
    knots = np.linspace(0.0, time, KNOTS)

    def drive(t, state):
        v, k = np.interp(t, knots, speed), np.interp(t, knots, curvature)
        return [v * np.cos(state[2]), v * np.sin(state[2]), v * k]

    state = start
    for begin, end in zip(knots[:-1], knots[1:], strict=True):
        solved = solve_ivp(drive, (begin, end), state, method="DOP853", rtol=1e-11, atol=1e-11)
        state = solved.y[:, -1]
    middle = state[:2] + MIDDLE * np.array([np.cos(state[2]), np.sin(state[2])])
    leaves = good(speed, curvature, time, start, middle)
    leaves["end_heading"][:] = state[2]
    for name in ("limits.acceleration", "limits.lateral_acceleration", "limits.steering_rate"):
        leaves[name][:] = np.inf
    leaves["lower"][:], leaves["upper"][:] = -np.inf, np.inf
    leaves["heading_tolerance"][:] = 1e-8
    assert assert_good(leaves).miss[0] < 1e-8
    leaves["end_heading"][:] += 0.3
    assert_fails(leaves, "heading", excess=0.3 - 1e-8, time=time)


def test_acceleration_is_that_of_the_steepest_piece_and_the_root_mean_square_of_all():
    speed = SPEED + 0.1 * np.array([0, 1, 3, 3, 2, 0, 0, 0, 0, 0, 0])
    end = np.array(START[:2]) + [H * (speed.sum() - SPEED) + MIDDLE, 0.0]
    verdict = assert_good(good(speed, end=end))
    rise = np.diff(speed) / H
    assert verdict.max_acceleration[0] == pytest.approx(0.4)
    assert verdict.rms_acceleration[0] == pytest.approx(math.sqrt(np.mean(rise**2)))
    leaves = good(speed, end=end)
    leaves["limits.acceleration"][:] = 0.32
    assert_fails(leaves, "acceleration", excess=0.25, time=H)


def test_jerk_is_the_change_of_the_acceleration_at_a_knot_over_the_time_between_knots():
    speed = SPEED + 0.1 * np.array([0, 1, 3, 3, 3, 3, 3, 3, 3, 3, 3])
    end = np.array(START[:2]) + [H * (speed.sum() - 0.5 * (speed[0] + speed[-1])) + MIDDLE, 0.0]
    leaves = good(speed, end=end)
    assert assert_good(leaves).max_jerk[0] == pytest.approx(0.2 / H**2)
    leaves["limits.jerk"][:] = 0.16 / H**2
    assert_fails(leaves, "jerk", excess=0.25, time=2.0 * H)
    leaves["limits.jerk"][:] = 0.2 / H**2
    assert_good(leaves)
    assert assert_good(good()).max_jerk[0] == 0.0


def test_lateral_acceleration_peaks_inside_of_a_piece():
    speed, curvature = np.zeros(KNOTS), np.zeros(KNOTS)
    speed[:4], curvature[4:] = 1.5, -2.0
    leaves = good(speed, curvature)
    for name in ("limits.acceleration", "limits.steering_rate", "tolerance"):
        leaves[name][:] = np.inf
    verdict = assert_good(leaves)
    peak = 4.0 / 27.0 * 1.5**2 * 2.0
    assert verdict.max_lateral_acceleration[0] == pytest.approx(peak)
    leaves["limits.lateral_acceleration"][:] = 0.5 * peak
    assert_fails(leaves, "lateral acceleration", excess=1.0, time=(3.0 + 1.0 / 3.0) * H)


@pytest.mark.parametrize(
    ("first", "second", "least", "place"),
    [(-0.5, 1.5, 0.0, 0.25), (0.4, 1.2, 0.4, 0.0), (-1.2, -0.4, 0.4, 1.0)],
)
def test_steering_is_fastest_where_the_curvature_is_least(first, second, least, place):
    curvature = np.array([first] * 3 + [second] * (KNOTS - 3))
    leaves = good(SPEED, curvature)
    for name in ("limits.lateral_acceleration", "tolerance"):
        leaves[name][:] = np.inf
    rate = WHEELBASE * abs(second - first) / H / (1.0 + (WHEELBASE * least) ** 2)
    assert assert_good(leaves).max_steering_rate[0] == pytest.approx(rate)
    leaves["limits.steering_rate"][:] = 0.8 * rate
    assert_fails(leaves, "steering rate", excess=0.25, time=(2.0 + place) * H)


def test_a_car_that_stops_late_is_inside_the_wall():
    end = START[0] + SPEED * TIME + FRONT
    wall = [[end - 0.07, 3.0], [end + 2.0, 3.0], [end + 2.0, 5.0], [end - 0.07, 5.0]]
    verdict = assert_fails(good(walls=[square(7, 1, 0.2), wall]), "wall", excess=0.07, time=TIME)
    assert verdict.nearest_wall[0] == 1 and verdict.wall_clearance[0] == pytest.approx(-0.07)
    says = "wall: the body is 0.07 m inside walls[1] or its margin at 5.000 s"
    assert verdict.sentence(0) == says
    touching = np.array(wall) + [0.07 - 9e-4, 0.0]
    assert assert_good(good(walls=[touching])).wall_clearance[0] == pytest.approx(-9e-4)
    assert_fails(good(walls=[touching]), "wall", contact_tolerance=8e-4)


def test_corners_graze_at_the_distance_of_their_diagonals():
    start = (2.0, 2.0, math.pi / 4.0)
    ahead, left = np.array([1.0, 1.0]) / math.sqrt(2.0), np.array([-1.0, 1.0]) / math.sqrt(2.0)
    beside = np.array(start[:2]) + 1.5 * ahead + (0.5 * WIDTH + 0.03) * left
    x, y = beside + [-0.4, 0.4]
    passed = good(start=start, walls=[square(x, y, 0.4)])
    assert assert_good(passed).wall_clearance[0] == pytest.approx(0.03)
    corner = np.array(start[:2]) + (SPEED * TIME + FRONT) * ahead + 0.5 * WIDTH * left
    corners = np.array([[0.0, 0.0], ahead, ahead + left, left])
    stopped = good(start=start, walls=[corner + 0.02 * ahead + 0.03 * left + corners])
    assert assert_good(stopped).wall_clearance[0] == pytest.approx(math.hypot(0.02, 0.03))
    wedged = good(start=start, walls=[corner - 0.02 * ahead - 0.03 * left + corners])
    assert_fails(wedged, "wall", excess=0.02, time=TIME)


def test_a_mover_is_hit_at_its_position_and_time():
    still, way = {"speed": 0.0, "time": 4.0}, [(0.5, 0.0)]
    x, y = START[0] + MIDDLE - 1.0, START[1] + 0.5 * WIDTH + 0.2
    passing = good(**still, movers=([square(x, y + 0.05, 0.2)], way))
    assert assert_good(passing).mover_clearance[0] == pytest.approx(0.05)
    hit = good(**still, movers=([square(7.0, 1.0, 0.2), square(x, y - 0.05, 0.2)], way * 2))
    verdict = assert_fails(hit, "mover", excess=0.05, says="inside movers[1]")
    assert verdict.failed_time[0] == pytest.approx(2.0 - 0.35 / 0.5, abs=0.02)
    convoy = good(movers=([square(START[0] + FRONT + 0.3, 4.0, 0.2)], [(SPEED, 0.0)]))
    assert assert_good(convoy).mover_clearance[0] == pytest.approx(0.1)
    slow = good(movers=([square(START[0] + FRONT + 0.3, 4.0, 0.2)], [(SPEED - 0.03, 0.0)]))
    assert_fails(slow, "mover", excess=0.05, time=TIME)


def random_polygon(random, most=6):
    """Return corners (most, 2) of a convex polygon; copies of the last corner fill the array."""
    num = random.integers(3, most + 1)
    angles = 2.0 * np.pi * (np.arange(num) + random.uniform(0.1, 0.9, num)) / num
    corners = random.uniform(0.1, 0.6) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return corners[np.minimum(np.arange(most), num - 1)]


def test_clearances_are_the_greatest_gap_in_any_direction():
    """Compare with the greatest gap between projections of two polygons on 2,881 directions."""
    random = np.random.default_rng(0)
    lanes, samples, num = 40, 5, 3
    half = np.tile([0.2, 0.125], (lanes, 1))
    obstacles = {
        "centre": random.uniform(-0.8, 0.8, (lanes, num, 2)),
        "velocity": random.uniform(-0.3, 0.3, (lanes, num, 2)),
        "corners": np.array([[random_polygon(random) for _ in range(num)] for _ in range(lanes)]),
        "present": random.uniform(size=(lanes, num)) < 0.7,
    }
    times = np.tile(np.arange(samples, dtype=float), (lanes, 1))
    poses = random.uniform([-0.8, -0.8, -3], [0.8, 0.8, 3], (lanes, samples, 3))
    least, when, nearest = clearances(obstacles, half, times, poses)
    angles = np.linspace(0.0, 2.0 * np.pi, 2881)
    u = np.stack([np.cos(angles), np.sin(angles)])
    cos, sin = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    turn = np.stack([np.stack([cos, -sin], axis=-1), np.stack([sin, cos], axis=-1)], axis=-2)
    box = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half[0]
    box = poses[..., None, :2] + np.einsum("bsij,kj->bski", turn, box)
    centre = obstacles["centre"][:, None] + obstacles["velocity"][:, None] * times[..., None, None]
    corners = centre[:, :, :, None] + obstacles["corners"][:, None]
    gaps = ((corners @ u).min(axis=3) - (box @ u).max(axis=2)[:, :, None]).max(axis=3)
    gaps = np.where(obstacles["present"][:, None], gaps, np.inf)
    found = np.isfinite(least)
    np.testing.assert_array_equal(found, obstacles["present"].any(axis=1))
    assert (least[found] > 0.0).any() and (least[found] < 0.0).any()
    np.testing.assert_allclose(least, gaps.min(axis=(1, 2)), atol=2e-3)
    at = gaps[np.arange(lanes), when.astype(int), nearest]
    np.testing.assert_allclose(at[found], least[found], atol=2e-3)
    assert (nearest[~found] == -1).all()


def test_polygons_may_have_either_orientation_and_repeated_corners():
    wall = square(3.0, 4.5, 0.3)
    plain, turned = good(walls=[wall]), good(walls=[wall[::-1]])
    tight = good()
    tight |= {f"walls.{k}": leaf for k, leaf in group([wall], room=(1, 4)).items()}
    expected = assert_good(plain).wall_clearance
    for leaves in (turned, tight):
        np.testing.assert_allclose(assert_good(leaves).wall_clearance, expected, rtol=1e-12)
    assert expected[0] == pytest.approx(0.2 - 0.5 * WIDTH)


def spoil(edits, *found, **options):
    return failure(edit(good(), edits), *found, **options)


BACKWARDS = [SPEED] * 6 + [-0.15] + [SPEED] * 4
FAILURES = {
    "time: late": spoil({"time": TIME - 0.5}, 0.5, TIME),
    "time: negative": spoil({"plan.time": -1.0}, 1.0, -1.0),
    "time: an hour": spoil({"plan.time": 4000.0, "time": 4000.0}, 400.0, 4000.0),
    "start: position": spoil({("start", (0, 1)): add([0.3, 0.4])}, 0.5 / LENGTH, 0.0),
    "start: heading": spoil({("plan.start", 2): add(2.0 * math.pi + 0.02)}, 0.02, 0.0),
    "start: speed": spoil({"speed": add(0.1)}, 0.1 / 1.5, 0.0),
    "start: curvature": spoil({"curvature": add(0.2)}, 0.2 * LENGTH, 0.0),
    "speed: too fast": spoil({"limits.speed": 0.64}, 0.25, 0.0),
    "speed: backwards": failure(edit(good(BACKWARDS), {"limits.acceleration": np.inf}), 0.1, 6 * H),
    "curvature: at a knot": failure(
        edit(good(SPEED, 0.5), {"limits.curvature": 0.5, ("plan.curvature", 4): 0.6}), 0.2, 4 * H
    ),
    "map: beyond its edge": spoil(
        {("upper", 0): START[0] + MIDDLE + SPEED * TIME - 0.4}, 0.4, TIME
    ),
    "meeting: missed": spoil({("target.pos", 1): add(0.2)}, 0.2, TIME),
}


def test_a_plan_may_end_before_the_cases_time():
    leaves = good()
    leaves["time"][:] = 10.0
    assert assert_good(leaves).meeting_time[0] == TIME


def test_the_true_path_replaces_the_expected_one():
    leaves = good()
    truth = tree(leaves).target
    truth.pos = truth.pos + [0.3, 0.0]
    assert_fails(leaves, "meeting", excess=0.3, truth=truth)
    leaves["target.pos"][:] = np.nan
    truth.pos = truth.pos - [0.3, 0.0]
    assert_good(leaves, truth=truth)


def test_targets_of_a_users_class_are_followed_by_a_function():
    case = tree(good())
    case.movers.track = None
    known, case.target = case.target, "hovering"

    def positions(target, times):
        assert target == "hovering"
        return known.pos + known.vel * times[:, None]

    assert referee_intercepts(case, case.plan, target_positions=positions).success[0]
    with pytest.raises(ValueError, match="a target of class str needs target_positions"):
        referee_intercepts(case, case.plan)
    with pytest.raises(ValueError, match=r"target_positions must be \(1, 2\), got \(3,\)"):
        referee_intercepts(case, case.plan, target_positions=lambda *_: np.zeros(3))


def unequal_lanes():
    wall, mover = square(3.0, 4.5, 0.3), square(3.0, 5.0, 0.3)
    return [
        good(walls=[wall], movers=([mover], [(0.0, -0.1)])),
        good(walls=[wall, square(4.0, 4.0, 0.2)]),
        good(1.3, time=3.0, movers=([square(2.0, 4.0, 0.3), mover], [(0.0, 0.0), (0.1, 0.0)])),
        good(np.linspace(0.5, 1.2, KNOTS), np.linspace(0.0, 0.4, KNOTS)),
        FAILURES["time: late"][0],
        good(),
    ]


FAILED = ["", "wall", "mover", "meeting", "time", ""]
UNKNOWN = ("miss",)
ABSURD = ("plan.speed", "plan.curvature", "plan.time", "plan.start", "target.vel", "walls.centre")
HARMLESS = "walls.centre"
WRONG = [
    ({"plan.speed": np.zeros(4)}, {}, r"plan.speed must be \(B, K \+ 1\), K >= 1, got \(4,\)"),
    ({"plan.curvature": np.zeros((1, 4))}, {}, r"plan.curvature must be \(1, 11\)"),
    ({"limits.speed": np.array(1.0)}, {}, r"limits.speed must be \(1,\), got \(\)"),
    ({"walls.corners": np.zeros((1, 3, 2))}, {}, r"walls.corners must be \(1, N, V >= 3, 2\)"),
    ({"movers.present": np.ones((1, 2))}, {}, r"movers.present must be \(1, 3\), got \(1, 2\)"),
    ({"target.vel": np.zeros(2)}, {}, r"target.vel must be \(1, 2\), got \(2,\)"),
]


def test_a_broken_plan_has_no_nearest_wall():
    leaves = unequal_lanes()[0]
    leaves["plan.time"][:] = np.nan
    assert judge(leaves).nearest_wall[0] == -1


def test_arrays_of_obstacles_may_be_empty():
    leaves = good()
    leaves |= {f"walls.{k}": leaf for k, leaf in group(room=(0, 4)).items()}
    assert np.isposinf(assert_good(leaves).wall_clearance[0])


def test_referee_and_planner_agree_where_a_target_is():
    random = np.random.default_rng(3)
    num, times = 50, random.uniform(0.0, 12.0, 50)

    def draw(*shape):
        return random.standard_normal((num, *shape))

    rates = np.where(np.arange(num) < 10, 0.0, 0.1 * draw())
    make: list[Any] = [TurningPath, PolynomialPath, LaterPath, ControlledPath]
    turning = make[0](pos=draw(2), vel=draw(2), turn_rate=rates)
    polynomial = make[1](coeffs=0.1 * draw(4, 2), origin=draw())
    controlled = make[3](state=draw(4), controls=draw(5, 2), step=random.uniform(0.5, 2.0, num))
    paths = [turning, polynomial, controlled]
    paths += [make[2](path=path, begin=random.uniform(0.0, 5.0, num)) for path in paths]
    for path in paths:
        assert position_setting(path) == {}
        with jax.enable_x64(True):
            theirs = jax.vmap(lambda path, time: path.at(time).pos)(path, times)
        # The planner's series of sin(x) / x for small angles has errors up to 1e-10.
        np.testing.assert_allclose(target_positions_of(path, times), theirs, rtol=0, atol=1e-9)


def test_a_target_of_an_own_class_is_where_its_method_says():
    @struct.dataclass
    class Standing:
        pos: Any

        def at(self, time):
            return PointState(pos=self.pos + 0.0 * time, vel=jnp.zeros_like(self.pos))

    target = LaterPath(path=Standing(np.array([[1.0, 2.0]])), begin=jnp.array([0.5]))
    where: Any = position_setting(target)["target_positions"]
    np.testing.assert_array_equal(where(target, np.array([3.0])), [[1.0, 2.0]])
