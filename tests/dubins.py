"""The shortest way of a car that only drives forward and turns no tighter than a given curvature.

Of Dubins's six words (three arcs, or an arc, a straight line and an arc, at the tightest
curvature) the shortest is the shortest way of all (L. E. Dubins, 1957). Their lengths are closed
forms (A. M. Shkel and V. Lumelsky, Classification of the Dubins set, 2001), all six at once here,
so that a batch takes no branches. World frame in the plane, SI units, headings counter-clockwise
from the x axis. [Qu2022] uses them as the heuristic and the last part of its search for a path
(Section III-B).
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
    """Three parts, each straight or an arc of the tightest curvature."""

    start: Array  # (3,) x [m], y [m], heading [rad]
    word: Array  # () int32, which of WORDS
    lengths: Array  # (3,) [m], of the three parts
    curvature: Array  # () [1/m], the tightest

    @property
    def length(self) -> Array:
        """Length of the whole way, () [m]."""
        return self.lengths.sum(axis=-1)


def dubins(start: Array, goal: Array, curvature: Array) -> DubinsPath:
    """The shortest way from a pose to another; it always exists.

    Args:
        start: (3,) x [m], y [m], heading [rad].
        goal: (3,) likewise.
        curvature: () [1/m], > 0, the tightest.
    """
    lengths, exists = dubins_words(start, goal, curvature)
    word = jnp.argmin(jnp.where(exists, jnp.sum(lengths, axis=-1), jnp.inf))
    return DubinsPath(
        start=start,
        word=word.astype(jnp.int32),
        lengths=lengths[word],
        curvature=jnp.asarray(curvature, lengths.dtype),
    )


def dubins_words(start: Array, goal: Array, curvature: Array) -> tuple[Array, Array]:
    """Lengths of the three parts of every word (6, 3) [m], and which words lead there (6,) bool.

    The order is that of `WORDS`; lengths of a word that does not lead there mean nothing.
    """
    east, north = (goal[0] - start[0]) * curvature, (goal[1] - start[1]) * curvature
    far = _root(east**2 + north**2)  # with the tightest radius as the unit of length
    along = _angle(north, east)
    a, b = start[2] - along, goal[2] - along
    sin_a, cos_a, sin_b, cos_b = jnp.sin(a), jnp.cos(a), jnp.sin(b), jnp.cos(b)

    # A word and its mirror image differ by the sign of both headings, here that of their sines.
    # What the closed forms have in common is the vector between the centres of two circles.
    def same_sense(side: float) -> tuple[Array, Array]:
        x, y = far + side * (sin_a - sin_b), cos_b - cos_a
        straight, heading = _root(x**2 + y**2), _angle(y, x)
        # Without a straight line the two arcs are one, and its heading has no meaning.
        is_arc = straight < 8.0 * jnp.finfo(straight.dtype).eps
        first = jnp.where(is_arc, side * (b - a), heading - side * a)
        last = jnp.where(is_arc, 0.0, side * b - heading)
        return jnp.stack([_positive(first), straight, _positive(last)]), straight >= 0.0

    def changing_sense(side: float) -> tuple[Array, Array]:
        x, y = far + side * (sin_a + sin_b), -cos_a - cos_b
        square = x**2 + y**2 - 4.0
        straight = _root(square)
        heading = _angle(y, x) - _angle(-2.0, straight)
        first, last = _positive(heading - side * a), _positive(heading - side * b)
        return jnp.stack([first, straight, last]), square >= 0.0

    def three_arcs(side: float) -> tuple[Array, Array]:
        x, y = far + side * (sin_a - sin_b), cos_b - cos_a
        cosine = 1.0 - (x**2 + y**2) / 8.0
        exists = jnp.abs(cosine) < 1.0
        middle = _TURN - jnp.arccos(jnp.where(exists, cosine, 0.0))
        first = _positive(_angle(y, x) - side * a + 0.5 * middle)
        last = _positive(side * (b - a) - first + middle)
        return jnp.stack([first, middle, last]), exists

    left, right = 1.0, -1.0
    words = [
        *(same_sense(left), same_sense(right)),
        *(changing_sense(left), changing_sense(right)),
        *(three_arcs(right), three_arcs(left)),
    ]
    lengths, exists = (jnp.stack(each) for each in zip(*words, strict=True))
    return lengths / curvature, exists


def pose_along(path: DubinsPath, station: Array) -> Array:
    """Pose (3,) of a path at a station () [m], the length since its start; held at its ends."""
    x, y, heading = path.start
    senses = jnp.asarray([[_SENSE[part] for part in word] for word in WORDS], path.lengths.dtype)
    for k in range(3):
        length = jnp.clip(station, 0.0, path.lengths[k])
        angle = senses[path.word, k] * path.curvature * length
        chord = length * jnp.sinc(angle / _TURN)
        x = x + chord * jnp.cos(heading + 0.5 * angle)
        y = y + chord * jnp.sin(heading + 0.5 * angle)
        heading = heading + angle
        station = station - length
    return jnp.stack([x, y, heading])


def sample_dubins(path: DubinsPath, num: int) -> Array:
    """Poses (num, 3) at equal distances along a path, its start and its end among them."""
    stations = jnp.linspace(0.0, 1.0, num) * path.length
    return jax.vmap(pose_along, in_axes=(None, 0))(path, stations)


def _root(square: Array) -> Array:
    """Square root, 0 for what is not positive, with a finite gradient."""
    is_positive = square > 0.0
    return jnp.where(is_positive, jnp.sqrt(jnp.where(is_positive, square, 1.0)), 0.0)


def _angle(y: Array | float, x: Array) -> Array:
    """Direction of a vector, 0 for none, with a finite gradient."""
    is_none = (x == 0.0) & (jnp.asarray(y) == 0.0)
    return jnp.arctan2(jnp.where(is_none, 0.0, y), jnp.where(is_none, 1.0, x))


def _positive(angle: Array) -> Array:
    """An angle [rad] in one turn from 0; a whole turn but for rounding is none."""
    turned = jnp.mod(angle, _TURN)
    return jnp.where(turned > _TURN - 100.0 * jnp.finfo(turned.dtype).eps, 0.0, turned)
