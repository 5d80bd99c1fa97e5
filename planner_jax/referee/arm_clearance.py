"""How far a six-axis arm with a shield stays from what it must not touch, in float64 NumPy.

It shares no code with the planners. Base frame of the arm, z up, SI units. Arrays of B lanes and
S samples have the components of their vectors first, (3, B, S); what stands still has S = 1.

The links are their capsules, the shield is a square plate, 0.01 m thick behind its face. Every
moving link and the shield keep off the floor, the pole and the beams of the rig; all of these but
link 1, which stands on it, off the base; links 3 to 6 and the shield off link 1; and the shield
off links 2 to 4, of which link 4 is thinner there (`_beside_shield`). Links 5 and 6 carry it.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from planner_jax.referee.solids import (
    between_boxes,
    between_segments,
    dot,
    from_segment,
    length,
    segment_to_box,
    turned,
    turned_back,
)

KINDS = ("floor", "pole", "rig", "base", "self")
THICKNESS = 0.01  # [m], of the shield
_POLE_HALF = 1e3  # [m], half the length of the pole, which is to have no end
# What rounding may do to a bound [m].
_SLACK = 1e-9
# Links 1 to 6 are 0 to 5 in an arm, and this is the base.
_BASE = -1


@dataclasses.dataclass(frozen=True)
class _Capsule:
    """One capsule at every sample."""

    name: str
    link: int
    first: np.ndarray  # (3, B, S) [m], one end of its axis
    second: np.ndarray  # (3, B, S) [m], the other one
    radius: np.ndarray  # (B, 1) [m]

    @property
    def middle(self) -> np.ndarray:
        """(3, B, S) [m]."""
        return 0.5 * (self.first + self.second)

    @property
    def reach(self) -> np.ndarray:
        """Radius (B, 1) [m] of the sphere around it."""
        return 0.5 * length(self.second[..., :1] - self.first[..., :1]) + self.radius

    def lowest(self) -> np.ndarray:
        """Return height (B, S) [m] of its lowest point."""
        return np.minimum(self.first[2], self.second[2]) - self.radius

    def from_point(self, point: np.ndarray) -> np.ndarray:
        """Return distances (B, S) [m] of points (3, B, S)."""
        return from_segment(point, self.first, self.second) - self.radius

    def from_capsule(self, other: "_Capsule") -> np.ndarray:
        """Return distances (P,) [m] of capsules, of both at P samples."""
        apart = between_segments(self.first, self.second, other.first, other.second)
        return apart - self.radius - other.radius

    def at(self, lane: np.ndarray, sample: np.ndarray) -> "_Capsule":
        """Return the capsules at P samples of lanes, (3, P) and (P,)."""
        first, second = (_picked(end, lane, sample) for end in (self.first, self.second))
        return _Capsule(self.name, self.link, first, second, self.radius[lane, 0])


@dataclasses.dataclass(frozen=True)
class _Box:
    """One box at every sample."""

    name: str
    middle: np.ndarray  # (3, B, S) [m]
    turn: np.ndarray  # (3, 3, B, S), out of its frame
    half: np.ndarray  # (3, B, 1) [m], half edges

    @property
    def reach(self) -> np.ndarray:
        """Radius (B, 1) [m] of the sphere around it."""
        return length(self.half)

    def lowest(self) -> np.ndarray:
        """Return height (B, S) [m] of its lowest point."""
        return self.middle[2] - sum(np.abs(self.turn[2, k]) * self.half[k] for k in range(3))

    def from_point(self, point: np.ndarray) -> np.ndarray:
        """Return distances (B, S) [m] of points (3, B, S)."""
        inside = turned_back(self.turn, point - self.middle)
        return length(np.maximum(np.abs(inside) - self.half, 0.0))

    def from_capsule(self, other: _Capsule) -> np.ndarray:
        """Return distances (P,) [m] of capsules, of both at P samples."""
        first, second = (
            turned_back(self.turn, end - self.middle) for end in (other.first, other.second)
        )
        return segment_to_box(first, second, self.half) - other.radius

    def from_box(self, other: "_Box") -> np.ndarray:
        """Return distances (P,) [m] of boxes, of both at P samples."""
        middle = turned_back(self.turn, other.middle - self.middle)
        turn = np.stack([turned_back(self.turn, other.turn[:, k]) for k in range(3)], axis=1)
        return between_boxes(middle, turn, other.half, self.half)

    def at(self, lane: np.ndarray, sample: np.ndarray) -> "_Box":
        """Return the boxes at P samples of lanes, (3, P) and (3, 3, P)."""
        middle, turn = (_picked(each, lane, sample) for each in (self.middle, self.turn))
        return _Box(self.name, middle, turn, self.half[:, lane, 0])


@dataclasses.dataclass(frozen=True)
class _Pair:
    """Two solids, or one and the floor."""

    name: str  # of what comes too close
    bound: np.ndarray  # (B, S) [m], which their distance is not below
    exact: Callable[[np.ndarray, np.ndarray], np.ndarray]  # lanes and samples (P,) -> (P,) [m]


def links_of(case: dict, angles: np.ndarray) -> tuple[list, list]:
    """Return rotations (3, 3, B, S) of links 1 to 6 and positions (3, B, S) [m] of their joints."""
    turn, place = np.eye(3)[..., None, None], np.zeros((3, 1, 1))
    turns, places = [], []
    for k in range(6):
        origin, quaternion, axis = (
            case[f"arm.{name}"][:, k].T[..., None] for name in ("origin", "turn", "axis")
        )
        place = place + turned(turn, origin)
        # The joint's own turn, then Rodrigues' formula about its axis.
        cos, sin = np.cos(angles[k]), np.sin(angles[k])
        own, along = _rotation(quaternion), axis[:, None] * axis[None]
        still = _product(own, along)
        turn = _product(turn, still + cos * (own - still) + sin * _product(own, _cross(axis)))
        turns.append(turn)
        places.append(place)
    return turns, places


def shield_middle(case: dict, turns: list, places: list) -> np.ndarray:
    """Return middle (3, B, S) [m] of the shield's face; its outward normal is the last link's x."""
    return places[5] + turned(turns[5], case["arm.shield_centre"].T[..., None])


def clearances(case: dict, links: Sequence, angles: np.ndarray, sampled: np.ndarray) -> dict:
    """Return least distances of an arm from what it must not touch, by `KINDS`.

    Those of overlapping solids are less than zero: minus the depth, but for a capsule not less
    than minus its radius, and for two not less than minus both. Pairs of solids and samples that
    a sphere around one of the two shows to be farther apart than another pair of their kind and
    lane are left out; the others are exact.

    Args:
        case: leaves of B lanes.
        links: of the capsules, 0 to 5 for links 1 to 6, -1 for the base.
        angles: (6, B, S) [rad].
        sampled: (B, S) bool, the samples that are looked at, at least one in each lane.

    Returns:
        By kind: the least distance (B,) [m], infinite where there is nothing to touch; its sample
        (B,); and the name (B,) of what comes so close.
    """
    capsules, shield = _arm(case, links, angles)
    moving = [each for each in capsules if each.link != _BASE]
    on_base = [each for each in capsules if each.link == _BASE]
    bodies = [*moving, shield]
    off_base = [each for each in moving if each.link > 0] + [shield]
    beams, pole, base = _beams(case), _pole(case), [_base_box(case), *on_base]
    floor = case["scene.floor"][:, None]
    heights = [(body.name, body.lowest() - floor) for body in bodies]
    first = [each for each in moving if each.link == 0]
    folded = [(body, part) for body in moving if body.link > 1 for part in first]
    guarded = [(part, shield) for part in (*first, *_beside_shield(case, links, capsules))]
    pairs = {
        "floor": [_Pair(name, above, partial(_picked, above)) for name, above in heights],
        "pole": [_pair(body, pole, body.name) for body in bodies],
        "rig": [_pair(body, beam, body.name) for body in bodies for beam in beams],
        "base": [_pair(body, part, body.name) for body in off_base for part in base],
        "self": [_pair(a, b, f"{a.name} and {b.name}") for a, b in (*folded, *guarded)],
    }
    return {kind: _least(pairs[kind], sampled) for kind in KINDS}


def _arm(case: dict, links: Sequence, angles: np.ndarray) -> tuple[list[_Capsule], _Box]:
    """Return the arm's capsules and its shield at angles (6, B, S)."""
    turns, places = links_of(case, angles)
    capsules = []
    for k, link in enumerate(links):
        first, second = case["arm.capsule_ends"][:, k].transpose(1, 2, 0)[..., None]
        if link != _BASE:
            first, second = (places[link] + turned(turns[link], end) for end in (first, second))
        name = "the base" if link == _BASE else f"link {link + 1}"
        radius = case["arm.capsule_radius"][:, k, None]
        capsules.append(_Capsule(name, link, first, second, radius))
    wide = case["arm.shield_half"][:, None]
    half = np.stack([np.full_like(wide, 0.5 * THICKNESS), wide, wide])
    middle = shield_middle(case, turns, places) - 0.5 * THICKNESS * turns[5][:, 0]
    return capsules, _Box("the shield", middle, turns[5], half)


def _beside_shield(case: dict, links: Sequence, capsules: list[_Capsule]) -> list[_Capsule]:
    """Return the capsules of links 2 to 4, whose distance from the shield is tested like link 1's.

    A capsule around the whole of link 4, as thick as the forearm is wide, reaches through the
    shield however the wrist is bent. The shield only ever comes at the forearm's narrow sides,
    about the axis of joint 5: here the capsule is at most so thick that the shield touches it
    when joint 5 is at 0.
    """
    num_lanes = len(case["arm.shield_half"])
    straight, shield = _arm(case, links, np.zeros((6, num_lanes, 1)))
    beside = []
    for each, unbent in zip(capsules, straight, strict=True):
        if each.link == 3:
            bare = dataclasses.replace(unbent, radius=np.zeros((num_lanes, 1)))
            here = np.arange(num_lanes), np.zeros(num_lanes, int)
            room = _distance(bare.at(*here), shield.at(*here))[:, None]
            each = dataclasses.replace(each, radius=np.minimum(each.radius, room))
        if 1 <= each.link <= 3:
            beside.append(each)
    return beside


def _pole(case: dict) -> _Capsule:
    """Return the pole; where there is none, one that nothing can touch."""
    x, y = case["scene.pole"].T[..., None]
    first, second = (np.stack([x, y, np.full_like(x, end)]) for end in (-_POLE_HALF, _POLE_HALF))
    radius = np.where(case["scene.has_pole"] != 0.0, case["scene.pole_radius"], -np.inf)
    return _Capsule("the pole", _BASE, first, second, radius[:, None])


def _beams(case: dict) -> list[_Capsule]:
    """Return the beams of the rig."""
    beams = []
    for k, radius in enumerate(case["scene.beam_radius"].T):
        first, second = case["scene.beam_ends"][:, k].transpose(1, 2, 0)[..., None]
        beams.append(_Capsule("a beam", _BASE, first, second, radius[:, None]))
    return beams


def _base_box(case: dict) -> _Box:
    """Return the base."""
    lower, upper = (case["arm.base_box"][:, k].T[..., None] for k in range(2))
    turn = np.broadcast_to(np.eye(3)[..., None, None], (3, *lower.shape))
    return _Box("the base", 0.5 * (lower + upper), turn, 0.5 * (upper - lower))


def _pair(one: _Capsule | _Box, other: _Capsule | _Box, name: str) -> _Pair:
    """Return two solids, of which the first has the smaller sphere around it."""

    def exact(lane: np.ndarray, sample: np.ndarray) -> np.ndarray:
        return _distance(one.at(lane, sample), other.at(lane, sample))

    return _Pair(name, other.from_point(one.middle) - one.reach, exact)


def _distance(one: _Capsule | _Box, other: _Capsule | _Box) -> np.ndarray:
    """Return distances (P,) [m] of two solids at P samples."""
    if isinstance(one, _Capsule):
        return other.from_capsule(one)
    return one.from_capsule(other) if isinstance(other, _Capsule) else other.from_box(one)


def _least(pairs: list[_Pair], sampled: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return least distance (B,) of all pairs, its sample (B,) and the pair's name (B,)."""
    num_lanes, num_samples = sampled.shape
    if not pairs:
        return np.full(num_lanes, np.inf), np.zeros(num_lanes, int), np.full(num_lanes, "")
    bounds = np.stack([np.where(sampled, pair.bound, np.inf) for pair in pairs], axis=1)
    bounds = bounds.reshape(num_lanes, -1)
    distances = np.full_like(bounds, np.inf)

    def work_out(wanted: np.ndarray) -> None:
        """Return the distances of the pairs and samples that are wanted (B, pairs x samples)."""
        for k, pair in enumerate(pairs):
            here = slice(k * num_samples, (k + 1) * num_samples)
            lane, sample = np.nonzero(wanted[:, here])
            if len(lane):
                distances[:, here][lane, sample] = pair.exact(lane, sample)

    lanes = np.arange(num_lanes)
    wanted = np.zeros(bounds.shape, bool)
    # One pair at one sample bounds the least distance from above.
    wanted[lanes, bounds.argmin(axis=1)] = True
    work_out(wanted)
    upper = distances.min(axis=1, keepdims=True) + _SLACK
    work_out((bounds <= upper) & np.isfinite(bounds) & ~wanted)
    place = distances.argmin(axis=1)
    which, sample = np.divmod(place, num_samples)
    return distances[lanes, place], sample, np.array([pair.name for pair in pairs])[which]


def _picked(values: np.ndarray, lane: np.ndarray, sample: np.ndarray) -> np.ndarray:
    """Return values (..., P) of values (..., B, S) at P samples of lanes; S = 1 if constant."""
    return values[..., lane, sample if values.shape[-1] > 1 else 0]


def _product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return products (3, 3, ...) of matrices (3, 3, ...)."""
    return np.stack([turned(first, second[:, k]) for k in range(3)], axis=1)


def _cross(axis: np.ndarray) -> np.ndarray:
    """Return matrices (3, 3, ...) that multiply vectors to cross products with axes (3, ...)."""
    (x, y, z), none = axis, np.zeros_like(axis[0])
    return np.array([[none, -z, y], [z, none, -x], [-y, x, none]])


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """Return rotations (3, 3, ...) of unit quaternions (4, ...), w x y z."""
    w, v = quaternion[0], quaternion[1:]
    upright = np.eye(3).reshape(3, 3, *(1,) * w.ndim)
    return (w * w - dot(v, v)) * upright + 2.0 * (v[:, None] * v[None] + w * _cross(v))
