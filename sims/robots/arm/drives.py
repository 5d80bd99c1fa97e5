"""Limits of the drives of an arm's joints, and errors of its encoders.

This module needs neither JAX nor MuJoCo, so that settings can be checked before either is imported.
"""

import dataclasses

from planner_jax.core.errors import ArgumentError

# [N m], torque limits of the six joints of an IRB 1600-6/1.2. They are an assumption, since its
# maker publishes no torques. Plans that block thrown balls, with accelerations up to 60 rad/s^2,
# hardly exceed these limits in joints 1 to 3. The wrist needs far less, because neither the motors'
# rotors nor the shield have a mass in the model.
TORQUES = (700.0, 700.0, 250.0, 10.0, 5.0, 2.0)


@dataclasses.dataclass(frozen=True)
class Drives:
    """Limits of the drives of n joints, and errors of their encoders.

    Raises:
        ValueError: a value is out of its range.
    """

    torques: tuple[float, ...] = TORQUES  # [N m], greatest magnitudes
    lag: float = 0.0  # [s], first-order lag of the torques
    latency: float = 0.0  # [s], delay of a plan's start at the joints
    angle_std: float = 0.0  # [rad], standard deviation of a measured angle
    rate_std: float = 0.0  # [rad/s], standard deviation of a measured rate
    mass_error: float = 0.0  # relative error of the masses and inertias in the controller's model

    def __post_init__(self) -> None:
        if not all(torque > 0.0 for torque in self.torques):
            raise ArgumentError("torques", "numbers > 0", self.torques)
        for name in ("lag", "latency", "angle_std", "rate_std"):
            value = getattr(self, name)
            if not value >= 0.0:
                raise ArgumentError(name, ">= 0", value)
        if not self.mass_error > -1.0:
            raise ArgumentError("mass_error", "> -1", self.mass_error)


IDEAL = Drives()  # drives and encoders without errors; only the torques are limited
# Presets of the standard deviations of measured angles [rad] and rates [rad/s], all assumptions:
# "fine" is an encoder of 16 bits per turn behind a gear, "coarse" a joint with play in its gear.
ENCODERS = {"none": (0.0, 0.0), "fine": (1e-4, 0.01), "coarse": (1e-3, 0.1)}
