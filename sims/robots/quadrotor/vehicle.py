"""The simulated quadrotor: masses, rotors, and the allocation of thrust and torque to them.

Body frame: x forward, y left, z along the thrust; the origin is the centre of mass, in the
propeller plane. Rotor i stands at 45 + 90 i degrees and turns against its neighbours.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax import Array, lax


@dataclasses.dataclass(frozen=True)
class Vehicle:
    """What the quadrotor is made of; static under jit.

    The diagonal is that of papers 000 and 002; they give neither mass, inertia nor rotors.
    Those here are assumptions: 0.9 kg of computer, battery and frame within 5 cm of the centre
    and 75 g of motor and propeller at the end of each arm. The greatest thrust is 4 g, so that a
    plan of 2.5 g leaves room for control. The body has no drag; net and racket weigh nothing.
    """

    mass: float = 1.2  # [kg]
    inertia: tuple[float, float, float] = (0.005, 0.005, 0.009)  # [kg m^2], principal
    diagonal: float = 0.33  # [m], between opposite rotors
    max_rotor_thrust: float = 11.8  # [N]
    torque_ratio: float = 0.016  # [m], rotor's drag torque over its thrust
    rotor_lag: float = 0.02  # [s], time constant of a rotor's thrust
    spare_thrust: float = 1.0  # [N], by which a rotor's may be raised to make room for a torque
    rotor_radius: float = 0.06  # [m], to be looked at

    def __post_init__(self) -> None:
        for name in ("mass", "diagonal", "max_rotor_thrust", "torque_ratio", "rotor_lag"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be > 0, got {getattr(self, name)}")


def rotor_positions(vehicle: Vehicle) -> np.ndarray:
    """Rotor centres (4, 3) [m], body frame."""
    angle = np.pi / 4.0 + np.pi / 2.0 * np.arange(4)
    return 0.5 * vehicle.diagonal * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)


def rotor_torques(vehicle: Vehicle) -> np.ndarray:
    """Torque about body z that each rotor's drag makes of its thrust (4,) [m]."""
    return vehicle.torque_ratio * np.array([1.0, -1.0, 1.0, -1.0])


def allocation(vehicle: Vehicle) -> np.ndarray:
    """The matrix (4, 4) from rotor thrusts [N] to total thrust [N] and torque [N m]."""
    places = rotor_positions(vehicle)
    return np.stack([np.ones(4), places[:, 1], -places[:, 0], rotor_torques(vehicle)])


def rotor_thrusts(vehicle: Vehicle, thrust: Array, torque: Array) -> Array:
    """Rotor thrusts (4,) [N] that make a wrench, each within what a rotor can do.

    Where they cannot make all of it, roll and pitch go before the thrust, without which it
    would point elsewhere, and the thrust before yaw, which a round tool does not feel. Roll and
    pitch are cut where they would raise the thrust by more than is spared for them.

    Args:
        vehicle: whose rotors.
        thrust: () [N], along body z.
        torque: (3,) [N m], body frame.
    """
    inverse = jnp.asarray(np.linalg.inv(allocation(vehicle)), torque.dtype)
    most = vehicle.max_rotor_thrust
    turning = jnp.matmul(inverse[:, 1:3], torque[:2], precision=lax.Precision.HIGHEST)
    lift = 0.25 * thrust
    turning *= jnp.minimum((lift + vehicle.spare_thrust) / jnp.maximum(-jnp.min(turning), 1e-6), 1)
    wanted = lift + turning
    below, above = jnp.maximum(-jnp.min(wanted), 0.0), jnp.maximum(jnp.max(wanted) - most, 0.0)
    level = jnp.clip(wanted + below - above, 0.0, most)
    yaw = inverse[:, 3] * torque[2]
    room = jnp.where(yaw > 0.0, most - level, level)
    share = jnp.min(room / jnp.maximum(jnp.abs(yaw), 1e-6))
    return level + jnp.minimum(share, 1.0) * yaw
