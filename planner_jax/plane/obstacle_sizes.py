"""Sizes to which planners pad the arrays of obstacles, so that many cases share one program."""

import dataclasses
import functools

import jax
import numpy as np

from planner_jax.core.arithmetic import Numbers
from planner_jax.core.shapes import next_size, on_host, resize
from planner_jax.plane.obstacles import Obstacles

CORNERS = (6, 8, 16, 32, 64)  # numbers of corners, over which the loops of programs are unrolled
POSES = (64,)  # numbers of poses of a track; the number does not change the computing time


def count_present(group: Obstacles, batch: tuple[int, ...]) -> int:
    """Return the number of entries of a group up to the last obstacle that is present in any case.

    If other hosts hold a part of a jax array, the number of all its entries is returned.
    """
    present, num = group.present, group.present.shape[-1]
    if isinstance(present, jax.Array) and not present.is_fully_addressable:
        return num
    is_used = np.asarray(present)
    used = np.flatnonzero(is_used.reshape(-1, num).any(axis=0) if batch else is_used)
    return int(used[-1]) + 1 if used.size else 0


def fit_obstacles(group: Obstacles, size: int, batch: tuple[int, ...]) -> Obstacles:
    """Return the obstacles of a case, or of a batch of the shape `batch`, in arrays of few sizes.

    The arrays get `size` entries. Added obstacles are absent, added corners and poses repeat the
    last one. Padded corners at the end of NumPy arrays are cut off first.
    """
    host, track = functools.partial(on_host, batch=batch), group.track
    corners = host(group.corners)
    most = next_size(_count_corners(corners), CORNERS)
    is_fit = group.present.shape[-1] == size and corners.shape[-2] == most
    if track is not None:
        poses = host(track.poses)
        num = next_size(poses.shape[-2], POSES)
        is_fit &= poses.shape[-2] == num
        track = dataclasses.replace(
            track,
            poses=resize(resize(poses, -2, num, None), -3, size),
            begin=resize(host(track.begin), -1, size),
            step=resize(host(track.step), -1, size, 1.0),
            end=resize(host(track.end), -1, size),
        )
    if is_fit:
        return group
    return dataclasses.replace(
        group,
        centre=resize(host(group.centre), -2, size),
        corners=resize(resize(corners, -2, most, None), -3, size),
        velocity=resize(host(group.velocity), -2, size),
        present=resize(host(group.present), -1, size, False),
        radius=resize(host(group.radius), -1, size),
        growth=resize(host(group.growth), -1, size),
        track=track,
    )


def _count_corners(corners: Numbers) -> int:
    """Return the number of corners (..., V, 2) up to the last one that differs from the others."""
    num = corners.shape[-2]
    least = CORNERS[0]
    if num <= least or not isinstance(corners, np.ndarray):
        return num
    is_own = corners[..., least:, :] != corners[..., least - 1 : -1, :]
    used = is_own.any(axis=(-3, -1)).reshape(-1, num - least).any(axis=0).nonzero()[0]
    return least + (int(used[-1]) + 1 if used.size else 0)
