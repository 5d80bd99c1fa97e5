"""Measure `pj.reach` on problems of others: UR5 of MotionBenchMaker, and pairs of [Natarajan2024].

    python -m benchmarks.reach_problems FOLDER [--every 1] [--first 0] [--out DIR]

FOLDER either has `starts.txt` and `goals.txt`, the joint states of an IRB 1600 in the repository
nrkumar93/pinsat, which are planned among the eight beams of its scene "hard". Or it has
`ur5_spherized.urdf` and folders of pairs `sceneK.yaml` and `requestK.yaml`, as in the
repository KavrakiLab/vamp. The arm's bodies are the spheres of the URDF. Pairs of links that a
scene's matrix of allowed collisions names are not tested, nor one pair of neighbours whose spheres
always overlap. The URDF limits speeds to 0.5 rad/s; here they are the robot's 3.15 rad/s, with
8 rad/s^2. As in VAMP, cylinders are replaced by capsules that enclose them, and in the family
box_ur5 by boxes that enclose them. A problem whose start or goal is in a collision has no solution,
and is counted apart.

If the package `vamp` (on PyPI: vamp-planner) is installed, its RRT-Connect and its simplification
of paths plan the same problems of the UR5, and a second table compares both planners. The motion
along a path of VAMP stops at the corners. The referee and VAMP's checker judge all motions.
"""

import dataclasses
import importlib
import importlib.util
import time
import xml.etree.ElementTree as ET
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

import planner_jax as pj
from planner_jax.benchmarks.run import argument_parser, begin
from planner_jax.task.reach import ReachCase, ReachPlan
from planner_jax.task.reach.motion import join_knots, straight_knots

LIMITS = {"velocity": 3.15, "acceleration": 8.0}  # [rad/s], [rad/s^2]
OVERLAPPING = {"fts_robotside", "wrist_2_link"}  # links whose spheres always overlap
_AWAY = (0.0, 0.0, -50.0)  # [m], position of obstacles that pad scenes to the same numbers
CORNERS = 64  # greatest number of corners of a path of VAMP
TURN = 0.017  # [rad], distance of states that VAMP's checker judges
JOINTS = tuple(
    f"{name}_joint"
    for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
)


def read_yaml(path: Path) -> dict:
    """Return the content of a YAML file."""
    return yaml.load(path.read_text(), yaml.CSafeLoader)


def read_arm(urdf: Path, allowed: dict):
    """Return the arm of the spheres, with the pairs that the matrix of a scene does not allow."""
    arm = pj.block.read_arm(urdf, limits=LIMITS)
    owners = [
        link.get("name")
        for link in ET.parse(urdf).getroot().iter("link")
        for _ in link.iter("sphere")
    ]
    if len(owners) != len(arm.capsule_link):
        raise ValueError(f"{urdf} has {len(owners)} spheres, the arm {len(arm.capsule_link)}")
    names, links = allowed["entry_names"], np.asarray(arm.capsule_link)
    pairs = [
        (k, j)
        for k in range(len(owners))
        for j in range(len(owners))
        if links[k] > links[j]
        and {owners[k], owners[j]} != OVERLAPPING
        and not allowed["entry_values"][names.index(owners[k])][names.index(owners[j])]
    ]
    return dataclasses.replace(arm, pairs=tuple(pairs), base_pairs=())


def pose_of(pose: dict) -> np.ndarray:
    """Return the matrix (4, 4) of a pose with a position and a quaternion x, y, z, w."""
    matrix = np.eye(4)
    matrix[:3, 3] = pose["position"]
    matrix[:3, :3] = Rotation.from_quat(pose["orientation"]).as_matrix()
    return matrix


def read_solids(scene: dict, is_boxed: bool) -> tuple[list, list, list]:
    """Return a scene's boxes, capsules and spheres, as `pj.reach.make_scene` takes them."""
    boxes, capsules, spheres = [], [], []
    for solid in scene["world"]["collision_objects"]:
        frame = pose_of(solid["pose"]) if "pose" in solid else np.eye(4)
        for shape, pose in zip(solid["primitives"], solid["primitive_poses"], strict=True):
            matrix, size = frame @ pose_of(pose), shape["dimensions"]
            middle, turn = matrix[:3, 3], matrix[:3, :3]
            upright = Rotation.from_matrix(turn).as_quat(scalar_first=True)
            if shape["type"] == "box":
                boxes.append((middle, size, upright))
            elif shape["type"] == "sphere":
                spheres.append((middle, size[0]))
            elif is_boxed:
                boxes.append((middle, (2.0 * size[1], 2.0 * size[1], size[0]), upright))
            else:
                ends = middle + np.outer([-0.5 * size[0], 0.5 * size[0]], turn[:, 2])
                capsules.append((ends, size[1]))
    return boxes, capsules, spheres


def read_problems(folder: Path, first: int, every: int) -> dict[str, list[ReachCase]]:
    """Return the cases of each family; all have the same numbers of obstacles."""
    found = []
    for path in sorted(folder.glob("*/scene*.yaml")):
        request = read_yaml(path.with_name(path.name.replace("scene", "request")))
        scene, state = read_yaml(path), request["start_state"]["joint_state"]
        start = dict(zip(state["name"], state["position"], strict=True))
        goal = request["goal_constraints"][0]["joint_constraints"]
        goal = {each["joint_name"]: each["position"] for each in goal}
        ends = [[each[joint] for joint in JOINTS] for each in (start, goal)]
        found.append(
            (path.parent.name, scene, ends, read_solids(scene, path.parent.name == "box_ur5"))
        )
    most = [max(len(solids[k]) for *_, solids in found) for k in range(3)]
    far = np.array(_AWAY)
    padding = [
        (far, (0.01, 0.01, 0.01), (1.0, 0.0, 0.0, 0.0)),
        (np.stack([far, far + 0.01]), 0.01),
        (far, 0.01),
    ]
    problems: dict[str, list[ReachCase]] = {}
    arms = {}
    for family, scene, (start, goal), solids in found[first::every]:
        padded = [
            [*each, *[filler] * (num - len(each))]
            for each, num, filler in zip(solids, most, padding, strict=True)
        ]
        boxes, capsules, spheres = padded
        allowed = scene["allowed_collision_matrix"]
        key = str(allowed)
        if key not in arms:
            arms[key] = read_arm(folder / "ur5_spherized.urdf", allowed)
        made = pj.reach.make_scene(boxes=boxes, capsules=capsules, spheres=spheres)
        case = pj.reach.case(goal, angles=start, arm=arms[key], scene=made)
        problems.setdefault(family, []).append(case)
    return problems


def read_pairs(folder: Path, first: int, every: int) -> dict[str, list[ReachCase]]:
    """Return cases of an IRB 1600 among four posts and four bars, in its base frame."""
    upright, wide, long = (1.0, 0.0, 0.0, 0.0), 0.12, 1.6
    sides = (0.8, -0.8)
    boxes = [((x, y, 0.55), (wide, wide, 2.0), upright) for x in sides for y in sides]
    boxes += [((x, 0.0, 0.8), (wide, long, wide), upright) for x in sides]
    boxes += [((0.0, y, 0.8), (long, wide, wide), upright) for y in sides]
    scene = pj.reach.make_scene(boxes=boxes, floor=-0.45)
    ends = (np.loadtxt(folder / f"{name}.txt")[first::every] for name in ("starts", "goals"))
    pairs = zip(*ends, strict=True)
    return {"pairs": [pj.reach.case(goal, angles=start, scene=scene) for start, goal in pairs]}


def main() -> None:
    """Plan and judge all problems, and print one row for each family."""
    parser = argument_parser("reach_problems", __doc__, every=1, first=0)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    planner = pj.reach.planner()
    with begin(parser, options) as bench:
        read = read_pairs if (options.folder / "starts.txt").exists() else read_problems
        problems = read(options.folder, options.first, options.every)
        some = next(iter(problems.values()))[0]
        pj.warm_up(planner, some)
        bench.say(
            "| family | problems | blocked | solved | refereed | p50 [ms] | p99 [ms] "
            "| duration p50 [s] |",
            "|---|---|---|---|---|---|---|---|",
        )
        plans: dict[str, list[ReachPlan]] = {family: [] for family in problems}
        rows = [
            (family, *measure(bench, planner, cases, plans[family]))
            for family, cases in problems.items()
        ]
        merged = [np.concatenate([row[k] for row in rows]) for k in range(1, 6)]
        for family, *row in [*rows, ("all", *merged)]:
            seconds, solved, good, blocked, durations = row
            open_ = ~blocked
            bench.say(
                f"| {family} | {len(solved)} | {blocked.sum()} | {solved[open_].mean():.2%} "
                f"| {good[open_].mean():.2%} | {1e3 * np.percentile(seconds[open_], 50):.0f} "
                f"| {1e3 * np.percentile(seconds[open_], 99):.0f} "
                f"| {np.median(durations[good]):.2f} |"
            )
        bench.count(merged[2][~merged[3]])
        if read is read_problems:
            compare_with_vamp(bench, problems, plans, merged)


def measure(
    bench, planner, cases: list[ReachCase], plans: list[ReachPlan]
) -> tuple[np.ndarray, ...]:
    """Return for each case its time [s], claim, verdict, whether it is blocked, and duration.

    The plans are appended to `plans`.
    """
    found = []
    for k, case in enumerate(cases):
        begun = time.perf_counter()
        plan = pj.plan(planner, case)
        seconds = time.perf_counter() - begun
        plans.append(plan)
        verdict = pj.reach.judge(case, plan)
        solved, blocked = bool(pj.are_solved(plan)), plan.status == pj.Status.BLOCKED
        if not (verdict.success or blocked):
            bench.say(f"problem {k}: {pj.Status(plan.status).name}, {verdict.sentence()}")
        found.append((seconds, solved, bool(verdict.success), blocked, float(verdict.duration)))
    seconds, *flags, durations = (np.array(each) for each in zip(*found, strict=True))
    return seconds, *(each.astype(bool) for each in flags), durations


def compare_with_vamp(bench, problems: dict, plans: dict, merged: list[np.ndarray]) -> None:
    """Plan the problems by VAMP, judge both planners by both checkers, and print a table."""
    if importlib.util.find_spec("vamp") is None:
        bench.say("VAMP is not installed (pip install vamp-planner), and is not compared.")
        return
    vamp = importlib.import_module("vamp")
    robot, search, settings, simplify = vamp.configure_robot_and_planner_with_kwargs("ur5", "rrtc")
    settings.max_iterations = settings.max_samples = 100_000
    found = []
    for family, cases in problems.items():
        for case, plan in zip(cases, plans[family], strict=True):
            scene = make_vamp_scene(vamp, case)
            ends = [np.asarray(each, np.float32) for each in (case.angles, case.goals[0])]
            is_free = all(robot.validate(each, scene) for each in ends)
            rng = robot.halton()
            begun = time.perf_counter()
            result = search(*ends, scene, settings, rng)
            if result.solved:
                result = robot.simplify(result.path, scene, simplify, rng)
            seconds = time.perf_counter() - begun
            path = list(result.path.numpy()) if result.solved else []
            is_solved = is_free and 1 < len(path) <= CORNERS
            theirs = stop_at(case, plan, path if is_solved else ends)
            verdict = pj.reach.judge(case, theirs)
            valid = [is_valid(robot, scene, each) for each in (plan, theirs)]
            good = is_solved and bool(verdict.success)
            found.append((is_free, is_solved, good, *valid, seconds, float(verdict.duration)))
    free, solved, good, valid, sound, seconds, durations = map(np.array, zip(*found, strict=True))
    mine, claimed, refereed, blocked, lasts = merged
    both = free & ~blocked
    bench.say(
        f"Problems that are free for both checkers: {both.sum()}",
        "| planner | solved | refereed | valid by VAMP | p50 [ms] | p99 [ms] | duration p50 [s] |",
        "|---|---|---|---|---|---|---|",
    )
    for name, *flags, spent, lasting in (
        ("`pj.reach`", claimed, refereed, claimed & valid, mine, lasts),
        ("VAMP", solved, good, solved & sound, seconds, durations),
    ):
        rates = " | ".join(f"{each[both].mean():.2%}" for each in flags)
        bench.say(
            f"| {name} | {rates} | {1e3 * np.percentile(spent[both], 50):.3g} "
            f"| {1e3 * np.percentile(spent[both], 99):.3g} "
            f"| {np.median(lasting[both & flags[1]]):.2f} |"
        )


def make_vamp_scene(vamp, case: ReachCase):
    """Return a case's obstacles as an environment of VAMP."""
    scene, made = case.scene, vamp.Environment()
    solids = zip(scene.box_middle, scene.box_turn, scene.box_half, strict=True)
    for middle, turn, half in solids:
        turn = Rotation.from_quat(np.asarray(turn), scalar_first=True).as_euler("xyz")
        made.add_cuboid(vamp.Cuboid(*(np.asarray(each).tolist() for each in (middle, turn, half))))
    for ends, radius in zip(scene.capsule_ends, scene.capsule_radius, strict=True):
        low, high = np.asarray(ends)
        middle, length = (0.5 * (low + high)).tolist(), float(np.linalg.norm(high - low))
        if length == 0.0:
            made.add_sphere(vamp.Sphere(middle, float(radius)))
            continue
        turn = Rotation.align_vectors([high - low], [[0.0, 0.0, 1.0]])[0].as_euler("xyz")
        made.add_capsule(vamp.Cylinder(middle, turn.tolist(), float(radius), length))
    return made


@jax.jit
def sample(motion: pj.PiecewisePolynomial, times: jax.Array) -> jax.Array:
    """Return the joint angles (T, n) of a motion at times (T,)."""
    return jax.vmap(lambda time: pj.evaluate(motion, time))(times)


def is_valid(robot, scene, plan: ReachPlan) -> bool:
    """Return whether VAMP accepts all states of a plan's motion, at most `TURN` apart."""
    duration = float(np.sum(plan.motion.durations))
    fastest = np.linalg.norm(np.asarray(plan.motion.coeffs)[:, 1], axis=1).max()
    stride = max(int(4095 * TURN / max(duration * fastest, TURN)), 1)
    states = sample(plan.motion, jnp.asarray(np.linspace(0.0, duration, 4096)))
    return all(robot.validate(state, scene) for state in np.asarray(states)[::stride])


def stop_at(case: ReachCase, plan: ReachPlan, path: list[np.ndarray]) -> ReachPlan:
    """Return the plan of a motion along straight lines that stops at each point of a path."""
    points = np.stack([*path, *[path[-1]] * (CORNERS - len(path))])
    knots = jax.jit(straight_knots)(jnp.asarray(points), case.limits)
    return dataclasses.replace(plan, motion=join_knots(jnp.asarray(path[0]), *knots))


if __name__ == "__main__":
    main()
