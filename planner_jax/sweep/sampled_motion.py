"""A quadrotor's trajectory as the rows hold it, sampled; float64 and NumPy alone."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True)
class SampledMotion:
    """A trajectory at N times."""

    time: np.ndarray  # (N,) [s]
    pos: np.ndarray  # (N, 3) [m]
    vel: np.ndarray  # (N, 3) [m/s]
    acc: np.ndarray  # (N, 3) [m/s^2]
    jerk: np.ndarray  # (N, 3) [m/s^3]


def sample_motion(
    coeffs: Sequence[float] | np.ndarray, durations: Sequence[float] | np.ndarray, num: int
) -> SampledMotion:
    """A trajectory as the rows hold it, at even times.

    Args:
        coeffs: flat, M pieces x ascending powers of the piece's own time x 3 axes.
        durations: (M,) [s].
        num: how many samples.
    """
    ends = np.cumsum(np.asarray(durations, float))
    pieces = np.asarray(coeffs, float).reshape(len(ends), -1, 3)
    time = np.linspace(0.0, ends[-1], num)
    piece = np.minimum(np.searchsorted(ends, time, side="right"), len(ends) - 1)
    local = time - np.concatenate([[0.0], ends[:-1]])[piece]
    powers = local[:, None] ** np.arange(pieces.shape[1])
    derivatives = []
    for order in range(4):
        factors = [math.perm(k, order) for k in range(order, pieces.shape[1])]
        scaled = pieces[piece, order:] * np.array(factors, float)[:, None]
        derivatives.append(np.einsum("nk,nki->ni", powers[:, : scaled.shape[1]], scaled))
    return SampledMotion(time, *derivatives)


def sample_rest(row: Mapping[str, Any], num: int) -> SampledMotion | None:
    """The way to rest of a row of the run, its times those of the plan; None if none."""
    if row["ending_durations"] is None:
        return None
    rest = sample_motion(row["ending_coeffs"], row["ending_durations"], num)
    return dataclasses.replace(rest, time=rest.time + np.sum(row["durations"]))


def net_thrust(motion: SampledMotion, gravity: float) -> np.ndarray:
    """Thrust per unit mass  a + g e_3, (N, 3) [m/s^2]."""
    return motion.acc + gravity * np.array([0.0, 0.0, 1.0])


def body_rate(motion: SampledMotion, gravity: float) -> np.ndarray:
    """Size (N,) [rad/s] of the body rate by the Hopf fibration at zero heading.

    From  c = thrust x jerk: |z'| = |c| / |thrust|^2 across the body z axis, and
    -c_z / (|thrust| (|thrust| + thrust_z)) about it. NaN without thrust and upside down.
    """
    thrust = net_thrust(motion, gravity)
    size = np.linalg.norm(thrust, axis=1)
    cross = np.cross(thrust, motion.jerk)
    with np.errstate(all="ignore"):
        across = np.linalg.norm(cross, axis=1) / size**2
        about = cross[:, 2] / (size * (size + thrust[:, 2]))
        return np.hypot(across, about)
