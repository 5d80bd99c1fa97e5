"""Conversions from the frames of this library to the frames of the autopilot PX4.

| | world | body | yaw |
|---|---|---|---|
| library, ROS | ENU: x east, y north, z up | FLU: forward, left, up | counter-clockwise from east |
| PX4 | NED: x north, y east, z down | FRD: forward, right, down | clockwise from north |

Both world frames have the same origin. The library's x axis counts as east.
"""

import numpy as np


def to_ned(vectors: np.ndarray) -> np.ndarray:
    """Convert vectors (..., 3) from ENU to NED or back: (x, y, z) -> (y, x, -z)."""
    return np.stack([vectors[..., 1], vectors[..., 0], -vectors[..., 2]], axis=-1)


def to_ned_yaw(yaw: np.ndarray) -> np.ndarray:
    """Convert a yaw [rad] counter-clockwise from east to clockwise from north, or back."""
    return np.mod(1.5 * np.pi - yaw, 2.0 * np.pi) - np.pi


# The yaw is undefined if the body's x axis has a shorter horizontal part than this number.
_VERTICAL = 1e-6


def yaw_of(quat_wxyz: np.ndarray, body_rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return yaw and yaw rate of K attitudes: the direction of the body's x axis, seen from above.

    Args:
        quat_wxyz: (K, 4), quaternions from the body frame FLU to the world frame ENU.
        body_rate: (K, 3) [rad/s], in the body frame.

    Returns:
        Yaw (K,) [rad], counter-clockwise from east, and its rate (K,) [rad/s]. Both are 0 where the
        horizontal part of the body's x axis is shorter than 1e-6.
    """
    forward, left, up = (rotate(quat_wxyz, axis) for axis in np.eye(3))
    moved = body_rate[:, 2:] * left - body_rate[:, 1:2] * up  # derivative of `forward`
    flat = forward[:, 0] ** 2 + forward[:, 1] ** 2
    turned = forward[:, 0] * moved[:, 1] - forward[:, 1] * moved[:, 0]
    level = flat > _VERTICAL**2
    yaw = np.arctan2(forward[:, 1], forward[:, 0])
    return np.where(level, yaw, 0.0), np.where(level, turned / np.where(level, flat, 1.0), 0.0)


def rotate(quat_wxyz: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Rotate vectors (K, 3) or (3,) from body to world by unit quaternions (K, 4), in float64."""
    quat = np.asarray(quat_wxyz, float)
    vectors = np.broadcast_to(vectors, (len(quat), 3)).astype(float)
    axis = quat[:, 1:]
    across = 2.0 * np.cross(axis, vectors)
    return vectors + quat[:, :1] * across + np.cross(axis, across)
