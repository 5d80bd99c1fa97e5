"""The box that the arm protects, and obstacles, in the robot's base frame [Natarajan2024]."""

import dataclasses
import itertools
import os
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from planner_jax.core import rules
from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.checks import numbers_of, require_number, require_switch
from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError
from planner_jax.core.rules import POSITIVE, Field, Table
from planner_jax.robot.capsule_fit import cover, enclosing_box, hull_of, measure_excess

INNER_HALF, INNER_HEIGHT = 0.4, 1.35  # [m], half side and height of the protected box
OUTER_HALF, OUTER_HEIGHT = 1.0, 1.85  # [m], half side and height of the box where balls are met
# [m], x and y of a vertical pole, the height of its top, and its radius
POLE, POLE_TOP, POLE_RADIUS = (0.806, 0.0), 2.52, 0.05
ABSENT = -10.0  # [m], radius of a capsule that does not exist
FLOOR = -0.4826  # [m], height of the floor
_LEAST = 1e-9  # least length of a quaternion, and of a cylinder's axis [m]
_ROD: dict[str, tuple[int, ...] | None] = {"ends": (2, 3), "radius": ()}
# Fields of an obstacle of each kind, with their shapes; None is a file or points.
SOLIDS: dict[str, dict[str, tuple[int, ...] | None]] = {
    "boxes": {"middle": (3,), "size": (3,), "turn": (4,)},
    "spheres": {"middle": (3,), "radius": ()},
    "capsules": _ROD,
    "cylinders": _ROD,
    "meshes": {"file": None, "scale": (), "position": (3,), "turn": (4,)},
    "protected_capsule": _ROD,
}
# Four horizontal beams form a square around the robot's pedestal. Each beam is modelled as a
# capsule that encloses its cross-section of 0.025 m x 0.076 m.
RIG_HALF, RIG_LENGTH = 0.559, 1.09  # [m], half the side of the square, and length of a beam
RIG_HEIGHT, RIG_RADIUS = -0.08, 0.0401  # [m], height of the beams' axes, and radius of a capsule


# Shapes and ranges that `pj.require_sound` checks for the obstacles of a case's scene.
RULES: Table = (
    Field("scene.inner_radius", (), rules.NOT_NEGATIVE),
    Field("scene.inner_ends", (2, 3)),
    Field("scene.capsule_ends", ("P", 2, 3)),
    Field("scene.capsule_radius", ("P",)),
    Field("scene.floor", ()),
    Field("scene.beam_ends", ("N", 2, 3)),
    Field("scene.beam_radius", ("N",), rules.NOT_NEGATIVE),
    Field("scene.box_middle", ("M", 3)),
    Field("scene.box_turn", ("M", 4)),
    Field("scene.box_half", ("M", 3), rules.NOT_NEGATIVE),
    Field("scene.cylinder_ends", ("L", 2, 3)),
    Field("scene.cylinder_radius", ("L",), rules.NOT_NEGATIVE),
    Field("scene.meshes.corners", ("K", "V", 3)),
)


@struct.dataclass
class Box:
    """A box whose edges are parallel to the axes of the robot's base frame."""

    lower: Array  # (3,) [m], least coordinates
    upper: Array  # (3,) [m], greatest coordinates


@struct.dataclass
class Meshes:
    """Convex hulls of meshes, and the capsules and boxes by which the planner encloses them."""

    corners: Array  # (K, V, 3) [m], corners of the hulls; the last corner may be repeated
    # (K, 2) [m], greatest distance of the enclosing solids' points from the hull, and how much
    # farther the solids reach than the hull, as a mean over all directions
    excess: Array
    solids: dict[str, Array]  # enclosing solids, as fields of `Scene`


@struct.dataclass
class Scene:
    """Surroundings of the arm: box to protect, box in which balls may be blocked, obstacles.

    Attributes:
        inner: protected box; the points up to `inner_radius` from it are protected, too.
        inner_radius: () [m], distance from `inner` up to which points are protected; > 0 for a
            capsule, whose axis is a box without width.
        outer: box in which the shield may meet a ball.
        capsule_ends: (P, 2, 3) [m], ends of the axes of capsules, such as poles. Spheres are
            capsules, too.
        capsule_radius: (P,) [m]; a capsule with a negative radius, `ABSENT`, does not exist.
        floor: () [m], height of the floor.
        beam_ends: (N, 2, 3) [m], ends of the axes of capsules around the rig's beams.
        beam_radius: (N,) [m], radii of these capsules.
        box_middle: (M, 3) [m], middles of boxes at any orientation.
        box_turn: (M, 4) unit quaternions w, x, y, z: rotations of the boxes' frames.
        box_half: (M, 3) [m], halves of the boxes' edges.
        cylinder_ends: (L, 2, 3) [m], ends of the cylinders' axes.
        cylinder_radius: (L,) [m], radii of the cylinders.
        meshes: convex hulls of meshes; None: there are none.
        inner_ends: (2, 3) [m], ends of a protected capsule's oblique axis; `inner` is then the box
            around it.
    """

    inner: Box
    inner_radius: Array
    outer: Box
    capsule_ends: Array
    capsule_radius: Array
    floor: Array
    beam_ends: Array
    beam_radius: Array
    box_middle: Array
    box_turn: Array
    box_half: Array
    cylinder_ends: Array
    cylinder_radius: Array
    meshes: Meshes | None = None
    inner_ends: Array | None = None

    def without_meshes(self) -> "Scene":
        """Return the scene with the solids that enclose meshes instead of the meshes."""
        if self.meshes is None:
            return self
        solids = self.meshes.solids.items()
        joined = {name: jnp.concatenate([getattr(self, name), own]) for name, own in solids}
        return dataclasses.replace(self, meshes=None, **joined)


def paper_scene(*, has_pole: bool = True, pole: ArrayLike = POLE, size: float = 1.0) -> Scene:
    """Return the scene of the simulations in [Natarajan2024, Fig. 5], with NumPy float32 leaves.

    The sizes are from the model in the authors' repository. The model's box around the camera is
    left out, since the arm touches this box in the pose in which the authors let it wait. A pole
    stands at x and y `pole` [m], unless `has_pole` is false. All lengths are multiplied by `size`
    > 0, which suits arms with another reach than the authors' arm.
    """
    require_number("size", size, POSITIVE)
    require_switch("has_pole", has_pole)
    x, y = numbers_of("pole", pole, (), (2,))

    def leaf(value: float | list | np.ndarray) -> Array:
        return host_leaf(size * np.asarray(value), np.float32)

    def box(half: float, height: float) -> Box:
        return Box(lower=leaf([-half, -half, 0.0]), upper=leaf([half, half, height]))

    ends = []
    for along in range(2):
        for side in (-RIG_HALF, RIG_HALF):
            pair = np.full((2, 3), RIG_HEIGHT)
            pair[:, along] = -0.5 * RIG_LENGTH, 0.5 * RIG_LENGTH
            pair[:, 1 - along] = side
            ends.append(pair)
    axis = size * np.array([[x, y, FLOOR], [x, y, POLE_TOP]])
    rods = [(axis, size * (POLE_RADIUS if has_pole else ABSENT))]
    return Scene(
        inner=box(INNER_HALF, INNER_HEIGHT),
        inner_radius=leaf(0.0),
        outer=box(OUTER_HALF, OUTER_HEIGHT),
        floor=leaf(FLOOR),
        beam_ends=leaf(ends),
        beam_radius=leaf(np.full(4, RIG_RADIUS)),
        **_solids(rods, (), ()),
    )


def make_scene(
    *,
    boxes: Sequence[tuple[ArrayLike, ArrayLike, ArrayLike]] = (),
    spheres: Sequence[tuple[ArrayLike, float]] = (),
    capsules: Sequence[tuple[ArrayLike, float]] = (),
    cylinders: Sequence[tuple[ArrayLike, float]] = (),
    meshes: Sequence[tuple[str | os.PathLike | ArrayLike, float, ArrayLike, ArrayLike]] = (),
    floor: float = -100.0,
    protected_box: ArrayLike | None = None,
    protected_capsule: tuple[ArrayLike, float] | None = None,
    outer: ArrayLike | None = None,
) -> Scene:
    """Return a scene of solid obstacles, without a rig, with NumPy float32 leaves.

    A program is compiled for each combination of numbers of obstacles, where capsules and spheres,
    boxes, and cylinders are padded to 0, 1, 8 or 64 each. Meshes are planned as the enclosing
    capsules and boxes.

    Args:
        boxes: for each box its middle (3,) [m], the lengths of its edges (3,) [m], and its rotation
            as a quaternion w, x, y, z (4,) != 0.
        spheres: for each sphere its middle (3,) [m] and its radius [m].
        capsules: for each capsule the ends of its axis (2, 3) [m] and its radius [m].
        cylinders: for each cylinder the different ends of its axis (2, 3) [m] and its radius [m].
        meshes: for each mesh its STL, OBJ or MSH file or its points (N, 3), its unit of length [m],
            the position (3,) [m] of its origin, and its rotation as a quaternion w, x, y, z != 0.
            The obstacle is the mesh's convex hull. The planner encloses the hull by a box or by
            capsules, whichever exceed the hull less: see `Scene.meshes.excess`.
        floor: [m], height of the floor.
        protected_box: lowest and highest corner [m] of the box that blocks protect; by default the
            box of [Natarajan2024].
        protected_capsule: instead of a box, the ends of a capsule's axis (2, 3) [m] and the radius
            [m], > 0.
        outer: lowest and highest corner [m] of the box in which balls may be met; by default the
            box of [Natarajan2024].

    Raises:
        ArgumentError: an obstacle lacks a field, or a number is wrong. The line names the entry.
    """
    given = {"boxes": boxes, "spheres": spheres, "capsules": capsules, "cylinders": cylinders}
    solids = {kind: _read_solids(kind, each) for kind, each in (given | {"meshes": meshes}).items()}
    rounded = [(np.tile(middle, (2, 1)), radius) for middle, radius in solids["spheres"]]
    rounded += solids["capsules"]
    paper, capsule = paper_scene(), protected_capsule
    body, ends = protected_box, None
    if capsule is not None:
        require(protected_box is None, "protected_box", "left out beside protected_capsule", body)
        capsule = _read_solid("protected_capsule", capsule, "protected_capsule")
        body = np.sort(capsule[0], axis=0)
        require(bool(capsule[1] > 0.0), "protected_capsule.radius", "> 0", float(capsule[1]))
        if np.sum(np.ptp(body, axis=0) > 0.0) > 1:
            ends = host_leaf(capsule[0], np.float32)
    corners = {"protected_box": body, "outer": outer}
    body, outer = (x if x is None else read_numbers(k, x, (2, 3)) for k, x in corners.items())

    def box(corners: ArrayLike | None, usual: Box) -> Box:
        return usual if corners is None else Box(*host_leaf(corners, np.float32))

    return dataclasses.replace(
        paper,
        inner=box(body, paper.inner),
        inner_radius=host_leaf(0.0 if capsule is None else capsule[1], np.float32),
        outer=box(outer, paper.outer),
        floor=host_leaf(read_numbers("floor", floor, ()), np.float32),
        beam_ends=paper.beam_ends[:0],
        beam_radius=paper.beam_radius[:0],
        **_solids(rounded, solids["boxes"], solids["cylinders"]),
        meshes=_enclose(solids["meshes"]) if solids["meshes"] else None,
        inner_ends=ends,
    )


def _read_solids(kind: str, given: Any) -> list[tuple]:
    try:
        entries = [*given]
    except TypeError:
        raise ArgumentError(kind, "a list of obstacles", given) from None
    return [_read_solid(kind, entry, f"{kind}[{k}]") for k, entry in enumerate(entries)]


def _read_solid(kind: str, entry: object, place: str) -> tuple:
    """Return the numbers of an obstacle; raise an error with its place unless they are sound."""
    shapes = SOLIDS[kind]
    if not isinstance(entry, list | tuple) or len(entry) != len(shapes):
        raise ArgumentError(place, f"a tuple of {', '.join(shapes)}", entry)
    found = {
        name: value if shape is None else read_numbers(f"{place}.{name}", value, shape)
        for (name, shape), value in zip(shapes.items(), entry, strict=True)
    }
    rules = {
        "radius": (">= 0", lambda x: x >= 0.0),
        "size": ("> 0", lambda x: np.all(x > 0.0)),
        "scale": ("> 0", lambda x: x > 0.0),
        "turn": ("a quaternion other than 0", lambda x: np.linalg.norm(x) > _LEAST),
    }
    if kind == "cylinders":
        rules["ends"] = ("two different points", lambda x: np.linalg.norm(x[1] - x[0]) > _LEAST)
    for name in rules.keys() & found.keys():
        rule, holds = rules[name]
        require(bool(holds(found[name])), f"{place}.{name}", rule, found[name].tolist())
    return tuple(found.values())


def read_numbers(name: str, value: object, shape: tuple[int, ...]) -> np.ndarray:
    """Return finite numbers of a shape as float64; raise an `ArgumentError` for all else."""
    try:
        found = np.array(value, float)
        has_switch = any(isinstance(each, bool | np.bool_) for each in np.array(value, object).flat)
    except (TypeError, ValueError, OverflowError):
        found, has_switch = np.full(0, np.nan), False
    if found.shape != shape or has_switch or not np.isfinite(found).all():
        lists = " lists of ".join(map(str, shape))
        rule = f"{lists} finite numbers" if shape else "a finite number"
        raise ArgumentError(name, rule, value)
    return found


def _enclose(meshes: Sequence) -> Meshes:
    hulls, excess, capsules, boxes = [], [], [], []
    for k, (mesh, scale, position, turn) in enumerate(meshes):
        own = hull_of(mesh, float(scale), f"meshes[{k}]")
        rotation = Rotation.from_quat(np.roll(turn, -1))
        middle, axes, half = enclosing_box(own)
        corners = middle + [*itertools.product((-1.0, 1.0), repeat=3)] * half @ axes.T
        of_box = measure_excess(corners.reshape(4, 2, 3), np.zeros(4), own)
        fitted = cover(own, most=4)
        if is_boxed := of_box[1] <= fitted.mean:
            turn = np.roll((rotation * Rotation.from_matrix(axes)).as_quat(), 1)
            boxes.append((rotation.apply(middle) + position, 2.0 * half, turn))
        else:
            ends = [rotation.apply(each) + position for each in fitted.ends]
            capsules += zip(ends, fitted.radius, strict=True)
        hulls.append(rotation.apply(own) + position)
        excess.append(of_box if is_boxed else fitted[2:])
    most = max(map(len, hulls))
    corners = [np.pad(hull, ((0, most - len(hull)), (0, 0)), "edge") for hull in hulls]
    leaves = host_leaf(corners, np.float32), host_leaf(excess, np.float32)
    return Meshes(*leaves, _solids(capsules, boxes, ()))


def _solids(rods: Sequence, boxes: Sequence, cylinders: Sequence) -> dict[str, Any]:
    def column(solids: Sequence, k: int, *shape: int) -> np.ndarray:
        return np.reshape([solid[k] for solid in solids], (-1, *shape)).astype(float)

    turn = column(boxes, 2, 4)
    leaves = {
        "capsule_ends": column(rods, 0, 2, 3),
        "capsule_radius": column(rods, 1),
        "box_middle": column(boxes, 0, 3),
        "box_turn": turn / np.linalg.norm(turn, axis=1, keepdims=True),
        "box_half": 0.5 * column(boxes, 1, 3),
        "cylinder_ends": column(cylinders, 0, 2, 3),
        "cylinder_radius": column(cylinders, 1),
    }
    return {name: host_leaf(leaf, np.float32) for name, leaf in leaves.items()}
