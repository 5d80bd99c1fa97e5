"""Friction of spinning balls on the racket, for the referee."""

import numpy as np


def rub_ball(case: dict, vel: np.ndarray, normal: np.ndarray, push: np.ndarray) -> tuple:
    """Return the velocity (3, B) [m/s] that friction adds, and the lift vector after the impact.

    `vel` is relative to the racket. The impact adds the velocity `push` along the `normal`.
    """
    lift, reach, grip = case["lift"].T, case["around.reach"], case["around.grip"]
    slip = vel - (vel * normal).sum(axis=0) * normal - reach * np.cross(lift, normal, axis=0)
    size = np.maximum(np.linalg.norm(slip, axis=0), 1e-12)
    rub = -np.minimum(case["around.friction"] * push / size, grip) * slip
    return rub, lift + (1.0 / grip - 1.0) / reach * np.cross(rub, normal, axis=0)
