"""How far an arm and its shield are from what stands around, and from themselves.

Capsules and the shield's face against a pole, the floor, beams, the base and each other. Links that
are neighbours are left out, and so are links 5 and 6 against the shield that they carry. The shield
is a plate of 0.01 m, its face the front one, with rounded edges.

Functions take N poses of the arm at once, and arrays have these on their last axis: so a processor
works on several poses with one instruction.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.robot.arm import Arm, link_frames
from planner_jax.space.distances import (
    approach,
    cross,
    dot,
    lowest_of_rectangle,
    lowest_of_segment,
    rectangle_to_vertical_line,
    segment_to_box,
    segment_to_rectangle,
    segment_to_segment,
    segment_to_vertical_line,
)
from planner_jax.task.block.scene import Scene

FAR = 10.0  # [m], how much farther a pole is taken to be that is not there
# The forearm ends in a fork around the wrist, which a capsule would round off: towards the
# shield it is no thicker than this share of the way from the wrist to the shield's face.
_FORK = 0.71
_HALF_THICKNESS = 0.005  # [m], of the shield
_SHIELD_LINK = 5


class _Poses(NamedTuple):
    """Where everything of the arm is in N poses."""

    ends: Array  # (2, 3, C, N) [m], of the capsules' segments
    middle: Array  # (3, N) [m], of the shield's plate
    edges: Array  # (2, 3, N) [m], halves of its edges
    axes: Array  # (6, 3, N), directions of the joints
    origins: Array  # (6, 3, N) [m], of the joints


class _Pairs(NamedTuple):
    """P pairs of a body that moves and one that it must not touch."""

    measure: Callable  # of `space.distances`
    bodies: tuple[Array, ...]  # what it takes, with lanes (P or 1, N) on the last axes
    thick: Array | float  # (P, 1) or () [m], what both bodies reach beyond that
    link: np.ndarray | int  # (P,) or (), 0 to 5, that the one turns with
    fixed: np.ndarray | int = -1  # likewise of the other body; -1 if it stands
    first: bool = True  # whether the body that moves is the measure's first one


def clearances(arm: Arm, scene: Scene, angles: Array) -> Array:
    """Return distances (R, N) [m] of all pairs in N poses; overlapping capsules have negative ones.

    The first `num_of_pole(arm)` are distances from the pole.
    """
    every = _pairs(arm, scene, _poses(arm, angles))
    return jnp.concatenate([pairs.measure(*pairs.bodies) - pairs.thick for pairs in every])


def least_clearances(arm: Arm, scene: Scene, angles: Array) -> Array:
    """Return the least of `clearances` in each of N poses, (N,) [m]."""
    return jnp.min(clearances(arm, scene, angles), axis=0)


def clearance_slopes(arm: Arm, scene: Scene, angles: Array) -> Array:
    """Return how `clearances` change with each joint, (R, 6, N) [m/rad].

    A joint that turns both bodies of a pair leaves their distance as it is.
    """
    poses = _poses(arm, angles)
    # A joint turns about its axis a through an origin o, and a . (o x n) is (a x o) . n.
    axes, origins = (tuple(jnp.moveaxis(each, 1, 0)) for each in poses[3:])  # 3 times (6, N)
    arms = cross(axes, origins)
    joint = np.arange(6)[:, None]
    slopes = []
    for pairs in _pairs(arm, scene, poses):
        line = approach(pairs.measure, *pairs.bodies)
        direction, moment = (tuple(each[:, None] for each in vector) for vector in line)
        slope = dot(axes, moment) - dot(arms, direction)  # (P, 6, N)
        of_link, of_fixed = (np.reshape(each, (-1, 1, 1)) for each in (pairs.link, pairs.fixed))
        between = (joint > of_fixed) & (joint <= of_link)
        slopes.append(jnp.where(between, slope if pairs.first else -slope, 0.0))
    return jnp.concatenate(slopes)


def num_of_pole(arm: Arm) -> int:
    """Return how many of the pairs are those with the pole: a capsule each, and the shield."""
    return len(_from_link(arm, 1)) + 1


def _from_link(arm: Arm, first: int) -> np.ndarray:
    """Return places of the capsules of a link, 1 to 6, and of those behind it."""
    return np.flatnonzero(np.asarray(arm.capsule_link) >= first - 1)


def _poses(arm: Arm, angles: Array) -> _Poses:
    """Return where the arm is at angles (N, 6)."""
    # Held, since the loops over distances would each work them out anew.
    rotations, origins = lax.optimization_barrier(
        jax.vmap(lambda angles: link_frames(arm, angles), out_axes=-1)(angles)
    )

    def turned(rotations: Array, vector: Array) -> Array:
        """Return vectors (..., 3) of links in the base frame, (..., 3, N)."""
        x, y, z = (rotations[..., j, :] * vector[..., j, None, None] for j in range(3))
        return x + y + z

    # The base is the last link, where -1 finds it.
    num = angles.shape[0]
    fixed = jnp.broadcast_to(jnp.eye(3, dtype=rotations.dtype)[None, :, :, None], (1, 3, 3, num))
    link = np.asarray(arm.capsule_link, np.int32)
    of_links = jnp.concatenate([rotations, fixed])[link]
    places = jnp.concatenate([origins, jnp.zeros((1, 3, num), origins.dtype)])[link]
    shield = rotations[_SHIELD_LINK]
    face = origins[_SHIELD_LINK] + turned(shield, jnp.asarray(arm.shield_centre))
    ends = [turned(of_links, arm.capsule_ends[:, k]) + places for k in range(2)]
    return lax.optimization_barrier(
        _Poses(
            ends=jnp.swapaxes(jnp.stack(ends), 1, 2),
            middle=face - _HALF_THICKNESS * shield[:, 0],
            edges=arm.shield_half * jnp.swapaxes(shield[:, 1:], 0, 1),
            axes=turned(rotations, jnp.asarray(arm.axis)),
            origins=origins,
        )
    )


def _pairs(arm: Arm, scene: Scene, poses: _Poses) -> list[_Pairs]:
    """Return all pairs, those with the pole first."""
    link, radius = np.asarray(arm.capsule_link), jnp.asarray(arm.capsule_radius)
    turning, swung, far = (_from_link(arm, first) for first in (1, 2, 3))
    trunk = np.flatnonzero(link == 0)
    before = np.flatnonzero((link >= 0) & (link <= 3))
    middle, edges = poses.middle[:, None], poses.edges[:, :, None]
    corners = [
        middle + a * edges[0] + b * edges[1] for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))
    ]
    outline = jnp.stack(
        [jnp.concatenate(corners, axis=1), jnp.concatenate(corners[1:] + corners[:1], axis=1)]
    )
    beams = jnp.moveaxis(jnp.asarray(scene.beam_ends), 0, 2)[..., None]  # (2, 3, N, 1)
    beams = jnp.broadcast_to(beams, (*beams.shape[:3], poses.middle.shape[-1]))
    num_beams = beams.shape[2]

    def with_beams(places: np.ndarray) -> Array:
        """Return segments (2, 3, K, N) of capsules and of all beams."""
        return jnp.concatenate([poses.ends[:, :, places], beams], axis=2)

    wrist = jnp.sqrt(jnp.sum((arm.origin[5] + arm.shield_centre) ** 2))
    thin = jnp.where(link[before] == 3, jnp.minimum(radius[before], _FORK * wrist), radius[before])
    near_radius = jnp.concatenate([thin, scene.beam_radius])[:, None] + _HALF_THICKNESS
    # Links against what is fixed to the trunk or to the ground; link 2 turns on the trunk itself.
    fixed = with_beams(trunk)
    place, fixture = (
        np.array(
            [(k, j) for k in turning for j in range(fixed.shape[2]) if j >= len(trunk) or k in far]
        )
    ).T
    against = fixed[:, :, fixture]
    fixed_radius = jnp.concatenate([radius[trunk], scene.beam_radius])
    among_radius = radius[place] + fixed_radius[fixture]
    of_fixed = np.where(fixture < len(trunk), 0, -1)
    near, (lower, upper) = with_beams(before), jnp.asarray(arm.base_box)
    of_near = np.append(link[before], np.full(num_beams, -1))
    pole = jnp.where(scene.has_pole, scene.pole_radius, -FAR)
    thick = radius[:, None]

    def ends(places: np.ndarray) -> Array:
        return poses.ends[:, :, places]

    return [
        _Pairs(
            segment_to_vertical_line,
            (ends(turning), scene.pole),
            thick[turning] + pole,
            link[turning],
        ),
        _Pairs(
            rectangle_to_vertical_line,
            (middle, edges, scene.pole),
            _HALF_THICKNESS + pole,
            _SHIELD_LINK,
        ),
        _Pairs(
            segment_to_segment,
            (ends(place), against),
            among_radius[:, None],
            link[place],
            of_fixed,
        ),
        _Pairs(
            segment_to_rectangle,
            (near, middle, edges),
            near_radius,
            _SHIELD_LINK,
            of_near,
            first=False,
        ),
        _Pairs(lowest_of_segment, (ends(swung),), thick[swung] + scene.floor, link[swung]),
        _Pairs(lowest_of_rectangle, (middle, edges), _HALF_THICKNESS + scene.floor, _SHIELD_LINK),
        _Pairs(segment_to_box, (ends(swung), lower, upper), thick[swung], link[swung]),
        _Pairs(segment_to_box, (outline, lower, upper), _HALF_THICKNESS, _SHIELD_LINK),
    ]
