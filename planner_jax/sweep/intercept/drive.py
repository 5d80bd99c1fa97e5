"""The case and the drive of one row of the run."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.typing import ArrayLike

from planner_jax.plane.obstacles import Obstacles
from planner_jax.plane.target import PointState
from planner_jax.robot.car import CarBody, CarLimits, knots_at, pose_at
from planner_jax.runs.manifest import Entries, Row
from planner_jax.task.intercept.case import InterceptCase

_BODY = tuple(field.name for field in dataclasses.fields(CarBody))
_LIMITS = tuple(field.name for field in dataclasses.fields(CarLimits))


@struct.dataclass
class SampledTarget:
    """A target of any class, straight between the places where it is at even times."""

    places: Array  # (M, 2) [m], the first at time 0
    end: Array  # () [s], the time of the last

    def at(self, time: Array) -> PointState:
        """Position [m] and velocity [m/s] at one time () [s]."""
        num = self.places.shape[0] - 1
        share = jnp.clip(time / self.end * num, 0.0, num)
        k = jnp.clip(share.astype(jnp.int32), 0, num - 1)
        step = self.places[k + 1] - self.places[k]
        return PointState(pos=self.places[k] + (share - k) * step, vel=step * (num / self.end))


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


def case_of(row: Row, setting: Entries) -> InterceptCase:
    """Return the case of a row, with the manifest's `setting`; its target is a `SampledTarget`."""

    def leaf(value: ArrayLike, *shape: int) -> Array:
        return jnp.asarray(np.reshape(value, shape), jnp.float32)

    due = leaf(row["due_time"])
    still = 0.0 * np.array(row["wall_present"], float)
    return InterceptCase(
        start=leaf(row["start"], 3),
        speed=leaf(row["initial_speed"]),
        curvature=leaf(row["initial_curvature"]),
        target=SampledTarget(places=leaf(row["target_way"], -1, 2), end=due),
        time=due,
        walls=_obstacles(row, "wall", np.repeat(still, 2)),
        movers=_obstacles(row, "mover", row["mover_velocity"]),
        lower=leaf(setting["lower"], 2),
        upper=leaf(setting["upper"], 2),
        body=CarBody(**{name: leaf(setting[f"body_{name}"]) for name in _BODY}),
        limits=CarLimits(**{name: leaf(setting[name]) for name in _LIMITS}),
        **{n: leaf(row[n]) for n in ("tolerance", "end_heading", "heading_tolerance")},
    )


def _obstacles(row: Row, kind: str, velocity: ArrayLike) -> Obstacles:
    present = np.array(row[f"{kind}_present"], bool)
    corners = np.reshape(row[f"{kind}_corners"], (len(present), -1, 2))
    centre = corners.mean(axis=1, keepdims=True)
    return Obstacles(
        centre=jnp.asarray(centre[:, 0], jnp.float32),
        corners=jnp.asarray(corners - centre, jnp.float32),
        velocity=jnp.asarray(np.reshape(velocity, (-1, 2)), jnp.float32),
        present=jnp.asarray(present),
    )
