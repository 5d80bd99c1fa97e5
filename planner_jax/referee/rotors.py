"""Thrusts of the rotors of a quadrotor along a trajectory, for the referee, in float64 NumPy.

Attitude and body rate follow from thrust, jerk and heading (Hopf fibration). The angular
acceleration is a central difference of body rates, so that the referee is independent of the
planners, which compute it from the snap.
"""

from collections.abc import Callable

import numpy as np

from planner_jax.referee.air import load_pieces, thrust_along
from planner_jax.referee.heading import headings_of, turn_axes
from planner_jax.referee.judging import cut, derivative
from planner_jax.referee.quadrotor import Pieces

_MOMENT = 1e-5  # [s], half the step of the central difference of body rates
_NUMBERS = 250_000  # greatest number of samples computed at once, so that they fit the cache


def judge_rotors(pieces: Pieces, case: dict, u: np.ndarray, relative: float) -> tuple[dict, dict]:
    """Measure rotor thrusts [N] at fractions u of pieces; test limits with tolerance `relative`."""
    parts = [
        rotor_range(pieces.of(lanes), {name: leaf[lanes] for name, leaf in case.items()}, u)
        for lanes in cut(len(pieces.durations), max(_NUMBERS // (pieces.flown[0].size * u.size), 1))
    ]
    least, least_time, most, most_time = (
        np.concatenate(found) for found in zip(*parts, strict=True)
    )
    low, high = case["limits.rotors.min_thrust"], case["limits.rotors.max_thrust"]
    # Both excesses are relative to the upper limit, since the lower limit of most rotors is zero.
    below, beyond = (low - least) / high, most / high - 1.0
    tests = {
        "rotor low": (~(below <= relative), below, least_time),
        "rotor high": (~(beyond <= relative), beyond, most_time),
    }
    return {"min_rotor_thrust": least, "max_rotor_thrust": most}, tests


def rotor_range(pieces: Pieces, case: dict, u: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the least rotor thrust (B,) [N] and its time [s], and the greatest and its time."""
    times = pieces.durations[:, :, None] * u
    body = (case[f"limits.rotors.{name}"] for name in ("mass", "inertia", "mixer"))
    load, (mass, inertia, mixer) = load_pieces(pieces, case), body
    turn = None
    if "heading.coeffs" in case:
        headings = headings_of(case)
        turn = lambda times: headings(times + pieces.starts[:, :, None])  # noqa: E731
    thrusts = rotor_thrusts(load.coeffs, times, case["gravity"], mass, inertia, mixer, turn)
    if load is not pieces:  # the drag along the thrust adds to the total thrust only
        pull = _pull_and_rate(load.coeffs, times, case["gravity"])[0]
        more = thrust_along(pieces, case, u) - np.linalg.norm(pull, axis=-1)
        thrusts += np.einsum("b,bi,bms->bmsi", mass, mixer[:, :, 0], more)
    lanes, at = np.arange(len(thrusts)), (times + pieces.starts[:, :, None]).reshape(len(times), -1)
    found = []
    for rows, sign in ((thrusts.min(axis=-1), 1.0), (thrusts.max(axis=-1), -1.0)):
        signed = np.where(np.isnan(rows), -np.inf, sign * rows).reshape(len(rows), -1)
        index = signed.argmin(axis=1)
        found += [sign * signed[lanes, index], at[lanes, index]]
    return tuple(found)


def rotor_thrusts(
    coeffs: np.ndarray,
    times: np.ndarray,
    gravity: np.ndarray,
    mass: np.ndarray,
    inertia: np.ndarray,
    mixer: np.ndarray,
    turn: Callable | None = None,
) -> np.ndarray:
    """Return the thrusts (B, M, S, R) [N] of R rotors at S times in M pieces of B trajectories.

    The thrusts are not finite where the attitude is undefined: without thrust and upside down.

    Args:
        coeffs: (3, B, M, D + 1), coefficients of position polynomials of degree D, of rising powers
            of the time since each piece's start.
        times: (B, M, S) [s], since each piece's start.
        gravity: (B,) [m/s^2], magnitude.
        mass: (B,) [kg].
        inertia: (B, 3) or (B, 6) [kg m^2], about the body's axes: I_xx, I_yy, I_zz, and maybe
            I_xy, I_xz, I_yz.
        mixer: (B, R, 4), matrix from thrust [N] and torques [N m] to the thrusts of the rotors.
        turn: function of `times` that returns the headings (B, M, S) [rad] and their derivatives;
            None for a heading of zero.
    """
    pull, rate = _pull_and_rate(coeffs, times, gravity, turn)
    before, after = (
        _pull_and_rate(coeffs, times + step, gravity, turn)[1] for step in (-_MOMENT, _MOMENT)
    )
    # The derivatives of the angular velocity omega in the world frame and in the body frame are
    # equal, because they differ by omega x omega = 0.
    change = (after - before) / (2.0 * _MOMENT)
    axes = _body_axes(pull)
    if turn is not None:
        axes = turn_axes(axes, turn(times)[0])
    own = np.einsum("...ij,...i->...j", axes, rate)
    turning = np.einsum("...ij,...i->...j", axes, change)
    x, y, z, xy, xz, yz = np.pad(inertia, ((0, 0), (0, 6 - inertia.shape[1]))).T
    matrix = np.stack([x, xy, xz, xy, y, yz, xz, yz, z], axis=1).reshape(-1, 1, 1, 3, 3)
    spin, push = (np.einsum("...ij,...j->...i", matrix, each) for each in (own, turning))
    torque = push + np.cross(own, spin)
    thrust = mass[:, None, None, None] * np.linalg.norm(pull, axis=-1)[..., None]
    return np.einsum("bik,bmsk->bmsi", mixer, np.concatenate([thrust, torque], axis=-1))


def _pull_and_rate(
    coeffs: np.ndarray, times: np.ndarray, gravity: np.ndarray, turn: Callable | None = None
) -> tuple[np.ndarray, np.ndarray]:
    powers = np.moveaxis(coeffs, -1, 0)[..., None]
    pull, jerk = (np.moveaxis(derivative(powers, times, order), 0, -1) for order in (2, 3))
    pull[..., 2] += gravity[:, None, None]
    return pull, angular_velocity(pull, jerk, 0.0 if turn is None else turn(times)[1])


def angular_velocity(pull: np.ndarray, jerk: np.ndarray, yaw_rate=0.0) -> np.ndarray:
    """Return angular velocities (..., 3) [rad/s], world frame, for thrusts per unit mass `pull`."""
    size = np.linalg.norm(pull, axis=-1)
    across = np.cross(pull, jerk)
    # The angular velocity is tau x jerk / |tau|^2 + r tau / |tau|, with the thrust per unit mass
    # tau. The Hopf fibration at zero heading determines the rate r about the thrust.
    about = yaw_rate - across[..., 2] / (size * (size + pull[..., 2]))
    return (across / size[..., None] + about[..., None] * pull) / size[..., None]


def _body_axes(pull: np.ndarray) -> np.ndarray:
    """Return the shortest rotations (..., 3, 3) from the world's z axis to thrusts (..., 3)."""
    x, y, z = np.moveaxis(pull / np.linalg.norm(pull, axis=-1, keepdims=True), -1, 0)
    k = 1.0 / (1.0 + z)
    rows = [[1.0 - k * x * x, -k * x * y, x], [-k * x * y, 1.0 - k * y * y, y], [-x, -y, z]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
