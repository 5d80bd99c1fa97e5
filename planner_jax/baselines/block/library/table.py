"""The table of a library, with a stored motion for every pair of cells, and the lookup in it.

A lookup intersects the ball's parabola with the two boxes around the arm. Each crossing lies in a
cell of its box, and the pair of cells has one row in the table [Natarajan2024, Section IV-D2]. The
lookup contains no search, so that its time is the same for every ball. In addition to the paper's
lookup, this lookup computes when and where the ball crosses the plane of the shield.
"""

import dataclasses
import hashlib
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.baselines.block.library.cells import Layout, cell_of
from planner_jax.core.choices import require
from planner_jax.robot.arm import Arm, ArmLimits
from planner_jax.robot.arm_scene import Box, Scene
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.problem.flight import entry_time


@struct.dataclass
class Setting:
    """Arm, joint limits and scene for which motions are planned; without ball and start pose."""

    arm: Arm
    limits: ArmLimits
    ends_at_rest: Array  # () bool, whether motions end at standstill
    scene: Scene


def setting_of(case: BlockCase) -> Setting:
    """Return arm, limits and scene of a case, or of a batch of cases."""
    return Setting(
        arm=case.arm, limits=case.limits, ends_at_rest=case.ends_at_rest, scene=case.scene
    )


def fingerprint(setting: Setting) -> str:
    """Return a hash of arm, limits and scene in float32, as twelve hexadecimal digits."""
    arm = setting.arm
    bodies = arm.capsule_link, arm.pairs, arm.shield_pairs, arm.base_pairs
    digest = hashlib.sha256(repr(bodies).encode())
    for path, leaf in jax.tree_util.tree_leaves_with_path(setting):
        value = np.asarray(leaf)
        value = value.astype("<f4") if value.dtype.kind == "f" else value.astype("<i4")
        digest.update(f"{jax.tree_util.keystr(path)}{value.shape}".encode())
        digest.update(value.tobytes())
    return digest.hexdigest()[:12]


@struct.dataclass
class Table:
    """Stored motions from H start poses, for P pairs of a cell on the outer and the inner box."""

    rows: Array | np.ndarray  # (H, P, 6 K + 10) float32, fields of `Row` for motions of K pieces
    homes: Array | np.ndarray  # (H, 6) [rad], joint angles at which the motions start
    inner: Box
    outer: Box
    layout: Layout = struct.field(pytree_node=False)


class Row(NamedTuple):
    """A stored motion and the shield's pose at its end; batches have leading axes.

    It is a tuple, since Python creates a tuple ten times as fast as a dataclass.
    """

    steps: Array | np.ndarray  # (K, 6) [rad], joint rates at K knots, times the duration
    duration: Array | np.ndarray  # () [s]; infinite if no motion is stored
    middle: Array | np.ndarray  # (3,) [m], centre of the shield's face
    normal: Array | np.ndarray  # (3,) unit vector, normal of the shield
    edge: Array | np.ndarray  # (3,) unit vector along one edge of the shield


def pieces_of(rows: Array | np.ndarray) -> int:
    """Return the number K of polynomial pieces of a motion, from table rows (..., 6 K + 10)."""
    return (rows.shape[-1] - 10) // 6


def pack_rows(row: Row) -> np.ndarray:
    """Join the fields of motions of K pieces into table rows (..., 6 K + 10), in float32."""
    steps, duration = np.asarray(row.steps), np.asarray(row.duration)
    flat = steps.reshape(*steps.shape[:-2], -1)
    parts = (flat, duration[..., None], row.middle, row.normal, row.edge)
    return np.concatenate(parts, axis=-1).astype(np.float32)


def unpack_rows(values: Array | np.ndarray) -> Row:
    """Split table rows (..., 6 K + 10), for motions of K pieces, into their fields."""
    pieces = pieces_of(values)
    rest = values[..., 6 * pieces :]
    return Row(
        steps=values[..., : 6 * pieces].reshape(*values.shape[:-1], pieces, 6),
        duration=rest[..., 0],
        middle=rest[..., 1:4],
        normal=rest[..., 4:7],
        edge=rest[..., 7:10],
    )


class Answer(NamedTuple):
    """The motion stored for a ball, and where the ball crosses the plane of the shield."""

    row: Row
    pair: Array | int  # () int32, number of the pair of cells; 0 without a pair
    stored: Array | bool  # () bool, whether the ball passes two cells with a stored motion
    time: Array | float  # () [s], when the ball crosses the plane of the shield
    # () [s], time from the outer box to the shield's plane, or from the plane to the inner box,
    # whichever is less.
    slack: Array | float
    # Two values () [m], distances of the crossing from the shield's centre along its two edges.
    beside: tuple[Array | float, Array | float]
    cosine: Array | float  # (), of the angle between shield normal and reversed ball velocity


def lookup(table: Table, ball: BallState, gravity: Array, home: Array | int = 0) -> Answer:
    """Look up the motion for one ball, in constant time and without a search.

    Args:
        table: table of a library.
        ball: state of the ball at time 0.
        gravity: () [m/s^2], magnitude.
        home: () int32, index of the start pose at which the arm stands.
    """
    layout = table.layout

    def at(time: Array) -> tuple[list[Array], list[Array]]:
        x, y, z = (ball.pos[k] + ball.vel[k] * time for k in range(3))
        fall = gravity * time
        return [x, y, z - 0.5 * fall * time], [ball.vel[0], ball.vel[1], ball.vel[2] - fall]

    outside, enters = entry_time(table.outer, ball, gravity)
    inside, hits = entry_time(table.inner, ball, gravity)
    place, velocity = at(outside)
    first, is_first = cell_of(layout.outer, table.outer, place)
    last, is_last = cell_of(layout.inner, table.inner, at(inside)[0])
    passes = enters & hits & is_first & is_last & (inside > outside)
    pair = jnp.where(passes, first * layout.num_inner + last, 0)
    row = unpack_rows(table.rows[home, pair])
    # The distance from the shield's plane is a parabola in time; take the root where it decreases.
    middle, normal, edge = (tuple(each) for each in (row.middle, row.normal, row.edge))
    away = _dot(normal, _minus(place, middle))
    toward = -_dot(normal, velocity)
    root = jnp.sqrt(jnp.maximum(toward**2 + 2.0 * gravity * normal[2] * away, 0.0))
    after = 2.0 * away / jnp.maximum(toward + root, 1e-6)
    place, velocity = at(outside + after)
    across = _minus(place, middle)
    other = (
        normal[1] * edge[2] - normal[2] * edge[1],
        normal[2] * edge[0] - normal[0] * edge[2],
        normal[0] * edge[1] - normal[1] * edge[0],
    )
    speed = jnp.sqrt(jnp.maximum(_dot(velocity, velocity), 1e-12))
    return Answer(
        row=row,
        pair=pair,
        stored=passes & jnp.isfinite(row.duration),
        time=outside + after,
        slack=jnp.minimum(after, inside - outside - after),
        beside=(_dot(across, edge), _dot(across, other)),
        cosine=-_dot(normal, velocity) / speed,
    )


def _minus(a: Sequence[Array], b: Sequence[Array]) -> list[Array]:
    return [x - y for x, y in zip(a, b, strict=True)]


def _dot(a: Sequence[Array], b: Sequence[Array]) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@struct.dataclass
class Library:
    """A library: the table of stored motions, and the setting for which they were planned."""

    table: Table
    setting: Setting

    @property
    def found(self) -> np.ndarray:
        """Mask (H, P) bool of stored motions: H start poses, P pairs of cells on two boxes."""
        return np.isfinite(np.asarray(unpack_rows(self.table.rows).duration))

    @property
    def num_bytes(self) -> int:
        """The size of the table's arrays in bytes."""
        return sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(self.table))


def library_of(
    rows: Array | np.ndarray, homes: Array | np.ndarray, layout: Layout, setting: Setting
) -> Library:
    """Create a library from H start poses `homes` (H, 6) [rad] and the motions that start there.

    `rows` (H, P, W) has the motions for P pairs of cells, as W numbers from `pack_rows`. `layout`
    has the cells, and `setting` the arm, limits and scene for which the motions were planned.
    """
    scene = setting.scene
    radius = float(scene.inner_radius)
    require(radius == 0.0, "scene.inner_radius", "0 for stored motions", radius)
    require(scene.meshes is None, "scene", "without meshes for stored motions", shown="meshes")
    table = Table(rows=rows, homes=homes, inner=scene.inner, outer=scene.outer, layout=layout)
    return Library(table=table, setting=setting)


def with_scene(library: Library, scene: Scene) -> Library:
    """Return a library with the same motions and another scene; its two boxes must be the same.

    Raises:
        ArgumentError: a box of the new scene differs from the library's box.
    """
    own = library.setting.scene
    for name, old, new in (("inner", own.inner, scene.inner), ("outer", own.outer, scene.outer)):
        is_same = np.array_equal([old.lower, old.upper], [new.lower, new.upper])
        require(is_same, f"scene.{name}", "the library's", shown="another box")
    return dataclasses.replace(library, setting=dataclasses.replace(library.setting, scene=scene))
