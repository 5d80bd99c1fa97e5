"""What stands around a flight and touches nothing: the court of paper 002, the pitching machine."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from planner_jax.task.catch import suites
from planner_jax.task.hit import court, serves

# Where the machines of the tasks stand by default: the mouth, from which balls are launched [m].
# Throws all come from one place, serves from anywhere in a region: the middle of the far one.
MOUTHS = {
    "net": suites.LAUNCH,
    "racket": (0.5 * (court.NEAR_LINE + serves.DEPTH), 0.0, serves.SERVE_HEIGHT),
}
TOWARDS_NET = np.pi  # [rad], heading of a machine that throws along -x
GROUND_COLOUR = "#A9C4A9"
LINE_COLOUR, MIDDLE_COLOUR, DEAD_COLOUR = "#FFFFFF", "#24292F", "#D98880"
_STEEL, _RUBBER = "#5B6B73", "#2E8B57"
_LINE = 0.03  # [m], width of the court's lines
_THIN = 0.002  # [m]


@dataclasses.dataclass(frozen=True)
class Part:
    """A solid that stands upright."""

    kind: str  # "box" or "cylinder"
    size: tuple[float, float, float]  # [m]: length, width, height; a cylinder's are its diameter
    centre: tuple[float, float, float]  # [m], world frame
    colour: str  # as #RRGGBB
    turn: float = 0.0  # [rad] about z

    @property
    def quat_wxyz(self) -> tuple[float, float, float, float]:
        """Attitude."""
        return (float(np.cos(0.5 * self.turn)), 0.0, 0.0, float(np.sin(0.5 * self.turn)))


def court_lines() -> np.ndarray:
    """The court's lines on the ground, (L, 2, 3) [m]: both ends. The first is that at the net."""
    length, width = court.HALF_LENGTH, court.HALF_WIDTH
    lines = [((0.0, -width), (0.0, width))]
    for side in (-1.0, 1.0):
        lines.append(((-length, side * width), (length, side * width)))
        lines.append(((side * length, -width), (side * length, width)))
        near, dead = side * court.NEAR_LINE, side * court.DEAD_ZONE
        lines.append(((near, -court.LANE_LINE), (near, court.LANE_LINE)))
        lines += [
            ((dead, lane), (side * length, lane)) for lane in (-court.LANE_LINE, court.LANE_LINE)
        ]
    return np.pad(np.array(lines), ((0, 0), (0, 0), (0, 1)))


def court_parts() -> list[Part]:
    """The court as flat boxes: the dead zone, and the lines over it."""
    dead = (2.0 * court.DEAD_ZONE, 2.0 * court.HALF_WIDTH, _THIN)
    parts = [Part("box", dead, (0.0, 0.0, 0.5 * _THIN), DEAD_COLOUR)]
    for number, (a, b) in enumerate(court_lines()):
        length, width, _ = np.abs(b - a) + _LINE
        x, y, _ = 0.5 * (a + b)
        colour = LINE_COLOUR if number else MIDDLE_COLOUR
        parts.append(Part("box", (length, width, 2.0 * _THIN), (x, y, _THIN), colour))
    return parts


def machine_parts(mouth: Sequence[float] | np.ndarray, heading: float) -> list[Part]:
    """A pitching machine: two wheels beside the mouth, a case behind it, mast and foot.

    Args:
        mouth: (3,) [m], where balls leave it, above the ground.
        heading: [rad] from the x axis, in which it throws.
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
    """A part's edges as lines, each (M, 3) [m], world frame."""
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
