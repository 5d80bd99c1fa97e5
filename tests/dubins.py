"""The shortest path of a car that only drives forward, with bounded curvature.

The path consists of three arcs, or of an arc, a straight line and an arc, at the greatest curvature
[Dubins1957]. There are six such sequences (words). Their lengths are closed forms [Shkel2001],
computed for all words at once, so that a batch needs no branches. All quantities are in SI units.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

WORDS = ("LSL", "RSR", "LSR", "RSL", "RLR", "LRL")
_SENSE = {"L": 1.0, "S": 0.0, "R": -1.0}
_TURN = 2.0 * jnp.pi


@struct.dataclass
class DubinsPath:
    start: Array  # (3,) x [m], y [m], heading [rad]
    word: Array  # () int32, index in WORDS
    lengths: Array  # (3,) [m], of the three parts
    curvature: Array  # () [1/m], the greatest

    @property
    def length(self) -> Array:
        return self.lengths.sum(axis=-1)


def dubins(start: Array, goal: Array, curvature: Array) -> DubinsPath:
    """Return the shortest path between two poses (3,) for a greatest curvature () [1/m] > 0."""
    east, north = (goal[0] - start[0]) * curvature, (goal[1] - start[1]) * curvature
    far = _root(east**2 + north**2)  # in units of the least radius
    along = jnp.arctan2(north, east)
    a, b = start[2] - along, goal[2] - along
    sin_a, cos_a, sin_b, cos_b = jnp.sin(a), jnp.cos(a), jnp.sin(b), jnp.cos(b)

    def same_sense(side: float) -> tuple[Array, Array]:
        x, y = far + side * (sin_a - sin_b), cos_b - cos_a
        straight, heading = _root(x**2 + y**2), jnp.arctan2(y, x)
        # A straight line of length zero has no heading, so `first` then contains both arcs.
        is_arc = straight < 8.0 * jnp.finfo(straight.dtype).eps
        first = jnp.where(is_arc, side * (b - a), heading - side * a)
        last = jnp.where(is_arc, 0.0, side * b - heading)
        return jnp.stack([_wrap(first), straight, _wrap(last)]), straight >= 0.0

    def changing_sense(side: float) -> tuple[Array, Array]:
        x, y = far + side * (sin_a + sin_b), -cos_a - cos_b
        square = x**2 + y**2 - 4.0
        straight = _root(square)
        heading = jnp.arctan2(y, x) - jnp.arctan2(-2.0, straight)
        first, last = _wrap(heading - side * a), _wrap(heading - side * b)
        return jnp.stack([first, straight, last]), square >= 0.0

    def three_arcs(side: float) -> tuple[Array, Array]:
        x, y = far + side * (sin_a - sin_b), cos_b - cos_a
        cosine = 1.0 - (x**2 + y**2) / 8.0
        exists = jnp.abs(cosine) < 1.0
        middle = _TURN - jnp.arccos(jnp.where(exists, cosine, 0.0))
        first = _wrap(jnp.arctan2(y, x) - side * a + 0.5 * middle)
        last = _wrap(side * (b - a) - first + middle)
        return jnp.stack([first, middle, last]), exists

    words = [
        *(same_sense(1.0), same_sense(-1.0)),
        *(changing_sense(1.0), changing_sense(-1.0)),
        *(three_arcs(-1.0), three_arcs(1.0)),
    ]
    lengths, exists = (jnp.stack(each) for each in zip(*words, strict=True))
    word = jnp.argmin(jnp.where(exists, jnp.sum(lengths, axis=-1), jnp.inf)).astype(jnp.int32)
    lengths = lengths[word] / curvature
    return DubinsPath(start, word, lengths, jnp.asarray(curvature, lengths.dtype))


def sample_dubins(path: DubinsPath, num: int) -> Array:
    """Return poses (num, 3) at equal distances along a path, from its start to its end."""
    senses = jnp.asarray([[_SENSE[part] for part in word] for word in WORDS], path.lengths.dtype)

    def pose_at(station: Array) -> Array:
        x, y, heading = path.start
        for k in range(3):
            length = jnp.clip(station, 0.0, path.lengths[k])
            angle = senses[path.word, k] * path.curvature * length
            chord = length * jnp.sinc(angle / _TURN)
            x = x + chord * jnp.cos(heading + 0.5 * angle)
            y = y + chord * jnp.sin(heading + 0.5 * angle)
            heading, station = heading + angle, station - length
        return jnp.stack([x, y, heading])

    return jax.vmap(pose_at)(jnp.linspace(0.0, 1.0, num) * path.length)


def _root(square: Array) -> Array:
    return jnp.sqrt(jnp.maximum(square, 0.0))


def _wrap(angle: Array) -> Array:
    """Return an angle [rad] in [0, 2 pi); a whole turn up to rounding becomes 0."""
    turned = jnp.mod(angle, _TURN)
    return jnp.where(turned > _TURN - 100.0 * jnp.finfo(turned.dtype).eps, 0.0, turned)
