"""Referee of joint motions: decides by MuJoCo's distances whether a motion succeeds.

A motion succeeds if it leads from the start to a goal within the limits of the joints, and no part
of the arm touches an obstacle, the base or a part that it must not touch. The referee builds a
MuJoCo model of the arm's capsules and of the obstacles, and shares no code with the planner. Boxes
are convex meshes in the model: for a capsule whose axis enters a box, `mj_geomDistance` of MuJoCo
4.0 may return a positive distance. Robot base frame, z up, SI units.
"""

import dataclasses
import functools
import importlib
import itertools
from typing import Any

import numpy as np

from planner_jax.referee import judging
from planner_jax.referee.arm_torque import Dynamics

_SENTENCES = {
    "not finite": judging.NOT_FINITE,
    "time": "a piece lasts {excess:.3g} s less than 0 s, or the motion lasts longer than a minute",
    "start": "{failed_part} starts {excess:.3g} rad or rad/s off the case",
    "continuity": "{failed_part} jumps by {excess:.3g} rad or rad/s at {time:.3f} s",
    "position": "{failed_part} is {excess:.3g} rad beyond its limit at {time:.3f} s",
    "velocity": "{failed_part} is {excess:.2%} above its limit at {time:.3f} s",
    "acceleration": "{failed_part} is {excess:.2%} above its limit at {time:.3f} s",
    "torque": "{failed_part} needs {excess:.2%} more torque than its limit at {time:.3f} s",
    "reach": "no motion exists: {failed_part} is {excess:.3g} rad beyond its limit at every goal",
    "ends": "no motion is free: {failed_part} are {excess:.3g} m inside each other",
    "goal": "{failed_part} ends {excess:.3g} rad or rad/s off standstill at the nearest goal",
    "obstacle": "{failed_part} are {excess:.3g} m inside each other at {time:.3f} s",
    "self": "{failed_part} are {excess:.3g} m inside each other at {time:.3f} s",
}
LIMITS = tuple(_SENTENCES)
LONGEST_STEP = 0.005  # [s], greatest time between two samples of the motion
LARGEST_TURN = 0.017  # [rad], greatest change between two samples, as norm of the joints' changes
LONGEST_PLAN = 60.0  # [s]
THICKNESS = 0.01  # [m], of the shield
_LEAST = 1e-9  # [m], least size of a body
_FAR = 5.0  # [m], greatest distance that is computed
_KINDS = ("obstacle", "self")


@dataclasses.dataclass(frozen=True)
class ReachVerdict(judging.Verdict):
    """Verdict on B plans in which an arm moves from one joint state to another.

    Measurements are NaN if a number of case or plan is not finite or a time is wrong. A clearance
    is the least distance of two bodies over the samples, negative if they overlap.
    """

    SENTENCES = _SENTENCES

    failed_part: np.ndarray  # (B,) str, name of the joint or of the two bodies, or ""
    duration: np.ndarray  # (B,) [s], of the motion
    velocity_share: np.ndarray  # (B,) greatest ratio of a joint's |velocity| to its limit
    acceleration_share: np.ndarray  # (B,) greatest ratio of a joint's |acceleration| to its limit
    torque_share: np.ndarray  # (B,) greatest ratio of a joint's |torque| to its limit, 0 without
    obstacle_clearance: np.ndarray  # (B,) [m], least distance of the arm from obstacles and floor
    self_clearance: np.ndarray  # (B,) [m], least distance of the arm from its base and itself

    def success_message(self, k: int | tuple) -> str:
        """Describe the duration and the clearance of plan `k`, a success."""
        time, gap = np.asarray(self.duration)[k], np.asarray(self.obstacle_clearance)[k]
        return f"the arm reaches the goal after {time:.3g} s, at least {gap:.2g} m from obstacles"


def referee_reaches(
    cases, plans, *, tolerance: float = 1e-3, contact_tolerance: float = 1e-3
) -> ReachVerdict:
    """Decide for every plan of a batch of joint motions whether it succeeds.

    Distances are computed at samples at most `LONGEST_STEP` and `LARGEST_TURN` apart. Between
    distant bodies they are bounded by spheres around the bodies. For limits with torques, MuJoCo's
    inverse dynamics computes torques at most 5 ms apart. The motion must consist of pieces
    of degree 2, whose rates and accelerations have their extremes at the ends of the pieces.

    Args:
        cases: object with the fields of `ReachCase`, for B cases.
        plans: object with the fields of `ReachPlan`, for B plans.
        tolerance: relative tolerance of velocities, accelerations and torques; absolute tolerance
            of start, goal and jumps between pieces [rad], [rad/s], and of angles beyond limits
            [rad].
        contact_tolerance: [m], greatest depth of two bodies in each other.

    Raises:
        ValueError: a leaf has the wrong shape.
    """
    coeffs = np.asarray(plans.motion.coeffs, float)
    durations = np.asarray(plans.motion.durations, float)
    num = np.shape(cases.arm.origin)[-2]
    if coeffs.ndim != 4 or coeffs.shape[2:] != (3, num):
        raise ValueError(f"plan.motion.coeffs must be (B, M, 3, {num}), got {coeffs.shape}")
    judging.check_leaf("plan.motion.durations", durations, coeffs.shape[:2])
    found = []
    for k in range(len(coeffs)):
        case = _Lane(cases, k)
        judge = functools.partial(_judge, case, tolerance, contact_tolerance)
        found.append(judge(coeffs[k], durations[k]))
    tests = {
        name: tuple(np.array([each[0][name][j] for each in found]) for j in range(3))
        for name in LIMITS[1:]
    }
    finite = np.array([each[3] for each in found], bool)
    first = judging.first_failures(tests, LIMITS, finite)
    parts = [each[1].get(name, "") for each, name in zip(found, first["failed_limit"], strict=True)]
    measured = {name: np.array([each[2][name] for each in found]) for name in _MEASURED}
    return ReachVerdict(**first, failed_part=np.array(parts, str), **measured)


_MEASURED = (
    *("duration", "velocity_share", "acceleration_share", "torque_share"),
    *("obstacle_clearance", "self_clearance"),
)


class _Lane:
    """The numbers of one case of a batch, in float64; an attribute is a part or an array."""

    def __init__(self, tree: object, k: int) -> None:
        self._tree, self._k = tree, k

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._tree, name)
        if dataclasses.is_dataclass(value):
            return _Lane(value, self._k)
        is_whole = value is None or isinstance(value, tuple)
        return value if is_whole else np.asarray(value, float)[self._k]


def _judge(
    case: _Lane, relative: float, contact: float, coeffs: np.ndarray, durations: np.ndarray
) -> tuple[dict, dict, dict, bool]:
    """Return one plan's tests (failed, excess, time), failed parts, measurements, and soundness."""
    arm, limits = case.arm, case.limits
    read = (case.angles, case.goals, limits.velocity, limits.acceleration, arm.origin)
    finite = all(np.isfinite(each).all() for each in (coeffs, durations, *read[:2], read[4]))
    finite = finite and not any(np.isnan(each).any() for each in read[2:4])
    tests: dict[str, tuple[bool, float, float]] = dict.fromkeys(LIMITS[1:], (False, 0.0, 0.0))
    parts: dict[str, str] = {}
    measured = dict.fromkeys(_MEASURED, np.nan)
    if not finite:
        return tests, parts, measured, False
    ends = np.cumsum(durations)
    total = float(ends[-1])
    measured["duration"] = total
    off = max(-durations.min(), total - LONGEST_PLAN)
    if off > 0.0:
        tests["time"] = (True, off, 0.0)
        return tests, parts, measured, True
    begins = ends - durations
    names = list(arm.joint_names)

    def test(name: str, excess: np.ndarray, times: np.ndarray, allowed: float) -> None:
        """Test an excess of N joints at M times (M, N)."""
        time, joint = np.unravel_index(excess.argmax(), excess.shape)
        worst = float(excess[time, joint])
        tests[name] = (worst > allowed, worst, float(times[time]))
        parts[name] = names[joint]

    def state(time: np.ndarray, piece: np.ndarray, order: int) -> np.ndarray:
        local = (time - begins[piece])[:, None]
        own = coeffs[piece]
        if order == 0:
            return own[:, 0] + local * (own[:, 1] + local * own[:, 2])
        return own[:, 1] + 2.0 * local * own[:, 2]

    index = np.arange(len(durations))
    first = [state(begins, index, order) for order in range(2)]
    last = [state(ends, index, order) for order in range(2)]
    start = np.maximum(np.abs(first[0][0] - case.angles), np.abs(first[1][0]))
    test("start", start[None], begins, relative)
    jumps = [np.abs(a[1:] - b[:-1]) for a, b in zip(first, last, strict=True)]
    if len(index) > 1:
        test("continuity", np.maximum(*jumps), begins[1:], relative)
    final = np.abs(last[0][-1] - case.goals), np.abs(last[1][-1])
    nearest = final[0].max(axis=1).argmin()
    test("goal", np.maximum(final[0][nearest], final[1])[None], ends[-1:], relative)
    scene, hulls = case.scene, () if case.scene.meshes is None else case.scene.meshes.corners
    bodies = Bodies(case.arm, scene.cylinder_ends, scene.cylinder_radius, hulls, scene)
    if tests["goal"][0]:
        beyond = np.maximum(case.goals - arm.upper, arm.lower - case.goals)
        goals = case.goals[beyond.max(axis=1) <= 0.0]
        if len(goals):
            depth, parts["ends"] = _deepest_end(bodies, case.angles, goals)
            tests["ends"] = (depth > 0.0, depth, 0.0)
        else:
            test("reach", beyond[beyond.max(axis=1).argmin()][None], ends[-1:], 0.0)
    # A joint's angle has its extremes at the ends of pieces and where its rate is zero.
    rise = np.where(coeffs[:, 2] == 0.0, np.inf, coeffs[:, 2])
    turning = np.clip(-0.5 * coeffs[:, 1] / rise, 0.0, durations[:, None])
    extremes = coeffs[:, 0] + turning * (coeffs[:, 1] + turning * coeffs[:, 2])
    angles = np.concatenate([first[0], last[0], extremes])
    times = np.concatenate([begins, ends, begins])
    test("position", np.maximum(angles - arm.upper, arm.lower - angles), times, relative)
    for name, values, times in (
        ("velocity", np.concatenate([first[1], last[1]]), np.concatenate([begins, ends])),
        ("acceleration", 2.0 * coeffs[durations > 0.0, 2], begins[durations > 0.0]),
    ):
        share = np.abs(values) / getattr(limits, name)
        if len(share):
            test(name, share - 1.0, times, relative)
            measured[f"{name}_share"] = float(share.max())
    fastest = np.linalg.norm(np.abs(np.stack([first[1], last[1]])).max(axis=0), axis=1)
    count = np.ceil(durations * np.maximum(1.0 / LONGEST_STEP, fastest / LARGEST_TURN)).astype(int)
    piece = np.repeat(index, count)
    number = np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count)
    time = np.append(begins[piece] + number / count[piece] * durations[piece], total)
    samples = state(time, np.append(piece, len(index) - 1), 0)
    measured["torque_share"] = 0.0
    if limits.torque is not None:
        compare = Dynamics(functools.partial(getattr, arm), float(case.gravity)).compare
        of_plan = coeffs.transpose(1, 2, 0), durations, limits.torque
        excess, at, joint = compare(*of_plan, stays=True)
        tests["torque"], parts["torque"] = (excess > relative, excess, at), names[joint]
        measured["torque_share"] = excess + 1.0
    for kind, (least, at, part) in bodies.clearances(samples).items():
        measured[f"{kind}_clearance"] = least
        tests[kind], parts[kind] = (-least > contact, -least, float(time[at])), part
    return tests, parts, measured, True


def _deepest_end(bodies: "Bodies", start: np.ndarray, goals: np.ndarray) -> tuple[float, str]:
    """Return how deep [m] bodies are in each other at the start, or else at the freest goal.

    The second result names the bodies and the end. The depth is at most 0 if both are free.
    """
    found = []
    for name, angles in [("start", start), *(("goal", goal) for goal in goals)]:
        gap, _, part = min(bodies.clearances(angles[None]).values())
        found.append((-gap, f"at the {name} {part}"))
    return found[0] if found[0][0] > 0.0 else min(found[1:])


class Bodies:
    """A MuJoCo model of an arm and obstacles, and the pairs that must not touch."""

    def __init__(
        self, arm: Any, ends: np.ndarray, radius: np.ndarray, hulls: Any, scene: Any = None
    ) -> None:
        """Make a model of an arm, cylinders, hulls of K meshes (K, V, 3) [m], and a scene's rest.

        The cylinders' axes have the ends (L, 2, 3) [m], and their radii are (L,) [m].
        """
        mujoco: Any = importlib.import_module("mujoco")  # slow to import
        self._mujoco = mujoco
        spec = mujoco.MjSpec()
        kinds = mujoco.mjtGeom
        self._names: list[str] = []
        body, links = spec.worldbody, []
        for k, name in enumerate(arm.joint_names):
            body = body.add_body(pos=arm.origin[k], quat=arm.turn[k])
            body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=arm.axis[k])
            body.mass, body.inertia, body.explicitinertial = 1.0, np.ones(3), True
            links.append(body)
        links.append(spec.worldbody)  # the base has the index -1

        def add(name: str, body, kind, **shape) -> int:
            body.add_geom(name=f"geom {len(self._names)}", type=kind, **shape)
            self._names.append(name)
            return len(self._names) - 1

        def add_capsule(name: str, body, ends: np.ndarray, radius: float) -> int:
            size = [max(radius, _LEAST), 0.0, 0.0]
            if np.linalg.norm(ends[1] - ends[0]) < _LEAST:
                return add(name, body, kinds.mjGEOM_SPHERE, pos=ends[0], size=size)
            return add(name, body, kinds.mjGEOM_CAPSULE, fromto=ends.ravel(), size=size)

        def add_hull(name: str, body, corners: np.ndarray, **pose) -> int:
            mesh = f"mesh {len(self._names)}"
            spec.add_mesh(name=mesh, uservert=corners.ravel())
            return add(name, body, kinds.mjGEOM_MESH, meshname=mesh, **pose)

        def add_box(name: str, body, middle: np.ndarray, turn: np.ndarray, half: np.ndarray) -> int:
            corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * half
            return add_hull(name, body, corners, pos=middle, quat=turn)

        shapes = zip(arm.capsule_link, arm.capsule_ends, arm.capsule_radius, strict=True)
        capsules = [
            add_capsule("the base" if link < 0 else f"link {link + 1}", links[link], ends, radius)
            for link, ends, radius in shapes
        ]
        moving = [each for each, link in zip(capsules, arm.capsule_link, strict=True) if link >= 0]
        own, based, self._added = list(arm.pairs), list(arm.base_pairs), {}
        if arm.shield_half.min() > 0.0:
            half = np.append(0.5 * THICKNESS, arm.shield_half)
            normal = np.zeros(3)
            mujoco.mju_rotVecQuat(normal, np.array([1.0, 0.0, 0.0]), arm.shield_turn)
            middle = arm.shield_centre - 0.5 * THICKNESS * normal
            shield = add_box("the shield", links[-2], middle, arm.shield_turn, half)
            moving.append(shield)
            based.append(shield)
            for k in arm.shield_pairs:
                own.append((k, shield))
                self._added[k, shield] = arm.capsule_radius[k] - arm.shield_gap_radius[k]
        if based:
            lower, upper = arm.base_box
            upright = np.array([1.0, 0.0, 0.0, 0.0])
            box = 0.5 * (lower + upper), upright, 0.5 * (upper - lower)
            if box[2].max() < _LEAST:  # a point, if capsules enclose the base
                base = add_capsule("the base", links[-1], arm.base_box, 0.0)
            else:
                base = add_box("the base", links[-1], *box)
            own += [(k, base) for k in based]
        fixed = [add_hull(f"mesh {k + 1}", links[-1], hull) for k, hull in enumerate(hulls)]
        for k, each in enumerate(zip(ends, radius, strict=True), 1):
            size = [max(each[1], _LEAST), 0.0, 0.0]
            shape = {"fromto": each[0].ravel(), "size": size}
            fixed.append(add(f"cylinder {k}", links[-1], kinds.mjGEOM_CYLINDER, **shape))
        self._pairs, pairs = {}, []
        if scene is not None:
            for kind in ("capsule", "beam"):
                rods = (getattr(scene, f"{kind}_{name}") for name in ("ends", "radius"))
                rods = enumerate(zip(*rods, strict=True), 1)
                known = [(f"{kind} {k}", links[-1], *rod) for k, rod in rods if rod[1] >= 0.0]
                fixed += [add_capsule(*each) for each in known]
            boxes = zip(scene.box_middle, scene.box_turn, scene.box_half, strict=True)
            fixed += [add_box(f"box {k}", links[-1], *box) for k, box in enumerate(boxes, 1)]
            shape = {"pos": [0.0, 0.0, float(scene.floor)], "size": [1.0, 1.0, 1.0]}
            floor = add("the floor", links[-1], kinds.mjGEOM_PLANE, **shape)
            low = [k for k in moving if k not in capsules or arm.capsule_link[k] > 0]
            self._pairs["self"] = np.array(own, int).reshape(-1, 2)
            pairs = [(k, floor) for k in low]
        pairs += [(k, j) for k in moving for j in fixed]
        self._pairs["obstacle"] = np.array(pairs)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        # MuJoCo numbers the geoms body by body.
        numbers = range(len(self._names))
        self._geoms = np.array([self._model.geom(f"geom {k}").id for k in numbers])

    def clearances(self, samples: np.ndarray) -> dict[str, tuple[float, int, str]]:
        """Return by kind the least distance [m] at samples (S, n), its sample, and both bodies."""
        mujoco, model, data = self._mujoco, self._model, self._data
        least: dict[str, tuple[float, int, str]] = dict.fromkeys(_KINDS, (np.inf, 0, ""))
        reach = np.where(model.geom_rbound > 0.0, model.geom_rbound, np.inf)  # 0 for the floor
        geoms = {kind: self._geoms[pairs] for kind, pairs in self._pairs.items()}
        bounds = {kind: reach[pairs].sum(axis=1) for kind, pairs in geoms.items()}
        for sample, angles in enumerate(samples):
            data.qpos[:] = angles
            mujoco.mj_kinematics(model, data)
            for kind, pairs in self._pairs.items():
                apart = np.subtract(*data.geom_xpos[geoms[kind].T])
                bound = np.linalg.norm(apart, axis=1) - bounds[kind]
                for k in np.argsort(bound):
                    if bound[k] >= least[kind][0]:
                        break
                    one, other = pairs[k].tolist()
                    gap = mujoco.mj_geomDistance(model, data, *geoms[kind][k].tolist(), _FAR, None)
                    gap += self._added.get((one, other), 0.0)
                    if gap < least[kind][0]:
                        part = f"{self._names[one]} and {self._names[other]}"
                        least[kind] = (gap, sample, part)
        return least
