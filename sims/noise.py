"""Rates, latencies and noise of the sensing of balls and robots, with presets.

This module needs neither JAX nor MuJoCo, so that settings can be checked before either is imported.
"""

import dataclasses
import math

from planner_jax.core.errors import ArgumentError


def require_whole(ratio: float, name: str, rule: str, value: float) -> None:
    """Raise `ValueError`, "NAME must be RULE, got VALUE", unless `ratio` is a whole number.

    `value` is the argument called `name` from which the caller has computed the ratio.
    """
    if abs(ratio - round(ratio)) > 1e-6 or (ratio > 0.0 and round(ratio) == 0):
        raise ArgumentError(name, rule, value)


@dataclasses.dataclass(frozen=True)
class Sensing:
    """Rates and errors of the motion capture of balls and robot; static under `jax.jit`.

    Raises:
        ValueError: a value is out of its range.
    """

    rate: float = 100.0  # [Hz], rate of the observations of the balls
    position_std: float = 0.0  # [m], standard deviation of a ball's coordinate
    dropout: float = 0.0  # probability that an observation is missing
    latency: float = 0.0  # [s], age of an observation when it arrives
    # Standard deviations of the quadrotor's estimated position [m], velocity [m/s], attitude [rad]
    # and body rate [rad/s]. Errors are drawn at every observation of the balls. Empty: no errors.
    robot_stds: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not all(part >= 0.0 for part in (value if isinstance(value, tuple) else (value,))):
                raise ArgumentError(field.name, ">= 0", value)
        if not self.rate > 0.0:
            raise ArgumentError("rate", "> 0", self.rate)
        if not self.dropout < 1.0:
            raise ArgumentError("dropout", "< 1", self.dropout)

    def observations_per_plan(self, replan: float) -> int:
        """Return the number of observations from one plan to the next; 1 without replanning.

        Args:
            replan: [Hz], rate of replanning; 0 for never.

        Raises:
            ValueError: the rate is negative or does not divide the rate of observations.
        """
        if not replan >= 0.0:
            raise ArgumentError("replan", ">= 0", replan)
        if replan == 0.0:
            return 1
        rule = f"a divisor of the observations' {self.rate:g} Hz"
        require_whole(self.rate / replan, "replan", rule, replan)
        return round(self.rate / replan)


@dataclasses.dataclass(frozen=True)
class RobotSensing:
    """Errors of a quadrotor's IMU and captured poses, for its own filter; static under `jax.jit`.

    [Yu2023catch] and [Yu2023bat] filter both sensors, but report none of these numbers; all are
    assumptions. The IMU measures at every physics step, and its biases are constant during a
    flight. A pose is captured at every observation of the balls, and none is lost.

    Raises:
        ValueError: a value is not positive, or the latency is negative.
    """

    # Spectral densities of accelerometer [m^2/s^3] and gyroscope [rad^2/s]: errors of 0.1 m/s^2 and
    # 0.01 rad/s at 250 Hz.
    force_density: float = 0.1**2 / 250.0
    rate_density: float = 0.01**2 / 250.0
    pos_std: float = 0.001  # [m], of a coordinate of a captured position
    attitude_std: float = math.radians(0.3)  # [rad], of each component of a captured attitude
    latency: float = 0.02  # [s], age of a pose when it arrives
    # Standard deviations of the biases [m/s^2] and [rad/s], and of the velocity [m/s] that the
    # filter assumes first. Its first pose has the errors of a captured pose.
    force_bias_std: float = 0.1
    rate_bias_std: float = 0.01
    vel_std: float = 0.01

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if not (value > 0.0 or (name == "latency" and value == 0.0)):
                raise ArgumentError(name, ">= 0" if name == "latency" else "> 0", value)


# Observers of a thrown ball, by name. All but the first use a linear Kalman filter, whose
# coefficients of linear drag are fitted to its last estimates [Yu2023catch, Section V-A].
OBSERVERS = {
    "energy": "filter with quadratic drag, whose coefficient follows from the lost energy",
    "linear": "linear filter; the ball's path is predicted with linear drag, too",
    "rls": "linear filter; the path is predicted with quadratic drag, from losses of energy by RLS",
}

NOISES = {
    "none": Sensing(),
    # [Yu2023bat] and [Yu2023catch] observe with Vicon. Every module of their software runs within
    # 20 ms [Yu2023bat, Section VI-C], which is the latency here. The papers report no noise, rate
    # or dropout. All other numbers are assumptions: 5 mm a coordinate for a 40 mm ball, 100
    # observations a second, of which 2 % are lost, and the errors of the quadrotor's state, which
    # both papers estimate by a Kalman filter from the captured pose and an IMU.
    "lab": Sensing(
        position_std=0.005, dropout=0.02, latency=0.02, robot_stds=(0.002, 0.02, 0.005, 0.02)
    ),
    # Assumptions for worse conditions than in a laboratory: three times the noise of "lab", twice
    # its latency, and one of ten observations lost.
    "harsh": Sensing(
        position_std=0.015, dropout=0.1, latency=0.04, robot_stds=(0.006, 0.06, 0.015, 0.06)
    ),
}


CONTROL_RATE = 200  # [Hz], rate of the control steps of a drive
FRAME_RATE = 50  # [Hz], rate of a drive's stored poses, at which collisions are checked


@dataclasses.dataclass(frozen=True)
class PlaneSensing:
    """Sensing of a car's target, of moving obstacles, and of its own pose; static under `jax.jit`.

    Observations arrive late by `latency`. Poses of the car are measured at every control step. The
    car knows its own speed and steering angle without delay.

    Raises:
        ValueError: a value is out of its range.
    """

    target_std: float = 0.0  # [m], standard deviation of an observed coordinate
    # Standard deviations of a measured coordinate [m] and heading [rad] of the car.
    pose_stds: tuple[float, float] = (0.0, 0.0)
    # [Hz], rate of observations of the target during the drive; 0 for no observations.
    observation_rate: float = 1.0
    latency: float = 0.05  # [s], age of a measurement at its arrival, planning time included

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not all(part >= 0.0 for part in (value if isinstance(value, tuple) else (value,))):
                raise ArgumentError(field.name, ">= 0", value)
        rule = f"a multiple of the control steps' {1.0 / CONTROL_RATE:g} s"
        require_whole(self.latency * CONTROL_RATE, "latency", rule, self.latency)

    def frames_per_plan(self, replan: float) -> int:
        """Return the number of 20 ms frames per plan; without replanning 50, that is, one second.

        Args:
            replan: [Hz], rate of replanning; 0 for never.

        Raises:
            ValueError: the rate is negative or does not divide the rate of frames.
        """
        if not replan >= 0.0:
            raise ArgumentError("replan", ">= 0", replan)
        if replan == 0.0:
            return FRAME_RATE
        require_whole(FRAME_RATE / replan, "replan", f"a divisor of {FRAME_RATE} Hz", replan)
        return round(FRAME_RATE / replan)


PLANE_NOISES = {
    "none": PlaneSensing(),
    # [Qu2022, Section V-A] observes targets once a second with a variance of 0.01 m^2 a coordinate.
    # The paper does not report the error of the car's own pose. The values 1 cm and 0.01 rad are
    # assumptions.
    "paper": PlaneSensing(target_std=0.1, pose_stds=(0.01, 0.01)),
}
