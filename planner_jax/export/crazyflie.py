"""Plans as a Crazyflie's high-level commander takes them: polynomials of degree 7, piece by piece.

Its memory holds 132 bytes a piece: eight coefficients of x, of y, of z [m] and of yaw [rad], from
the constant on, and the duration [s], all little-endian float32. Its frame is ours, z up, and its
time in a piece begins at zero as ours does, so that no number changes.
"""

from typing import BinaryIO

import numpy as np

from planner_jax.core.errors import ArgumentError
from planner_jax.export.csv_rows import write_table
from planner_jax.export.setpoints import pieces_of
from planner_jax.robot.quadrotor import QuadrotorPlan

MEMORY = 4096  # bytes for trajectories in the firmware
POWERS = 8
_BYTES = 4 * (4 * POWERS + 1)  # of a piece


def poly4d(plan: QuadrotorPlan) -> np.ndarray:
    """The pieces of a plan, (M, 33) float32: duration [s], then x, y, z [m] and yaw [rad].

    Of each there are eight coefficients, from the constant on, in the time [s] since the piece
    began. The yaw is zero throughout.

    Raises:
        ArgumentError: the plan cannot be exported, its degree is above 7, it has more pieces than
            the memory holds, or its numbers are too large for float32.
    """
    pieces = pieces_of(plan)
    num, powers, _ = pieces.coeffs.shape
    degree = int(np.max(np.nonzero(pieces.coeffs)[1], initial=0))
    if degree >= POWERS:
        raise ArgumentError("plan", f"of degree {POWERS - 1} or less for this", degree)
    if num > MEMORY // _BYTES:
        rule = f"at most {MEMORY // _BYTES} pieces, which fill a Crazyflie's {MEMORY} bytes"
        raise ArgumentError("plan", rule, num, verb="have")
    rows = np.zeros((num, 4, POWERS), np.float32)
    kept = min(powers, POWERS)
    with np.errstate(over="ignore"):
        rows[:, :3, :kept] = np.swapaxes(pieces.coeffs[:, :kept], 1, 2)
        found = np.hstack([pieces.durations[:, None].astype(np.float32), rows.reshape(num, -1)])
    if not np.isfinite(found).all() or not (found[:, 0] > 0.0).all():
        raise ArgumentError("plan", "numbers that float32 holds", verb="have", shown="larger ones")
    return found


def write_csv(plan: QuadrotorPlan, rate: None, file: BinaryIO) -> None:
    """Write the pieces as the table of 33 columns that Crazyflie tools read."""
    powers = [f"{name}^{k}" for name in ("x", "y", "z", "yaw") for k in range(POWERS)]
    write_table(file, ["duration", *powers], [poly4d(plan)])


def write_bin(plan: QuadrotorPlan, rate: None, file: BinaryIO) -> None:
    """Write the pieces as they lie in the Crazyflie's memory, the duration behind the rest."""
    found = poly4d(plan)
    file.write(np.hstack([found[:, 1:], found[:, :1]]).astype("<f4").tobytes())
