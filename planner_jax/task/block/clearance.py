"""How far an arm and its shield are from what stands around, and from themselves.

Capsules and the shield's face against a pole, the floor, beams, the base and each other. Links that
are neighbours are left out, and so are links 5 and 6 against the shield that they carry. The shield
is a plate of 0.01 m, its face the front one, with rounded edges.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.robot.arm import Arm, capsules, shield_pose
from planner_jax.space.distances import (
    lowest_of_rectangle,
    lowest_of_segment,
    rectangle_to_vertical_line,
    segment_to_box,
    segment_to_rectangle,
    segment_to_segment,
    segment_to_vertical_line,
)
from planner_jax.task.block.scene import Scene

FAR = 10.0  # [m], of a pole that is not there
# The forearm ends in a fork around the wrist, which a capsule would round off: towards the
# shield it is no thicker than this share of the way from the wrist to the shield's face.
_FORK = 0.71
_HALF_THICKNESS = 0.005  # [m], of the shield


def clearances(arm: Arm, scene: Scene, angles: Array) -> Array:
    """Distances (R,) [m] of all pairs at angles (6,); capsules that overlap have negative ones.

    The first `num_of_pole(arm)` are those from the pole.
    """
    ends = capsules(arm, angles)
    rotation, middle = shield_pose(arm, angles)
    middle = middle - _HALF_THICKNESS * rotation[:, 0]
    edges = arm.shield_half * rotation[:, 1:].T
    link = np.asarray(arm.capsule_link)
    moving, trunk = _moving(arm), np.flatnonzero(link == 0)
    before = np.flatnonzero((link >= 0) & (link <= 3))
    radius = jnp.asarray(arm.capsule_radius)
    shield_edges = _outline(middle, edges)

    def to_pole(distance: Array) -> Array:
        return jnp.where(scene.has_pole, distance - scene.pole_radius, FAR)

    of_links = jax.vmap(segment_to_segment, (None, 0))
    fixed = jnp.concatenate([ends[trunk], scene.beam_ends])
    fixed_radius = jnp.concatenate([radius[trunk], scene.beam_radius])
    among = jax.vmap(of_links, (0, None))(ends[moving], fixed)
    near_shield = jnp.concatenate([ends[before], scene.beam_ends])
    wrist = jnp.sqrt(jnp.sum((arm.origin[5] + arm.shield_centre) ** 2))
    thin = jnp.where(link[before] == 3, jnp.minimum(radius[before], _FORK * wrist), radius[before])
    near_radius = jnp.concatenate([thin, scene.beam_radius])
    of_shield = jax.vmap(segment_to_rectangle, (0, None, None))(near_shield, middle, edges)
    on_pole = jax.vmap(segment_to_vertical_line, (0, None))(ends[moving], scene.pole)
    shield_on_pole = rectangle_to_vertical_line(middle, edges, scene.pole)
    on_floor = jax.vmap(lowest_of_segment)(ends[moving]) - scene.floor
    on_base = jax.vmap(segment_to_box, (0, None, None))
    lower, upper = jnp.asarray(arm.base_box)
    shield_on_base = jnp.min(on_base(shield_edges, lower, upper))
    rows = [
        to_pole(on_pole - radius[moving]),
        to_pole(shield_on_pole - _HALF_THICKNESS)[None],
        (among - radius[moving][:, None] - fixed_radius).reshape(-1),
        of_shield - near_radius - _HALF_THICKNESS,
        on_floor - radius[moving],
        lowest_of_rectangle(middle, edges)[None] - _HALF_THICKNESS - scene.floor,
        on_base(ends[moving], lower, upper) - radius[moving],
        shield_on_base[None] - _HALF_THICKNESS,
    ]
    return jnp.concatenate(rows)


def num_of_pole(arm: Arm) -> int:
    """How many of the pairs are those with the pole: a capsule each, and the shield."""
    return len(_moving(arm)) + 1


def _moving(arm: Arm) -> np.ndarray:
    """Places of the capsules of links 3 to 6, which reach what stands around."""
    return np.flatnonzero(np.asarray(arm.capsule_link) >= 2)


def _outline(middle: Array, edges: Array) -> Array:
    """The four edges (4, 2, 3) of a rectangle."""
    signs = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)])
    corners = middle + signs[:, :1] * edges[0] + signs[:, 1:] * edges[1]
    return jnp.stack([corners, jnp.roll(corners, -1, axis=0)], axis=1)
