"""Time-optimal motion of the joints along a path, by TOPP-RA, for `rrt-connect` and `epase`.

TOPP-RA [Pham2018] is called through the package `toppra`. [Natarajan2024] times the paths of its
baselines with this method. A cubic spline interpolates the points of the path, and the arm stands
still at the start and at the end.
"""

import importlib
from types import ModuleType

import numpy as np

from planner_jax.core.errors import MissingExtra

PIECES = 128  # greatest number of pieces of a timed motion
DEGREE = 6  # degree of a timed piece: a cubic spline in a quadratic function of time
_INSIDE = np.array([0.0, 0.25, 0.5, 0.75, 1.0])  # fractions of a piece at which limits are checked
_SPARE = 2e-4  # relative slowdown beyond the necessary one, against rounding


def import_extra(name: str) -> ModuleType:
    """Import a module of a package that the optional extra `arm-peers` installs.

    Raises:
        MissingExtra: the package is not installed.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        package = name.partition(".")[0]
        if error.name != package:
            raise
        raise MissingExtra("rrt-connect or epase", package, "arm-peers") from None


def time_path(
    points: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the quickest motion along a spline through points, from standstill to standstill.

    TOPP-RA keeps the limits at the points of a grid. If a limit is exceeded between grid points,
    the whole motion is slowed down.

    Args:
        points: (N, 6) [rad], 2 to `PIECES` / 2 points, of which neighbours differ.
        velocity: (6,) [rad/s], > 0, limits of the joints.
        acceleration: (6,) [rad/s^2], > 0, limits of the joints.

    Returns:
        Coefficients (M, DEGREE + 1, 6) [rad/s^k] and durations (M,) [s] of M <= `PIECES` pieces, or
        None if TOPP-RA fails.

    Raises:
        MissingExtra: toppra is not installed.
    """
    toppra = import_extra("toppra")
    constraint = importlib.import_module("toppra.constraint")
    algorithm = importlib.import_module("toppra.algorithm")
    toppra.setup_logging("ERROR")
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    knots = np.append(0.0, np.cumsum(lengths))
    path = toppra.SplineInterpolator(knots, points)
    grid = _grid(knots)
    limits = [
        constraint.JointVelocityConstraint(velocity),
        constraint.JointAccelerationConstraint(
            acceleration, discretization_scheme=constraint.DiscretizationType.Interpolation
        ),
    ]
    timing = algorithm.TOPPRA(limits, path, gridpoints=grid, solver_wrapper="seidel")
    _, speeds, _ = timing.compute_parameterization(0.0, 0.0)
    if speeds is None or not np.isfinite(speeds).all():
        return None
    steps = np.diff(grid)
    means = 0.5 * (speeds[1:] + speeds[:-1])
    if not (means > 0.0).all():
        return None
    durations = steps / means
    rises = 0.5 * (speeds[1:] - speeds[:-1]) / durations
    spline = np.stack([path(grid[:-1], k) for k in range(3)], axis=1)
    third = (path(grid[1:], 2) - path(grid[:-1], 2)) / steps[:, None]
    coeffs = _compose(
        np.concatenate([spline, third[:, None]], axis=1) / [[[1.0], [1.0], [2.0], [6.0]]],
        speeds[:-1, None],
        rises[:, None],
    )
    slow = (1.0 + _SPARE) * _excess(coeffs, durations, velocity, acceleration)
    return coeffs / slow ** np.arange(DEGREE + 1)[:, None], slow * durations


def _grid(knots: np.ndarray) -> np.ndarray:
    """Return up to `PIECES` + 1 about equally spaced positions along a path, knots included.

    Each span between knots is divided into equal parts, in proportion to its length.
    """
    spans = np.diff(knots)
    parts = 1 + np.floor((PIECES - len(spans)) * spans / spans.sum()).astype(int)
    cut = [knots[k] + spans[k] * np.arange(count) / count for k, count in enumerate(parts)]
    return np.append(np.concatenate(cut), knots[-1])


def _compose(cubic: np.ndarray, speed: np.ndarray, rise: np.ndarray) -> np.ndarray:
    """Return coefficients (M, 7, 6) in time t of cubics (M, 4, 6) in p = speed t + rise t^2."""
    none, one, two, three = np.moveaxis(cubic, 1, 0)
    return np.stack(
        [
            none,
            one * speed,
            one * rise + two * speed**2,
            2.0 * two * speed * rise + three * speed**3,
            two * rise**2 + 3.0 * three * speed**2 * rise,
            3.0 * three * speed * rise**2,
            three * rise**3,
        ],
        axis=1,
    )


def _excess(
    coeffs: np.ndarray, durations: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray
) -> float:
    """Return the factor >= 1 by which a motion has to be slowed down to keep its limits."""
    powers = np.arange(coeffs.shape[1])
    times = (_INSIDE * durations[:, None])[..., None]  # (M, S, 1)
    rates = np.where(powers > 0, times ** np.maximum(powers - 1, 0), 0.0) * powers
    rises = np.where(powers > 1, times ** np.maximum(powers - 2, 0), 0.0) * powers * (powers - 1)
    rate, rise = (np.abs(np.matmul(each, coeffs)).max(axis=(0, 1)) for each in (rates, rises))
    return max(1.0, float(np.max(rate / velocity)), float(np.max(rise / acceleration)) ** 0.5)
