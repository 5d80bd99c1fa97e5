"""Visual surroundings of a flight: solid parts, a pitching machine, and their MJCF text."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull

from planner_jax.sims.robot import Solid

GROUND_COLOUR = "#A9C4A9"
FLAT = 0.01  # [m], height up to which a part counts as lying flat on the ground
VISUAL = 'mass="0" contype="0" conaffinity="0"'  # MJCF attributes of geoms that are visual only
_STEEL, _RUBBER = "#5B6B73", "#2E8B57"
_SIDES, _RINGS = 14, 3  # numbers of facets of a drawn capsule, around its axis and at each end


@dataclasses.dataclass(frozen=True)
class Part:
    """An upright box or cylinder, or a convex hull of points, of the surroundings, for drawing."""

    kind: str  # "box", "cylinder" or "hull"
    # [m]: length, width, height; length and width of a cylinder both are its diameter.
    size: tuple[float, float, float]
    centre: tuple[float, float, float]  # [m], world frame
    colour: str  # as #RRGGBB
    turn: float = 0.0  # [rad], rotation about z
    opacity: float = 1.0  # less than 1 for transparent parts
    corners: tuple[tuple[float, float, float], ...] = ()  # [m], of a hull, in the world frame

    @property
    def quat_wxyz(self) -> tuple[float, float, float, float]:
        """The part's attitude as a unit quaternion, w x y z."""
        return (float(np.cos(0.5 * self.turn)), 0.0, 0.0, float(np.sin(0.5 * self.turn)))


@dataclasses.dataclass(frozen=True)
class Prism:
    """An upright prism on the ground that stands still or moves at constant velocity."""

    corners: np.ndarray  # (V, 2) [m], of its convex base at time 0, in either orientation
    height: float  # [m]
    colour: str  # as #RRGGBB
    velocity: tuple[float, float] = (0.0, 0.0)  # [m/s]

    def outlines(self, time: float) -> list[np.ndarray]:
        """Return the edges at a time [s] as lines of points [m]: closed base, closed top, sides."""
        base = self.corners + time * np.asarray(self.velocity)
        ring = np.concatenate([base, base[:1]])
        low, high = (np.pad(ring, ((0, 0), (0, 1)), constant_values=z) for z in (0.0, self.height))
        return [low, high, *(np.stack([low[k], high[k]]) for k in range(len(base)))]

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Return corners [m] at time 0, and triangles (corner indices) of the sides and the top."""
        num = len(self.corners)
        low, high = (
            np.pad(self.corners, ((0, 0), (0, 1)), constant_values=z) for z in (0.0, self.height)
        )
        own = np.arange(num)
        after = (own + 1) % num
        sides = [(own, after, after + num), (own, after + num, own + num)]
        top = np.stack([np.full(num - 2, num), num + own[1:-1], num + own[2:]], axis=1)
        return np.concatenate([low, high]), np.concatenate([*(np.stack(s, 1) for s in sides), top])


def machine_parts(mouth: Sequence[float] | np.ndarray, heading: float) -> list[Part]:
    """Return the parts of a pitching machine: two wheels beside the mouth, a case, mast and foot.

    Args:
        mouth: (3,) [m], point where balls leave the machine, above the ground.
        heading: [rad], direction of the throws, from the x axis.
    """
    ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
    aside = np.array([-np.sin(heading), np.cos(heading), 0.0])
    place = np.asarray(mouth, float)

    def part(
        kind: str, size: tuple[float, float, float], colour: str, x: float, y: float, z: float
    ) -> Part:
        centre = place + x * ahead + y * aside + [0.0, 0.0, z]
        return Part(kind, size, (centre[0], centre[1], centre[2]), colour, heading)

    wheel, mast = (0.18, 0.18, 0.04), place[2] - 0.1
    return [
        *(part("cylinder", wheel, _RUBBER, -0.06, side * 0.11, 0.0) for side in (-1.0, 1.0)),
        part("box", (0.3, 0.26, 0.2), _STEEL, -0.33, 0.0, 0.0),
        part("cylinder", (0.06, 0.06, mast), _STEEL, -0.33, 0.0, -0.1 - 0.5 * mast),
        part("cylinder", (0.5, 0.5, 0.02), _STEEL, -0.33, 0.0, 0.01 - place[2]),
    ]


def outlines(part: Part) -> list[np.ndarray]:
    """Return the edges of a part as lines of points [m], in the world frame; a hull has none."""
    if part.corners:
        return []
    if part.kind == "box":
        angle = np.linspace(0.25, 2.25, 5) * np.pi
        ring = np.sign(np.stack([np.cos(angle), np.sin(angle)], axis=1))
    else:
        angle = np.linspace(0.0, 2.0 * np.pi, 25)
        ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    cos, sin = np.cos(part.turn), np.sin(part.turn)
    half = 0.5 * np.array(part.size)
    flat = (ring * half[:2]) @ np.array([[cos, sin], [-sin, cos]])
    low, high = (
        np.pad(flat, ((0, 0), (0, 1))) + part.centre + np.array([0.0, 0.0, z])
        for z in (-half[2], half[2])
    )
    corners = range(0, len(ring) - 1, (len(ring) - 1) // 4)
    return [low, high, *(np.stack([low[k], high[k]]) for k in corners)]


def hull(points: np.ndarray) -> Solid:
    """Return the convex hull of P points (P, 3) [m]; every point must be a vertex of the hull."""
    found = ConvexHull(points)
    a, b, c = (points[found.simplices[:, k]] for k in range(3))
    inward = np.sum(np.cross(b - a, c - a) * found.equations[:, :3], axis=1) < 0.0
    triangles = np.where(inward[:, None], found.simplices[:, ::-1], found.simplices)
    return Solid(points, triangles)


def make_hull_part(points: np.ndarray, colour: str) -> Part:
    """Return the convex hull of P points (P, 3) [m] as a part."""
    corners = points[np.unique(ConvexHull(points).vertices)]
    size, (x, y, z) = np.ptp(corners, axis=0), corners.mean(axis=0)
    # Slightly transparent, as films fill transparent parts alone.
    return Part("hull", (*size,), (x, y, z), colour, 0.0, 0.95, (*map(tuple, corners.tolist()),))


def box_solid(lower: np.ndarray, upper: np.ndarray) -> Solid:
    """Return the axis-aligned box between two corners (3,) [m]."""
    share = np.stack(np.meshgrid(*[[0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    return hull(lower + share * (np.asarray(upper) - lower))


def capsule_solid(first: np.ndarray, second: np.ndarray, radius: float) -> Solid:
    """Return a capsule around the segment between two ends (3,) [m], as a mesh."""
    along = np.asarray(second, float) - first
    length = float(np.linalg.norm(along))
    axis = along / length if length > 0.0 else np.array([1.0, 0.0, 0.0])
    aside = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    aside /= np.linalg.norm(aside)
    turn = np.linspace(0.0, 2.0 * np.pi, _SIDES, endpoint=False)[:, None]
    ring = np.cos(turn) * aside + np.sin(turn) * np.cross(axis, aside)
    rise = np.linspace(0.0, 0.5 * np.pi, _RINGS + 1)[:-1, None, None]
    cap = radius * (np.cos(rise) * ring + np.sin(rise) * axis).reshape(-1, 3)
    ends = np.concatenate([cap, radius * axis[None]])
    points = np.concatenate([second + ends, first - ends])
    if length == 0.0:
        points = np.unique(points.round(9), axis=0)
    return hull(points)


def part_solid(part: Part) -> Solid:
    """Return the surface of a part in the world frame; a cylinder becomes a prism."""
    if part.corners:
        return hull(np.array(part.corners))
    return hull(np.concatenate([line[:-1] for line in outlines(part)[:2]]))


def xml_numbers(*values: float) -> str:
    """Format numbers for MJCF, MuJoCo's XML format: separated by spaces."""
    return " ".join(f"{value:.9g}" for value in values)


def xml_colour(colour: str, opacity: float = 1.0) -> str:
    """Convert a colour #RRGGBB and an opacity to MJCF text."""
    return xml_numbers(*(int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5)), opacity)


def part_xml(part: Part) -> str:
    """Return a part of the surroundings as an MJCF geom; hulls are left out."""
    if part.corners:
        return ""
    length, width, height = (0.5 * size for size in part.size)
    half = (length, width, height) if part.kind == "box" else (length, height)
    return (
        f'<geom type="{part.kind}" size="{xml_numbers(*half)}" pos="{xml_numbers(*part.centre)}" '
        f'quat="{xml_numbers(*part.quat_wxyz)}" '
        f'rgba="{xml_colour(part.colour, part.opacity)}" {VISUAL}/>'
    )
