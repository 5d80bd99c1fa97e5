"""Thrust of quadrotors with drag and wind, for the referee."""

import dataclasses

import numpy as np

from planner_jax.referee.quadrotor import Pieces, motion_of, norm_squared


def load_pieces(pieces: Pieces, case: dict) -> Pieces:
    """Return pieces q whose second derivative is  a + d (v - w) , or `pieces` if drag is absent.

    With the drag d [1/s] across the thrust and the wind w [m/s], `pieces` need the thrust direction
    and the body rate that q would need without drag [Faessler2018]. For the position p,
    q = p + d (integral of p from 0 to t) - d w t^2 / 2 .
    """
    if "limits.air.drag" not in case:
        return pieces
    drag, wind = case["limits.air.drag"][:, None], case["limits.air.wind"].T[:, :, None]
    coeffs = np.pad(pieces.coeffs, [(0, 0)] * 3 + [(0, 1)])
    coeffs[..., 1:] += drag[..., None] * pieces.coeffs / np.arange(1, coeffs.shape[-1])
    coeffs[..., 2] -= 0.5 * drag * wind
    return dataclasses.replace(pieces, coeffs=coeffs)


def thrust_along(pieces: Pieces, case: dict, u: np.ndarray) -> np.ndarray:
    """Return the thrust per unit mass (B, M, S) [m/s^2] against gravity, drag and wind.

    It is  n . (a + g e_3 + d_z (v - w))  for the thrust direction n, at S fractions of the pieces.
    """
    _, vel, acc, _ = motion_of(pieces, u)
    direction = motion_of(load_pieces(pieces, case), u)[2]
    for each in (acc, direction):
        each[2] += case["gravity"][:, None, None]
    wind, drag = case["limits.air.wind"].T[:, :, None, None], case["limits.air.thrust_drag"]
    force = acc + drag[:, None, None] * (vel - wind)
    return (direction * force).sum(axis=0) / np.sqrt(norm_squared(direction))
