"""Clearance of an arm of n joints with a shield from obstacles and from itself, in float64 NumPy.

Base frame of the arm, z up, SI units. Vectors at S sampled times of B motions are (3, B, S), with
S = 1 for solids that do not move. The solids are capsules around the links, and a rectangular
plate, the shield, 0.01 m thick. These distances are tested:

- of every link and the shield from the floor, obstacles and the beams of the rig around the arm;
- of the shield and the links of `Arm.base_pairs` from the base, on which link 1 is mounted;
- of the links of `Arm.pairs`, since neighbouring links always touch;
- of the links of `Arm.shield_pairs` from the shield, which the last link carries.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np

from planner_jax.referee import solids
from planner_jax.referee.reach import Bodies

KINDS = ("floor", "obstacle", "rig", "base", "self")
THICKNESS = 0.01  # [m], thickness of the shield's plate
_SLACK = 1e-9  # [m], greatest rounding error of the lower bound of a distance
_BASE = -1  # index of the base, where links 1 to n have indices 0 to n - 1


@dataclasses.dataclass(frozen=True)
class _Capsule:
    """The pose of a capsule (a link, a beam or an obstacle) at every sample of B motions."""

    name: str
    link: int
    first: np.ndarray  # (3, B, S) [m], first end of the axis
    second: np.ndarray  # (3, B, S) [m], second end of the axis
    radius: np.ndarray  # (B, 1) [m]

    @property
    def middle(self) -> np.ndarray:
        return 0.5 * (self.first + self.second)

    @property
    def reach(self) -> np.ndarray:
        """Radius (B, 1) [m] of the sphere around `middle` that contains the capsule."""
        return 0.5 * solids.length(self.second[..., :1] - self.first[..., :1]) + self.radius

    def lowest(self) -> np.ndarray:
        return np.minimum(self.first[2], self.second[2]) - self.radius

    def distance_to_point(self, point: np.ndarray) -> np.ndarray:
        return solids.from_segment(point, self.first, self.second) - self.radius

    def distance_to_capsule(self, other: "_Capsule") -> np.ndarray:
        apart = solids.between_segments(self.first, self.second, other.first, other.second)
        return apart - self.radius - other.radius

    def at(self, lane: np.ndarray, sample: np.ndarray) -> "_Capsule":
        first, second = (_pick_samples(end, lane, sample) for end in (self.first, self.second))
        return _Capsule(self.name, self.link, first, second, self.radius[lane, 0])


@dataclasses.dataclass(frozen=True)
class _Box:
    """The pose of a box (shield, base or obstacle) at every sample of B motions."""

    name: str
    middle: np.ndarray  # (3, B, S) [m]
    turn: np.ndarray  # (3, 3, B, S), rotation from the frame of the box
    half: np.ndarray  # (3, B, 1) [m], half edges

    @property
    def reach(self) -> np.ndarray:
        return solids.length(self.half)

    def lowest(self) -> np.ndarray:
        return self.middle[2] - sum(np.abs(self.turn[2, k]) * self.half[k] for k in range(3))

    def distance_to_point(self, point: np.ndarray) -> np.ndarray:
        inside = solids.rotate_back(self.turn, point - self.middle)
        return solids.length(np.maximum(np.abs(inside) - self.half, 0.0))

    def distance_to_capsule(self, other: _Capsule) -> np.ndarray:
        first, second = (
            solids.rotate_back(self.turn, end - self.middle) for end in (other.first, other.second)
        )
        return solids.segment_to_box(first, second, self.half) - other.radius

    def distance_to_box(self, other: "_Box") -> np.ndarray:
        middle = solids.rotate_back(self.turn, other.middle - self.middle)
        turn = np.stack([solids.rotate_back(self.turn, other.turn[:, k]) for k in range(3)], axis=1)
        return solids.between_boxes(middle, turn, other.half, self.half)

    def at(self, lane: np.ndarray, sample: np.ndarray) -> "_Box":
        middle, turn = (_pick_samples(each, lane, sample) for each in (self.middle, self.turn))
        return _Box(self.name, middle, turn, self.half[:, lane, 0])


@dataclasses.dataclass(frozen=True)
class _Pair:
    """Two solids, or a solid and the floor, whose distance is tested at S samples of B motions."""

    name: str  # name of the part of the arm, or of both parts
    bound: np.ndarray  # (B, S) [m], lower bound of the distance
    # Function that returns exact distances [m] at P samples: its arguments are the indices (P,) of
    # their motions, and the indices (P,) of the samples within the motions.
    exact: Callable[[np.ndarray, np.ndarray], np.ndarray]


def links_of(case: dict, angles: np.ndarray) -> tuple[list, list]:
    """Return links' rotations to the base frame, and joints' positions [m], for links 1 to n.

    Joint `angles` are (n, B, S) [rad], at S samples of B motions. Each rotation is (3, 3, B, S),
    each position (3, B, S).
    """
    turn, position = np.eye(3)[..., None, None], np.zeros((3, 1, 1))
    turns, positions = [], []
    for k in range(len(angles)):
        origin, quaternion, axis = (
            case[f"arm.{name}"][:, k].T[..., None] for name in ("origin", "turn", "axis")
        )
        position = position + solids.rotate(turn, origin)
        # Multiply by the joint's fixed rotation, and by the rotation about its axis (Rodrigues).
        cos, sin = np.cos(angles[k]), np.sin(angles[k])
        own, along = _rotation(quaternion), axis[:, None] * axis[None]
        still = _product(own, along)
        turn = _product(turn, still + cos * (own - still) + sin * _product(own, _cross(axis)))
        turns.append(turn)
        positions.append(position)
    return turns, positions


def shield_pose(case: dict, turns: list, positions: list) -> tuple[np.ndarray, np.ndarray]:
    """Return the shield's rotation (3, 3, B, S), and its face's middle (3, B, S) [m].

    The columns of the rotation are the outward normal of the face and the directions of its edges.
    """
    own = _rotation(case["arm.shield_turn"].T[..., None])
    middle = positions[-1] + solids.rotate(turns[-1], case["arm.shield_centre"].T[..., None])
    return _product(turns[-1], own), middle


def clearances(case: dict, arm: Any, angles: np.ndarray, sampled: np.ndarray) -> dict:
    """Return an arm's least distances to the floor, obstacles, the rig, its base and itself.

    The distance of overlapping solids is minus the penetration depth. If one solid is a capsule,
    the depth is at most its radius, and for two capsules at most the sum of both radii. Distances
    at samples are exact. MuJoCo computes the distances from cylinders and hulls of meshes.

    Args:
        case: arrays of B cases.
        arm: object with `capsule_link`, `pairs`, `shield_pairs` and `base_pairs` of `Arm`.
        angles: (n, B, S) [rad], joint angles at S samples of each motion.
        sampled: (B, S) bool, samples to evaluate, at least one in each motion.

    Returns:
        For each kind of obstacle: the least distance (B,) [m], infinite without an obstacle; the
        index (B,) of its sample; and the name (B,) of the part of the arm.
    """
    capsules, shield = _arm(case, arm.capsule_link, angles)
    moving = [each for each in capsules if each.link != _BASE]
    on_base = [each for each in capsules if each.link == _BASE]
    bodies = [*moving, shield]
    off_base = [*(capsules[k] for k in arm.base_pairs), shield]
    beams, base = _rods(case, "beam"), [_base_box(case), *on_base]
    obstacles = _obstacles(case)
    floor = case["scene.floor"][:, None]
    heights = [(body.name, body.lowest() - floor) for body in bodies]
    folded = [(capsules[k], capsules[other]) for k, other in arm.pairs]
    guarded = [(part, shield) for part in _beside_shield(case, arm, capsules)]
    pairs = {
        "floor": [_Pair(name, above, partial(_pick_samples, above)) for name, above in heights],
        "obstacle": [_pair(a, b, f"{a.name} and {b.name}") for a in bodies for b in obstacles],
        "rig": [_pair(body, beam, body.name) for body in bodies for beam in beams],
        "base": [_pair(body, part, body.name) for body in off_base for part in base],
        "self": [_pair(a, b, f"{a.name} and {b.name}") for a, b in (*folded, *guarded)],
    }
    found = {kind: _least(pairs[kind], sampled) for kind in KINDS}
    found["obstacle"] = _with_hulls(case, arm, angles, sampled, found["obstacle"])
    return found


def _with_hulls(
    case: dict, arm: Any, angles: np.ndarray, sampled: np.ndarray, others: tuple
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `others`, a result of `_least`, or the distance from cylinders and meshes if less."""
    ends, radius = case["scene.cylinder_ends"], case["scene.cylinder_radius"]
    hulls = case.get("scene.meshes.corners", radius[:, :0])
    least, at, part = others[0], others[1], others[2].astype("<U64")
    for k in range(len(least) if radius.shape[1] + hulls.shape[1] else 0):
        own = {name[4:]: leaf[k] for name, leaf in case.items() if name.startswith("arm.")}
        known = [leaf for name, leaf in own.items() if name not in ("lower", "upper")]
        if not all(np.isfinite(leaf).all() for leaf in (*known, ends[k], radius[k], hulls[k])):
            continue  # the plan fails as "not finite"
        bodies = Bodies(SimpleNamespace(**vars(arm) | own), ends[k], radius[k], hulls[k])
        index = np.flatnonzero(sampled[k])
        gap, sample, name = bodies.clearances(angles[:, k, index].T)["obstacle"]
        if gap < least[k]:
            least[k], at[k], part[k] = gap, index[sample], name
    return least, at, part


def _arm(case: dict, links: Sequence, angles: np.ndarray) -> tuple[list[_Capsule], _Box]:
    turns, positions = links_of(case, angles)
    capsules = []
    for k, link in enumerate(links):
        first, second = case["arm.capsule_ends"][:, k].transpose(1, 2, 0)[..., None]
        if link != _BASE:
            first, second = (
                positions[link] + solids.rotate(turns[link], end) for end in (first, second)
            )
        name = "the base" if link == _BASE else f"link {link + 1}"
        capsules.append(_Capsule(name, link, first, second, case["arm.capsule_radius"][:, k, None]))
    wide, high = case["arm.shield_half"].T[..., None]
    half = np.stack([np.full_like(wide, 0.5 * THICKNESS), wide, high])
    turn, face = shield_pose(case, turns, positions)
    return capsules, _Box("the shield", face - 0.5 * THICKNESS * turn[:, 0], turn, half)


def _beside_shield(case: dict, arm: Any, capsules: list[_Capsule]) -> list[_Capsule]:
    """Return the capsules for the test against the shield.

    A link can be wider than thick, and the shield approaches only its narrow sides. A capsule that
    contains the wide sides would overlap the shield. The arm states a smaller radius for such a
    capsule. Here its radius is reduced so that it just touches the shield if all joint angles
    are 0.
    """
    num_lanes = len(case["arm.shield_half"])
    straight, shield = _arm(case, arm.capsule_link, np.zeros((len(arm.joint_names), num_lanes, 1)))
    beside, here = [], (np.arange(num_lanes), np.zeros(num_lanes, int))
    for k in arm.shield_pairs:
        bare = dataclasses.replace(straight[k], radius=np.zeros((num_lanes, 1)))
        gap = _distance(bare.at(*here), shield.at(*here))[:, None]
        whole = capsules[k].radius
        is_thin = case["arm.shield_gap_radius"][:, k, None] < whole
        radius = np.where(is_thin, np.minimum(whole, gap), whole)
        beside.append(dataclasses.replace(capsules[k], radius=radius))
    return beside


def _rods(case: dict, kind: str) -> list[_Capsule]:
    """Return the capsules or beams of the scene; one with a negative radius is infinitely far."""
    rods = []
    for k, radius in enumerate(case[f"scene.{kind}_radius"].T):
        first, second = case[f"scene.{kind}_ends"][:, k].transpose(1, 2, 0)[..., None]
        radius = np.where(radius < 0.0, -np.inf, radius)
        rods.append(_Capsule(f"{kind} {k + 1}", _BASE, first, second, radius[:, None]))
    return rods


def _obstacles(case: dict) -> list[_Capsule | _Box]:
    solids: list[_Capsule | _Box] = [*_rods(case, "capsule")]
    for k in range(case["scene.box_half"].shape[1]):
        middle, turn, half = (
            case[f"scene.box_{name}"][:, k].T[..., None] for name in ("middle", "turn", "half")
        )
        solids.append(_Box(f"box {k + 1}", middle, _rotation(turn), half))
    return solids


def _base_box(case: dict) -> _Box:
    lower, upper = (case["arm.base_box"][:, k].T[..., None] for k in range(2))
    turn = np.broadcast_to(np.eye(3)[..., None, None], (3, *lower.shape))
    return _Box("the base", 0.5 * (lower + upper), turn, 0.5 * (upper - lower))


def _pair(one: _Capsule | _Box, other: _Capsule | _Box, name: str) -> _Pair:

    def exact(lane: np.ndarray, sample: np.ndarray) -> np.ndarray:
        return _distance(one.at(lane, sample), other.at(lane, sample))

    return _Pair(name, other.distance_to_point(one.middle) - one.reach, exact)


def _distance(one: _Capsule | _Box, other: _Capsule | _Box) -> np.ndarray:
    if isinstance(one, _Capsule):
        return other.distance_to_capsule(one)
    is_capsule = isinstance(other, _Capsule)
    return one.distance_to_capsule(other) if is_capsule else other.distance_to_box(one)


def _least(pairs: list[_Pair], sampled: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    num_lanes, num_samples = sampled.shape
    if not pairs:
        return np.full(num_lanes, np.inf), np.zeros(num_lanes, int), np.full(num_lanes, "")
    bounds = np.stack([np.where(sampled, pair.bound, np.inf) for pair in pairs], axis=1)
    bounds = bounds.reshape(num_lanes, -1)
    distances = np.full_like(bounds, np.inf)

    def compute(selected: np.ndarray) -> None:
        for k, pair in enumerate(pairs):
            here = slice(k * num_samples, (k + 1) * num_samples)
            lane, sample = np.nonzero(selected[:, here])
            if len(lane):
                distances[:, here][lane, sample] = pair.exact(lane, sample)

    lanes = np.arange(num_lanes)
    first = np.zeros(bounds.shape, bool)
    # An entry is the distance of two solids at a sample. The entry with the least lower bound is
    # computed first. Entries with a lower bound above its exact distance need no computation.
    first[lanes, bounds.argmin(axis=1)] = True
    compute(first)
    upper = distances.min(axis=1, keepdims=True) + _SLACK
    compute((bounds <= upper) & np.isfinite(bounds) & ~first)
    index = distances.argmin(axis=1)
    which, sample = np.divmod(index, num_samples)
    return distances[lanes, index], sample, np.array([pair.name for pair in pairs])[which]


def _pick_samples(values: np.ndarray, lane: np.ndarray, sample: np.ndarray) -> np.ndarray:
    return values[..., lane, sample if values.shape[-1] > 1 else 0]


def _product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.stack([solids.rotate(first, second[:, k]) for k in range(3)], axis=1)


def _cross(axis: np.ndarray) -> np.ndarray:
    (x, y, z), none = axis, np.zeros_like(axis[0])
    return np.array([[none, -z, y], [z, none, -x], [-y, x, none]])


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """Convert unit quaternions (4, ...), w x y z, to rotations (3, 3, ...)."""
    w, v = quaternion[0], quaternion[1:]
    upright = np.eye(3).reshape(3, 3, *(1,) * w.ndim)
    return (w * w - solids.dot(v, v)) * upright + 2.0 * (v[:, None] * v[None] + w * _cross(v))
