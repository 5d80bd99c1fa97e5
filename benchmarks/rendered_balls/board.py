"""Calibration of a camera from a board that the arm holds up, without rendered images.

The board covers the face of the arm's shield and has the same size. Each corner of the board's
grid is measured with the independent noise of a stereo camera. Poses of the arm are not checked
for collisions.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.benchmarks.rendered_balls.calibrate import Calibration, calibrate, pose
from planner_jax.robot.arm import Arm, link_frames
from planner_jax.sims.perception.camera import Camera, from_numbers, in_view, to_camera
from planner_jax.sims.perception.noise import StereoNoise, depth_std

_CORNERS = 6  # number of grid corners along each edge of the board
_FACING = 0.5  # least cosine between the board's normal and the direction to the camera


class BoardViews(NamedTuple):
    """K views of a calibration board that an arm holds up: the arguments of `calibrate`."""

    flange: np.ndarray  # (K, 4, 4), poses of the arm's flange in the base frame
    points: np.ndarray  # (M, 3) [m], positions of the corners in the flange's frame
    seen: np.ndarray  # (K, M, 3) [m], measured corners in the camera's frame
    std: np.ndarray  # (K, M, 3) [m], standard deviations of the measured corners


def show_board(
    arm: Arm, camera: Camera, noise: StereoNoise, num: int, *, seed: int = 0, draws: int = 20000
) -> BoardViews:
    """Return views of a calibration board on the arm, in `num` random poses of the arm.

    Args:
        arm: the arm, with NumPy leaves.
        camera: the camera at its true pose.
        noise: parameters of the stereo camera's noise.
        num: number of views, >= 1.
        seed: random seed of poses and noise.
        draws: number of drawn poses; poses in which the camera cannot see the board are dropped.

    Raises:
        ValueError: the camera sees the board in fewer than `num` of the drawn poses.
    """
    rng = np.random.default_rng(seed)
    angles = rng.uniform(arm.lower, arm.upper, (draws, 6)).astype(np.float32)
    rotations, positions = jax.jit(jax.vmap(link_frames, (None, 0)))(arm, angles)
    flange = pose(np.asarray(rotations[:, 5], float), np.asarray(positions[:, 5], float))
    half = float(np.min(arm.shield_half))
    grid = np.stack(np.meshgrid(*[np.linspace(-half, half, _CORNERS)] * 2), axis=-1)
    points = np.asarray(arm.shield_centre) + np.pad(grid.reshape(-1, 2), ((0, 0), (1, 0)))
    shown = points @ np.swapaxes(flange[:, :3, :3], 1, 2) + flange[:, None, :3, 3]
    away = np.asarray(camera.position) - shown.mean(axis=1)
    facing = np.sum(flange[:, :3, 0] * away, axis=1) / np.linalg.norm(away, axis=1)
    all_seen = np.asarray(in_view(camera, jnp.asarray(shown, jnp.float32))).all(axis=1)
    chosen = np.flatnonzero(all_seen & (facing > _FACING))[:num]
    if len(chosen) < num:
        raise ValueError(f"the camera sees the board in {len(chosen)} of {draws} poses, not {num}")
    own = np.asarray(to_camera(camera, jnp.asarray(shown[chosen], jnp.float32)), float)
    depth = own[..., 2]
    across = depth * float(noise.pixel_std) / float(camera.focal)
    along = np.asarray(depth_std(camera, noise, jnp.asarray(depth, jnp.float32)))
    # The depth error acts along the ray from camera to corner. The pixel errors act across the
    # ray; their components along the ray are neglected.
    ray = own / depth[..., None]
    none = np.zeros_like(depth)
    errors = rng.normal(size=own.shape)
    off = errors * np.stack([across, across, none], axis=-1)
    seen = own + off + (errors[..., 2] * along)[..., None] * ray
    std = np.sqrt(np.stack([across, across, none], axis=-1) ** 2 + (along[..., None] * ray) ** 2)
    return BoardViews(flange[chosen], points, seen, std)


def calibrate_camera(
    arm: Arm, camera: Camera, noise: StereoNoise, num: int = 20, *, seed: int = 0
) -> tuple[Camera, Calibration]:
    """Calibrate a camera by `num` simulated views of a board that the arm holds in random poses.

    Returns:
        The camera at its calibrated pose, and the poses and residuals of the calibration.
    """
    found = calibrate(*show_board(arm, camera, noise, num, seed=seed))
    return move_camera(camera, found.camera), found


def move_camera(camera: Camera, pose: np.ndarray) -> Camera:
    """Return the camera at another pose, a homogeneous transform (4, 4) from camera to world."""
    moved = functools.partial(Camera, focal=camera.focal, size=camera.size)
    return from_numbers(moved, rotation=pose[:3, :3], position=pose[:3, 3])
