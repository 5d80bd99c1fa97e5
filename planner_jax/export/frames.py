"""Frames of a plan and of those who fly it, the one place where axes and signs change.

Ours, and that of ROS (REP 103): world ENU, x east, y north, z up; body FLU, x forward, y left, z
up; yaw counter-clockwise from east. Where a world has no compass, its x axis is called east. That
of PX4: world NED, x north, y east, z down; body FRD, x forward, y right, z down; yaw clockwise from
north. Nothing moves the origin.
"""

import numpy as np


def to_ned(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) of ENU in NED, or of NED in ENU: (x, y, z) -> (y, x, -z), its own inverse.

    It holds for places, velocities and all other derivatives alike, and changes no bit of a number
    but its sign.
    """
    return np.stack([vectors[..., 1], vectors[..., 0], -vectors[..., 2]], axis=-1)


def to_ned_yaw(yaw: np.ndarray) -> np.ndarray:
    """A yaw [rad] from east to the left as one from north to the right, or back; in [-pi, pi).

    Its rate changes the sign alone.
    """
    return np.mod(1.5 * np.pi - yaw, 2.0 * np.pi) - np.pi


def yaw_of(quat_wxyz: np.ndarray, body_rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Yaw of attitudes, the direction of the body's x axis seen from above, and its rate.

    Args:
        quat_wxyz: (K, 4), FLU body to ENU world.
        body_rate: (K, 3) [rad/s], in the body frame.

    Returns:
        yaw: (K,) [rad] from east to the left; 0 where the x axis points straight up or down.
        rate: (K,) [rad/s], of this angle; 0 there.
    """
    forward, left, up = (rotated(quat_wxyz, axis) for axis in np.eye(3))
    moved = body_rate[:, 2:] * left - body_rate[:, 1:2] * up  # of the x axis, per second
    flat = forward[:, 0] ** 2 + forward[:, 1] ** 2
    turned = forward[:, 0] * moved[:, 1] - forward[:, 1] * moved[:, 0]
    level = flat > 0.0
    yaw = np.arctan2(forward[:, 1], forward[:, 0])
    return np.where(level, yaw, 0.0), np.where(level, turned / np.where(level, flat, 1.0), 0.0)


def rotated(quat_wxyz: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors (K, 3) or (3,) of the body in the world, by unit quaternions (K, 4), in float64."""
    quat = np.asarray(quat_wxyz, float)
    vectors = np.broadcast_to(vectors, (len(quat), 3)).astype(float)
    axis = quat[:, 1:]
    across = 2.0 * np.cross(axis, vectors)
    return vectors + quat[:, :1] * across + np.cross(axis, across)
