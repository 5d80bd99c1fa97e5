"""The drive of one row of the run."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.robot.car import knots_at, pose_at
from planner_jax.runs.manifest import Entries, Row


@dataclasses.dataclass(frozen=True)
class SampledDrive:
    """A row, its obstacles as polygons, and car and target at K even times of the plan."""

    row: Row
    setting: Entries  # of the manifest
    walls: list[np.ndarray]  # (V, 2) [m] each
    movers: list[np.ndarray]  # likewise, at time 0
    velocities: np.ndarray  # (N, 2) [m/s], of the movers
    time: np.ndarray  # (K,) [s]
    pose: np.ndarray  # (K, 3), of the rear axle: x, y [m], heading [rad]
    middle: np.ndarray  # (K, 2) [m], of the body
    speed: np.ndarray  # (K,) [m/s]
    acceleration: np.ndarray  # (K,) [m/s^2], along the way
    curvature: np.ndarray  # (K,) [1/m]
    target: np.ndarray  # (K, 2) [m]

    def target_at(self, times: np.ndarray | float) -> np.ndarray:
        """Return where the target is expected at times (T,) [s] up to the case's, (T, 2) [m]."""
        places = np.reshape(self.row["target_way"], (-1, 2))
        known = np.linspace(0.0, self.row["due_time"], len(places))
        return np.stack([np.interp(times, known, places[:, k]) for k in range(2)], axis=-1)

    def pose_at(self, time: float) -> np.ndarray:
        """Pose (3,) of the rear axle at one time [s]."""
        return np.array([np.interp(time, self.time, self.pose[:, k]) for k in range(3)])

    def footprint(self, pose: np.ndarray) -> np.ndarray:
        """Return corners (4, 2) [m] of the body around a pose (3,) of the rear axle."""
        behind, half = -self.setting["body_rear_overhang"], 0.5 * self.setting["body_width"]
        ahead = behind + self.setting["body_length"]
        corners = np.array([(behind, -half), (ahead, -half), (ahead, half), (behind, half)])
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        return pose[:2] + corners @ np.array([[cos, sin], [-sin, cos]])


def sampled_drive(row: Row, setting: Entries, num: int) -> SampledDrive:
    """Return a row at so many even times, with the manifest's `setting`."""
    start, speed, curvature = (
        jnp.asarray(row[name], jnp.float32) for name in ("start", "speed", "curvature")
    )
    end = jnp.asarray(row["meeting_time"], jnp.float32)
    shares = jnp.linspace(0.0, 1.0, num)
    found = _sampled(start, end, speed, curvature, shares)
    sampled = {name: np.array(leaf) for name, leaf in found.items()}
    direction = np.stack([np.cos(sampled["pose"][:, 2]), np.sin(sampled["pose"][:, 2])], axis=1)
    ahead = 0.5 * setting["body_length"] - setting["body_rear_overhang"]
    velocity = np.reshape(row["mover_velocity"], (-1, 2))
    drive = SampledDrive(
        row=row,
        setting=setting,
        walls=_polygons(row, "wall"),
        movers=_polygons(row, "mover"),
        velocities=velocity[np.array(row["mover_present"], bool)],
        middle=sampled["pose"][:, :2] + ahead * direction,
        target=np.zeros((num, 2)),
        **sampled,
    )
    return dataclasses.replace(drive, target=drive.target_at(drive.time))


def _polygons(row: Row, kind: str) -> list[np.ndarray]:
    """Return those of a kind that are there, (V, 2) [m] each."""
    present = np.array(row[f"{kind}_present"], bool)
    corners = np.reshape(row[f"{kind}_corners"], (len(present), -1, 2))
    return list(corners[present])


@jax.jit
def _sampled(
    start: Array, end: Array, speed: Array, curvature: Array, shares: Array
) -> dict[str, Array]:
    """Return fields of `SampledDrive` of one plan at shares (K,) of its time, by name."""
    time = end * shares

    def at(time: Array) -> tuple[Array, ...]:
        return pose_at(start, end, speed, curvature, time), *knots_at(end, speed, curvature, time)

    pose, v, c, acceleration = jax.vmap(at)(time)
    return {"time": time, "pose": pose, "speed": v, "curvature": c, "acceleration": acceleration}
