"""Plans for the high-level commander of a Crazyflie quadrotor: polynomials of degree 7.

The memory holds 132 bytes for each piece: eight coefficients each of x, y, z [m] and yaw [rad], the
constant first, then the duration [s], all little-endian float32. The frame is the library's, z up.
The yaw is the plan's heading.
"""

from typing import BinaryIO

import numpy as np

from planner_jax.core.errors import ArgumentError
from planner_jax.export.csv_rows import write_table
from planner_jax.export.setpoints import pieces_of, require_near
from planner_jax.referee.heading import headings_of
from planner_jax.robot.quadrotor import QuadrotorPlan
from planner_jax.trajectory.polynomial import PiecewisePolynomial

MEMORY = 4096  # [bytes], memory for trajectories in the firmware
POWERS = 8  # number of coefficients of a polynomial
_WEIGHT = 1e3  # of the values and rates at the ends of the pieces, in fits of a heading
_BYTES = 4 * (4 * POWERS + 1)  # [bytes], memory of one piece


def poly4d(plan: QuadrotorPlan) -> np.ndarray:
    """Return the polynomial pieces of a plan as rows of 33 float32 numbers.

    A row has the duration [s], then 8 coefficients of rising powers each of x, y, z [m], yaw [rad].

    Raises:
        ArgumentError: the plan cannot be exported, its degree is above 7, it has more pieces than
            4,096 bytes hold, or its numbers are too large for float32.
    """
    pieces = pieces_of(plan)
    num, powers, _ = pieces.coeffs.shape
    degree = int(np.max(np.nonzero(pieces.coeffs)[1], initial=0))
    if degree >= POWERS:
        raise ArgumentError("plan", f"of degree {POWERS - 1} or less for a Crazyflie", degree)
    if num > MEMORY // _BYTES:
        rule = f"at most {MEMORY // _BYTES} pieces, which fill a Crazyflie's {MEMORY} bytes"
        raise ArgumentError("plan", rule, num, verb="have")
    rows = np.zeros((num, 4, POWERS), np.float32)
    if plan.heading is not None:
        rows[:, 3] = _fit_heading(plan.heading, np.asarray(pieces.durations, float))
    stored = min(powers, POWERS)
    with np.errstate(over="ignore"):
        rows[:, :3, :stored] = np.swapaxes(pieces.coeffs[:, :stored], 1, 2)
        table = np.hstack([pieces.durations[:, None].astype(np.float32), rows.reshape(num, -1)])
    if not np.isfinite(table).all() or not (table[:, 0] > 0.0).all():
        raise ArgumentError("plan", "numbers that float32 holds", verb="have", shown="larger ones")
    require_near(np.asarray(pieces.coeffs)[:, 0])
    return table


def _fit_heading(heading: PiecewisePolynomial, durations: np.ndarray) -> np.ndarray:
    """Return polynomials (M, 8) that fit a heading [rad] in M pieces, with its rate at both ends.

    Least squares at 33 times; the values and rates at the ends have weights that make them exact.
    """
    u, powers = np.linspace(0.0, 1.0, 33), np.arange(POWERS)
    leaves = {f"heading.{k}": np.asarray(v, float)[None] for k, v in vars(heading).items()}
    times = (np.cumsum(durations) - durations)[:, None] + durations[:, None] * u
    angle, rate = (each[0] for each in headings_of(leaves)(times[None]))
    ends = [0, -1]
    matrix, slope = u[:, None] ** powers, powers * u[ends, None] ** np.maximum(powers - 1, 0)
    matrix = np.concatenate([matrix, _WEIGHT * matrix[ends], _WEIGHT * slope])
    wanted = [angle, _WEIGHT * angle[:, ends], _WEIGHT * durations[:, None] * rate[:, ends]]
    scaled = np.linalg.lstsq(matrix, np.concatenate(wanted, axis=1).T, rcond=None)[0]
    return scaled.T / durations[:, None] ** powers


def write_csv(plan: QuadrotorPlan, rate: None, file: BinaryIO) -> None:
    """Write the pieces of a plan as a CSV table of 33 columns, the format of Crazyflie's tools."""
    powers = [f"{name}^{k}" for name in ("x", "y", "z", "yaw") for k in range(POWERS)]
    write_table(file, ["duration", *powers], [poly4d(plan)])


def write_bin(plan: QuadrotorPlan, rate: None, file: BinaryIO) -> None:
    """Write the pieces of a plan in the binary layout of the Crazyflie's memory."""
    table = poly4d(plan)
    file.write(np.hstack([table[:, 1:], table[:, :1]]).astype("<f4").tobytes())
