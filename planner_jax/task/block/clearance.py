"""Distances of an arm and its shield from obstacles, and between the arm's own links.

The links are represented by capsules, and the shield by a plate of 0.01 m with rounded edges. The
obstacles are a pole, the floor, beams, the base and other links. Distances between neighbouring
links are not computed, nor distances of the links 5 and 6 from the shield, which they carry.

The functions process N poses of the arm at once. N is the last axis of arrays, so that a processor
works on several poses with one instruction.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.robot.arm import Arm, link_frames
from planner_jax.space import distances as space
from planner_jax.task.block.scene import Scene

FAR = 10.0  # [m], added to the distances from the pole if the scene has no pole
# The forearm ends in a fork around the wrist, and the forearm's capsule extends beyond the fork.
# For distances from the shield, the capsule's radius is therefore reduced to at most this fraction
# of the distance between the wrist and the shield's face.
_FORK = 0.71
_HALF_THICKNESS = 0.005  # [m], of the shield
_SHIELD_LINK = 5


class _Poses(NamedTuple):
    ends: Array  # (2, 3, C, N) [m], ends of the capsules' axes
    middle: Array  # (3, N) [m], middle of the shield's plate
    edges: Array  # (2, 3, N) [m], half edges of the plate
    axes: Array  # (6, 3, N), directions of the joints
    origins: Array  # (6, 3, N) [m], positions of the joints


class _Pairs(NamedTuple):
    measure: Callable  # function of `space.distances` that returns the distance of two shapes
    bodies: tuple[Array, ...]  # arguments of `measure`; their last axes are (P or 1, N)
    thick: Array | float  # (P, 1) or () [m], sum of the radii around both bodies
    link: np.ndarray | int  # (P,) or (), 0 to 5, link of the moving body
    fixed: np.ndarray | int = -1  # link of the other body; -1 if it does not move
    first: bool = True  # whether the moving body is the first argument of `measure`


def clearances(arm: Arm, scene: Scene, angles: Array) -> Array:
    """Return the distances (R, N) [m] of R pairs of bodies, in N poses at angles (N, 6) [rad].

    A pair is a link or the shield, and a body that it must not touch. A distance is negative
    if the bodies overlap. The first `num_of_pole(arm)` of the R rows are distances from the pole.
    """
    every = _pairs(arm, scene, _poses(arm, angles))
    return jnp.concatenate([pairs.measure(*pairs.bodies) - pairs.thick for pairs in every])


def least_clearances(arm: Arm, scene: Scene, angles: Array) -> Array:
    """Return the least distance (N,) [m] of bodies that must not touch, at angles (N, 6) [rad]."""
    return jnp.min(clearances(arm, scene, angles), axis=0)


def clearances_and_slopes(
    arm: Arm, scene: Scene, angles: Array
) -> tuple[Array, Callable[[Array], Array]]:
    """Return distances (R, N) [m] of R pairs of bodies in N poses, and their derivative function.

    The function takes the indices (W,) of W of the N poses, and returns the derivatives of the R
    distances at these poses by the joint angles, (R, 6, W) [m/rad]. The derivative by a joint that
    moves both bodies of a pair as one is zero.
    """
    poses = _poses(arm, angles)
    every = _pairs(arm, scene, poses)
    found = [space.nearest_points(pairs.measure, *pairs.bodies) for pairs in every]
    distances = [each - pairs.thick for (each, _), pairs in zip(found, every, strict=True)]
    joint = np.arange(6)[:, None]

    def slopes_at(index: Array) -> Array:
        def at(array: Array) -> Array:  # selects poses; keeps arrays without poses
            return array[..., index] if array.ndim > 1 and array.shape[-1] > 1 else array

        # A joint turns about the axis a through the point o. The derivative of a distance along the
        # unit vector n at the point p is  a . ((p - o) x n), and  a . (o x n) = (a x o) . n.
        axes, origins = (tuple(jnp.moveaxis(at(each), 1, 0)[:, None]) for each in poses[3:])
        arms = space.cross(axes, origins)  # 3 times (1, 6, W)
        slopes = []
        for (_, nearest), pairs in zip(found, every, strict=True):
            line = space.approach(pairs.measure, *jax.tree.map(at, (nearest, *pairs.bodies)))
            direction, moment = (tuple(each[:, None] for each in vector) for vector in line)
            slope = space.dot(axes, moment) - space.dot(arms, direction)  # (P, 6, W)
            of_link, of_fixed = (np.reshape(each, (-1, 1, 1)) for each in (pairs.link, pairs.fixed))
            between = (joint > of_fixed) & (joint <= of_link)
            slopes.append(jnp.where(between, slope if pairs.first else -slope, 0.0))
        return jnp.concatenate(slopes)

    return jnp.concatenate(distances), slopes_at


def num_of_pole(arm: Arm) -> int:
    """Return the number of bodies whose distance from the pole is computed: capsules and shield."""
    return len(_from_link(arm, 1)) + 1


def _from_link(arm: Arm, first: int) -> np.ndarray:
    return np.flatnonzero(np.asarray(arm.capsule_link) >= first - 1)


def _poses(arm: Arm, angles: Array) -> _Poses:
    # Without `optimization_barrier` XLA would compute the poses again for every distance.
    rotations, origins = lax.optimization_barrier(
        jax.vmap(lambda angles: link_frames(arm, angles), out_axes=-1)(angles)
    )

    def rotate(rotations: Array, vector: Array) -> Array:
        x, y, z = (rotations[..., j, :] * vector[..., j, None, None] for j in range(3))
        return x + y + z

    # Append the base as the last link, since the base has the index -1 in `arm.capsule_link`.
    num = angles.shape[0]
    fixed = jnp.broadcast_to(jnp.eye(3, dtype=rotations.dtype)[None, :, :, None], (1, 3, 3, num))
    link = np.asarray(arm.capsule_link, np.int32)
    of_links = jnp.concatenate([rotations, fixed])[link]
    positions = jnp.concatenate([origins, jnp.zeros((1, 3, num), origins.dtype)])[link]
    shield = rotations[_SHIELD_LINK]
    face = origins[_SHIELD_LINK] + rotate(shield, jnp.asarray(arm.shield_centre))
    ends = [rotate(of_links, arm.capsule_ends[:, k]) + positions for k in range(2)]
    return lax.optimization_barrier(
        _Poses(
            ends=jnp.swapaxes(jnp.stack(ends), 1, 2),
            middle=face - _HALF_THICKNESS * shield[:, 0],
            edges=arm.shield_half * jnp.swapaxes(shield[:, 1:], 0, 1),
            axes=rotate(rotations, jnp.asarray(arm.axis)),
            origins=origins,
        )
    )


def _pairs(arm: Arm, scene: Scene, poses: _Poses) -> list[_Pairs]:
    link, radius = np.asarray(arm.capsule_link), jnp.asarray(arm.capsule_radius)
    turning, swung, far = (_from_link(arm, first) for first in (1, 2, 3))
    trunk = np.flatnonzero(link == 0)
    before = np.flatnonzero((link >= 0) & (link <= 3))
    middle, edges = poses.middle[:, None], poses.edges[:, :, None]
    signs = ((1, 1), (1, -1), (-1, -1), (-1, 1))
    corners = [middle + a * edges[0] + b * edges[1] for a, b in signs]
    ends_of_edges = (corners, corners[1:] + corners[:1])
    outline = jnp.stack([jnp.concatenate(ends, axis=1) for ends in ends_of_edges])
    beams = jnp.moveaxis(jnp.asarray(scene.beam_ends), 0, 2)[..., None]  # (2, 3, N, 1)
    beams = jnp.broadcast_to(beams, (*beams.shape[:3], poses.middle.shape[-1]))
    num_beams = beams.shape[2]

    def with_beams(index: np.ndarray) -> Array:
        return jnp.concatenate([poses.ends[:, :, index], beams], axis=2)

    wrist = jnp.sqrt(jnp.sum((arm.origin[5] + arm.shield_centre) ** 2))
    thin = jnp.where(link[before] == 3, jnp.minimum(radius[before], _FORK * wrist), radius[before])
    near_to = jnp.concatenate([thin, scene.beam_radius])[:, None] + _HALF_THICKNESS
    # Pairs of links 3 to 6 with link 1, the trunk, and of links 1 to 6 with the beams. Link 2 is
    # not paired with the trunk, because a joint connects both.
    fixed = with_beams(trunk)
    every = ((k, j) for k in turning for j in range(fixed.shape[2]))
    moving, fixture = np.array([(k, j) for k, j in every if j >= len(trunk) or k in far]).T
    against = fixed[:, :, fixture]
    fixed_radius = jnp.concatenate([radius[trunk], scene.beam_radius])
    between = (radius[moving] + fixed_radius[fixture])[:, None]
    of_fixed = np.where(fixture < len(trunk), 0, -1)
    near, (lower, upper) = with_beams(before), jnp.asarray(arm.base_box)
    of_near = np.append(link[before], np.full(num_beams, -1))
    pole = jnp.where(scene.has_pole, scene.pole_radius, -FAR)
    thick, plate, shield, half = radius[:, None], (middle, edges), _SHIELD_LINK, _HALF_THICKNESS
    to_pole = thick[turning] + pole

    boxed = jnp.concatenate([poses.ends[:, :, swung], outline], axis=2)
    boxed_radius = jnp.concatenate([thick[swung], jnp.full((4, 1), half, thick.dtype)])
    boxed_link = np.append(link[swung], np.full(4, shield))

    def ends(index: np.ndarray) -> Array:
        return poses.ends[:, :, index]

    return [
        _Pairs(space.segment_to_vertical_line, (ends(turning), scene.pole), to_pole, link[turning]),
        _Pairs(space.rectangle_to_vertical_line, (*plate, scene.pole), half + pole, shield),
        _Pairs(space.segment_to_segment, (ends(moving), against), between, link[moving], of_fixed),
        _Pairs(space.segment_to_rectangle, (near, *plate), near_to, shield, of_near, first=False),
        _Pairs(space.lowest_of_segment, (ends(swung),), thick[swung] + scene.floor, link[swung]),
        _Pairs(space.lowest_of_rectangle, plate, half + scene.floor, shield),
        _Pairs(space.segment_to_box, (boxed, lower, upper), boxed_radius, boxed_link),
    ]
