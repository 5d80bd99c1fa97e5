"""The shield of an arm: its outline, its pose at the last link, and its inertia."""

import dataclasses
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from planner_jax.core.checks import numbers_of, require_number, require_numeric
from planner_jax.core.choices import require
from planner_jax.core.rules import NOT_NEGATIVE, POSITIVE
from planner_jax.robot.arm_chain import ArmModel

THICKNESS = 0.01  # [m], of a shield's plate
_SIDES = 32  # number of corners of the polygon in a disc


@dataclasses.dataclass(frozen=True)
class Shield:
    """A flat shield, 0.01 m thick, at the tip of an arm: a rectangle, a disc or a convex polygon.

    The origin of the shield's frame is the middle of the front face. The axis x is the outward
    normal, y and z are parallel to the edges. By default x is the axis z of the tip, as for the
    frame `tool0` of ROS. One of `half`, `radius` and `corners` describes the outline; without them
    the shield is a square of 0.30 m. Collisions are tested with a rectangle around the outline.

    Attributes:
        half: [m], halves of a rectangle's edges along y and z.
        radius: [m], radius of a disc, whose outline is a regular polygon in the circle.
        corners: [m], corners (y, z) of a convex polygon in their order around the middle, which is
            inside.
        position: [m], position of the shield's middle in the frame of the tip.
        turn: unit quaternion w, x, y, z: rotation of the shield's frame in the frame of the tip.
        mass: [kg], mass of the plate, spread evenly.
    """

    half: tuple[float, float] | None = None
    radius: float | None = None
    corners: tuple[tuple[float, float], ...] | list | None = None
    position: tuple[float, float, float] = (0.0, 0.0, 0.02)
    turn: tuple[float, float, float, float] = (0.5**0.5, 0.0, -(0.5**0.5), 0.0)
    mass: float = 0.0

    def __post_init__(self) -> None:
        given = [x for x in (self.half, self.radius, self.corners) if x is not None]
        rule = "described by one of half, radius and corners"
        require(len(given) <= 1, "the shield", rule, shown=f"{len(given)} of them")
        if not given:
            object.__setattr__(self, "half", (0.15, 0.15))
        if self.half is not None:
            half = numbers_of("shield.half", self.half, (), (2,))
            require(bool((half > 0.0).all()), "shield.half", "> 0", self.half)
        if self.radius is not None:
            require_number("shield.radius", self.radius, POSITIVE)
        numbers_of("shield.position", self.position, (), (3,))
        turn = numbers_of("shield.turn", self.turn, (), (4,))
        corners = self.outline
        turns = corners[:, 0] + 1j * corners[:, 1]
        sides = np.roll(turns, -1) - turns
        # The polygon is convex around the middle if its corners and its sides turn once.
        angles = [np.angle(np.roll(each, -1) * each.conj()) for each in (turns, sides)]
        is_convex = all(bool(np.all(x > 1e-9)) and np.sum(x) < 6.3 for x in angles)
        rule = "corners of a convex polygon around (0, 0), in their order"
        require(bool(is_convex), "shield.corners", rule, self.corners)
        require_number("shield.mass", self.mass, NOT_NEGATIVE)
        require(bool(turn.any()), "shield.turn", "a quaternion other than zero", self.turn)

    @property
    def outline(self) -> np.ndarray:
        """Corners (K, 2) [m] of the shield along y and z, counterclockwise."""
        if self.half is not None:
            return _rectangle(np.array(self.half, float))
        if self.radius is not None:
            angles = np.arange(_SIDES) * (2.0 * np.pi / _SIDES)
            return self.radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        corners = np.array(require_numeric("shield.corners", self.corners), float)
        is_list = corners.ndim == 2 and corners.shape[1] == 2 and len(corners) > 2
        rule = "at least three corners (y, z)"
        is_sound = is_list and bool(np.isfinite(corners).all())
        require(is_sound, "shield.corners", rule, self.corners)
        (y, z), (y_next, z_next) = corners.T, np.roll(corners, -1, axis=0).T
        return corners if np.sum(y * z_next - z * y_next) > 0.0 else corners[::-1]


def _rectangle(half: np.ndarray) -> np.ndarray:
    return half * np.array([(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)])


class Mount(NamedTuple):
    """A shield in the frame of the last link."""

    centre: np.ndarray  # (3,) [m], middle of the front face
    turn: np.ndarray  # (3, 3), rotation of the shield's frame
    corners: np.ndarray  # (K, 2) [m], of the outline; 0 without a shield
    mass: float = 0.0  # [kg], in addition to the masses of the file's bodies
    geom: int = -1  # index of the file's geom that is the shield, or -1

    @property
    def half(self) -> np.ndarray:
        """Halves of the edges (2,) [m] of a rectangle around the middle with the outline in it."""
        return np.max(np.abs(self.corners), axis=0)


def inertia_of(mount: Mount) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Return mass, centre and inertia of a shield that is not a body of the file, in a list."""
    if not mount.mass:
        return []
    # Triangles of the middle and a side have the corners 0, a and b, and the area  a x b / 2. The
    # integral of p p^T over a triangle is  area / 12 (a a^T + b b^T + (a + b) (a + b)^T).
    a, b = mount.corners, np.roll(mount.corners, -1, axis=0)
    share = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    share = share / np.sum(share)
    middle = np.array([-0.5 * THICKNESS, *(share @ (a + b) / 3.0)])
    spread = np.diag([THICKNESS**2 / 12.0, 0.0, 0.0])
    spread[1:, 1:] = sum((share[:, None] * x).T @ x for x in (a, b, a + b)) / 12.0
    spread[1:, 1:] -= np.outer(middle[1:], middle[1:])
    inertia = mount.mass * (np.trace(spread) * np.eye(3) - spread)
    centre = mount.centre + mount.turn @ middle
    return [(mount.mass, centre, mount.turn @ inertia @ mount.turn.T)]


def mount_shield(model: ArmModel, shield: Shield | None, usual: Shield | None) -> Mount:
    """Return the shield passed, or else the file's, or else the usual one, or one of size 0."""
    origin, turn = model.tip
    mj, kinds, last = model.model, model.mujoco.mjtGeom, model.num - 1
    every = [(mj.ngeom, mj.geom), (mj.nsite, mj.site)]
    geoms, sites = ([k for k in range(num) if at(k).name == "shield"] for num, at in every)
    if shield is not None or not geoms:
        shield = shield or usual
        own = shield or Shield(position=(0.0, 0.0, 0.0))
        rotation = Rotation.from_quat(own.turn, scalar_first=True).as_matrix()
        corners = own.outline if shield else np.zeros((4, 2))
        return Mount(origin + turn @ np.array(own.position), turn @ rotation, corners, own.mass)
    geom, half = geoms[0], mj.geom_size[geoms[0]]
    if mj.geom_type[geom] != kinds.mjGEOM_BOX or model.link[mj.geom_bodyid[geom]] != last:
        raise model.error(
            'geom "shield"', "a box of the last link; rename it or pass shield=", "be"
        )
    middle, turn = model.pose_of("geom", geom, last)
    if sites:
        face = turn.T @ (model.pose_of("site", sites[0], last)[0] - middle)
        k = int(np.argmax(np.abs(face) / half))
    else:  # a broad face, whose outward normal points away from the link's origin
        k, face = int(np.argmin(half)), turn.T @ middle
    sign = -1.0 if face[k] < 0.0 else 1.0
    front = sign * half[k] * np.eye(3)[k]
    if sites and not np.allclose(face, front, rtol=0.0, atol=1e-6):
        raise model.error('site "shield"', "in the middle of a face of the shield's box", "be")
    y, z = (k + 1) % 3, (k + 2) % 3
    own = np.eye(3)[[k, y, z]].T * [sign, 1.0, sign]
    return Mount(middle + turn @ front, turn @ own, _rectangle(half[[y, z]]), geom=geom)
