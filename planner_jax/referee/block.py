"""Float64 NumPy referee of blocks: decides by kinematics whether a plan succeeds.

A block stops a thrown ball with a shield on a six-axis arm. The referee reads the plan's motion and
contact time, and ignores its status and cost. It shares no code with the planners. The ball's
parabola is [Natarajan2024, eqs 5 to 7]. Robot base frame, z up, SI units. Times count from the
first observation of the ball.
"""

import dataclasses
import functools
from typing import Any

import numpy as np

from planner_jax.referee import arm_torque, judging
from planner_jax.referee.arm_clearance import KINDS, clearances, links_of, shield_pose
from planner_jax.referee.ball_in_box import SIDES, entry_time, times_inside
from planner_jax.referee.solids import rotate_back

_SENTENCES = {
    "not finite": judging.NOT_FINITE,
    "time": "the contact at {time:.3f} s is off by {excess:.3g} s; it must not come before the arm "
    "may start nor before its motion ends nor after a minute, and no piece may last less than 0 s",
    "start": "{failed_part} starts {excess:.3g} rad or rad/s off the case",
    "continuity": "{failed_part} jumps by {excess:.3g} rad or rad/s at {time:.3f} s",
    "position": "{failed_part} is {excess:.3g} rad beyond its limit at {time:.3f} s",
    "velocity": "{failed_part} is {excess:.2%} above its limit at {time:.3f} s",
    "acceleration": "{failed_part} is {excess:.2%} above its limit at {time:.3f} s",
    "torque": "{failed_part} needs {excess:.2%} more torque than its limit at {time:.3f} s",
    "rest": "{failed_part} turns at {excess:.3g} rad/s when the motion ends, at {time:.3f} s; the "
    "arm must be at standstill there if the case requires it or the contact is later",
    "floor": "{failed_part} is {excess:.3g} m below the floor at {time:.3f} s",
    "obstacle": "{failed_part} are {excess:.3g} m inside each other at {time:.3f} s",
    "rig": "{failed_part} is {excess:.3g} m inside a beam of the rig at {time:.3f} s",
    "base": "{failed_part} is {excess:.3g} m inside the base at {time:.3f} s",
    "self": "{failed_part} are {excess:.3g} m inside each other at {time:.3f} s",
    "ball": "the ball is {height:.3g} m off the plane of the shield's face and {miss:.3g} m from "
    "its middle in that plane at {time:.3f} s",
    "tilt": "the shield's normal is {excess:.3g} rad off minus the ball's velocity at {time:.3f} s",
    "tunnel": "the contact at {time:.3f} s is {excess:.3g} s off the time that the ball is in the "
    "outer box before it gets into the inner one",
}
LIMITS = tuple(_SENTENCES)
# Fields of a case that may be infinite, besides limits of joint velocities and accelerations.
_UNBOUNDED_LEAVES = ("arm.lower", "arm.upper", "offset", "tilt")
# Shapes of leaves for each obstacle of a kind.
_OBSTACLES: dict[str, dict[str, tuple[int, ...]]] = {
    "capsule": {"ends": (2, 3), "radius": ()},
    "beam": {"ends": (2, 3), "radius": ()},
    "box": {"middle": (3,), "turn": (4,), "half": (3,)},
    "cylinder": {"ends": (2, 3), "radius": ()},
}
_CASE_SHAPES: dict[str, tuple[int, ...]] = {
    **{"ball.pos": (3,), "ball.vel": (3,), "gravity": (), "ball_radius": ()},
    **{"delay": (), "ends_at_rest": (), "offset": (), "tilt": ()},
    **{"arm.base_box": (2, 3), "scene.floor": (), "scene.inner_radius": ()},
    **{"arm.shield_centre": (3,), "arm.shield_turn": (4,), "arm.shield_half": (2,)},
    **{f"scene.{box}.{side}": (3,) for box in ("inner", "outer") for side in SIDES},
}
# Shapes of leaves for each of the n joints.
_JOINT_SHAPES: dict[str, tuple[int, ...]] = {
    **{"angles": (), "rates": (), "arm.lower": (), "arm.upper": ()},
    **{"arm.origin": (3,), "arm.turn": (4,), "arm.axis": (3,)},
    **{"limits.velocity": (), "limits.acceleration": (), "limits.torque": ()},
    **{"arm.mass": (), "arm.armature": (), "arm.centre": (3,), "arm.inertia": (3, 3)},
}


LONGEST_STEP = 0.002  # [s], greatest time between two samples of the arm's motion
# [rad] Greatest change between two samples, as the norm of the joint angles' changes.
LARGEST_TURN = 0.017
# [rad/s] The samples' distance in time is `LARGEST_TURN` / (norm of the joint rates). A norm above
# this number counts as this number, which limits the number of samples.
_FASTEST = 100.0
LONGEST_PLAN = 60.0  # [s], latest contact that the referee accepts
REST = 0.01  # [rad/s], greatest joint rate that counts as standstill
_HALVINGS = 45  # number of bisections in the search for the time of a joint's extreme angle or rate
_SAMPLES = 16384  # number of poses whose clearances are computed together and fit the cache


@dataclasses.dataclass(frozen=True)
class BlockVerdict(judging.Verdict):
    """Verdict on B plans in which an arm blocks a ball with its shield.

    Measurements are NaN if a number of case or plan is not finite, or a time of the plan is wrong:
    a negative duration, or a contact before the motion's end or after `LONGEST_PLAN`. A clearance
    is the least distance of solids over the samples: negative if they overlap, and infinite without
    an obstacle.
    """

    SENTENCES = _SENTENCES
    UNBOUNDED = {"tunnel": "the ball never gets into the outer box"}

    failed_part: np.ndarray  # (B,) str, name of the joint or part that exceeds a limit, or ""
    contact_time: np.ndarray  # (B,) [s], time of the ball's contact, as the plan reports it
    execution_time: np.ndarray  # (B,) [s], duration of the arm's motion
    velocity_share: np.ndarray  # (B,) greatest ratio of a joint's |velocity| to its limit
    acceleration_share: np.ndarray  # (B,) greatest ratio of a joint's |acceleration| to its limit
    torque_share: np.ndarray  # (B,) greatest ratio of a joint's |torque| to its limit, 0 without
    floor_clearance: np.ndarray  # (B,) [m], least distance of arm and shield from the floor
    obstacle_clearance: np.ndarray  # (B,) [m], least distance of arm and shield from obstacles
    rig_clearance: np.ndarray  # (B,) [m], least distance of arm and shield from the rig's beams
    base_clearance: np.ndarray  # (B,) [m], least distance of shield and links from the base
    self_clearance: np.ndarray  # (B,) [m], least distance between two parts of the arm
    miss: np.ndarray  # (B,) [m], ball to the shield's middle at the contact, in the face's plane
    height: np.ndarray  # (B,) [m], least height of the ball above the face at the contact
    tilt: np.ndarray  # (B,) [rad], angle between shield's normal and minus the ball's velocity

    def success_message(self, k: int | tuple) -> str:
        """Describe for plan `k`, a success, where and when the ball meets the shield."""
        miss, time = np.asarray(self.miss)[k], np.asarray(self.contact_time)[k]
        return f"the ball is {miss:.2g} m from the shield's middle at {time:.3g} s"


def referee_blocks(
    cases, plans, *, tolerance: float = 1e-3, contact_tolerance: float = 1e-3
) -> BlockVerdict:
    """Decide for every plan of a batch of blocks whether it succeeds.

    Angles, rates and accelerations are tested at the ends of each piece and at their extrema. For
    limits with torques, MuJoCo's inverse dynamics computes torques at the ends of each piece, and
    at samples at most 5 ms apart. An arm that stays at the end must hold still there.

    Clearances are computed at the ends of the pieces and at samples between them. Samples are at
    most `LONGEST_STEP` and `LARGEST_TURN` apart, but not closer than 0.17 ms. At samples the
    distances between the solids that `referee.arm_clearance` lists are exact.

    The motion starts at the time `delay` of the case, and the arm then stays at the motion's end.
    It must be at standstill there if the case requires it, or if the contact is later.

    Args:
        cases: object with the fields of `BlockCase`, for B cases; gravity > 0.
        plans: object with the fields of `BlockPlan`, for B plans of M polynomial pieces of degree
            D: coefficients (B, M, D + 1, n), durations (B, M).
        tolerance: relative tolerance of velocities, accelerations, torques, and the case's `offset`
            and `tilt` at the contact; absolute tolerance of the start and of jumps between pieces
            [rad], [rad/s], and of joint angles beyond their limits [rad].
        contact_tolerance: [m], greatest distance of the ball from the shield's face at the
            contact, and greatest depth of the arm in an obstacle. The ball must be blocked inside
            the outer box, before it touches the protected body. The outer box is enlarged,
            and the inner box reduced, by this length.

    Returns:
        A `BlockVerdict` of float64 arrays. A plan with numbers that are not finite fails as "not
        finite". Limits of a case, also of its `offset` and `tilt`, may be infinite.

    Raises:
        ValueError: a leaf has the wrong shape.
    """
    leaves, arm = _read(cases, plans), cases.arm
    judge = functools.partial(_judge, arm=arm, relative=tolerance, contact=contact_tolerance)
    return BlockVerdict(**judging.judge_in_chunks(judge, leaves, chunk=256))


def _read(cases, plans) -> dict[str, np.ndarray]:
    coeffs = np.asarray(plans.motion.coeffs)
    num = len(cases.arm.joint_names)
    if coeffs.ndim != 4 or coeffs.shape[-1] != num or 0 in coeffs.shape[1:]:
        raise ValueError(f"plan.motion.coeffs must be (B, M, D + 1, {num}), got {coeffs.shape}")
    links = tuple(int(link) for link in cases.arm.capsule_link)
    if not all(-1 <= link < num for link in links):
        raise ValueError(f"arm.capsule_link must be in -1, ..., {num - 1}, got {links}")
    num_lanes, capsules = len(coeffs), len(links)
    of_joints = {name: (num, *shape) for name, shape in _JOINT_SHAPES.items()}
    shapes = (
        _CASE_SHAPES
        | of_joints
        | {
            "arm.capsule_ends": (capsules, 2, 3),
            "arm.capsule_radius": (capsules,),
            "arm.shield_gap_radius": (capsules,),
            "arm.shield_corners": ((*np.shape(cases.arm.shield_corners), 0, 0)[1], 2),
        }
    )
    for kind, parts in _OBSTACLES.items():
        num_solids = (*np.shape(getattr(cases.scene, f"{kind}_{[*parts][-1]}")), 0, 0)[1]
        shapes |= {f"scene.{kind}_{name}": (num_solids, *of) for name, of in parts.items()}
    if getattr(cases.scene, "inner_ends", None) is not None:
        shapes["scene.inner_ends"] = (2, 3)
    if meshes := getattr(cases.scene, "meshes", None):
        shapes["scene.meshes.corners"] = np.shape(meshes.corners)[1:]
    leaves = {"plan.motion.coeffs": coeffs} | judging.read_leaves(cases, shapes, num_lanes)
    of_plan = {"motion.durations": coeffs.shape[1:2], "contact_time": ()}
    leaves |= judging.read_leaves(plans, of_plan, num_lanes, "plan.")
    return leaves


def _judge(case: dict, arm: Any, relative: float, contact: float) -> dict:
    finite = judging.finite_lanes(case, _UNBOUNDED_LEAVES)
    execution = case["plan.motion.durations"].sum(axis=1)
    # Time [s] from the end of the arm's motion to the contact with the ball.
    stays = case["plan.contact_time"] - case["delay"] - execution
    wrong_times = _times(case, stays)
    sound = finite & ~wrong_times[0]
    durations = np.where(sound[:, None], case["plan.motion.durations"], 0.0)
    motion = _Motion(
        coeffs=np.where(sound[:, None], case["plan.motion.coeffs"].transpose(2, 3, 0, 1), 0.0),
        durations=durations,
        starts=case["delay"][:, None] + np.cumsum(durations, axis=1) - durations,
    )
    extremes = _extremes(motion)
    measured, tests, parts = _judge_limits(case, motion, extremes, relative)
    found, more = _judge_contact(case, _final(motion, stays), relative, contact)
    measured, tests = measured | found, tests | more
    has_to = (case["ends_at_rest"] != 0.0) | (stays > judging.CONTACT_TIME_TOLERANCE)
    tests["rest"], parts["rest"] = _rest(motion, has_to)
    excess, time, parts["torque"] = _torques(case, motion, sound, has_to)
    tests["torque"] = excess > relative, excess, time
    measured["torque_share"] = excess + 1.0
    turning = np.sqrt((np.abs(extremes[1][0]).max(axis=0) ** 2).sum(axis=0))
    near = _clearances(case, arm, motion, turning)
    measured |= {f"{kind}_clearance": least for kind, (least, _, _) in near.items()}
    for kind, (least, time, part) in _put_start_first(case, arm, motion, near, contact).items():
        tests[kind], parts[kind] = (-least > contact, -least, time), part
    measured = {name: np.where(sound, value, np.nan) for name, value in measured.items()}
    measured |= {"contact_time": case["plan.contact_time"], "execution_time": execution}
    tests = judging.clear_where(~sound, tests)
    tests["time"] = (wrong_times[0], np.where(finite, wrong_times[1], 0.0), wrong_times[2])
    found = judging.first_failures(tests, LIMITS, finite)
    failed_part = np.full(len(finite), "")
    for name, part in parts.items():
        failed_part = np.where(found["failed_limit"] == name, part, failed_part)
    return found | {"failed_part": failed_part} | measured


def _times(case: dict, stays: np.ndarray) -> tuple:
    contact = case["plan.contact_time"]
    shortest = case["plan.motion.durations"].min(axis=1)
    off = np.maximum.reduce([case["delay"] - contact, -stays, contact - LONGEST_PLAN, -shortest])
    return (off > judging.CONTACT_TIME_TOLERANCE) | (shortest < 0.0), off, contact


@dataclasses.dataclass(frozen=True)
class _Motion:
    """Joint angles of B arms as polynomials of degree D in M pieces."""

    # (D + 1, n, B, M), coefficients of rising powers of the time [s] since the piece's start.
    coeffs: np.ndarray
    durations: np.ndarray  # (B, M) [s]
    starts: np.ndarray  # (B, M) [s]


def _extremes(motion: _Motion) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return joint angles, rates and accelerations, each with times, at extrema and piece ends."""
    degree, shape = len(motion.coeffs) - 1, motion.coeffs.shape[1:]
    ends = np.stack([np.zeros(shape), np.broadcast_to(motion.durations, shape)])
    times, found = ends, []
    for order in range(max(degree, 2), -1, -1):
        values = judging.derivative(motion.coeffs, times, order)
        found.append((values, times))
        if order >= degree:
            continue  # a constant derivative has no extrema
        # Between two of its extrema the derivative is monotonic, and has at most one root. A root
        # of a derivative is an extremum of the next lower derivative.
        low, high, is_below = times[:-1], times[1:], values[:-1] < 0.0
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            is_before = (judging.derivative(motion.coeffs, middle, order) < 0.0) == is_below
            low, high = np.where(is_before, middle, low), np.where(is_before, high, middle)
        times = np.concatenate([ends[:1], high, ends[1:]])
    return found[:-4:-1]


def _worst(excess: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    by_lane = judging.flat(np.moveaxis(excess, 2, 0))
    lanes, top = np.arange(len(by_lane)), by_lane.argmax(axis=1)
    k, joint, piece = np.unravel_index(top, (*excess.shape[:2], excess.shape[3]))
    time = np.broadcast_to(times, excess.shape)[k, joint, lanes, piece]
    return by_lane[lanes, top], time, np.char.add("joint ", (joint + 1).astype(str))


def _judge_limits(case: dict, motion: _Motion, extremes: list, relative: float) -> tuple:
    """Test start, continuity and limits of joints; return measurements, tests and worst joints."""
    tests, parts, measured = {}, {}, {}

    def test(name: str, excess: np.ndarray, times: np.ndarray, allowed: float) -> None:
        worst, time, parts[name] = _worst(excess, times)
        tests[name] = (worst > allowed, worst, time)

    # Jumps of angles and rates: the values at the start of each piece minus the values at the end
    # of the preceding piece, or minus the case's values for the first piece.
    begin, end = (
        np.stack([judging.derivative(motion.coeffs, times, order) for order in range(2)])
        for times in (np.zeros_like(motion.durations), motion.durations)
    )
    initial = np.stack([case["angles"].T, case["rates"].T])[..., None]
    jumps = np.abs(begin - np.concatenate([initial, end[..., :-1]], axis=3))
    is_first = np.arange(jumps.shape[3]) == 0
    test("start", np.where(is_first, jumps, 0.0), motion.starts, relative)
    test("continuity", np.where(is_first, 0.0, jumps), motion.starts, relative)
    angles, times = extremes[0]
    lower, upper = (case[f"arm.{side}"].T[..., None] for side in SIDES)
    test("position", np.maximum(angles - upper, lower - angles), motion.starts + times, relative)
    for name, (values, times) in zip(("velocity", "acceleration"), extremes[1:], strict=True):
        size, limit = np.abs(values), case[f"limits.{name}"].T[..., None]
        test(name, judging.above(size, limit, relative, times)[1], motion.starts + times, relative)
        share = size / np.maximum(limit, judging.SMALLEST_LIMIT)
        measured[f"{name}_share"] = share.max(axis=(0, 1, 3))
    return measured, tests, parts


def _torques(case: dict, motion: _Motion, sound: np.ndarray, stays: np.ndarray) -> tuple:
    """Return each plan's greatest relative excess of a torque, its time [s], and the joint.

    Without limits, and for plans that are not sound, the excess is -1. An arm that `stays` has to
    hold still at the end of the motion.
    """
    worst, when, joint = -np.ones(sound.shape), np.zeros(sound.shape), np.zeros(sound.shape, int)
    models: dict[bytes, arm_torque.Dynamics] = {}
    for k in np.flatnonzero(sound & ("limits.torque" in case)).tolist():
        own = {name: leaf[k] for name, leaf in case.items() if name[:4] in ("arm.", "grav")}
        key = b"".join(leaf.tobytes() for leaf in own.values())
        if key not in models:
            leaf = lambda name, own=own: own.get(f"arm.{name}")  # noqa: E731
            models[key] = arm_torque.Dynamics(leaf, float(own["gravity"]))
        of_plan = motion.coeffs[:, :, k], motion.durations[k], case["limits.torque"][k], stays[k]
        worst[k], when[k], joint[k] = models[key].compare(*of_plan)
    return worst, motion.starts[:, 0] + when, np.char.add("joint ", (joint + 1).astype(str))


def _rest(motion: _Motion, has_to_stay: np.ndarray) -> tuple[tuple, np.ndarray]:
    rates = np.abs(judging.derivative(motion.coeffs[..., -1], motion.durations[:, -1], 1))
    time = motion.starts[:, -1] + motion.durations[:, -1]
    worst, time, joint = _worst(rates[None, ..., None], time[:, None])
    return (has_to_stay & (worst > REST), worst, time), joint


def _final(motion: _Motion, stays: np.ndarray) -> np.ndarray:
    beyond = np.where(np.abs(stays) > judging.CONTACT_TIME_TOLERANCE, 0.0, stays)
    return judging.derivative(motion.coeffs[..., -1], motion.durations[:, -1] + beyond, 0)


def _clearances(case: dict, arm: Any, motion: _Motion, turning: np.ndarray) -> dict[str, tuple]:
    """Return by kind of obstacle each plan's least distance [m], its time [s], and the arm's part.

    `turning` (B, M) [rad/s] bounds the norm of the joint rates in each piece.
    """
    turning = np.fmin(np.fmax(turning, np.finfo(float).tiny), _FASTEST)
    longest = np.minimum(LONGEST_STEP, LARGEST_TURN / turning)
    count = np.maximum(np.ceil(motion.durations / longest - 1e-9), 1.0)
    most = count.sum(axis=1).astype(int) + 1
    # Plans with similar numbers of samples are computed together, so that few samples are padding.
    order, begin = np.argsort(-most), 0
    nothing = np.zeros(0), np.zeros(0), np.zeros(0, str)
    found = {kind: [nothing] for kind in KINDS}
    while begin < len(order):
        lanes = order[begin : begin + max(_SAMPLES // int(most[order[begin]]), 1)]
        begin += len(lanes)
        sample = np.arange(most[lanes[0]])
        times, angles = _sample(motion, lanes, count[lanes], sample)
        of_lanes = {name: leaf[lanes] for name, leaf in case.items()}
        near = clearances(of_lanes, arm, angles, sample < most[lanes, None])
        for kind, (least, at, part) in near.items():
            found[kind].append((least, times[np.arange(len(lanes)), at], part))
    back = np.argsort(order)
    return {
        kind: tuple(np.concatenate(values)[back] for values in zip(*parts, strict=True))
        for kind, parts in found.items()
    }


def _put_start_first(
    case: dict, arm: Any, motion: _Motion, near: dict[str, tuple], contact: float
) -> dict[str, tuple]:
    """Return clearances in which the start pose counts alone if the arm starts in contact.

    A case that starts in a collision has no solution: the verdict names its start, although the
    motion may get deeper into the obstacle.
    """
    hit = np.any([-least > contact for least, _, _ in near.values()], axis=0)
    if not hit.any():
        return near
    of_hit, index = {name: leaf[hit] for name, leaf in case.items()}, np.cumsum(hit) - 1
    angles = motion.coeffs[0][:, hit, :1]
    found = {}
    only = np.ones(angles.shape[1:], bool)
    for kind, (least, _, part) in clearances(of_hit, arm, angles, only).items():
        start = least, motion.starts[hit, 0], part
        is_inside = hit & (-least[index] > contact)
        pairs = zip(start, near[kind], strict=True)
        found[kind] = tuple(np.where(is_inside, new[index], old) for new, old in pairs)
    return found


def _sample(
    motion: _Motion, lanes: np.ndarray, count: np.ndarray, sample: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    behind = np.cumsum(count, axis=1)
    piece = (sample >= behind[..., None]).sum(axis=1).clip(max=count.shape[1] - 1)  # (B, S)
    rows, lanes = np.arange(len(lanes))[:, None], lanes[:, None]
    share = np.minimum((sample - behind[rows, piece]) / count[rows, piece] + 1.0, 1.0)
    local = share * motion.durations[lanes, piece]
    angles = judging.derivative(motion.coeffs[:, :, lanes, piece], local, 0)
    return motion.starts[lanes, piece] + local, angles


def _judge_contact(case: dict, angles: np.ndarray, relative: float, contact: float) -> tuple:
    time, fall = case["plan.contact_time"], np.array([[0.0], [0.0], [1.0]]) * case["gravity"]
    ball = case["ball.pos"].T + case["ball.vel"].T * time - 0.5 * fall * time**2
    turns, positions = links_of(case, angles[..., None])
    turn, middle = (each[..., 0] for each in shield_pose(case, turns, positions))
    height, *beside = rotate_back(turn, ball - middle)
    height = height - case["ball_radius"]
    toward, *across = rotate_back(turn, fall * time - case["ball.vel"].T)
    miss, tilt = np.hypot(*beside), np.arctan2(np.hypot(*across), toward)
    is_off = np.abs(height) > contact
    corners = np.moveaxis(case["arm.shield_corners"], 2, 0)  # (2, B, K), counterclockwise
    (y, z), (wide, high) = corners, np.roll(corners, -1, axis=2) - corners
    beyond = (beside[0][:, None] - y) * high - (beside[1][:, None] - z) * wide
    is_beside = (miss > case["offset"] * (1.0 + relative)) | (
        (beyond > contact * np.hypot(wide, high)).any(axis=1)
    )
    tests = {
        "ball": (is_off | is_beside, np.where(is_off, np.abs(height), miss), time),
        "tilt": (tilt > case["tilt"] * (1.0 + relative), tilt, time),
        "tunnel": _tunnel(case, contact),
    }
    return {"miss": miss, "height": height, "tilt": tilt}, tests


def _tunnel(case: dict, contact: float) -> tuple:
    time = case["plan.contact_time"]

    def off(grown: float) -> np.ndarray:
        begin, end = times_inside(case, "outer", grown)
        out = np.maximum(np.maximum(begin - time, time - end), 0.0).min(axis=0)
        return np.maximum(out, time - entry_time(case, grown))

    return off(contact) > 0.0, off(0.0), time
