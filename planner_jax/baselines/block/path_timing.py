"""Quickest motion of the joints along a path, by TOPP-RA, for `rrt-connect` and `epase`.

The method TOPP-RA [Pham2018] is called through the package `toppra`. [Natarajan2024] uses it for
the paths of its baselines. A cubic spline interpolates the points of the path, and the arm stands
still at the start and at the end.
"""

import importlib
from types import ModuleType

import numpy as np

from planner_jax.core.missing_extra import MissingExtra

PIECES = 128  # greatest number of polynomial pieces of a timed motion
DEGREE = 6  # degree of a piece: a cubic in the path length, which is quadratic in time
_INSIDE = np.array([0.0, 0.25, 0.5, 0.75, 1.0])  # fractions of a piece at which limits are checked
_SPARE = 2e-4  # additional relative slowdown of a motion, because of rounding errors


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

    TOPP-RA keeps the limits at some points of the path (a grid). If a limit is exceeded between
    two of them, the whole motion is slowed down.

    Args:
        points: (N, 6) [rad], joint angles of 2 to `PIECES` / 2 points; neighbours must differ.
        velocity: (6,) [rad/s], > 0, limits of the joints.
        acceleration: (6,) [rad/s^2], > 0, limits of the joints.

    Returns:
        Coefficients (M, DEGREE + 1, 6), lowest power of time first, and durations (M,) [s] of
        M <= `PIECES` polynomial pieces; or None if TOPP-RA fails.

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
    spans = np.diff(knots)
    parts = 1 + np.floor((PIECES - len(spans)) * spans / spans.sum()).astype(int)
    cut = [knots[k] + spans[k] * np.arange(count) / count for k, count in enumerate(parts)]
    return np.append(np.concatenate(cut), knots[-1])


def _compose(cubic: np.ndarray, speed: np.ndarray, rise: np.ndarray) -> np.ndarray:
    """Convert M cubics in the path length to polynomials of degree 6 in the time t, (M, 7, 6).

    The path length is speed t + rise t^2. `cubic` (M, 4, 6) has coefficients for six joints.
    """
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
    """Return the factor >= 1 on a motion's durations that is needed to keep the joint limits."""
    powers = np.arange(coeffs.shape[1])
    times = (_INSIDE * durations[:, None])[..., None]  # (M, S, 1)
    rates = np.where(powers > 0, times ** np.maximum(powers - 1, 0), 0.0) * powers
    rises = np.where(powers > 1, times ** np.maximum(powers - 2, 0), 0.0) * powers * (powers - 1)
    rate, rise = (np.abs(np.matmul(each, coeffs)).max(axis=(0, 1)) for each in (rates, rises))
    return max(1.0, float(np.max(rate / velocity)), float(np.max(rise / acceleration)) ** 0.5)
