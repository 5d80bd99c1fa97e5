"""How well a flight's balls and robot are seen: rates, latency and noise, with presets.

Nothing here needs JAX or MuJoCo, so that settings can be checked before either is imported.
"""

import dataclasses

from planner_jax.core.errors import ArgumentError


def require_whole(ratio: float, name: str, rule: str, value: float) -> None:
    """Raise `ValueError`, "name must be rule, got value", unless a ratio is a whole number."""
    if abs(ratio - round(ratio)) > 1e-6 or (ratio > 0.0 and round(ratio) == 0):
        raise ArgumentError(name, rule, value)


@dataclasses.dataclass(frozen=True)
class Sensing:
    """Motion capture of the balls and of the robot; static under jit.

    Raises:
        ValueError: a value is out of its range.
    """

    rate: float = 100.0  # [Hz], of the looks at the balls
    position_std: float = 0.0  # [m], of a ball's coordinate
    dropout: float = 0.0  # probability that a look shows nothing
    latency: float = 0.0  # [s], age of what a look shows
    # Standard deviations of the robot's own state, one for each field of the state in its units;
    # the errors are drawn anew at every look. Empty: the robot knows its state.
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

    def looks_per_plan(self, replan: float) -> int:
        """Looks from plan to plan at a rate of planning anew; one where that rate is 0.

        Args:
            replan: [Hz].

        Raises:
            ValueError: the rate is negative or does not divide that of the looks.
        """
        if not replan >= 0.0:
            raise ArgumentError("replan", ">= 0", replan)
        if replan == 0.0:
            return 1
        rule = f"a divisor of the looks' {self.rate:g} Hz"
        require_whole(self.rate / replan, "replan", rule, replan)
        return round(self.rate / replan)


NOISES = {
    "none": Sensing(),
    # Both papers see with Vicon and run every module within 20 ms (002, Section VI-C), which is
    # the latency; neither gives noise, rate or dropout. 5 mm a coordinate on a 40 mm ball at
    # 7 m/s, 100 looks a second and 2 % of them lost are assumptions, as are the errors of the
    # quadrotor's own state, an EKF of pose and IMU in both papers: of its position [m], velocity
    # [m/s], attitude [rad] and body rate [rad/s].
    "lab": Sensing(
        position_std=0.005, dropout=0.02, latency=0.02, robot_stds=(0.002, 0.02, 0.005, 0.02)
    ),
    # Worse than the papers' halls: three times the noise, twice the latency, one look in ten
    # lost; an assumption throughout.
    "harsh": Sensing(
        position_std=0.015, dropout=0.1, latency=0.04, robot_stds=(0.006, 0.06, 0.015, 0.06)
    ),
}


CONTROL_RATE = 200  # [Hz], of the control steps of a drive
FRAME_RATE = 50  # [Hz], of the poses of a drive that are kept and held against obstacles


@dataclasses.dataclass(frozen=True)
class PlaneSensing:
    """How a car sees a target and movers in the plane, and itself; static under jit.

    What is shown is a latency old. Poses of the car come at every control step; its own speed and
    steering angle it knows at once.

    Raises:
        ValueError: a value is out of its range.
    """

    target_std: float = 0.0  # [m], of a coordinate of the target or of a mover
    pose_stds: tuple[float, float] = (0.0, 0.0)  # of a coordinate [m] and of the heading [rad]
    observation_rate: float = 1.0  # [Hz], of looks at the target during the drive; 0 for none
    latency: float = 0.05  # [s]; that of the planner is a part of it

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not all(part >= 0.0 for part in (value if isinstance(value, tuple) else (value,))):
                raise ArgumentError(field.name, ">= 0", value)
        rule = f"a multiple of the control steps' {1.0 / CONTROL_RATE:g} s"
        require_whole(self.latency * CONTROL_RATE, "latency", rule, self.latency)

    def frames_per_plan(self, replan: float) -> int:
        """Frames from plan to plan at a rate of planning anew; those of a second if it is 0.

        Args:
            replan: [Hz].

        Raises:
            ValueError: the rate is negative or does not divide that of the frames.
        """
        if not replan >= 0.0:
            raise ArgumentError("replan", ">= 0", replan)
        if replan == 0.0:
            return FRAME_RATE
        require_whole(FRAME_RATE / replan, "replan", f"a divisor of {FRAME_RATE} Hz", replan)
        return round(FRAME_RATE / replan)


PLANE_NOISES = {
    "none": PlaneSensing(),
    # [Qu2022, Section V-A], sees targets once a second with a variance of 0.01 m^2 a coordinate,
    # and says nothing of the car's own pose, of which 1 cm and 0.01 rad are assumptions.
    "paper": PlaneSensing(target_std=0.1, pose_stds=(0.01, 0.01)),
}
