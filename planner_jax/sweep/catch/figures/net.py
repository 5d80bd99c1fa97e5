"""Where the net is along a plan."""

from typing import Any, NamedTuple

import numpy as np

from planner_jax.sweep.catch.targets import target_positions
from planner_jax.sweep.figures.motion import SampledMotion, net_thrust, sample_motion


class NetMotion(NamedTuple):
    """Net and quadrotor at K times."""

    motion: SampledMotion
    axis: np.ndarray  # (K, 3) thrust direction
    centre: np.ndarray  # (K, 3) [m], of the hoop


def net_motion(row: dict[str, Any], setting: dict[str, Any], num: int) -> NetMotion:
    """Net and quadrotor at `num` even times of a plan.

    Args:
        row: of `plans.parquet`.
        setting: physics, as in the manifest.
        num: how many times.
    """
    motion = sample_motion(row["coeffs"], row["durations"], num)
    thrust = net_thrust(motion, setting["gravity"])
    axis = thrust / np.maximum(np.linalg.norm(thrust, axis=1, keepdims=True), 1e-9)
    return NetMotion(motion, axis, motion.pos + setting["net_height"] * axis)


def due_distance(row: dict[str, Any], net: NetMotion) -> np.ndarray:
    """Distance (K,) [m] from the net's centre to the target that is to be caught next.

    NaN at the first time after a catch, so that curves have a gap there.
    """
    times = net.motion.time
    num = int(np.sum(row["present"]))
    place = np.searchsorted(np.array(row["catch_times"])[:num], times - 1e-6)
    due = np.array(row["order"])[np.minimum(place, num - 1)]
    targets = target_positions(row, times)
    distance = np.linalg.norm(targets[due, np.arange(len(times))] - net.centre, axis=1)
    return np.where(np.diff(place, prepend=0) > 0, np.nan, distance)


def at_catches(row: dict[str, Any], times: np.ndarray) -> np.ndarray:
    """Places (n,) in sampled times (K,) of the n catches."""
    catches = np.array(row["catch_times"])[: int(np.sum(row["present"]))]
    return np.abs(times[:, None] - catches).argmin(axis=0)
