"""Cells on the faces of both boxes, the tunnels between them, and what a shield covers of these.

[Natarajan2024] calls the boxes domes (Section IV-C). It gives neither the number of cells nor the
faces that have any; `LAYOUTS` has those that are used here. A pair is a cell of the outer box and
one of the inner box: pair `outer * num_inner + inner`. Cells are numbered face by face; on a face
by its axes in the order x, y, z, the last one fastest. Robot base frame, z up, SI units.
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
    """A face of a box that is cut into equal cells; static."""

    axis: int  # of its normal: 0 x, 1 y, 2 z
    side: int  # 1 where it faces along the axis, -1 where against it
    cells: tuple[int, int]  # along the two other axes

    @property
    def num(self) -> int:
        """How many cells."""
        return self.cells[0] * self.cells[1]

    @property
    def across(self) -> tuple[int, int]:
        """The two axes along the face."""
        first, second = (axis for axis in range(3) if axis != self.axis)
        return first, second

    @property
    def name(self) -> str:
        """Such as +x."""
        return f"{'-+'[self.side > 0]}{'xyz'[self.axis]}"


@dataclasses.dataclass(frozen=True)
class Layout:
    """Which faces of both boxes have cells; static."""

    outer: tuple[Face, ...]
    inner: tuple[Face, ...]

    @property
    def num_outer(self) -> int:
        """Cells of the outer box."""
        return sum(face.num for face in self.outer)

    @property
    def num_inner(self) -> int:
        """Cells of the inner box."""
        return sum(face.num for face in self.inner)

    @property
    def num_pairs(self) -> int:
        """Pairs of cells, those among them that no ball can pass through, too."""
        return self.num_outer * self.num_inner


def _faces(names: str, cells: tuple[int, int]) -> tuple[Face, ...]:
    """Return faces by names such as "+x +y", with as many cells each."""
    return tuple(
        Face("xyz".index(name[1]), 1 if name[0] == "+" else -1, cells) for name in names.split()
    )


# The paper's authors plan for 5,760 pairs (a constant of their code); A to C are three ways to
# come to as many. D has cells on all sides that balls from ahead can get to, the default on the
# outer box's top besides, through which lobbed ones come.
LAYOUTS = {
    "full": Layout(_faces("+x +y -y +z", (8, 8)), _faces("+x +y -y", (4, 7))),
    "A": Layout(_faces("+x +y -y", (8, 8)), _faces("+x +z", (3, 5))),
    "B": Layout(_faces("+x +y", (8, 8)), _faces("+x +y -y", (3, 5))),
    "C": Layout(_faces("+x", (10, 9)), _faces("+x +z", (4, 8))),
    "D": Layout(_faces("+x +y -y", (8, 8)), _faces("+x +y -y", (4, 7))),
}


def cell_of(faces: tuple[Face, ...], box: Box, point: Sequence[Array]) -> tuple[Array, Array]:
    """Return the cell in which a point of a box's surface lies, in closed form.

    The point is of the face that it is farthest out towards, in shares of the box; where these are
    equal, as on an edge, of the face across the first axis. What lies between two cells is of the
    one with the greater coordinate.

    Args:
        faces: that have cells.
        box: the whole box.
        point: three numbers () [m]; rounding may put it off the surface.

    Returns:
        cell: () int32, its number; 0 where there is none.
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
        faces: that have cells.
        box: the whole box.
        point: three numbers () [m]; its face is that of `cell_of`.

    Returns:
        cells: (4,) int32, their numbers; where a face has only one cell across, it is there twice.
        away: (4,), square of the distance from the point to their middles, in cells.
        found: () bool, whether the face has cells.
    """
    own, found = cell_of(faces, box, point)
    share = [(point[k] - box.lower[k]) / (box.upper[k] - box.lower[k]) for k in range(3)]
    cells, away, begin = jnp.zeros(4, jnp.int32), jnp.zeros(4, share[0].dtype), 0
    for face in faces:
        places = []
        for axis, count in zip(face.across, face.cells, strict=True):
            place = share[axis] * count - 0.5  # in cells, from the middle of the first
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

    outer: np.ndarray  # (P, 2, 3) [m], corners of the part of the outer cell that sees the inner
    inner: np.ndarray  # (P, 2, 3) [m], corners of the inner cell, lowest and highest
    is_feasible: np.ndarray  # (P,) bool, whether a ball can get from the one into the other
    is_centred: np.ndarray  # (P,) bool, whether one from the middle of the outer cell can


def tunnels(layout: Layout, inner: Box, outer: Box) -> Tunnels:
    """Return the tunnels between the cells of two boxes.

    A ball gets to an inner cell only from in front of that cell's face. The outer cell is therefore
    cut off at the plane of this face; what is left is again a rectangle, and as both boxes are
    convex, every straight line from it to the inner cell is free. Where nothing is left, the pair
    is one of those that the paper discards: its tunnel "snaps to zero".
    """
    from_outer, _ = _corners(layout.outer, outer)
    to_inner, of_face = _corners(layout.inner, inner)
    pairs = np.indices((len(from_outer), len(to_inner))).reshape(2, -1)
    begin, end = from_outer[pairs[0]].copy(), to_inner[pairs[1]]
    axis = np.array([face.axis for face in layout.inner])[of_face[pairs[1]]]
    side = np.array([face.side for face in layout.inner])[of_face[pairs[1]]]
    rows = np.arange(len(begin))
    plane = end[rows, 0, axis]  # both corners lie in it
    middle = begin.mean(axis=1)[rows, axis]
    # Towards a face along its axis the lower corner moves, else the higher one.
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
    """Return the ball that represents a tunnel: from the middle of one cell to the other middle.

    Args:
        outer: (2, 3) [m], corners of the outer cell, lowest and highest.
        inner: (2, 3) [m], of the inner one.

    Returns:
        ball: as it gets into the outer box.
        span: () [s], until it gets into the inner one, at `SPEED` along the straight line.
    """
    begin = jnp.mean(outer, axis=0)
    way = jnp.mean(inner, axis=0) - begin
    span = jnp.sqrt(jnp.sum(way**2)) / SPEED
    vel = way / span + jnp.zeros_like(way).at[2].set(0.5 * GRAVITY * span)
    return BallState(pos=begin, vel=vel), span


def farthest_crossing(outer: Array, inner: Array, middle: Array, rotation: Array) -> Array:
    """Return how far from a shield's middle the balls of a tunnel cross its plane.

    All straight lines from a rectangle to another one cross a plane between the two within the
    convex hull of the crossings of the lines from corner to corner: with one end held, the crossing
    is a projection of the other, which keeps convex sets convex. Balls are taken to be above these
    lines by as much as the nominal ball there.

    Args:
        outer: (2, 3) [m], corners of a rectangle along the axes, lowest and highest.
        inner: (2, 3) [m], likewise.
        middle: (3,) [m], of the shield's face.
        rotation: (3, 3), of the shield: its normal and its edges are the columns.

    Returns:
        () [m], along the shield's edges, the greatest of both; infinite where the plane is not
        between the rectangles. A shield whose half edge is longer blocks the whole tunnel.
    """
    ball, span = nominal_ball(outer, inner)
    way = jnp.mean(inner, axis=0) - ball.pos
    time = span * jnp.clip(jnp.sum((middle - ball.pos) * way) / jnp.sum(way**2), 0.0, 1.0)
    middle = middle.at[2].add(-0.5 * GRAVITY * time * (span - time))
    begin, end = ((_corners_of(each) - middle) for each in (outer, inner))
    begin, end = (product(each, rotation) for each in (begin, end))  # (8, 3), along the shield's
    between = jnp.all(begin[:, 0] > 0.0) & jnp.all(end[:, 0] < 0.0)
    share = begin[:, None, 0] / jnp.where(between, begin[:, None, 0] - end[:, 0], 1.0)
    crossings = begin[:, None, 1:] + share[..., None] * (end[:, 1:] - begin[:, None, 1:])
    return jnp.where(between, jnp.max(jnp.abs(crossings)), jnp.inf)


def _corners_of(box: Array) -> Array:
    """Return the corners (8, 3) of a box along the axes (2, 3); a flat box has each one twice."""
    high = np.indices((2, 2, 2)).reshape(3, 8).T == 1
    return jnp.where(high, box[1], box[0])
