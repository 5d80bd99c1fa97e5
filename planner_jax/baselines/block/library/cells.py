"""Division of two boxes around the arm into cells, by which libraries of motions are indexed.

The inner box is protected from balls; in the outer box the arm may meet a ball. Cells are equal
rectangles on the faces of both boxes. A ball passes one cell of the outer box and then one cell of
the inner box. The two cells are a pair, with the number `outer * num_inner + inner` from the
numbers of the two cells. The space between the cells is a tunnel. [Natarajan2024, Section IV-C]
calls the boxes domes. The paper specifies neither the number of cells nor the faces that have
cells; `LAYOUTS` has the layouts of this library. Cells are numbered face by face. All positions are
in the robot's base frame, z up, in SI units.
"""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.core import GRAVITY
from planner_jax.robot.arm import product
from planner_jax.robot.arm_scene import Box

SPEED = 8.0  # [m/s], speed of the ball that stands for all balls through one pair of cells


@dataclasses.dataclass(frozen=True)
class Face:
    """A face of a box that is divided into equal rectangular cells."""

    axis: int  # axis of the face's normal: 0 x, 1 y, 2 z
    side: int  # 1 if the normal points along the axis, -1 if against it
    cells: tuple[int, int]  # number of cells along each of the two other axes

    @property
    def num(self) -> int:
        """The number of cells, equal rectangles, into which the face is divided."""
        return self.cells[0] * self.cells[1]

    @property
    def across(self) -> tuple[int, int]:
        """The indices of the two axes along the face: 0 x, 1 y, 2 z."""
        first, second = (axis for axis in range(3) if axis != self.axis)
        return first, second

    @property
    def name(self) -> str:
        """The name: sign and axis of the normal, such as +x."""
        return f"{'-+'[self.side > 0]}{'xyz'[self.axis]}"


@dataclasses.dataclass(frozen=True)
class Layout:
    """The faces of the outer and of the inner box around the arm that are divided into cells."""

    outer: tuple[Face, ...]
    inner: tuple[Face, ...]

    @property
    def num_outer(self) -> int:
        """The number of cells of the outer box, in which the arm may meet a ball."""
        return sum(face.num for face in self.outer)

    @property
    def num_inner(self) -> int:
        """The number of cells of the inner box, which is protected from balls."""
        return sum(face.num for face in self.inner)

    @property
    def num_pairs(self) -> int:
        """The number of pairs of an outer and an inner cell, even if no ball can pass both."""
        return self.num_outer * self.num_inner


def _faces(names: str, cells: tuple[int, int]) -> tuple[Face, ...]:
    return tuple(
        Face("xyz".index(name[1]), 1 if name[0] == "+" else -1, cells) for name in names.split()
    )


# Faces of the outer, then the inner box (+x is its front), with numbers of cells along the other
# two axes, in the order x, y, z. A, B and C have 5,760 pairs of cells, as the code of
# [Natarajan2024]. The default "full" has cells on the outer top, too, for lobbed balls.
LAYOUTS = {
    "full": Layout(_faces("+x +y -y +z", (8, 8)), _faces("+x +y -y", (4, 7))),
    "A": Layout(_faces("+x +y -y", (8, 8)), _faces("+x +z", (3, 5))),
    "B": Layout(_faces("+x +y", (8, 8)), _faces("+x +y -y", (3, 5))),
    "C": Layout(_faces("+x", (10, 9)), _faces("+x +z", (4, 8))),
    "D": Layout(_faces("+x +y -y", (8, 8)), _faces("+x +y -y", (4, 7))),
}


def cell_of(faces: tuple[Face, ...], box: Box, point: Sequence[Array]) -> tuple[Array, Array]:
    """Return the cell that contains a point of a box's surface.

    A point on an edge of the box belongs to the face whose normal is first in the order x, y, z. A
    point on the border of two cells belongs to the cell with the greater coordinate.

    Args:
        faces: the faces of the box that are divided into cells.
        box: the box.
        point: three coordinates () [m]; rounding errors may move the point off the surface.

    Returns:
        cell: () int32, number of the cell; 0 if the point's face has no cells.
        found: () bool, whether the point's face has cells.
    """
    share = [(point[k] - box.lower[k]) / (box.upper[k] - box.lower[k]) for k in range(3)]
    x, y, z = (jnp.abs(2.0 * each - 1.0) for each in share)
    is_axis = ((x >= y) & (x >= z), (y > x) & (y >= z), (z > x) & (z > y))
    begin, cell, found = 0, jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    for face in faces:
        there = is_axis[face.axis] & (face.side * (share[face.axis] - 0.5) > 0.0)
        first, second = (
            jnp.clip(jnp.floor(share[axis] * count).astype(jnp.int32), 0, count - 1)
            for axis, count in zip(face.across, face.cells, strict=True)
        )
        cell = jnp.where(there, begin + first * face.cells[1] + second, cell)
        found = found | there
        begin += face.num
    return cell, found


@struct.dataclass
class Tunnels:
    """The P spaces (tunnels), each from a cell of the outer to a cell of the inner box; float64."""

    outer: np.ndarray  # (P, 2, 3) [m], corners of the outer cell's part in front of the inner cell
    inner: np.ndarray  # (P, 2, 3) [m], corners of the inner cell, lowest and highest
    is_feasible: np.ndarray  # (P,) bool, whether a ball can pass from one cell to the other
    is_centred: np.ndarray  # (P,) bool, whether a ball from the outer cell's centre can pass both


def tunnels(layout: Layout, inner: Box, outer: Box) -> Tunnels:
    """Return the tunnel of every pair of cells: the space between an outer and an inner cell.

    A ball reaches an inner cell only from in front of that cell's face. The part of the outer cell
    behind the plane of this face is therefore cut off. If nothing remains of the outer cell, no
    ball can pass both cells.
    """
    from_outer, _ = _corners(layout.outer, outer)
    to_inner, of_face = _corners(layout.inner, inner)
    pairs = np.indices((len(from_outer), len(to_inner))).reshape(2, -1)
    begin, end = from_outer[pairs[0]].copy(), to_inner[pairs[1]]
    axis = np.array([face.axis for face in layout.inner])[of_face[pairs[1]]]
    side = np.array([face.side for face in layout.inner])[of_face[pairs[1]]]
    rows = np.arange(len(begin))
    plane = end[rows, 0, axis]  # coordinate of the inner cell's face
    middle = begin.mean(axis=1)[rows, axis]
    near, far = np.where(side > 0, 0, 1), np.where(side > 0, 1, 0)
    begin[rows, near, axis] = side * np.maximum(side * begin[rows, near, axis], side * plane)
    feasible = side * (begin[rows, far, axis] - plane) > 1e-6
    return Tunnels(
        outer=begin, inner=end, is_feasible=feasible, is_centred=side * (middle - plane) > 1e-6
    )


def _corners(faces: tuple[Face, ...], box: Box) -> tuple[np.ndarray, np.ndarray]:
    """Return two opposite corners (N, 2, 3) [m] of N cells, and the indices (N,) of their faces."""
    lower, upper = np.asarray(box.lower, float), np.asarray(box.upper, float)
    found, of_face = [], []
    for place, face in enumerate(faces):
        corners = np.empty((*face.cells, 2, 3))
        corners[..., face.axis] = (upper if face.side > 0 else lower)[face.axis]
        for k, (axis, count) in enumerate(zip(face.across, face.cells, strict=True)):
            edges = np.linspace(lower[axis], upper[axis], count + 1)
            shape = (count, 1) if k == 0 else (1, count)
            corners[..., 0, axis] = edges[:-1].reshape(shape)
            corners[..., 1, axis] = edges[1:].reshape(shape)
        found.append(corners.reshape(-1, 2, 3))
        of_face.append(np.full(face.num, place))
    return np.concatenate(found), np.concatenate(of_face)


def nominal_ball(outer: Array, inner: Array) -> tuple[BallState, Array]:
    """Return a ball that flies between the centres of a cell of the outer and of the inner box.

    Args:
        outer: (2, 3) [m], corners of the outer cell, lowest and highest.
        inner: (2, 3) [m], corners of the inner cell, lowest and highest.

    Returns:
        ball: state of the ball as it enters the outer box.
        span: () [s], time from the outer to the inner box: their distance / (8 m/s).
    """
    begin = jnp.mean(outer, axis=0)
    path = jnp.mean(inner, axis=0) - begin
    span = jnp.sqrt(jnp.sum(path**2)) / SPEED
    vel = path / span + jnp.zeros_like(path).at[2].set(0.5 * GRAVITY * span)
    return BallState(pos=begin, vel=vel), span


def farthest_crossing(outer: Array, inner: Array, middle: Array, rotation: Array) -> Array:
    """Return the largest distance from a shield's centre at which balls cross the shield's plane.

    The balls fly from one rectangle (cell) to another. They cross the plane within the convex hull
    of the crossings of all straight lines from corner to corner. A ball's height above its straight
    line is taken from the nominal ball, which flies between the rectangles' centres.

    Args:
        outer: (2, 3) [m], corners of an axis-aligned rectangle, lowest and highest.
        inner: (2, 3) [m], corners of the other rectangle.
        middle: (3,) [m], centre of the shield's face.
        rotation: (3, 3), orientation of the shield: its normal and its edges are the columns.

    Returns:
        () [m], measured along the edges of the shield; infinite if the plane is not between the
        rectangles. A shield blocks all balls if half of its edge is longer.
    """
    ball, span = nominal_ball(outer, inner)
    path = jnp.mean(inner, axis=0) - ball.pos
    time = span * jnp.clip(jnp.sum((middle - ball.pos) * path) / jnp.sum(path**2), 0.0, 1.0)
    middle = middle.at[2].add(-0.5 * GRAVITY * time * (span - time))
    begin, end = ((_corners_of(each) - middle) for each in (outer, inner))
    begin, end = (product(each, rotation) for each in (begin, end))  # (8, 3), in the shield's frame
    between = jnp.all(begin[:, 0] > 0.0) & jnp.all(end[:, 0] < 0.0)
    share = begin[:, None, 0] / jnp.where(between, begin[:, None, 0] - end[:, 0], 1.0)
    crossings = begin[:, None, 1:] + share[..., None] * (end[:, 1:] - begin[:, None, 1:])
    return jnp.where(between, jnp.max(jnp.abs(crossings)), jnp.inf)


def _corners_of(box: Array) -> Array:
    """Return the corners (8, 3) of an axis-aligned box (2, 3); a flat box repeats each corner."""
    high = np.indices((2, 2, 2)).reshape(3, 8).T == 1
    return jnp.where(high, box[1], box[0])
