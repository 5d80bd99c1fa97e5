"""Columns of stored cases, and sampled trajectories, for runs of quadrotors that hit or catch."""

import dataclasses

import numpy as np
from numpy.typing import ArrayLike

from planner_jax.core.arithmetic import host_leaf
from planner_jax.referee.rotors import angular_velocity
from planner_jax.robot.quadrotor import Air, add_drag, add_drag_rate
from planner_jax.runs.columns import LIST, VECTOR, Column, RefereedBatch, leaves_of
from planner_jax.runs.manifest import Entries, Row
from planner_jax.trajectory.polynomial import PiecewisePolynomial, states_at


def _starts(batch: RefereedBatch) -> np.ndarray:
    return np.asarray(batch.cases.head_state)[:, 0]


START = Column("start", "m", "hover position of the quadrotor", VECTOR, _starts)

MOTION = leaves_of(
    "verdict",
    ("max_speed", "m/s", "of the quadrotor"),
    ("max_body_rate", "rad/s", "of the quadrotor"),
    ("min_height", "m", "of the propeller plane"),
    ("min_thrust", "m/s^2", "per unit mass"),
    ("max_thrust", "m/s^2", "per unit mass"),
    ("min_rotor_thrust", "N", "of any rotor; NaN where rotors have no limits"),
    ("max_rotor_thrust", "N", "of any rotor; NaN where rotors have no limits"),
    ("continuity_error", "m", "worst jump between pieces"),
    ("head_error", "m", "of the state at time 0"),
)


TRAJECTORY = [
    *leaves_of(
        "plans.trajectory",
        ("durations", "s", "of the pieces", LIST),
        ("coeffs", "m/s^k", "pieces x powers k = 0..D x 3 axes, flat", LIST),
    ),
    *leaves_of(
        "plans.recovery",
        ("recovery_durations", "s", "of the recovery's pieces, if any", LIST, "durations"),
        ("recovery_coeffs", "m/s^k", "of the recovery, as `coeffs`", LIST, "coeffs"),
        optional=True,
    ),
]

_RESTS = {"brake": "to standstill at the cheapest place", "home": "back to the start"}


def recovery_remark(parameters: Row) -> list[str]:
    """Return a sentence on the trajectory after the last contact; [] if the run plans none."""
    if (where := _RESTS.get(parameters.get("recovery", ""))) is None:
        return []
    words = f"After the last contact: a trajectory {where}"
    return [f"{words}; a plan is a success only together with it."]


@dataclasses.dataclass(frozen=True)
class SampledMotion:
    """Position and its first three derivatives along a quadrotor's trajectory, at N times."""

    time: np.ndarray  # (N,) [s]
    pos: np.ndarray  # (N, 3) [m]
    vel: np.ndarray  # (N, 3) [m/s]
    acc: np.ndarray  # (N, 3) [m/s^2]
    jerk: np.ndarray  # (N, 3) [m/s^3]
    air: Air | None = None  # drag and wind, with NumPy leaves


def air_of(setting: Entries) -> Air | None:
    """Return the drag and wind in a manifest's entry `setting`, in float32; None if absent."""
    names = [name for name in ("air_drag", "air_thrust_drag", "air_wind") if name in setting]
    return Air(*(host_leaf(setting[name], np.float32) for name in names)) if names else None


def sample_motion(
    coeffs: ArrayLike, durations: ArrayLike, num: int, air: Air | None = None
) -> SampledMotion:
    """Sample a piecewise polynomial of M pieces at `num` evenly spaced times, in float64.

    Args:
        coeffs: coefficients (M, powers, 3), flattened to one axis; ascending powers of the time
            since the start of each piece.
        durations: (M,) [s], durations of the pieces.
        num: number of samples from the start of the first piece to the end of the last.
        air: drag and wind, for the thrust and the body rate.
    """
    lengths = np.asarray(durations, float)
    pieces = np.asarray(coeffs, float).reshape(len(lengths), -1, 3)
    time = np.linspace(0.0, lengths.sum(), num)
    leaves = (host_leaf(np.broadcast_to(x, (num, *x.shape))) for x in (pieces, lengths))
    states = np.moveaxis(states_at(PiecewisePolynomial(*leaves), time), 1, 0)
    return SampledMotion(time, *states, air=air)


def sample_rest(row: Row, num: int, air: Air | None) -> SampledMotion | None:
    """Sample the recovery trajectory to standstill in a stored row; None if the row has none."""
    if row["recovery_durations"] is None:
        return None
    rest = sample_motion(row["recovery_coeffs"], row["recovery_durations"], num, air)
    return dataclasses.replace(rest, time=rest.time + np.sum(row["durations"]))


def net_thrust(motion: SampledMotion, gravity: float) -> np.ndarray:
    """Return vectors (N, 3) [m/s^2] along the thrust, without drag the thrust per unit mass."""
    load = add_drag(motion.air, motion.vel, motion.acc)  # type: ignore[arg-type]
    return np.asarray(load) + gravity * np.array([0.0, 0.0, 1.0])


def thrust_size(motion: SampledMotion, gravity: float) -> np.ndarray:
    """Return the magnitude of the thrust per unit mass at N times, (N,) [m/s^2]."""
    thrust, air = net_thrust(motion, gravity), motion.air
    size = np.linalg.norm(thrust, axis=1)
    if air is None:
        return size
    along = np.sum(thrust * (motion.vel - air.wind), axis=1) / size
    return size + (air.thrust_drag - air.drag) * along


def body_rate(motion: SampledMotion, gravity: float) -> np.ndarray:
    """Return the magnitude [rad/s] of the body's angular velocity at N times, at zero heading.

    The result is NaN where the thrust is zero or points straight down.
    """
    thrust = net_thrust(motion, gravity)
    jerk = add_drag_rate(motion.air, motion.acc, motion.jerk)  # type: ignore[arg-type]
    with np.errstate(all="ignore"):
        return np.linalg.norm(angular_velocity(thrust, np.asarray(jerk)), axis=1)
