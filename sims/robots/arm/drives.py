"""What the drives of an arm's joints can do, and what its encoders say.

Nothing here needs JAX or MuJoCo, so that settings can be checked before either is imported.
"""

import dataclasses

from planner_jax.core.errors import ArgumentError

# [N m] of the joints of an IRB 1600-6/1.2, an assumption: its maker publishes no torques. Plans
# with the greatest accelerations of the regimes, 60 rad/s^2, need hardly more of joints 1 to 3.
# The wrist never needs so much: the model gives neither rotors nor the shield a mass.
TORQUES = (700.0, 700.0, 250.0, 10.0, 5.0, 2.0)


@dataclasses.dataclass(frozen=True)
class Drives:
    """Drives and encoders of six joints.

    Raises:
        ValueError: a value is out of its range.
    """

    torques: tuple[float, ...] = TORQUES  # [N m], greatest, either way
    lag: float = 0.0  # [s], first order, of the torques
    latency: float = 0.0  # [s], by which a plan comes late to the joints
    angle_std: float = 0.0  # [rad], of an angle that is read
    rate_std: float = 0.0  # [rad/s], of a rate
    mass_error: float = 0.0  # relative, of what control believes of all masses and inertias

    def __post_init__(self) -> None:
        if len(self.torques) != 6 or not all(torque > 0.0 for torque in self.torques):
            raise ArgumentError("torques", "six numbers > 0", self.torques)
        for name in ("lag", "latency", "angle_std", "rate_std"):
            value = getattr(self, name)
            if not value >= 0.0:
                raise ArgumentError(name, ">= 0", value)
        if not self.mass_error > -1.0:
            raise ArgumentError("mass_error", "> -1", self.mass_error)


IDEAL = Drives()  # but for the limits of its torques
# Standard deviations of angles [rad] and rates [rad/s] that are read. Both are assumptions: an
# encoder of 16 bits a turn behind a gear, and the error of a joint with play in its gear.
ENCODERS = {"none": (0.0, 0.0), "fine": (1e-4, 0.01), "coarse": (1e-3, 0.1)}
