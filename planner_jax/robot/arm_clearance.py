"""Distances of an arm and its shield from obstacles, and between the arm's own links.

The links are represented by capsules, and the shield by a plate of 0.01 m with rounded edges. The
obstacles are capsules, boxes and cylinders of the scene, which also enclose its meshes, the rig's
beams, the floor, the base and other links. The arm states which of its bodies must not touch each
other.

The functions process N poses of the arm at once. N is the last axis of arrays, so that a processor
works on several poses with one instruction.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.robot.arm import Arm, link_frames, quaternion_rotation
from planner_jax.robot.arm_scene import Scene
from planner_jax.space import distances as space

_HALF_THICKNESS = 0.005  # [m], of the shield


class _Poses(NamedTuple):
    ends: Array  # (2, 3, C, N) [m], ends of the capsules' axes
    middle: Array  # (3, N) [m], middle of the shield's plate
    edges: Array  # (2, 3, N) [m], half edges of the plate
    axes: Array  # (n, 3, N), directions of the joints
    origins: Array  # (n, 3, N) [m], positions of the joints


class _Pairs(NamedTuple):
    measure: Callable  # function of `space.distances` that returns the distance of two shapes
    bodies: tuple[Array, ...]  # arguments of `measure`; their last axes are (P or 1, N)
    thick: Array | float  # (P, 1) or () [m], sum of the radii around both bodies
    link: np.ndarray | int  # (P,) or (), 0 to n - 1, link of the moving body
    fixed: np.ndarray | int = -1  # link of the other body; -1 if it does not move
    first: bool = True  # whether the moving body is the first argument of `measure`


def clearances(arm: Arm, scene: Scene, angles: Array) -> Array:
    """Return the distances (R, N) [m] of R pairs of bodies, in N poses at angles (N, n) [rad].

    A pair is a link or the shield, and a body that it must not touch. A distance is negative
    if the bodies overlap. The first `num_of_obstacles(arm, scene)` of the R rows are distances from
    capsules, boxes and cylinders of the scene.
    """
    every = _pairs(arm, scene.without_meshes(), _poses(arm, angles))
    return jnp.concatenate([pairs.measure(*pairs.bodies) - pairs.thick for pairs in every])


def least_clearances(arm: Arm, scene: Scene, angles: Array) -> Array:
    """Return the least distance (N,) [m] of bodies that must not touch, at angles (N, n) [rad]."""
    return jnp.min(clearances(arm, scene, angles), axis=0)


def clearances_and_slopes(
    arm: Arm, scene: Scene, angles: Array
) -> tuple[Array, Callable[[Array], Array]]:
    """Return distances (R, N) [m] of R pairs of bodies in N poses, and their derivative function.

    The function takes the indices (W,) of W of the N poses, and returns the derivatives of the R
    distances at these poses by the joint angles, (R, n, W) [m/rad]. The derivative by a joint that
    moves both bodies of a pair as one is zero.
    """
    poses = _poses(arm, angles)
    every = _pairs(arm, scene.without_meshes(), poses)
    found = [space.nearest_points(pairs.measure, *pairs.bodies) for pairs in every]
    distances = [each - pairs.thick for (each, _), pairs in zip(found, every, strict=True)]
    joint = np.arange(arm.num)[:, None]

    def slopes_at(index: Array) -> Array:
        def at(array: Array) -> Array:  # selects poses; keeps arrays without poses
            return array[..., index] if array.ndim > 1 and array.shape[-1] > 1 else array

        # A joint turns about the axis a through the point o. The derivative of a distance along the
        # unit vector n at the point p is  a . ((p - o) x n), and  a . (o x n) = (a x o) . n.
        axes, origins = (tuple(jnp.moveaxis(at(each), 1, 0)[:, None]) for each in poses[3:])
        arms = space.cross(axes, origins)  # 3 times (1, n, W)
        slopes = []
        for (_, nearest), pairs in zip(found, every, strict=True):
            line = space.approach(pairs.measure, *jax.tree.map(at, (nearest, *pairs.bodies)))
            direction, moment = (tuple(each[:, None] for each in vector) for vector in line)
            slope = space.dot(axes, moment) - space.dot(arms, direction)  # (P, n, W)
            of_link, of_fixed = (np.reshape(each, (-1, 1, 1)) for each in (pairs.link, pairs.fixed))
            between = (joint > of_fixed) & (joint <= of_link)
            slopes.append(jnp.where(between, slope if pairs.first else -slope, 0.0))
        return jnp.concatenate(slopes)

    return jnp.concatenate(distances), slopes_at


def num_of_obstacles(arm: Arm, scene: Scene) -> int:
    """Return the number of pairs of a link or the shield, and a part of a scene's obstacle."""
    scene = scene.without_meshes()
    solids = (scene.capsule_radius, scene.box_half, scene.cylinder_radius)
    rods, boxes, cylinders = (len(each) for each in solids)
    # The shield has pairs with capsules, axes of cylinders, and the 12 edges of each box. Each box
    # has pairs with the shield's 4 edges.
    of_shield = rods + cylinders + (12 + 4) * boxes
    return len(_moving(arm)) * (rods + boxes + cylinders) + of_shield


def _moving(arm: Arm) -> np.ndarray:
    return np.flatnonzero(np.asarray(arm.capsule_link) >= 0)


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
    face = origins[-1] + rotate(rotations[-1], jnp.asarray(arm.shield_centre))
    columns = quaternion_rotation(jnp.asarray(arm.shield_turn)).T
    normal, *edges = (rotate(rotations[-1], column) for column in columns)
    ends = [rotate(of_links, arm.capsule_ends[:, k]) + positions for k in range(2)]
    return lax.optimization_barrier(
        _Poses(
            ends=jnp.swapaxes(jnp.stack(ends), 1, 2),
            middle=face - _HALF_THICKNESS * normal,
            edges=jnp.asarray(arm.shield_half)[:, None, None] * jnp.stack(edges),
            axes=rotate(rotations, jnp.asarray(arm.axis)),
            origins=origins,
        )
    )


def _pairs(arm: Arm, scene: Scene, poses: _Poses) -> list[_Pairs]:
    link, radius = np.asarray(arm.capsule_link), jnp.asarray(arm.capsule_radius)
    turning, high = _moving(arm), np.flatnonzero(link > 0)  # link 1 cannot reach the floor
    swung, before = (np.array(each, int) for each in (arm.base_pairs, arm.shield_pairs))
    middle, edges = poses.middle[:, None], poses.edges[:, :, None]
    outline = _outline(middle, edges)
    beams = jnp.moveaxis(jnp.asarray(scene.beam_ends), 0, 2)[..., None]  # (2, 3, N, 1)
    beams = jnp.broadcast_to(beams, (*beams.shape[:3], poses.middle.shape[-1]))
    num_beams = beams.shape[2]

    def with_beams(index: np.ndarray) -> Array:
        return jnp.concatenate([poses.ends[:, :, index], beams], axis=2)

    thin = jnp.asarray(arm.shield_gap_radius)[before]
    near_to = jnp.concatenate([thin, scene.beam_radius])[:, None] + _HALF_THICKNESS
    # Pairs of the arm's own capsules, and pairs of each moving capsule with each beam.
    others = np.unique([other for _, other in arm.pairs]).astype(int)
    own = [(k, np.searchsorted(others, other)) for k, other in arm.pairs]
    own += [(k, len(others) + beam) for k in turning for beam in range(num_beams)]
    moving, fixture = np.array(own, int).reshape(-1, 2).T
    against = with_beams(others)[:, :, fixture]
    fixed_radius = jnp.concatenate([radius[others], scene.beam_radius])
    between = (radius[moving] + fixed_radius[fixture])[:, None]
    of_fixed = np.append(link[others], np.full(num_beams, -1))[fixture]
    near, (lower, upper) = with_beams(before), jnp.asarray(arm.base_box)
    of_near = np.append(link[before], np.full(num_beams, -1))
    thick, plate, shield, half = radius[:, None], (middle, edges), arm.num - 1, _HALF_THICKNESS

    boxed = jnp.concatenate([poses.ends[:, :, swung], outline], axis=2)
    boxed_radius = jnp.concatenate([thick[swung], jnp.full((4, 1), half, thick.dtype)])
    boxed_link = np.append(link[swung], np.full(4, shield))

    def ends(index: np.ndarray) -> Array:
        return poses.ends[:, :, index]

    return [
        *_obstacles(arm, scene, poses),
        _Pairs(space.segment_to_segment, (ends(moving), against), between, link[moving], of_fixed),
        _Pairs(space.segment_to_rectangle, (near, *plate), near_to, shield, of_near, first=False),
        _Pairs(space.lowest_of_segment, (ends(high),), thick[high] + scene.floor, link[high]),
        _Pairs(space.lowest_of_rectangle, plate, half + scene.floor, shield),
        _Pairs(space.segment_to_box, (boxed, lower, upper), boxed_radius, boxed_link),
    ]


def _outline(middle: Array, edges: Array) -> Array:
    """Return the edges of the shield's plate as segments (2, 3, 4, N) [m]."""
    signs = ((1, 1), (1, -1), (-1, -1), (-1, 1))
    corners = [middle + a * edges[0] + b * edges[1] for a, b in signs]
    ends_of_edges = (corners, corners[1:] + corners[:1])
    return jnp.stack([jnp.concatenate(ends, axis=1) for ends in ends_of_edges])


def _obstacles(arm: Arm, scene: Scene, poses: _Poses) -> list[_Pairs]:
    """Return the pairs of each link and the shield with each obstacle of the scene."""
    link, shield = np.asarray(arm.capsule_link), arm.num - 1
    moving, plate = _moving(arm), (poses.middle[:, None], poses.edges[:, :, None])
    radius, num_poses = jnp.asarray(arm.capsule_radius)[moving], poses.middle.shape[-1]
    # Segments (2, 3, S, 1) whose distance from the shield counts, and the radii around them [m].
    sticks = jnp.moveaxis(jnp.asarray(scene.capsule_ends), 0, 2)[..., None]
    around = jnp.asarray(scene.capsule_radius)
    pairs = []
    if num := around.shape[0]:
        k, j = np.repeat(np.arange(len(moving)), num), np.tile(np.arange(num), len(moving))
        bodies, between = (poses.ends[:, :, moving[k]], sticks[:, :, j]), radius[k] + around[j]
        pairs.append(_Pairs(space.segment_to_segment, bodies, between[:, None], link[moving[k]]))
    if num := scene.box_half.shape[0]:
        middle = jnp.asarray(scene.box_middle).T[..., None]  # (3, M, 1)
        turns = quaternion_rotation(jnp.asarray(scene.box_turn))
        axes = jnp.moveaxis(jnp.swapaxes(turns, 1, 2), 0, 2)[..., None]  # (3, 3, M, 1)
        half = jnp.asarray(scene.box_half).T[..., None]
        # The nearest points of the shield's plate and a box are on an edge of one of them.
        segments = jnp.concatenate([poses.ends[:, :, moving], _outline(*plate)], axis=2)
        of_link = np.append(link[moving], np.full(4, shield))
        thick = jnp.append(radius, jnp.full(4, _HALF_THICKNESS, radius.dtype))
        k, j = np.repeat(np.arange(len(of_link)), num), np.tile(np.arange(num), len(of_link))
        bodies = (segments[:, :, k], middle[:, j], axes[:, :, j], half[:, j])
        pairs.append(_Pairs(space.segment_to_turned_box, bodies, thick[k, None], of_link[k]))
        signs = np.array([(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)])
        corners = [np.insert(sign, k, end) for k in range(3) for sign in signs for end in (-1, 1)]
        corners = jnp.einsum("ec,cmx,cdmx->demx", jnp.asarray(corners, half.dtype), half, axes)
        edges = (corners + middle[:, None]).reshape(3, 12, 2, num)
        edges = jnp.moveaxis(edges, 2, 0).reshape(2, 3, 12 * num, 1)
        sticks = jnp.concatenate([sticks, edges], axis=2)
        around = jnp.append(around, jnp.zeros(12 * num, radius.dtype))
    if num := scene.cylinder_radius.shape[0]:
        axis_ends = jnp.moveaxis(jnp.asarray(scene.cylinder_ends), 0, 2)[..., None]
        wide = jnp.asarray(scene.cylinder_radius)
        k, j = np.repeat(np.arange(len(moving)), num), np.tile(np.arange(num), len(moving))
        bodies = (poses.ends[:, :, moving[k]], axis_ends[:, :, j], wide[j, None])
        pairs.append(_Pairs(space.segment_to_cylinder, bodies, radius[k, None], link[moving[k]]))
        # For distances from the shield, a cylinder is enclosed by a capsule.
        sticks, around = jnp.concatenate([sticks, axis_ends], axis=2), jnp.append(around, wide)
    if pairs:
        bodies = (jnp.broadcast_to(sticks, (*sticks.shape[:3], num_poses)), *plate)
        thick = around[:, None] + _HALF_THICKNESS
        pairs.append(_Pairs(space.segment_to_rectangle, bodies, thick, shield, first=False))
    return pairs
