"""Where the targets, the quadrotor and its net of one row of the run are."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.ball.flight import BallState
from planner_jax.ball.target import BallPath, HarmonicPath
from planner_jax.runs.manifest import Entries, Row
from planner_jax.sweep.quadrotor import SampledMotion, net_thrust


def target_paths(row: Row) -> BallPath | HarmonicPath:
    """Return the targets, leaves with a leading axis N."""

    def leaf(name: str, *trailing: int) -> jax.Array:
        return jnp.asarray(np.reshape(row[name], (-1, *trailing)), jnp.float32)

    if row["swing_pos"] is None:
        ball = BallState(leaf("ball_pos", 3), leaf("ball_vel", 3))
        return BallPath(ball, leaf("drag", 3), leaf("ball_gravity"))
    vectors = {name: leaf(f"swing_{name}", 3) for name in ("pos", "vel", "amplitude")}
    return HarmonicPath(**vectors, rate=leaf("swing_rate"), phase=leaf("swing_phase"))


def target_positions(row: Row, times: np.ndarray) -> np.ndarray:
    """Return where all targets are at some times (K,) [s], (N, K, 3) [m]."""
    return np.asarray(_positions(target_paths(row), jnp.asarray(times, jnp.float32)))


@jax.jit
def _positions(paths: BallPath | HarmonicPath, times: jax.Array) -> jax.Array:
    return jax.vmap(lambda path: jax.vmap(lambda time: path.at(time).pos)(times))(paths)


class SampledCatch(NamedTuple):
    """A row, and its quadrotor, net and N targets at K times."""

    row: Row
    motion: SampledMotion
    axis: np.ndarray  # (K, 3) thrust direction
    centre: np.ndarray  # (K, 3) [m], of the hoop
    radius: float  # [m], of the hoop
    targets: np.ndarray  # (N, K, 3) [m]
    catches: np.ndarray  # (n,) places of the n catches among the times


def sampled_catch(row: Row, motion: SampledMotion, setting: Entries) -> SampledCatch:
    """Return a row whose plan has been sampled, with the physics of the manifest's `setting`."""
    thrust = net_thrust(motion, setting["gravity"])
    axis = thrust / np.maximum(np.linalg.norm(thrust, axis=1, keepdims=True), 1e-9)
    centre = motion.pos + setting["net_height"] * axis
    targets = target_positions(row, motion.time)
    times = np.array(row["catch_times"])[: int(np.sum(row["present"]))]
    catches = np.abs(motion.time[:, None] - times).argmin(axis=0)
    return SampledCatch(row, motion, axis, centre, setting["net_radius"], targets, catches)


def due_distance(plan: SampledCatch) -> np.ndarray:
    """Return distance (K,) [m] from the net's centre to the target that is to be caught next.

    NaN at the first time after a catch, so that curves have a gap there.
    """
    times, num = plan.motion.time, len(plan.catches)
    place = np.searchsorted(np.array(plan.row["catch_times"])[:num], times - 1e-6)
    due = np.array(plan.row["order"])[np.minimum(place, num - 1)]
    distance = np.linalg.norm(plan.targets[due, np.arange(len(times))] - plan.centre, axis=1)
    return np.where(np.diff(place, prepend=0) > 0, np.nan, distance)
