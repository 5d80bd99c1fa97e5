"""The referee of interceptions on obstacles that turn, grow or vanish, and on regions and units."""

import math

import numpy as np
import pytest
from referees import add, edit
from scipy.integrate import quad
from test_referee_intercept import (
    FRONT,
    KNOTS,
    LENGTH,
    MIDDLE,
    SPEED,
    START,
    TIME,
    WHEELBASE,
    WIDTH,
    H,
    assert_fails,
    assert_good,
    good,
    judge,
    square,
)

import planner_jax as pj
from planner_jax.plane.make_obstacles import Circle
from planner_jax.referee.clearance import clearances
from planner_jax.referee.intercept import LONGEST_MOVE
from planner_jax.task.group.plan import GroupPlan
from planner_jax.task.intercept.plan import InterceptPlan

END = np.array([START[0] + SPEED * TIME + MIDDLE, START[1]])  # the body's middle at the end
LEFT = START[1] + 0.5 * WIDTH  # y of the body's left side
EPSILON = 1e-6


def disc(x, y, radius, group="walls", **edits):
    """Return a good case with one circular obstacle, whose corners are all equal."""
    point = np.full((3, 2), [x, y])
    leaves = good(**{group: [point] if group == "walls" else ([point], [(0.0, 0.0)])})
    return edit(leaves, {(f"{group}.radius", 0): radius, **edits})


def tracked(polygon, poses, begin=0.0, step=1.0, end=math.inf, **changes):
    """Return a case with one mover that follows a table of poses (K, 3), and an absent mover."""
    leaves = good(movers=([polygon], [(0.0, 0.0)]), **changes)
    leaves["movers.corners"] += leaves["movers.centre"][:, :, None]
    leaves["movers.centre"][:] = leaves["movers.velocity"][:] = np.nan
    num = leaves["movers.present"].shape[1]
    table = np.full((1, num, len(poses), 3), np.nan)
    table[0, 0] = poses
    leaves["movers.track.poses"] = table
    for name, value in {"begin": begin, "step": step, "end": min(end, 1e6)}.items():
        leaves[f"movers.track.{name}"] = np.full((1, num), value)
    return leaves


def test_a_circle_is_hit_if_it_is_nearer_than_its_radius():
    x, gap = 3.0, 0.3
    radius = gap - LENGTH * 2.5e-3  # the body may be 1/400 of its length inside
    for excess in (-EPSILON, EPSILON):
        leaves = disc(x, LEFT + gap, gap + LENGTH * 2.5e-3 + excess)
        if excess < 0.0:
            assert_good(leaves)
        else:
            assert_fails(leaves, "wall", excess=LENGTH * 2.5e-3 + excess)
    assert assert_good(disc(x, LEFT + gap, radius)).wall_clearance[0] == pytest.approx(gap - radius)
    ahead = disc(END[0] + 0.5 * LENGTH + 0.3, LEFT + 0.4, 0.45)
    assert assert_good(ahead).wall_clearance[0] == pytest.approx(0.05)


def test_two_corners_and_a_radius_are_a_capsule():
    along = np.array([[2.0, LEFT + 0.1], [3.0, LEFT + 1.1], [3.0, LEFT + 1.1]])
    leaves = edit(good(walls=[along]), {("walls.radius", 0): 0.06})
    assert assert_good(leaves).wall_clearance[0] == pytest.approx(0.04)
    # The bounding boxes of body and capsule overlap, but the body is right of the diagonal.
    start = (2.0, 3.0, math.pi / 4.0)
    diagonal = np.array([[1.0, 2.5], [6.0, 7.5], [6.0, 7.5]])
    beside = edit(good(start=start, walls=[diagonal]), {("walls.radius", 0): 0.1})
    expected = 0.5 / math.sqrt(2.0) - 0.5 * WIDTH - 0.1
    assert assert_good(beside).wall_clearance[0] == pytest.approx(expected)


def test_a_margin_is_kept_from_walls_and_movers():
    for group, one in (("walls", "wall"), ("movers", "mover")):
        leaves = disc(3.0, LEFT + 0.3, 0.2, group, margin=0.1 + 9e-4)
        assert assert_good(leaves).sentence(0).startswith("success")
        leaves["margin"][:] = 0.12
        verdict = assert_fails(leaves, one, excess=0.02, says=f"inside {group}[0] or its margin")
        assert getattr(verdict, f"{one}_clearance")[0] == pytest.approx(0.1)
        assert_good(leaves, contact_tolerance=0.021)


def test_an_obstacle_that_grows_is_hit_late():
    x, y = END[0], LEFT + 0.5
    growing = disc(x, y, 0.1, "movers", **{("movers.growth"): 0.08})
    gap = 0.4 - 0.08 * TIME
    assert assert_good(growing).mover_clearance[0] == pytest.approx(gap)
    growing["movers.growth"][:] = 0.09
    assert_fails(growing, "mover", excess=0.05, time=TIME)


def test_a_corner_of_a_turning_box_sweeps_the_lane():
    """A bar turns by a quarter; only at 45 degrees its corner reaches into the lane of the car."""
    half = 0.3
    box = square(0.0, 0.0, half)
    reach = math.sqrt(2.0) * half
    centre = (START[0] + MIDDLE, LEFT + reach - 0.05)
    still = {"speed": 0.0, "time": 2.0}
    turning = tracked(box, [(*centre, 0.0), (*centre, math.pi / 2.0)], step=2.0, **still)
    verdict = assert_fails(turning, "mover", rel=1e-3, excess=0.05)
    assert verdict.failed_time[0] == pytest.approx(1.0, abs=0.01)
    standing = tracked(box, [(*centre, 0.0), (*centre, 0.0)], step=2.0, **still)
    assert assert_good(standing).mover_clearance[0] == pytest.approx(reach - 0.05 - half)


def test_a_mover_with_a_track_is_between_its_poses():
    path = [(3.0, 6.0, 0.0), (3.0, 5.0, 0.0), (3.0, 5.0, 0.0)]
    for begin, step in ((0.0, 2.0), (1.0, 1.0)):
        far = tracked(square(0, 0, 0.2), path, begin=begin, step=step)
        assert assert_good(far).mover_clearance[0] == pytest.approx(4.8 - LEFT)
    straight = good(movers=([square(4.0, 6.0, 0.2)], [(-0.2, -0.3)]))
    table = [(4.0 - 0.2 * t, 6.0 - 0.3 * t, 0.0) for t in (-1.0, 2.0, 5.0)]
    same = tracked(square(0, 0, 0.2), table, begin=-1.0, step=3.0)
    expected = assert_good(straight).mover_clearance
    np.testing.assert_allclose(assert_good(same).mover_clearance, expected, atol=1e-9)


@pytest.mark.parametrize(("begin", "end"), [(-5.0, 1.9), (3.1, 9.0), (9.0, 12.0)])
def test_a_mover_blocks_only_while_it_exists(begin, end):
    x = START[0] + FRONT + SPEED * 2.0
    reaches, leaves = 2.0, 2.0 + LENGTH / SPEED
    assert end < reaches or begin > leaves
    poses = [(x, START[1], 0.0)] * 3
    thin = square(0.0, 0.0, 0.01)
    assert_good(tracked(thin, poses, begin=begin, end=end))
    assert_fails(tracked(thin, poses, begin=min(begin, 2.3), end=max(end, 2.2)), "mover")


def test_a_mover_that_exists_for_an_instant_is_seen():
    instant = 2.3456789
    place = (START[0] + MIDDLE + SPEED * instant, START[1], 0.0)
    leaves = tracked(square(0.0, 0.0, 0.05), [place], begin=instant, end=instant)
    verdict = assert_fails(leaves, "mover", time=instant)
    assert verdict.mover_clearance[0] == pytest.approx(-0.05 - 0.5 * WIDTH)
    leaves["movers.track.poses"][..., 0] += 0.5 * LENGTH + 0.06
    assert assert_good(leaves).mover_clearance[0] == pytest.approx(0.01)


def test_extra_samples_lie_on_the_drive():
    """A disc appears for an instant beside a car on an arc; its clearance has a closed form."""
    instant, curvature = 3.3333, 0.5
    leaves = tracked(square(0, 0, 0.05), [(0, 0, 0)], begin=instant, end=instant)
    leaves = edit(leaves, {"plan.curvature": curvature, "curvature": curvature})
    leaves = edit(leaves, {"tolerance": np.inf, ("lower"): -np.inf})
    angle = START[2] + SPEED * instant * curvature
    ahead, left = (np.array([math.cos(a), math.sin(a)]) for a in (angle, angle + math.pi / 2.0))
    centre = np.array(START[:2]) + np.array([0.0, 1.0]) / curvature - left / curvature
    beside = centre + MIDDLE * ahead + (0.5 * WIDTH + 0.2) * left
    leaves["movers.track.poses"][0, 0, 0] = [*beside, angle]
    assert assert_good(leaves).mover_clearance[0] == pytest.approx(0.15, abs=1e-9)


def test_clearances_from_moving_frames_equal_clearances_from_moved_polygons():
    random = np.random.default_rng(1)
    lanes, samples, num = 30, 6, 3
    half, zero = np.tile([0.2, 0.125], (lanes, 1)), np.zeros((lanes, num, 2))
    corners = np.array([square(0, 0, 0.2)[:3]] * num)[None] * random.uniform(
        0.3, 1, (lanes, 1, 1, 1)
    )
    poses = random.uniform([-0.8, -0.8, -3], [0.8, 0.8, 3], (lanes, num, 4, 3))
    group = {"corners": corners, "present": np.ones((lanes, num), bool)}
    group |= {"radius": random.uniform(0, 0.1, (lanes, num)), "growth": 0.02 + zero[..., 0]}
    track = {"poses": poses, "step": 0.7 + zero[..., 0], "begin": 0.4 + zero[..., 0]}
    track |= {"end": np.full((lanes, num), 2.2)}
    cars = random.uniform([-0.8, -0.8, -3], [0.8, 0.8, 3], (lanes, samples, 3))
    times = np.tile(np.linspace(0.0, 3.0, samples), (lanes, 1))
    tracks = {f"track.{name}": leaf for name, leaf in track.items()}
    found = clearances({**group, **tracks}, half, times, cars)[0]
    expected = np.full(lanes, np.inf)
    for s, time in enumerate(times[0]):
        if not 0.4 <= time <= 2.2:
            continue
        k = min(int((time - 0.4) / 0.7), 2)
        pose = poses[:, :, k] + ((time - 0.4) / 0.7 - k) * (poses[:, :, k + 1] - poses[:, :, k])
        cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
        turn = np.stack([np.stack([cos, -sin], axis=-1), np.stack([sin, cos], axis=-1)], axis=-2)
        still = {"centre": pose[..., :2], "velocity": zero, "present": group["present"]}
        still |= {"corners": np.einsum("bnij,bnvj->bnvi", turn, corners)}
        still |= {"radius": group["radius"] + 0.02 * time}
        one = clearances(still, half, times[:, s : s + 1], cars[:, s : s + 1])[0]
        expected = np.minimum(expected, one)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_fast_pass_is_sampled_densely():
    """A corner reaches 4 cm into the lane. A car of 0.4 m at 40 m/s drives 0.8 m in 20 ms."""
    wedge = np.array([[50.37, LEFT - 0.04], [50.4, LEFT + 1.0], [50.34, LEFT + 1.0]])
    fast = good(speed=40.0, time=2.0, walls=[wedge])
    fast = edit(fast, {"limits.speed": 50.0, "upper": 1000.0})
    assert_fails(fast, "wall", excess=0.04, rel=0.02)
    crossing = square(START[0] + MIDDLE, -30.0, 0.05)
    hit = good(speed=0.0, time=2.0, movers=([crossing], [(0.0, 60.0)]))
    verdict = assert_fails(hit, "mover")
    assert -verdict.mover_clearance[0] > 0.5 * WIDTH + 0.05 - LONGEST_MOVE * LENGTH


def test_the_map_is_turned():
    """On a map that is turned by 30 degrees, the car at x = 4.95 m, y = 4 m is 6.29 m along it."""
    turn = math.pi / 6.0
    leaves = edit(good(), {"map_heading": turn, "lower": -np.inf, "upper": np.inf})
    along = math.cos(turn) * END[0] + math.sin(turn) * END[1]
    assert_good(leaves)
    leaves["upper"][0, 0] = along + EPSILON
    assert_good(leaves)
    leaves["upper"][0, 0] = along - 0.3
    assert_fails(leaves, "map", excess=0.3, time=TIME)
    leaves["upper"][0, 0] = np.inf
    across = math.cos(turn) * END[1] - math.sin(turn) * END[0]
    leaves["lower"][0, 1] = across + 0.2
    assert_fails(leaves, "map", excess=0.2, time=TIME)


@pytest.mark.parametrize("sense", [1, -1])
def test_the_region_moves_with_the_target(sense):
    corners = np.array([[0.1, -0.5], [1.0, -0.5], [1.0, 0.5], [0.1, 0.5]])[::sense]
    leaves = edit(good(), {"region": corners, "tolerance": 0.05})
    assert_fails(leaves, "meeting", excess=0.1, time=TIME)
    leaves["region"] -= [0.05 + EPSILON, 0.0]
    assert assert_good(leaves).miss[0] == pytest.approx(0.05 - EPSILON)
    leaves["region"] -= [0.5, 0.0]
    assert assert_good(leaves).miss[0] == 0.0
    beyond = edit(leaves, {"region": corners + [0.2, 0.9], "tolerance": 0.2})
    assert_fails(beyond, "meeting", excess=0.5)
    point = edit(good(), {"region": [0.3, 0.4], "tolerance": 0.4})
    assert_fails(point, "meeting", excess=0.5)


def test_a_plan_may_not_end_before_the_earliest_time():
    assert_good(edit(good(), {"earliest": TIME}))
    verdict = assert_fails(edit(good(), {"earliest": TIME + 0.5, "time": 9.0}), "early", time=TIME)
    assert verdict.sentence(0) == "early: the plan ends at 5.000 s, 0.5 s before the earliest time"


def test_the_speed_at_the_end_is_in_its_range():
    assert assert_good(edit(good(), {"end_speed": SPEED})).end_speed[0] == SPEED
    slow = edit(good(), {"end_speed": (SPEED + 0.3, np.inf)})
    assert_fails(slow, "end speed", excess=0.3, time=TIME, says="0.8 m/s, is 0.3 m/s out of")
    assert_fails(edit(good(), {"end_speed": (0.0, 0.5)}), "end speed", excess=0.3)
    nearly = {"end_speed": (0.0, SPEED - 1.4e-3)}  # the tolerance is 1e-3 of the speed limit
    assert_good(edit(good(), nearly))


def test_the_origin_of_a_plan_is_the_case_s():
    leaves = edit(good(), {("plan.origin", 0): add(3.0)})
    assert_fails(leaves, "origin", excess=3.0, time=0.0)
    assert_good(edit(leaves, {("origin", 0): add(3.0)}))


LENGTHS = {"limits.curvature": -1, "curvature": -1, "plan.curvature": -1}
LENGTHS |= dict.fromkeys(("start", "plan.start", "region", "lower", "upper", "tolerance"), 1)
LENGTHS |= dict.fromkeys(("limits.speed", "limits.acceleration", "limits.lateral_acceleration"), 1)
LENGTHS |= dict.fromkeys(("speed", "plan.speed", "end_speed", "margin", "target.pos"), 1)
LENGTHS |= dict.fromkeys(("target.vel", "origin", "plan.origin"), 1)
LENGTHS |= {f"body.{name}": 1 for name in ("length", "width", "wheelbase", "rear_overhang")}
for kind in ("walls", "movers"):
    LENGTHS |= {
        f"{kind}.{name}": 1 for name in ("centre", "velocity", "corners", "radius", "growth")
    }


def in_units(leaves, scale):
    """Return a case in which lengths have another unit: 1 m is `scale` units."""
    changed = {name: leaf * scale ** LENGTHS.get(name, 0) for name, leaf in leaves.items()}
    for name in ("start", "plan.start"):
        changed[name][:, 2] = leaves[name][:, 2]
    return changed


@pytest.mark.parametrize("scale", [1e3, 1e-3])
def test_verdicts_do_not_depend_on_the_unit_of_length(scale):
    curved = {"plan.curvature": 0.3, "curvature": 0.3, "tolerance": np.inf}
    near = good(walls=[square(3.0, 4.5, 0.3)], movers=([square(4.0, 5.0, 0.3)], [(0.0, -0.1)]))
    edits = {
        "": {},
        "nearly at its start": {("plan.start", 0): add(3.9e-4)},
        "start": {("plan.start", 0): add(4.1e-4)},
        "nearly as slow": {"speed": add(7e-4), "limits.speed": np.inf},
        "curvature": {**curved, "limits.curvature": 0.2995},
        "lateral acceleration": {**curved, "limits.lateral_acceleration": SPEED**2 * 0.2995},
        "wall": {"walls.centre": add([0.0, -0.1762])},
        "grazed": {"walls.centre": add([0.0, -0.0759])},
        "end speed": {"end_speed": (SPEED + 1.6e-3, np.inf)},
    }
    for name, changes in edits.items():
        leaves = edit({key: leaf.copy() for key, leaf in near.items()}, changes)
        metres, others = judge(leaves), judge(in_units(leaves, scale))
        expected = name if name in metres.SENTENCES else ""
        assert metres.failed_limit[0] == others.failed_limit[0] == expected
        gaps = others.wall_clearance / scale, others.mover_clearance / scale
        np.testing.assert_allclose(gaps, (metres.wall_clearance, metres.mover_clearance), atol=1e-9)


def test_measurements_of_comfort_are_integrals_over_time():
    random = np.random.default_rng(5)
    speed, curvature = random.uniform(0.2, 1.5, KNOTS), random.uniform(-1.0, 1.0, KNOTS)
    leaves = edit(good(speed, curvature), {"tolerance": np.inf, "end_speed": (0.0, np.inf)})
    for name in ("acceleration", "lateral_acceleration", "steering_rate"):
        leaves[f"limits.{name}"][:] = np.inf
    verdict = assert_good(leaves)
    knots = np.linspace(0.0, TIME, KNOTS)

    def rms(of):
        parts = [
            quad(lambda t, k=k: of(t, k) ** 2, *knots[k : k + 2], epsabs=1e-12)[0]
            for k in range(KNOTS - 1)
        ]
        return math.sqrt(sum(parts) / TIME)

    rise, bend = np.diff(speed) / H, np.diff(curvature) / H
    at = [lambda t, each=each: np.interp(t, knots, each) for each in (speed, curvature)]
    v, k = at
    expected = {
        "rms_lateral_acceleration": rms(lambda t, _: v(t) ** 2 * k(t)),
        "rms_lateral_jerk": rms(lambda t, i: 2 * v(t) * rise[i] * k(t) + v(t) ** 2 * bend[i]),
        "rms_steering_rate": rms(
            lambda t, i: WHEELBASE * bend[i] / (1.0 + (WHEELBASE * k(t)) ** 2)
        ),
        "total_curvature_variation": np.abs(np.diff(curvature)).sum(),
        "end_speed": speed[-1],
    }
    for name, value in expected.items():
        assert getattr(verdict, name)[0] == pytest.approx(value, rel=1e-9), name
    calm = assert_good(good())
    for name in ("rms_lateral_acceleration", "rms_lateral_jerk", "rms_steering_rate"):
        assert getattr(calm, name)[0] == 0.0


def two_legs(**settings):
    """Judge a straight drive at 1 m/s to two targets, which are met after 2 s and 4 s."""
    places = np.array([[2.0 + MIDDLE, 4.0], [4.0 + MIDDLE, 4.0]])
    target = pj.TurningPath(places, np.zeros((2, 2)), np.zeros(2))
    settings = {"start": (0.0, 4.0, 0.0), "initial_speed": 1.0, "end_speed": (0.9, 1.1), **settings}
    group = pj.group.case(target, 6.0, **settings)
    knots = {"speed": np.ones((2, KNOTS)), "curvature": np.zeros((2, KNOTS))}
    knots |= {"time": np.full(2, 2.0), "start": np.array([[0.0, 4.0, 0.0], [2.0, 4.0, 0.0]])}
    solver = dict.fromkeys(("cost", "violation", "iterations", "status"), np.zeros(2))
    legs = InterceptPlan(**knots, **solver, origin=np.zeros((2, 2)), meeting=places)
    one = dict.fromkeys(("cost", "violation", "iterations", "status"), np.array(0))
    return pj.group.judge(group, GroupPlan(**one, legs=legs, order=np.arange(2), begins=[0, 2]))


def test_movers_of_a_group_grow_and_follow_tracks_from_leg_to_leg():
    mover = square(4.0 + MIDDLE, LEFT + 0.45, 0.1)
    passing = two_legs(movers=[mover], mover_growth=0.08)
    assert passing.mover_clearance == pytest.approx(0.03, abs=1e-6)
    verdict = two_legs(movers=[mover], mover_growth=0.1)
    assert verdict.sentence().startswith("mover: leg 1: the body is 0.05 m inside movers[0]")
    for ends, is_met in (((0.5, 3.0), True), ((3.5, 4.0), False), ((4.1, 9.0), True)):
        poses = [(4.0 + MIDDLE, 4.0, 0.0)] * 2
        verdict = two_legs(movers=[square(0.0, 0.0, 0.1)], mover_paths=[(np.array(ends), poses)])
        assert verdict.success == is_met, verdict.sentence()


def test_the_earliest_time_of_a_group_counts_from_the_start_of_the_first_leg():
    assert two_legs(earliest=2.0).success
    verdict = two_legs(earliest=3.0)
    assert verdict.failed_limit == "early" and verdict.leg == 0


def test_a_case_far_from_the_world_s_origin_is_judged():
    """A case in the coordinates of a map grid, with a recorded mover, a circle and a region."""
    far = np.array([5e5, 4.2e6])
    poses = np.array([[4.0, 0.4, 0.0], [3.0, 0.4, 0.5], [3.0, 1.5, 0.5]]) + [*far, 0.0]
    case = pj.intercept.case(
        pj.TurningPath(far + [4.0, 0.0], np.zeros(2), np.zeros(())),
        6.0,
        start=(*far, 0.0),
        origin=far,
        initial_speed=1.0,
        walls=[Circle(far[0] + 2.0, far[1] + 0.6, 0.3)],
        movers=[square(0.0, 0.0, 0.1)],
        mover_paths=[(np.array([0.0, 1.0, 2.5]), poses)],
        region=square(0.0, 0.0, 0.5),
        lower=(-np.inf, -np.inf),
        upper=(np.inf, np.inf),
    )
    knots = {"speed": np.ones(KNOTS), "curvature": np.zeros(KNOTS), "time": np.array(4.0)}
    known = {"start": case.start, "origin": case.origin, "meeting": np.zeros(2)}
    solver = dict.fromkeys(("cost", "violation", "iterations", "status"), np.array(0))
    verdict = pj.intercept.judge(case, InterceptPlan(**knots, **known, **solver))
    assert verdict.success, verdict.sentence()
    assert verdict.wall_clearance == pytest.approx(0.3 - 0.5 * WIDTH, abs=1e-5)
    assert 0.0 < verdict.mover_clearance < 1.5 and verdict.miss == 0.0
