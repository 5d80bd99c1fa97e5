"""The referee of blocks, an independent check of plans, on motions in closed form."""

import functools
import itertools
from typing import Any
from unittest.mock import Mock

import jax
import numpy as np
import pytest
from referees import add, checks, edit, failure, stack, tree
from scipy.optimize import least_squares, lsq_linear
from scipy.spatial.transform import Rotation

from planner_jax.referee import block, solids
from planner_jax.referee.arm_clearance import KINDS, clearances
from planner_jax.referee.ball_in_box import times_inside
from planner_jax.referee.block import LIMITS, BlockVerdict, referee_blocks
from planner_jax.robot.arm import REGIMES, shield_pose
from planner_jax.robot.arm_file import irb1600
from planner_jax.robot.arm_scene import ABSENT, make_scene
from planner_jax.task.block.case import case

GRAVITY, DELAY, SPAN = 9.81, 0.1, 0.9
CONTACT_TIME = DELAY + SPAN
CONTACT = np.array([0.7, 0.5, 0.7])  # between the boxes, and clear of the pole
INCOMING = np.array([-7.0, -0.3, -3.0])  # velocity of the ball there
PIECES = (0.3, 0.6)
ARM = jax.tree.map(lambda leaf: np.asarray(leaf, float), irb1600())
HOME, THICKNESS = ARM.home, 0.01
BOX = (0.1, 0.1, 0.1), (1.0, 0.0, 0.0, 0.0)  # edges [m] and rotation of a box
COEFFS, DURATIONS = "plan.motion.coeffs", "plan.motion.durations"
# Coefficients of polynomials from 0 to 1 in time / duration: with standstill at both ends, and with
# standstill at the start only.
REST_TO_REST, FROM_REST = (0.0, 0.0, 0.0, 10.0, -15.0, 6.0), (0.0, 0.0, 1.0)


def links(angles):
    rotation, place, found = np.eye(3), np.zeros(3), []
    for k in range(6):
        place = place + rotation @ ARM.origin[k]
        own = Rotation.from_quat(ARM.turn[k], scalar_first=True)
        turned = own * Rotation.from_rotvec(angles[k] * ARM.axis[k])
        rotation = rotation @ turned.as_matrix()
        found.append((rotation, place))
    return found


def shield(angles):
    rotation, place = links(angles)[5]
    return rotation, place + rotation @ ARM.shield_centre


def angles_for(middle, normal):
    def off(angles):
        rotation, place = shield(angles)
        return np.concatenate([place - middle, rotation[:, 0] - normal])

    found = least_squares(off, HOME, bounds=(ARM.lower, ARM.upper), xtol=1e-15, gtol=1e-15)
    assert np.abs(found.fun).max() < 1e-12
    angles = found.x
    angles[5] -= 0.5 * np.pi * np.round((angles[5] - HOME[5]) / (0.5 * np.pi))
    return angles


GOAL = angles_for(CONTACT, -INCOMING / np.linalg.norm(INCOMING))
ROTATION = shield(GOAL)[0]


def motion(shape, end=GOAL, durations=PIECES, start=HOME):
    total = sum(durations)
    shifted = np.polynomial.Polynomial(np.array(shape) / total ** np.arange(len(shape)))
    pieces, begin = [], 0.0
    for duration in durations:
        here = shifted(np.polynomial.Polynomial([begin, 1.0])).coef
        begin += duration
        piece = np.outer(np.pad(here, (0, len(shape) - len(here))), np.asarray(end) - start)
        piece[0] += start
        pieces.append(piece)
    return np.array(pieces)


def leaves_of(**options):
    """Return the arrays of a case by name, with any ball."""
    pairs, _ = jax.tree_util.tree_flatten_with_path(case(CONTACT, INCOMING, delay=DELAY, **options))
    return {jax.tree_util.keystr(path)[1:]: np.asarray(leaf) for path, leaf in pairs}


usual_leaves = functools.cache(leaves_of)


def good(shape=REST_TO_REST, end=GOAL, durations=PIECES, velocity=INCOMING, at=CONTACT, **options):
    fall = np.array([0.0, 0.0, GRAVITY])
    begin = velocity + fall * CONTACT_TIME
    pos = at - begin * CONTACT_TIME + 0.5 * fall * CONTACT_TIME**2
    leaves = leaves_of(**options) if options else usual_leaves()
    leaves = leaves | {"ball.pos": pos, "ball.vel": begin, "gravity": GRAVITY, "delay": DELAY}
    leaves |= {COEFFS: motion(shape, end, durations), DURATIONS: durations}
    leaves |= {"plan.contact_time": CONTACT_TIME, "angles": HOME}
    leaves = {name: np.array(leaf)[None] for name, leaf in leaves.items()}
    return {k: leaf if leaf.dtype == bool else leaf.astype(float) for k, leaf in leaves.items()}


def judge(leaves, capsule_link=ARM.capsule_link, **options) -> BlockVerdict:
    judged = tree(leaves)
    for name in ("pairs", "shield_pairs", "base_pairs", "joint_names"):
        setattr(judged.arm, name, getattr(ARM, name))
    judged.arm.capsule_link, judged.arm.armature = capsule_link, None
    vars(judged.limits).setdefault("torque", None)
    return referee_blocks(judged, judged.plan, **options)


assert_good, assert_limit = checks(judge)


def assert_fails(leaves, name, *, part="", **found):
    verdict = assert_limit(leaves, name, says=f"{name}: {part}", **found)
    assert verdict.failed_part[0] == part
    return verdict


def still(angles, **options):
    still = {COEFFS: angles[None, None, None], "angles": angles[None]}
    return good(durations=(SPAN,), **options) | still


def test_an_arm_that_swings_to_the_balls_place_blocks_it():
    verdict = assert_good(good())
    assert verdict.failed_limit[0] == verdict.failed_part[0] == ""
    assert np.isnan(verdict.failed_time[0]) and verdict.contact_time[0] == CONTACT_TIME
    assert verdict.miss[0] < 1e-9 and abs(verdict.height[0]) < 1e-9 and verdict.tilt[0] < 1e-7
    assert verdict.execution_time[0] == pytest.approx(SPAN)
    assert verdict.sentence(0).endswith("from the shield's middle at 1 s")


def test_the_shield_is_where_the_library_puts_it():
    angles = np.random.default_rng(0).uniform(ARM.lower, ARM.upper, (5, 6))
    rotations, middles = jax.jit(jax.vmap(shield_pose, in_axes=(None, 0)))(ARM, angles)
    for found, rotation, middle in zip(angles, rotations, middles, strict=True):
        at, own = shield(found)[1], shield(found)[0]
        np.testing.assert_allclose(rotation, own, atol=1e-5)
        np.testing.assert_allclose(middle, at, atol=1e-5)
        verdict = judge(still(found, at=at + 0.03 * own[:, 0] + 0.04 * own[:, 1]))
        assert verdict.height[0] == pytest.approx(0.03) and verdict.miss[0] == pytest.approx(0.04)


CHANGE = GOAL - HOME
FOLDED = np.where(np.arange(6) == 4, 1.9, HOME)  # the shield meets the forearm
FASTEST = int(np.argmax(np.abs(CHANGE) / np.asarray(REGIMES["R2"].limits.velocity)))
STEEPEST = int(np.argmax(np.abs(CHANGE)))  # all joints have one limit
TURN = Rotation.from_rotvec(0.1 * ROTATION[:, 1]).as_matrix()
TIP = 27.0 / 4.0 * 0.4  # u (1 - u)^2 has its maximum 4 / 27 at u = 1/3


def overshoot(**edits):
    leaves = good((0.0, TIP, -2.0 * TIP, TIP), end=HOME + np.eye(6)[5], durations=(SPAN,))
    leaves["rates"][0, 5] = TIP / SPAN
    leaves["limits.velocity"][:] = leaves["limits.acceleration"][:] = np.inf
    for name, value in edits.items():
        leaves[f"arm.{name}"][0, 5] = value
    return leaves


PEAK = 2.0 * abs(CHANGE[STEEPEST])  # final rate x duration of a motion by FROM_REST
JOINT = DELAY + PIECES[0]  # time at which the two pieces join


def weight(angles, step=1e-5):
    """Return the torque [N m] of joint 2 that holds the arm still, from its potential energy."""

    def energy(turn):
        bodies = zip(links(angles + turn * (np.arange(6) == 1)), ARM.mass, ARM.centre, strict=True)
        return sum(GRAVITY * m * (place + turned @ c)[2] for (turned, place), m, c in bodies)

    return (energy(step) - energy(-step)) / (2.0 * step)


WEAK = np.where(np.arange(6) == 1, abs(weight(GOAL)) / 1.25, np.inf)
TOP_ACCELERATION = 10.0 / np.sqrt(3.0) * abs(CHANGE[STEEPEST]) / SPAN**2
STEEP, FAST = f"joint {STEEPEST + 1}", f"joint {FASTEST + 1}"


def spoil(edits, *found, **options):
    return failure(edit(good(), edits), *found, **options)


FAILURES = {
    "time: before delay": spoil({"plan.contact_time": 0.07, DURATIONS: 0.0}, 0.03, 0.07),
    "time: motion too long": spoil({"plan.contact_time": 0.9}, 0.1, 0.9),
    "time: negative": spoil({DURATIONS: [[-0.25, 0.6]]}, 0.25, CONTACT_TIME),
    "time: an hour": spoil({"plan.contact_time": 3600.0}, 3540.0, 3600.0),
    "start: angle": spoil({("angles", 2): add(0.02)}, 0.02, DELAY, part="joint 3"),
    "start: rate": spoil({("rates", 4): add(0.3)}, 0.3, DELAY, part="joint 5"),
    "continuity: angle": spoil({(COEFFS, 1, 0, 3): add(0.01)}, 0.01, JOINT, part="joint 4"),
    "continuity: rate": spoil({(COEFFS, 1, 1, 0): add(-0.1)}, 0.1, JOINT, part="joint 1"),
    "position: above": failure(
        overshoot(upper=HOME[5] + 0.35), 0.05, DELAY + SPAN / 3.0, part="joint 6"
    ),
    "position: below": failure(overshoot(lower=HOME[5] + 0.1), 0.1, part="joint 6"),
    "velocity: 4/5": spoil(
        {"limits.velocity": lambda limit: 0.8 * judge(good()).velocity_share * limit},
        *(0.25, DELAY + 0.5 * SPAN),
        part=FAST,
    ),
    "acceleration: 2/3": spoil({"limits.acceleration": TOP_ACCELERATION / 1.5}, 0.5, part=STEEP),
    "torque: 4/5 of the weight": failure(
        still(GOAL) | {"limits.torque": WEAK[None]}, 0.25, None, part="joint 2"
    ),
    "rest: required": failure(good(FROM_REST, regime="R3"), PEAK / SPAN, part=STEEP),
    "rest: stops at once": failure(
        good(FROM_REST, regime="R1", durations=(0.2, 0.6)), PEAK / 0.8, 0.9, part=STEEP
    ),
    "self: wrist": failure(good(end=FOLDED), None, CONTACT_TIME, part="link 4 and the shield"),
    "ball: beside": failure(good(at=CONTACT + 0.01 * ROTATION[:, 2]), 0.01, CONTACT_TIME),
    "ball: in front": failure(good(at=CONTACT + 0.005 * ROTATION[:, 0]), 0.005, CONTACT_TIME),
    "tilt: by TURN": failure(good(velocity=TURN @ INCOMING), 0.1, CONTACT_TIME),
    "tunnel: not yet": spoil({"scene.outer.upper": [0.6, 1.0, 1.85]}, 0.1 / 7.0, CONTACT_TIME),
    "tunnel: too late": spoil({"scene.inner.upper": [[0.75, 0.55, 0.8]]}, 0.05 / 7.0, CONTACT_TIME),
    "tunnel: through and out again": spoil(
        {"scene.inner.lower": [0.8, 0.4, 0.6], "scene.inner.upper": [0.9, 0.6, 1.2]},
        *(0.2 / 7.0, CONTACT_TIME),
    ),
    "tunnel: never": spoil({"scene.outer.lower": [[-1.0, 0.9, 0.0]]}, np.inf, CONTACT_TIME),
}
NEARER = {
    "floor": ("scene.floor", ...),
    "obstacle": ("scene.capsule_radius", ...),
    "rig": ("scene.beam_radius", ...),
    "base": ("arm.base_box", (0, 1, 2)),  # its top: link 2 is above it
}


def test_each_limit_has_a_failure_here():
    failed = {key.split(":")[0] for key in FAILURES}
    assert failed | {"not finite"} | NEARER.keys() == {*LIMITS}


@pytest.mark.parametrize("kind", NEARER)
def test_an_obstacle_moved_beyond_its_clearance_is_hit_by_the_difference(kind):
    leaves, (name, place) = good(), NEARER[kind]
    room = getattr(judge(leaves), f"{kind}_clearance")[0]
    leaves[name][place] += room - 0.002
    assert getattr(assert_good(leaves), f"{kind}_clearance")[0] == pytest.approx(0.002)
    leaves[name][place] += 0.003
    assert_good(leaves, contact_tolerance=0.0011)
    leaves[name][place] += 0.019
    verdict = assert_limit(leaves, kind)
    assert getattr(verdict, f"{kind}_clearance")[0] == pytest.approx(-0.02)
    part, excess = verdict.failed_part[0], verdict.failed_excess[0]
    verb = "are" if " and " in part else "is"
    assert f"{part} {verb} {excess:.3g} m " in verdict.sentence(0)
    assert excess == pytest.approx(0.02) or verdict.failed_time[0] == pytest.approx(DELAY)


def test_an_arm_that_starts_in_the_pole_fails_at_its_start_although_it_gets_deeper_later():
    poles = [np.mean([links(HOME)[k][1][:2] for k in (3, 4)], axis=0), CONTACT[:2]]
    leaves = stack(good(), good())
    leaves["scene.capsule_ends"][:, 0, :, :2] = np.array(poles)[:, None]
    start = {"scene.capsule_ends": leaves["scene.capsule_ends"][:1]}
    verdict, stays = judge(leaves), judge(still(HOME) | start)
    np.testing.assert_array_equal(verdict.failed_limit, "obstacle")
    assert verdict.failed_time[0] == pytest.approx(DELAY) and verdict.failed_time[1] > 2.0 * DELAY
    assert verdict.failed_excess[0] == pytest.approx(-stays.obstacle_clearance[0])
    assert verdict.failed_excess[0] < -verdict.obstacle_clearance[0]
    assert verdict.failed_excess[1] == -verdict.obstacle_clearance[1]


def test_an_absent_pole_and_absent_beams_are_ignored():
    leaves = good()
    leaves["scene.capsule_ends"][..., :2] = CONTACT[:2]
    assert_fails(leaves, "obstacle", part="link 4 and capsule 1")
    leaves["scene.capsule_radius"][:] = ABSENT
    assert np.isposinf(assert_good(leaves).obstacle_clearance[0])
    leaves |= {name: leaves[name][:, :0] for name in ("scene.beam_ends", "scene.beam_radius")}
    assert np.isposinf(assert_good(leaves).rig_clearance[0])


def test_an_arm_may_move_at_the_contact_if_the_case_does_not_require_rest():
    leaves = good(FROM_REST, regime="R1")
    for early in (0.0, -5e-5, 5e-5):  # The motion is evaluated at the contact.
        leaves[DURATIONS][0, -1] = PIECES[-1] - early
        assert_good(leaves, contact_tolerance=1e-7)
    leaves["ends_at_rest"][:] = True
    assert_fails(leaves, "rest", part=STEEP)
    # In both regimes of limits, an arm that arrives before the ball may stand still and wait. Only
    # R3 requires standstill at the contact.
    for regime in ("R1", "R3"):
        assert_good(good(regime=regime, durations=(0.2, 0.4)))


def test_the_shield_may_be_met_beside_its_middle_and_at_an_angle_but_not_beyond_its_edge():
    assert_good(good(velocity=TURN @ INCOMING, wide=True))
    assert_good(good(at=CONTACT + 0.09 * ROTATION[:, 2], wide=True))
    for beside, verdict in ((0.149, ""), (0.16, "ball")):
        leaves = good(at=CONTACT + beside * (ROTATION[:, 1] - 0.5 * ROTATION[:, 2]))
        leaves["offset"][:] = np.inf
        assert judge(leaves).failed_limit[0] == verdict


def test_a_ball_is_inside_a_box_when_it_is_found_there():
    random = np.random.default_rng(3)
    num, times = 200, np.linspace(-1.0, 3.0, 4001)
    corner = random.uniform([-1.0, -1.0, 0.0], 0.0, (num, 3))
    low, high = corner + [0.0, 0.0, 0.3], corner + [1.5, 1.5, 0.7]
    moves = random.random((num, 3)) < 0.8
    pos = random.uniform(-1.0, 1.0, (num, 3)) * [1.0, 1.0, 0.0]
    vel = random.uniform([-1.0, -1.0, 3.0], [1.0, 1.0, 7.0], (num, 3)) * moves
    leaves = {"ball.pos": pos, "ball.vel": vel, "gravity": random.uniform(5.0, 10.0, num)}
    leaves |= {"scene.box.lower": low, "scene.box.upper": high}
    with np.errstate(invalid="ignore"):
        begin, end = times_inside(leaves, "box", 0.05)
    computed = ((begin[..., None] <= times) & (times <= end[..., None])).any(axis=0)
    place = pos[:, None] + vel[:, None] * times[:, None]
    place[..., 2] -= 0.5 * leaves["gravity"][:, None] * times**2
    sampled = ((low[:, None] - 0.05 <= place) & (place <= high[:, None] + 0.05)).all(axis=2)
    np.testing.assert_array_equal(computed, sampled)
    changes = np.abs(np.diff(sampled.astype(int), axis=1)).sum(axis=1)
    assert (changes == 4).sum() > 5 and (changes == 0).sum() > 5


@pytest.mark.parametrize("seed", range(3))
def test_extrema_are_the_greatest_of_many_samples(seed):
    random = np.random.default_rng(seed)
    coeffs = random.normal(size=(1, 2, (2, 4, 8)[seed], 6))
    leaves = good() | {COEFFS: coeffs}
    verdict = judge(leaves)
    for order, name in ((1, "velocity"), (2, "acceleration")):
        found = []
        for piece, duration in enumerate(PIECES):
            times = np.linspace(0.0, duration, 3001)
            derived = np.polynomial.polynomial.polyder(coeffs[0, piece], order)
            found.append(np.abs(np.polynomial.polynomial.polyval(times, derived)).max(axis=1))
        share = np.max(np.max(found, axis=0) / leaves[f"limits.{name}"])
        assert getattr(verdict, f"{name}_share")[0] == pytest.approx(share, rel=1e-5)
        assert getattr(verdict, f"{name}_share")[0] >= share * (1.0 - 1e-12)


@functools.cache
def judge_poses():
    """Judge arms at standstill in 201 poses along the motion from `HOME` to `GOAL`."""
    shares = np.linspace(0.0, 1.0, 201)
    angles = HOME + np.polynomial.polynomial.polyval(shares, REST_TO_REST)[:, None] * CHANGE
    return judge(stack(*(still(each) for each in angles)))


@pytest.mark.parametrize("durations", [PIECES, (0.05, 0.02), (0.0, 0.9)])
def test_the_least_clearance_is_that_of_a_pose_among_close_samples(monkeypatch, durations):
    clearances = Mock(wraps=block.clearances)
    monkeypatch.setattr(block, "clearances", clearances)
    verdict = judge(good(durations=durations))
    *_, angles, sampled = clearances.call_args_list[0].args
    sampled_angles = angles[:, 0, sampled[0]]
    steps = np.linalg.norm(np.diff(sampled_angles), axis=0)
    assert steps.max() <= block.LARGEST_TURN and len(steps) >= sum(durations) / block.LONGEST_STEP
    np.testing.assert_allclose(sampled_angles[:, [0, -1]].T, [HOME, GOAL], atol=1e-12)
    for kind in KINDS:
        least, found = (getattr(x, f"{kind}_clearance").min() for x in (judge_poses(), verdict))
        assert 0.0 <= least - found + 1e-12 < 1e-4


def gap(first, second):
    """Solve for the distance of two rounded boxes, each a tuple (middle, half edges, radius)."""
    (middle, spans, radius), (other, others, more) = first, second
    columns = np.concatenate([spans, -np.asarray(others)]).T
    found = lsq_linear(columns, other - middle, bounds=(-1.0, 1.0), method="bvls", tol=1e-14)
    return np.sqrt(2.0 * found.cost) - radius - more


def segment(first, second, radius=0.0):
    return 0.5 * (first + second), [0.5 * (second - first)], radius


def solids_of(angles):
    frames, found = links(angles), []
    for k, link in enumerate(ARM.capsule_link):
        rotation, place = frames[link]
        ends = place + ARM.capsule_ends[k] @ rotation.T
        found.append((link, *segment(ends[0], ends[1], ARM.capsule_radius[k])))
    rotation, middle = shield(angles)
    half = np.array([0.5 * THICKNESS, *ARM.shield_half])
    plate = (6, middle - 0.5 * THICKNESS * rotation[:, 0], list(half[:, None] * rotation.T), 0.0)
    return [*found, plate]


def brute_clearances(angles, scene):
    """Return the arm's least distances [m] from floor, obstacle, rig, base and itself, by name."""
    arm = solids_of(angles)
    first, second = scene.capsule_ends[0, 0]
    pole = segment(first, second, scene.capsule_radius[0, 0])
    rods = zip(scene.beam_ends[0], scene.beam_radius[0], strict=True)
    beams = [segment(ends[0], ends[1], radius) for ends, radius in rods]
    low, high = ARM.base_box
    base = (0.5 * (low + high), list(0.5 * np.diag(high - low)), 0.0)
    wrist, plate = solids_of(np.zeros(6))[5], solids_of(np.zeros(6))[8]
    thin = min(wrist[3], gap((*wrist[1:3], 0.0), plate[1:]))
    found = {
        "floor": [
            m[2] - np.abs(np.array(s)[:, 2]).sum() - r - scene.floor[0] for _, m, s, r in arm
        ],
        "obstacle": [gap(solid, pole) for _, *solid in arm],
        "rig": [gap(solid, beam) for _, *solid in arm for beam in beams],
        "base": [gap(solid, base) for link, *solid in arm if link > 0],
        "self": [gap(a, b) for i, *a in arm if i == 0 for j, *b in arm if j > 1],
    }
    for link, middle, spans, radius in arm:
        if link in (1, 2, 3):
            room = thin if link == 3 else radius
            found["self"].append(gap((middle, spans, room), arm[-1][1:]))
    if gap(arm[-1][1:], base) < 1e-6:  # the solver does not measure the depth of boxes
        del found["base"]
    return {kind: min(values) for kind, values in found.items()}


def test_clearances_are_those_of_a_solver():
    low, high = [-1.0, 0.0, -3.5, -3.0, -2.0, -3.0], [1.0, 1.9, 0.9, 3.0, 2.0, 3.0]
    angles = np.random.default_rng(4).uniform(low, high, (20, 6))
    leaves = stack(*map(still, angles))
    leaves["scene.floor"][:] = -0.1
    verdict, scene, touched = judge(leaves), tree(leaves).scene, set()
    for k, pose in enumerate(angles):
        for kind, least in brute_clearances(pose, scene).items():
            assert getattr(verdict, f"{kind}_clearance")[k] == pytest.approx(least, abs=1e-8)
            touched |= {kind} if least < 0.0 else set()
    assert touched == {*KINDS}


def test_a_straight_wrist_does_not_touch_its_shield_and_a_folded_one_does():
    for bend, success in ((0.0, True), (1.5, True), (-1.5, True), (1.75, False), (-1.75, False)):
        angles = np.array([0.5, 0.2, 0.0, 0.3, bend, 0.0])
        assert (judge(still(angles)).self_clearance[0] > -1e-6) == success


def test_capsules_of_the_base_are_kept_off_like_its_box():
    leaves = good()
    leaves["arm.capsule_ends"][0, 0] = [[0.9, 0.45, 0.0], [0.9, 0.45, 0.5]]  # under the wrist
    assert_fails(leaves, "base", part="the shield", capsule_link=(-1, *ARM.capsule_link[1:]))


def test_distances_of_segments_are_those_of_a_solver():
    random, num = np.random.default_rng(0), 60
    a, b, c, d = random.normal(size=(4, 3, num))
    b[:, :5] = a[:, :5]  # points
    d[:, 3:10] = c[:, 3:10]
    d[:, 10:20] = c[:, 10:20] + (b - a)[:, 10:20] * random.normal(size=10)  # parallel
    found, points = solids.between_segments(a, b, c, d), solids.from_segment(c, a, b)
    for k in range(num):
        first, second = segment(a[:, k], b[:, k]), segment(c[:, k], d[:, k])
        assert found[k] == pytest.approx(gap(first, second), abs=1e-9)
        assert points[k] == pytest.approx(gap(first, (c[:, k], np.zeros((1, 3)), 0.0)), abs=1e-9)


def test_distances_of_boxes_are_those_of_a_solver():
    random, num = np.random.default_rng(1), 60
    a, b, middle = random.normal(size=(3, 3, num))
    b[0, :10] = a[0, :10]
    b[1, 5:15] = a[1, 5:15]
    half, other = random.uniform(0.01, 1.0, (2, 3, num))
    rotation = np.moveaxis(Rotation.random(num, rng=random).as_matrix(), 0, -1).copy()
    rotation[..., :5] = np.eye(3)[..., None]
    segments = solids.segment_to_box(a, b, half)
    boxes = solids.between_boxes(1.5 * middle, rotation, half, other)
    assert (segments == 0.0).any() and (boxes < 0.0).any()
    for k in range(num):
        box = np.zeros(3), np.diag(half[:, k]), 0.0
        assert segments[k] == pytest.approx(gap(box, segment(a[:, k], b[:, k])), abs=1e-9)
        turned = 1.5 * middle[:, k], (rotation[..., k] * half[:, k]).T, 0.0
        apart = gap(turned, (np.zeros(3), np.diag(other[:, k]), 0.0))
        assert max(boxes[k], 0.0) == pytest.approx(apart, abs=1e-7)


def test_overlapping_boxes_are_as_deep_as_the_shortest_way_out():
    half, other = np.array([[0.1], [0.2], [0.3]]), np.array([[1.0], [1.0], [1.0]])
    turn = Rotation.from_euler("z", 45.0, degrees=True).as_matrix()[..., None]
    middle = np.array([[0.9], [0.0], [0.2]])
    assert solids.between_boxes(middle, np.eye(3)[..., None], half, other)[0] == pytest.approx(-0.2)
    found = solids.between_boxes(middle, turn, half, other)[0]
    assert found == pytest.approx(-(0.1 + np.sqrt(0.5) * 0.3))


def test_distances_from_cylinders_and_hulls_are_distances_from_nearly_equal_solids():
    """A capsule on an axis is a cylinder with half-spheres, a prism a cylinder, a box a mesh."""
    turn, middle, half = (0.9, 0.1, 0.2, 0.3), (0.7, 0.5, 1.2), np.array([0.1, 0.4, 0.2])
    corners = np.array([*itertools.product((-1.0, 1.0), repeat=3)])
    angle = np.linspace(0.0, 2.0 * np.pi, 41)[:-1]
    rim = 0.1 * np.stack([np.cos(angle), np.sin(angle), np.zeros(40)], axis=1)
    prism = np.concatenate([rim, rim + [0.0, 0.0, 1.0]])
    ends, upright = np.array([(0.8, 0.1, 0.5), (0.8, 0.1, 1.5)]), (1.0, 0.0, 0.0, 0.0)
    rng = np.random.default_rng(0)
    angles = rng.uniform(-1.0, 1.0, (6, 1, 1)) + 0.8 * rng.uniform(-1.0, 1.0, (6, 1, 40))
    least = []
    for obstacles in (
        {"boxes": [(middle, 2.0 * half, turn)]},
        {"meshes": [(corners * half, 1.0, middle, turn)]},
        {"cylinders": [(ends, 0.1)]},
        {"meshes": [(prism, 1.0, ends[0], upright)]},
    ):
        leaves, one = good(scene=make_scene(**obstacles)), np.ones((1, 1), bool)
        near = [clearances(leaves, ARM, angles[..., [k]], one) for k in range(40)]
        least.append([float(each["obstacle"][0][0]) for each in near])
    box, mesh, cylinder, prism = np.array(least)
    assert min(box) < 0.0 < max(box) and min(cylinder) < 0.0 < max(cylinder)
    free = box > 0.0  # inside, the depth of a capsule in a box is at most its radius
    np.testing.assert_allclose(mesh[free], box[free], atol=1e-6)
    assert np.all(mesh[~free] <= box[~free] + 1e-6)
    np.testing.assert_allclose(prism, cylinder, atol=5e-4)


def test_every_kind_of_obstacle_is_hit_and_named():
    boxes = [((0.0, 2.0, 1.0), (0.2, 0.2, 0.2), (1.0, 0.0, 0.0, 0.0)), (CONTACT, *BOX)]
    rods = [([(2.0, 0.0, 0.0), (2.0, 0.0, 1.0)], 0.1), ([CONTACT - 0.1, CONTACT + 0.1], 0.05)]
    given: dict[str, Any] = {"boxes": boxes, "capsules": rods, "cylinders": rods}
    points = np.eye(4, 3) - 0.25
    given["meshes"] = [(points, 0.1, middle, (1.0, 0.0, 0.0, 0.0)) for middle, *_ in boxes]
    singular = {"boxes": "box", "meshes": "mesh"}
    for kind, some in given.items():
        scene, name = make_scene(**{kind: some}), singular.get(kind, kind.removesuffix("s"))
        verdict = assert_limit(good(scene=scene), "obstacle")
        assert verdict.failed_part[0].endswith(f" and {name} 2")
    assert_good(good(scene=make_scene(boxes=boxes[:1], capsules=rods[:1], cylinders=rods[:1])))
    absent = good(scene=make_scene(meshes=given["meshes"]))
    absent["scene.meshes.corners"][:] = np.nan
    assert judge(absent).failed_limit[0] == "not finite"


def test_a_ball_must_be_within_the_outline_of_the_shield():
    corners = np.array([(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)])
    leaves = good(at=CONTACT + 0.12 * ROTATION[:, 1], anywhere=True)
    assert_good(leaves)
    for half, success in (((0.13, 0.01), True), ((0.11, 0.3), False), ((0.1195, 0.01), True)):
        leaves["arm.shield_corners"] = (corners * half)[None]
        assert judge(leaves).success[0] == success
    ring = np.arange(6) * np.pi / 3.0  # a hexagon, whose side is nearer than its corners
    for radius, success in ((0.118, False), (0.125, True)):
        for turned in (ring, ring + np.pi / 6.0):
            outline = radius * np.stack([np.cos(turned), np.sin(turned)], axis=1)
            leaves["arm.shield_corners"] = outline[None]
            assert judge(leaves).success[0] == (success and turned is ring)


def unequal_lanes():
    failed = [FAILURES[key][0] for key in ("tilt: by TURN", "time: an hour", "self: wrist")]
    return [good(), *failed, good(durations=(0.05, 0.06)), good(durations=(0.1, 0.3)), good()]


FAILED = ["", "tilt", "time", "self", "velocity", "velocity", ""]
# The home pose, and the arm's own limits, which a case can replace.
UNREAD = {"arm.home"}
UNREAD |= {"arm.limits.velocity", "arm.limits.acceleration"}
# The usual scene has no boxes and no cylinders.
UNREAD |= {f"scene.box_{name}" for name in ("half", "middle", "turn")}
UNREAD |= {"scene.cylinder_ends", "scene.cylinder_radius"}
UNKNOWN = ("miss", "obstacle_clearance")
PLANNED = (COEFFS, DURATIONS, "plan.contact_time")
ABSURD, HARMLESS = (
    ("ball.pos", "angles", "arm.origin", "scene.capsule_ends", *PLANNED),
    "scene.capsule_ends",
)
USUAL = good()
READ = {name for name, leaf in USUAL.items() if leaf.dtype == float} - UNREAD
READ |= {"ends_at_rest"}
WRONG = [
    ({}, {"capsule_link": (6,) * 8}, "arm.capsule_link must be in -1, ..., 5"),
    ({COEFFS: np.zeros((1, 2, 6, 5))}, {}, r"coeffs must be \(B, M, D \+ 1, 6\), got"),
    *(({name: USUAL[name][..., None]}, {}, f"{name} must be ") for name in sorted(READ)),
]
