"""Cells on the faces of both boxes, tunnels between them, and the part that a shield covers.

[Natarajan2024] calls the boxes domes (Section IV-C). It specifies neither the number of cells nor
the faces that have cells; `LAYOUTS` has the layouts of this library. A pair is a cell of the outer
box and one of the inner box, numbered `outer * num_inner + inner`. Cells are numbered face by face;
on a face by its axes in the order x, y, z, the last one fastest. Robot base frame, z up, SI units.
"""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.robot.arm import product
from planner_jax.task.block.scene import Box

SPEED = 8.0  # [m/s], of nominal balls
GRAVITY = 9.81  # [m/s^2]


@dataclasses.dataclass(frozen=True)
class Face:
    """A face of a box that is divided into equal cells; static."""

    axis: int  # axis of its normal: 0 x, 1 y, 2 z
    side: int  # 1 if its normal points along the axis, -1 if against it
    cells: tuple[int, int]  # number along each of the two other axes

    @property
    def num(self) -> int:
        """The number of cells."""
        return self.cells[0] * self.cells[1]

    @property
    def across(self) -> tuple[int, int]:
        """The two axes along the face."""
        first, second = (axis for axis in range(3) if axis != self.axis)
        return first, second

    @property
    def name(self) -> str:
        """The name, such as +x."""
        return f"{'-+'[self.side > 0]}{'xyz'[self.axis]}"


@dataclasses.dataclass(frozen=True)
class Layout:
    """The faces of both boxes that have cells; static."""

    outer: tuple[Face, ...]
    inner: tuple[Face, ...]

    @property
    def num_outer(self) -> int:
        """The number of cells of the outer box."""
        return sum(face.num for face in self.outer)

    @property
    def num_inner(self) -> int:
        """The number of cells of the inner box."""
        return sum(face.num for face in self.inner)

    @property
    def num_pairs(self) -> int:
        """The number of pairs of cells, including pairs that no ball can pass."""
        return self.num_outer * self.num_inner


def _faces(names: str, cells: tuple[int, int]) -> tuple[Face, ...]:
    """Return faces by names such as "+x +y", each with the same number of cells."""
    return tuple(
        Face("xyz".index(name[1]), 1 if name[0] == "+" else -1, cells) for name in names.split()
    )


# The paper's authors plan for 5,760 pairs (a constant of their code); A to C are three layouts with
# this number. D has cells on all sides that balls from ahead can reach. The default "full" also has
# cells on the top of the outer box, through which lobbed balls come.
LAYOUTS = {
    "full": Layout(_faces("+x +y -y +z", (8, 8)), _faces("+x +y -y", (4, 7))),
    "A": Layout(_faces("+x +y -y", (8, 8)), _faces("+x +z", (3, 5))),
    "B": Layout(_faces("+x +y", (8, 8)), _faces("+x +y -y", (3, 5))),
    "C": Layout(_faces("+x", (10, 9)), _faces("+x +z", (4, 8))),
    "D": Layout(_faces("+x +y -y", (8, 8)), _faces("+x +y -y", (4, 7))),
}


def cell_of(faces: tuple[Face, ...], box: Box, point: Sequence[Array]) -> tuple[Array, Array]:
    """Return the cell that contains a point of a box's surface, in closed form.

    The point belongs to the face towards which it is farthest out, relative to the size of the box.
    On an edge, where these fractions are equal, it belongs to the face of the first axis. A point
    between two cells belongs to the one with the greater coordinate.

    Args:
        faces: faces that have cells.
        box: the whole box.
        point: three numbers () [m]; rounding may move it off the surface.

    Returns:
        cell: () int32, its number; 0 without a cell.
        found: () bool, whether the face has cells.
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


def cells_around(
    faces: tuple[Face, ...], box: Box, point: Sequence[Array]
) -> tuple[Array, Array, Array]:
    """Return the cells nearest to a point of a box's surface, up to two in each direction.

    Args:
        faces: faces that have cells.
        box: the whole box.
        point: three numbers () [m]; `cell_of` selects its face.

    Returns:
        cells: (4,) int32, their numbers; repeated if a face has only one cell in a direction.
        away: (4,), squared distance from the point to their centres, in cells.
        found: () bool, whether the face has cells.
    """
    own, found = cell_of(faces, box, point)
    share = [(point[k] - box.lower[k]) / (box.upper[k] - box.lower[k]) for k in range(3)]
    cells, away, begin = jnp.zeros(4, jnp.int32), jnp.zeros(4, share[0].dtype), 0
    for face in faces:
        places = []
        for axis, count in zip(face.across, face.cells, strict=True):
            place = share[axis] * count - 0.5  # in cells, from the centre of the first cell
            lower = jnp.clip(jnp.floor(place), 0, max(count - 2, 0))
            pair = jnp.minimum(jnp.stack([lower, lower + 1.0]), count - 1.0)
            places.append((pair.astype(jnp.int32), (pair - place) ** 2))
        (first, first_away), (second, second_away) = places
        there = (own >= begin) & (own < begin + face.num)
        of_face = begin + first[:, None] * face.cells[1] + second
        cells = jnp.where(there, of_face.reshape(-1), cells)
        away = jnp.where(there, (first_away[:, None] + second_away).reshape(-1), away)
        begin += face.num
    return cells, away, found


@struct.dataclass
class Tunnels:
    """The tunnels of all pairs of a layout, NumPy float64 leaves."""

    outer: np.ndarray  # (P, 2, 3) [m], corners of the outer cell's part in front of the inner cell
    inner: np.ndarray  # (P, 2, 3) [m], corners of the inner cell, lowest and highest
    is_feasible: np.ndarray  # (P,) bool, whether a ball can pass from one cell to the other
    is_centred: np.ndarray  # (P,) bool, whether a ball from the centre of the outer cell can


def tunnels(layout: Layout, inner: Box, outer: Box) -> Tunnels:
    """Return the tunnels between the cells of two boxes.

    A ball reaches an inner cell only from in front of that cell's face. The outer cell is therefore
    cut off at the plane of this face. The remainder is a rectangle, and since both boxes are
    convex, every straight line from it to the inner cell is free. A pair without a remainder is one
    of the pairs that the paper discards: its tunnel "snaps to zero".
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
    # The corner behind the plane is moved to the plane.
    near, far = np.where(side > 0, 0, 1), np.where(side > 0, 1, 0)
    begin[rows, near, axis] = side * np.maximum(side * begin[rows, near, axis], side * plane)
    feasible = side * (begin[rows, far, axis] - plane) > 1e-6
    return Tunnels(
        outer=begin,
        inner=end,
        is_feasible=feasible,
        is_centred=side * (middle - plane) > 1e-6,
    )


def _corners(faces: tuple[Face, ...], box: Box) -> tuple[np.ndarray, np.ndarray]:
    """Return the extreme corners (N, 2, 3) [m] of all cells, and the indices (N,) of faces."""
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
    """Return the ball that represents a tunnel, from cell centre to cell centre.

    Args:
        outer: (2, 3) [m], corners of the outer cell, lowest and highest.
        inner: (2, 3) [m], corners of the inner cell.

    Returns:
        ball: as it enters the outer box.
        span: () [s], until it enters the inner box, at `SPEED` along the straight line.
    """
    begin = jnp.mean(outer, axis=0)
    path = jnp.mean(inner, axis=0) - begin
    span = jnp.sqrt(jnp.sum(path**2)) / SPEED
    vel = path / span + jnp.zeros_like(path).at[2].set(0.5 * GRAVITY * span)
    return BallState(pos=begin, vel=vel), span


def farthest_crossing(outer: Array, inner: Array, middle: Array, rotation: Array) -> Array:
    """Return how far from a shield's centre the balls of a tunnel cross its plane at most.

    All straight lines from a rectangle to another one cross a plane between the two within the
    convex hull of the crossings of the lines from corner to corner: for one fixed end, the crossing
    is a projection of the other end, and projections keep convex sets convex. Balls are assumed to
    be as far above these lines as the nominal ball is above its line.

    Args:
        outer: (2, 3) [m], corners of an axis-aligned rectangle, lowest and highest.
        inner: (2, 3) [m], corners of the other rectangle.
        middle: (3,) [m], centre of the shield's face.
        rotation: (3, 3), of the shield: its normal and its edges are the columns.

    Returns:
        () [m], the maximum over both edge directions of the shield; infinite if the plane is not
        between the rectangles. A shield with a longer half edge blocks the whole tunnel.
    """
    ball, span = nominal_ball(outer, inner)
    path = jnp.mean(inner, axis=0) - ball.pos
    time = span * jnp.clip(jnp.sum((middle - ball.pos) * path) / jnp.sum(path**2), 0.0, 1.0)
    middle = middle.at[2].add(-0.5 * GRAVITY * time * (span - time))
    begin, end = ((_corners_of(each) - middle) for each in (outer, inner))
    begin, end = (product(each, rotation) for each in (begin, end))  # (8, 3), along the shield's
    between = jnp.all(begin[:, 0] > 0.0) & jnp.all(end[:, 0] < 0.0)
    share = begin[:, None, 0] / jnp.where(between, begin[:, None, 0] - end[:, 0], 1.0)
    crossings = begin[:, None, 1:] + share[..., None] * (end[:, 1:] - begin[:, None, 1:])
    return jnp.where(between, jnp.max(jnp.abs(crossings)), jnp.inf)


def _corners_of(box: Array) -> Array:
    """Return the corners (8, 3) of an axis-aligned box (2, 3); a flat box repeats each corner."""
    high = np.indices((2, 2, 2)).reshape(3, 8).T == 1
    return jnp.where(high, box[1], box[0])
