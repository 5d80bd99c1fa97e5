"""Identification of the drag of a quadrotor's rotors from a log, in float64 NumPy."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from planner_jax.core.checks import numbers_of, shape_of
from planner_jax.core.choices import require
from planner_jax.robot.quadrotor_model import GRAVITY, RotorDrag

_WINDOW, _FEWEST = 0.5, 10  # duration [s] and least number of samples of one average
_BUMP = np.poly1d([-1.0, 0.0, 1.0]) ** 5  # weight (1 - s^2)^5 in a window from s = -1 to 1
_BLOCKS = 10  # number of parts of a log; each is left out once, for the standard deviations


def fit_drag(
    times: ArrayLike,
    attitudes: ArrayLike,
    thrusts: ArrayLike,
    *,
    velocities: ArrayLike | None = None,
    positions: ArrayLike | None = None,
    wind: ArrayLike = (0.0, 0.0, 0.0),
) -> tuple[RotorDrag, RotorDrag]:
    """Fit the linear drag [Faessler2018] to K samples of a flight; return it, and its errors.

    The second result has the standard deviations of the two coefficients. The fit is robust least
    squares of accelerations, which are averaged over half a second.

    Args:
        times: (K,) [s], increasing; gaps and irregular steps are allowed.
        attitudes: (K, 4), quaternions w x y z from body to world, or (K, 3), thrust directions.
        thrusts: (K,) [m/s^2], thrust per unit mass, apart from a factor, which is estimated too.
        velocities: (K, 3) [m/s], or None with `positions`.
        positions: (K, 3) [m], or None with `velocities`.
        wind: (3,) or (K, 3) [m/s], velocity of the air.

    Raises:
        ArgumentError: an argument is invalid, or the flight does not determine the drag.
    """
    degree = 1 if positions is None else 2  # of the derivative that is the acceleration
    name, path = ("velocities", velocities) if degree == 1 else ("positions", positions)
    require(velocities is None or degree == 1, "velocities", "left out beside positions", shown="")
    width = 3 if shape_of("attitudes", attitudes)[-1:] == (3,) else 4
    given = {"times": (times, ()), "attitudes": (attitudes, (width,)), "thrusts": (thrusts, ())}
    given |= {name: (path, (3,)), "wind": (wind, (3,))}
    num = shape_of("times", times)[:1]
    arrays = [np.asarray(numbers_of(k, x, num, shape), float) for k, (x, shape) in given.items()]
    for word, array in zip(given, arrays, strict=True):
        require(bool(np.isfinite(array).all()), word, "finite", shown="NaN or infinity")
    t, axis, thrust, data, wind = arrays
    require(bool((np.diff(t) > 0.0).all()), "times", "increasing", t)
    if width == 4:
        w, x, y, z = axis.T
        axis = np.stack([w * y + x * z, y * z - w * x, 0.5 * (w * w - x * x - y * y + z * z)], 1)
    axis = axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
    air = (data if degree == 1 else np.gradient(data, t, axis=0)) - wind
    along = axis * np.sum(axis * air, axis=1, keepdims=True)
    forces = np.stack([thrust[:, None] * axis, along - air, -along])  # times factor, d and d_z
    rows, values, slope = [], [], 2.0 / _WINDOW
    for start in np.arange(t[0], t[-1] - _WINDOW, 0.5 * _WINDOW):
        cut = slice(*np.searchsorted(t, (start, start + _WINDOW)))
        if cut.stop - cut.start < _FEWEST or np.diff(t[cut]).max() > 0.25 * _WINDOW:
            continue
        # The equation of motion, averaged with the weight `_BUMP`, is integrated by parts: samples
        # are not differentiated. The polynomial fit makes averages of constant accelerations exact.
        s = slope * (t[cut] - start) - 1.0
        bump = 0.5 * np.convolve(np.diff(t[cut]), [1.0, 1.0])  # weights of the trapezoid rule
        bump /= bump @ _BUMP(s)
        kernel = bump * (-slope) ** degree * _BUMP.deriv(degree)(s)
        powers = np.vander(t[cut] - start, degree + 1)
        base = np.linalg.lstsq(powers, data[cut])[0]
        acc = degree * base[0] + kernel @ (data[cut] - powers @ base)
        values.append(acc + [0.0, 0.0, GRAVITY])
        rows.append(np.einsum("k,fki->if", bump * _BUMP(s), forces[:, cut]))
    require(len(rows) >= _BLOCKS, "times", f"of {_BLOCKS} windows of {_WINDOW} s", len(rows))
    matrix, right = np.concatenate(rows), np.concatenate(values)
    singular = np.linalg.svd(matrix / (np.abs(matrix).max() + 1e-9), compute_uv=False)
    rule = "of a flight that moves across and along the thrust"
    require(bool(singular[-1] > 1e-3 * singular[0]), name, rule, shown="too little of either")
    drag = [max(x, 0.0) for x in _solve(matrix, right)]
    parts = np.array_split(np.arange(len(right)), _BLOCKS)  # of the delete-a-group jackknife
    others = [_solve(np.delete(matrix, k, 0), np.delete(right, k)) for k in parts]
    std = np.sqrt((_BLOCKS - 1) * np.var(others, axis=0))
    return RotorDrag(*drag), RotorDrag(*std.tolist())


def _solve(matrix: np.ndarray, right: np.ndarray) -> list[float]:
    first = np.linalg.lstsq(matrix, right)[0]
    spread = 1.4826 * np.median(np.abs(right - matrix @ first)) + 1e-9
    off = lambda x: matrix @ x - right  # noqa: E731
    return least_squares(off, first, loss="soft_l1", f_scale=spread).x.tolist()[1:]
