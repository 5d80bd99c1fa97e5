"""Dimensions and limits of the simulated car, and its tyres.

The car is a model car of scale 1:10, as in `planner_jax.task.intercept.case`. [Qu2022] reports no
dimensions and limits. The limits of drive and steering are 50 % above the limits of plans, which
leaves a margin for control.
"""

import dataclasses

from planner_jax.core import GRAVITY
from planner_jax.core.errors import ArgumentError


@dataclasses.dataclass(frozen=True)
class Tyres:
    """Parameters of the tyres: lateral force is proportional to slip angle, up to a limit.

    The numbers are assumptions for hard rubber on a smooth floor.
    """

    stiffness: float = 5.0  # [1/rad], (lateral force) / (vertical load) per slip angle
    friction: float = 0.5  # greatest (lateral force) / (vertical load)

    def __post_init__(self) -> None:
        for name in ("stiffness", "friction"):
            value = getattr(self, name)
            if not value > 0.0:
                raise ArgumentError(name, "> 0", value)


@dataclasses.dataclass(frozen=True)
class Vehicle:
    """A car with rear drive and front steering; static under `jax.jit`."""

    mass: float = 3.0  # [kg]
    yaw_inertia: float = 0.055  # [kg m^2], about the centre of mass
    length: float = 0.4  # [m], length of the body
    width: float = 0.25  # [m], width of the body
    wheelbase: float = 0.3  # [m]
    rear_overhang: float = 0.05  # [m], from the rear axle to the rear end
    mass_ahead: float = 0.15  # [m], distance of the centre of mass ahead of the rear axle
    wheel_radius: float = 0.05  # [m]
    acceleration: float = 1.5  # [m/s^2], greatest drive or brake force over mass
    steering: float = 0.62  # [rad], greatest steering angle
    steering_rate: float = 3.0  # [rad/s], greatest rate of the steering angle
    drive_lag: float = 0.05  # [s], first-order lag of the drive force
    steering_lag: float = 0.05  # [s], first-order lag of the steering angle
    tyres: Tyres | None = None  # None for tyres without slip

    @property
    def loads(self) -> tuple[float, float]:
        """The vertical loads [N] on the rear axle and on the front axle."""
        front = self.mass_ahead / self.wheelbase
        return (1.0 - front) * self.mass * GRAVITY, front * self.mass * GRAVITY
