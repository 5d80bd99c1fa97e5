"""The box that the arm protects, and obstacles, in the robot's base frame [Natarajan2024]."""

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from numpy.typing import ArrayLike

from planner_jax.ball.flight import BallState, drag_free_fall_time
from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.choices import require

INNER_HALF, INNER_HEIGHT = 0.4, 1.35  # [m], half side and height of the protected box
OUTER_HALF, OUTER_HEIGHT = 1.0, 1.85  # [m], half side and height of the box where balls are met
POLE, POLE_RADIUS = (0.806, 0.0), 0.05  # [m], x and y of a vertical pole, and its radius
FLOOR = -0.4826  # [m], height of the floor
# Four horizontal beams form a square around the robot's pedestal. Each beam is modelled as a
# capsule that encloses its cross-section of 0.025 m x 0.076 m.
RIG_HALF, RIG_LENGTH = 0.559, 1.09  # [m], half the side of the square, and length of a beam
RIG_HEIGHT, RIG_RADIUS = -0.08, 0.0401  # [m], height of the beams' axes, and radius of a capsule


@struct.dataclass
class Box:
    """A box whose edges are parallel to the axes of the robot's base frame."""

    lower: Array  # (3,) [m], least coordinates
    upper: Array  # (3,) [m], greatest coordinates


@struct.dataclass
class Scene:
    """Surroundings of the arm: box to protect, box in which balls may be blocked, obstacles."""

    inner: Box  # protected box
    outer: Box  # box in which the shield may meet a ball
    pole: Array  # (2,) [m], x and y of a vertical pole of infinite length
    pole_radius: Array  # () [m]
    has_pole: Array  # () bool, whether the pole exists
    floor: Array  # () [m], height of the floor
    beam_ends: Array  # (N, 2, 3) [m], ends of the axes of capsules around beams
    beam_radius: Array  # (N,) [m]


def paper_scene(*, has_pole: bool = True, size: float = 1.0) -> Scene:
    """Return the scene of the simulations in [Natarajan2024, Fig. 5], with NumPy float32 leaves.

    The sizes are from the model in the authors' repository. The model's box around the camera is
    left out, since the arm touches this box in the pose in which the authors let it wait. All
    lengths are multiplied by `size` > 0, which suits arms with another reach than the authors' arm.
    """
    require(size > 0.0, "size", "> 0", size)

    def leaf(value: ArrayLike) -> Array:
        return host_leaf(size * np.asarray(value), np.float32)

    def box(half: float, height: float) -> Box:
        return Box(lower=leaf([-half, -half, 0.0]), upper=leaf([half, half, height]))

    ends = []
    for along in range(2):
        for side in (-RIG_HALF, RIG_HALF):
            pair = np.full((2, 3), RIG_HEIGHT)
            pair[:, along] = -0.5 * RIG_LENGTH, 0.5 * RIG_LENGTH
            pair[:, 1 - along] = side
            ends.append(pair)
    return Scene(
        inner=box(INNER_HALF, INNER_HEIGHT),
        outer=box(OUTER_HALF, OUTER_HEIGHT),
        pole=leaf(POLE),
        pole_radius=leaf(POLE_RADIUS),
        has_pole=host_leaf(has_pole),
        floor=leaf(FLOOR),
        beam_ends=leaf(ends),
        beam_radius=leaf(np.full(4, RIG_RADIUS)),
    )


def entry_time(box: Box, ball: BallState, gravity: Array) -> tuple[Array, Array]:
    """Return the time at which a ball without drag enters a box through a side or the top.

    The coordinates are processed one by one, so that the compiled program has few loops.

    Returns:
        time: () [s].
        enters: () bool; false for a ball that misses the box, starts inside, or enters from below.
    """
    between = []
    for axis in range(2):
        x, v = ball.pos[axis], ball.vel[axis]
        moves = jnp.where(jnp.abs(v) > 1e-6, v, 1e-6)
        between.append(((box.lower[axis] - x) / moves, (box.upper[axis] - x) / moves))
    from_side = jnp.maximum(*(jnp.minimum(*times) for times in between))
    until = jnp.minimum(*(jnp.maximum(*times) for times in between))
    from_top, _ = drag_free_fall_time(ball, box.upper[2], gravity)

    def height(time: Array) -> Array:
        return ball.pos[2] + ball.vel[2] * time - 0.5 * gravity * time**2

    time = jnp.where(height(jnp.maximum(from_side, 0.0)) > box.upper[2], from_top, from_side)
    return time, (time > 0.0) & (time <= until) & (height(time) > box.lower[2])
