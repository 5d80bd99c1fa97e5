"""Flight of spinning balls, and their friction on the racket, for the referee."""

import numpy as np


def spin_acc(vel: np.ndarray, air: np.ndarray) -> np.ndarray:
    """Return the accelerations g - K_D s u + l x u of balls with velocities v, and u = v - w.

    `air` has the rows K_D and g, three rows of l and of w, and a row of the radius r, in units of
    |l| / omega. For the spin omega,  s^2 = |u|^2 + |r omega x u|^2 / |u|^2 .
    """
    u = vel - air[5:8]
    square, push = (u * u).sum(axis=0), np.cross(air[2:5], u, axis=0)
    square = square + air[8] ** 2 * (push * push).sum(axis=0) / np.maximum(square, 1e-12)
    acc = -air[0] * np.sqrt(square) * u
    acc[2] -= air[1]
    return acc + push


def rub_ball(case: dict, vel: np.ndarray, normal: np.ndarray, push: np.ndarray) -> tuple:
    """Return the velocity (3, B) [m/s] that friction adds, and the lift vector after the impact.

    `vel` is relative to the racket. The impact adds the velocity `push` along the `normal`.
    """
    lift, reach, grip = case["lift"].T, case["around.reach"], case["around.grip"]
    slip = vel - (vel * normal).sum(axis=0) * normal - reach * np.cross(lift, normal, axis=0)
    size = np.maximum(np.linalg.norm(slip, axis=0), 1e-12)
    rub = -np.minimum(case["around.friction"] * push / size, grip) * slip
    return rub, lift + (1.0 / grip - 1.0) / reach * np.cross(rub, normal, axis=0)
