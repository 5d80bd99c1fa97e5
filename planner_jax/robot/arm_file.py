"""Reader of arms from MJCF and URDF files, by MuJoCo's own compiler; see `docs/arms.md`.

The arm is a chain of six or seven hinge joints. A body without a joint of the chain belongs to the
link that carries it. The joints of a gripper stay at their home positions.
"""

import dataclasses
import functools
import importlib.resources
import itertools
import os
import warnings
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike
from scipy.spatial.transform import Rotation

from planner_jax.core.arithmetic import host_leaf
from planner_jax.referee import solids
from planner_jax.robot.arm import Arm, ArmLimits
from planner_jax.robot.arm_chain import BASE, DENSITY, OUTSIDE, ArmModel, Frame
from planner_jax.robot.arm_ik import choose_ik
from planner_jax.robot.arm_limits import Limits, limits_of
from planner_jax.robot.arm_shield import THICKNESS, Mount, Shield, inertia_of, mount_shield
from planner_jax.robot.capsule_fit import Cover, cover, measure_excess

_FORK = 0.71  # see `irb1600`
# [rad], [rad/s] Greater limits of angles or rates are likely to be in degrees.
_MOST_TURN, _MOST_RATE = 4.0 * np.pi, 50.0
_CORNERS = np.array([(0.0, a, b) for a in (-1.0, 1.0) for b in (-1.0, 1.0)])  # of a plate


@functools.cache
def irb1600(dtype: DTypeLike = np.float32) -> Arm:
    """Return the arm ABB IRB 1600-6/1.2 with a square shield of 0.30 m (`models/irb1600.xml`).

    Only pairs of bodies are checked that can touch: links 3 to 6 and link 1, links 1 to 4 and the
    shield. Link 4 ends in a fork around the wrist, and its capsule extends beyond the fork. For
    distances from the shield, the radius of this capsule is therefore at most a fraction of the
    distance between the wrist and the shield's face.
    """
    models = importlib.resources.files("planner_jax.robot") / "models"
    arm = read_arm(os.fspath(models / "irb1600.xml"), dtype=dtype)  # type: ignore[arg-type]
    link, radius = np.array(arm.capsule_link), np.asarray(arm.capsule_radius)
    wrist = np.linalg.norm(np.add(arm.origin[5], arm.shield_centre, dtype=float))
    thin = np.where(link == 3, np.minimum(radius, _FORK * wrist), radius)
    every = range(len(link))
    return dataclasses.replace(
        arm,
        shield_gap_radius=host_leaf(thin, dtype),
        pairs=tuple((k, j) for k in every for j in every if link[k] >= 2 and link[j] == 0),
        shield_pairs=tuple(k for k in every if 0 <= link[k] <= 3),
    )


def read_arm(
    path: str | os.PathLike,
    *,
    limits: Limits = None,
    shield: Shield | None = None,
    tip: str | None = None,
    home: Iterable[float] | None = None,
    dtype: DTypeLike = np.float32,
) -> Arm:
    """Read an arm from an MJCF or URDF file; its leaves are NumPy arrays.

    The base frame is the frame of the outermost body that carries the arm. The pose of this body
    in the world is ignored.

    Args:
        path: path of a file, or its text, which begins with "<".
        limits: limits of the joints as a dictionary, or the path of a YAML file with them. By
            default `NAME.limits.yaml` beside the file is read, if it exists.
        shield: the shield. By default it is the box named "shield" of the file, if there is one.
        tip: name of the body or the site at the end of the arm. By default the arm ends where its
            chain of hinges branches or ends.
        home: joint angles [rad] at which the arm waits. By default they are the key named home of
            the file or its only key, or the angles nearest to 0 within the limits.
        dtype: type of every leaf.

    A Python warning names links whose masses the file does not state, and joints whose limits look
    like degrees.

    Raises:
        ArgumentError: the file is no such arm, or lacks limits. The message is one line that names
            the file, the element and the remedy.
    """
    arm, _, doubts = _read(path, limits, shield, tip, home, dtype)
    _warn(doubts)
    return arm


@functools.cache
def read_shield_arm(path: str, tip: str | None = None, shield: Shield | None = None) -> Arm:
    """Read an arm for blocks: as `read_arm`, with a shield of 0.30 m at `tip` if it has none.

    A process reads each file once.
    """
    arm, _, doubts = _read(path, shield=shield, tip=tip, usual=Shield())
    _warn(doubts)
    return arm


def _warn(doubts: list[str]) -> None:
    for doubt in doubts:
        warnings.warn(doubt, stacklevel=3)


def describe_arm(path: str | os.PathLike, **settings: Any) -> str:
    """Describe an arm as `read_arm` reads it: joints, fit of the capsules, pairs not checked.

    The function takes the arguments of `read_arm`, and raises the same errors.
    """
    return _read(path, **settings)[1]


def _read(
    path: str | os.PathLike,
    limits: Limits = None,
    shield: Shield | None = None,
    tip: str | None = None,
    home: Iterable[float] | None = None,
    dtype: DTypeLike = np.float32,
    usual: Shield | None = None,
) -> tuple[Arm, str, list[str]]:
    """Return the arm of a file, the text of `describe_arm`, and what may be wrong with the file.

    `usual` is the shield of an arm whose file has none, if no other one is passed.
    """
    model = ArmModel(path, tip)
    stated = limits_of(model, limits)
    lower, upper = stated["position"].T
    rest, source = model.home(home, lower, upper)
    mount = mount_shield(model, shield, usual)
    before = [(np.zeros(3), np.eye(3)), *model.zero[:-1]]
    steps = [
        (turn.T @ (p - q), turn.T @ r) for (q, turn), (p, r) in zip(before, model.zero, strict=True)
    ]
    inertials = [_sum_inertias(model.bodies(k)) for k in range(model.num - 1)]
    inertials.append(_sum_inertias([*model.bodies(model.num - 1), *inertia_of(mount)]))
    mass, centre, inertia = zip(*inertials, strict=True)
    covers, box = _cover(model, mount.geom)
    link = tuple(k for k, each in covers for _ in each.radius)
    ends = np.concatenate([np.zeros((0, 2, 3)), *(each.ends for _, each in covers)])
    radius = np.concatenate([np.zeros(0), *(each.radius for _, each in covers)])
    if box is None:  # a point inside the base, or else of the first joint
        inside = ends[link.index(BASE)][0] if BASE in link else steps[0][0]
        base_box = np.stack([inside, inside])
    else:
        base_box = box
    axis = np.array([model.axis(k) for k in range(model.num)])
    leaves = {
        "origin": [origin for origin, _ in steps],
        "turn": [_quaternion(turn) for _, turn in steps],
        "axis": axis,
        "lower": lower,
        "upper": upper,
        "home": rest,
        "mass": mass,
        "centre": centre,
        "inertia": inertia,
        "capsule_ends": ends,
        "capsule_radius": radius,
        "shield_gap_radius": radius,
        "base_box": base_box,
        "shield_centre": mount.centre,
        "shield_turn": _quaternion(mount.turn),
        "shield_half": mount.half,
        "shield_corners": mount.corners,
    }
    poses = [model.frames(angles) for angles in (rest, np.clip(0.0, lower, upper))]
    checked = _pairs(link, ends, radius, box, mount, poses)
    if checked.is_buried:
        raise model.error("the shield", "outside of the links; move it by shield=", "be")
    armature = model.model.dof_armature[model.model.jnt_dofadr[model.joints]]
    has_torques = bool(np.any(np.isfinite(stated["torque"])))
    off_axis = np.cross([mount.turn[:, 0], mount.centre], axis[-1])
    arrays = {name: host_leaf(leaf, dtype) for name, leaf in leaves.items()}
    arm = Arm(
        **arrays,
        limits=ArmLimits(
            velocity=host_leaf(stated["velocity"], dtype),
            acceleration=host_leaf(stated["acceleration"], dtype),
            torque=host_leaf(stated["torque"], dtype) if has_torques else None,
        ),
        armature=host_leaf(armature, dtype) if np.any(armature) else None,
        capsule_link=link,
        pairs=checked.pairs,
        base_pairs=checked.base_pairs,
        shield_pairs=checked.shield_pairs,
        joint_names=model.joint_names,
        turns_in_plane=bool(np.max(np.abs(off_axis)) < 1e-6),
        ik="numerical",
    )
    arm = dataclasses.replace(arm, ik=choose_ik(arm))
    doubts = _find_doubts(model, stated)
    text = _describe(model, covers, source, checked.touching, stated["torque"])
    return arm, "\n".join([text, *doubts]), doubts


def _find_doubts(model: ArmModel, stated: dict[str, np.ndarray]) -> list[str]:
    """Return lines that name links with masses of MuJoCo's, and joints with limits in degrees."""
    weighed = {int(model.link[body]) for body in model.weighed} - {BASE, OUTSIDE}
    links = ", ".join(model.link_names[k] for k in sorted(weighed))
    turns, rates = np.max(np.abs(stated["position"]), axis=1), stated["velocity"]
    wide = (turns > _MOST_TURN) | (rates > _MOST_RATE)
    joints = ", ".join(np.array(model.joint_names)[wide])
    doubts = []
    if links:
        density = f"MuJoCo computes it by {DENSITY:g} kg/m^3"
        doubts.append(f"{model.name}: no mass is stated for {links}; {density}")
    if joints:
        limits = f"limits up to {np.max(turns):g} rad and {np.max(rates):g} rad/s"
        doubts.append(f"{model.name}: {limits} of {joints} look like degrees; state radians")
    return doubts


def _quaternion(turn: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(turn).as_quat(canonical=True, scalar_first=True)


def _sum_inertias(bodies: list) -> tuple[float, np.ndarray, np.ndarray]:
    """Return mass [kg], centre (3,) [m] and inertia (3, 3) [kg m^2] of rigidly connected bodies."""
    mass = sum(m for m, _, _ in bodies)
    centre = sum((m * c for m, c, _ in bodies), np.zeros(3)) / (mass or 1.0)
    inertia = np.zeros((3, 3))
    for m, c, own in bodies:
        off = c - centre
        inertia += own + m * (off @ off * np.eye(3) - np.outer(off, off))
    return mass, centre, inertia


def _cover(model: ArmModel, plate: int) -> tuple[list[tuple[int, Cover]], np.ndarray | None]:
    """Return covers of the collision geoms with their links, and the base's box (2, 3) [m].

    The largest geom of the base is covered by a box, parallel to the axes of the base frame, if
    capsules would exceed the geom more.

    Args:
        model: the arm's model.
        plate: index of the geom that is the shield, or -1.
    """
    geoms = model.model.geom_bodyid
    shapes = [(k, int(model.link[geoms[k]]), model.shape(k)) for k in model.solids()]
    hulls = [each for _, link, each in shapes if link == BASE and not isinstance(each, Cover)]
    largest = max(hulls, key=lambda corners: np.prod(np.ptp(corners, axis=0)), default=None)
    covers, chosen = [], None
    for k, link, shape in shapes:
        # A shield that is thicker than a plate is a body of the last link, too.
        if k == plate and np.min(model.model.geom_size[k]) < 0.5 * THICKNESS + 1e-6:
            continue
        if isinstance(shape, Cover):
            fitted = shape
        else:
            box = np.stack([np.min(shape, axis=0), np.max(shape, axis=0)])
            corners = np.array([*itertools.product(*box.T)])[:, None].repeat(2, axis=1)
            around = Cover(corners[:0], np.zeros(0), *measure_excess(corners, np.zeros(8), shape))
            fitted = around if around.mean < 1e-9 and shape is largest else cover(shape)
            if shape is largest and around.mean <= fitted.mean:
                fitted, chosen = around, box
        covers.append((link, fitted))
    return covers, chosen


class _Checked(NamedTuple):
    """Bodies that must not touch, as fields of `Arm`, and the pairs of links that are left out."""

    pairs: tuple[tuple[int, int], ...]
    base_pairs: tuple[int, ...]
    shield_pairs: tuple[int, ...]
    touching: tuple[tuple[int, int], ...]  # links that touch at rest; the shield has the index n
    is_buried: bool  # whether links contain all corners of the shield at home


def _pairs(
    link: tuple[int, ...],
    ends: np.ndarray,
    radius: np.ndarray,
    box: np.ndarray | None,
    mount: Mount,
    rest: list[list[Frame]],
) -> _Checked:
    """Return the bodies that must not touch: bodies that do not touch in the poses `rest`.

    Bodies of one link or of neighbouring links are left out. The shield is a body of the last link.
    """
    num, every = len(rest[0]), range(len(link))
    poses = []  # ends of the capsules (C, 2, 3) [m] in each pose
    for links in rest:
        frames = [*links, (np.zeros(3), np.eye(3))]  # the base has the index -1
        turned = [ends[k] @ frames[link[k]][1].T + frames[link[k]][0] for k in every]
        poses.append(np.reshape(turned, (-1, 2, 3)))

    def gap(k: int, j: int) -> float:
        gaps = [solids.between_segments(p[k, 0], p[k, 1], p[j, 0], p[j, 1]) for p in poses]
        return min(gaps) - radius[k] - radius[j]

    def box_gap(k: int, half: np.ndarray, middles: list[Frame]) -> float:
        gaps = []
        for (middle, turn), ends in zip(middles, poses, strict=True):
            first, second = (ends[k] - middle) @ turn
            gaps.append(solids.segment_to_box(first, second, half))
        return min(gaps) - radius[k]

    base = [k for k in every if link[k] == BASE]
    pairs, base_pairs, touching = [], [], set()
    for k in (k for k in every if link[k] >= 1):
        gaps = [gap(k, j) for j in base]
        if box is not None:
            middle = box.mean(axis=0), np.eye(3)
            gaps.append(box_gap(k, 0.5 * np.ptp(box, axis=0), [middle] * len(rest)))
        if gaps and min(gaps) > 0.0:
            base_pairs.append(k)
            pairs += [(k, j) for j in base]
        elif gaps:
            touching.add((link[k], BASE))
        for j in (j for j in every if 0 <= link[j] < link[k] - 1):
            if gap(k, j) > 0.0:
                pairs.append((k, j))
            else:
                touching.add((link[k], link[j]))
    shield_pairs, is_buried = [], False
    if np.any(mount.half):
        half, plates = np.array([0.5 * THICKNESS, *mount.half]), []
        for links in rest:
            origin, turn = links[-1]
            own = turn @ mount.turn
            plates.append((origin + turn @ mount.centre - half[0] * own[:, 0], own))
        corners = plates[0][0] + _CORNERS * [0.0, *mount.half] @ plates[0][1].T
        is_buried = all(
            any(
                solids.from_segment(corner, *ends) < r
                for ends, r in zip(poses[0], radius, strict=True)
            )
            for corner in corners
        )
        for k in (k for k in every if link[k] < num - 2):
            if link[k] == BASE or box_gap(k, half, plates) > 0.0:
                shield_pairs.append(k)
            else:
                touching.add((num, link[k]))
    left_out = tuple(sorted(touching))
    return _Checked(tuple(pairs), tuple(base_pairs), tuple(shield_pairs), left_out, is_buried)


def _describe(
    model: ArmModel,
    covers: list[tuple[int, Cover]],
    home: str,
    touching: tuple[tuple[int, int], ...],
    torque: np.ndarray,
) -> str:
    mj = model.model
    frozen = [
        mj.joint(j).name
        for j in range(mj.njnt)
        if j not in model.joints and model.link[mj.jnt_bodyid[j]] != OUTSIDE
    ]
    names = [*model.link_names, "the shield", "the base"]  # the base has the index -1
    pairs = ", ".join(f"{names[a]} and {names[b]}" for a, b in touching) or "none"
    lines = [
        f"{model.name}: {model.num} hinges, {', '.join(model.joint_names)}",
        f"Home: {home}. Joints that stay there: {', '.join(frozen) or 'none'}.",
        f"Greatest torques [N m]: {', '.join(f'{each:g}' for each in torque)}.",
        f"{'link':24}{'capsules':>10}{'greatest excess [mm]':>22}{'mean excess [mm]':>18}",
    ]
    for link in (BASE, *range(model.num)):
        of_link = [each for k, each in covers if k == link]
        num = sum(len(each.radius) for each in of_link)
        greatest = 1e3 * max((each.greatest for each in of_link), default=0.0)
        mean = 1e3 * sum(each.mean for each in of_link) / max(len(of_link), 1)
        lines.append(f"{names[link]:24}{num:>10}{greatest:>22.1f}{mean:>18.1f}")
    bare = [name for k, name in enumerate(model.link_names) if k not in dict(covers)]
    lines.append(f"Links without a collision body: {', '.join(bare) or 'none'}.")
    lines.append("Pairs of neighbouring links are not checked.")
    lines.append(f"Not checked, because bodies touch at home or at angles 0: {pairs}.")
    return "\n".join(lines)
