"""Settings of flights of thrown balls that an arm blocks; they become command-line options."""

import dataclasses
import math
from typing import Any, ClassVar

from planner_jax.core.choices import SCALES, require, require_one_of
from planner_jax.core.registry import Task
from planner_jax.runs.settings import Options, option
from planner_jax.sims.robots.arm.drives import ENCODERS, TORQUES, Drives
from planner_jax.sims.settings import FlySettings
from planner_jax.sweep.block.settings import REGIMES, ArmSettings, require_moderate
from planner_jax.task.block.spec import TASK as BLOCK

_FASTEST_CAMERA = 1000.0  # [Hz], greatest frame rate


@dataclasses.dataclass(frozen=True)
class BlockFly(ArmSettings, FlySettings):
    """Settings of flights of thrown balls, which an arm with a shield is to block.

    The defaults with `perception` are settings under which the arm blocks most of the balls.
    """

    replan: float | None = option(
        None, "HZ", "with --perception: rate of replanning (default: 0, the arm plans once)"
    )
    planner: str = option("online", "NAME", "planner of all plans, which are made one at a time")
    suite: str | None = option(None, "NAME", "(default: pole, with --perception short)")
    regime: str | None = option(
        None,
        "NAME",
        f"joint limits of plans: {', '.join(REGIMES)} (default: R2, with --perception R1: the "
        "slower arm of R2 blocks far fewer of the balls that it observes)",
    )
    wide: bool | None = option(
        None,
        "",
        "allow contacts up to 0.1 m from the shield's centre and 30 degrees from its normal "
        "(default: with --perception)",
    )
    perception: bool = option(
        False, "", "plan with a camera's observations of the ball instead of its true flight"
    )
    observe: float | None = option(
        None,
        "S",
        "time of observation before the first plan (default: 0.133, with --perception 0.25)",
    )
    planning_budget: float | None = option(
        None,
        "S",
        "time for planning, after which the arm starts (default: 0.03, with --perception 0.05)",
    )
    noise: float = option(
        0.02,
        "M",
        "with --perception: standard deviation of each observed coordinate; 0 for the noise of a "
        "stereo camera",
    )
    frame_rate: float = option(60.0, "HZ", "with --perception: frame rate of the camera")
    torque: float = option(1.0, "F", "scale of the drives' torque limits")
    lag: float = option(0.005, "S", "first-order lag of the torques")
    latency: float = option(0.0, "S", "delay of plans at the joints")
    encoders: str = option(
        "fine", "NAME", f"preset of encoder noise in angles and rates: {', '.join(ENCODERS)}"
    )
    mass_error: float = option(0.05, "F", "relative error of the masses in the controller's model")

    TASK: ClassVar[Task] = BLOCK
    FLIGHT: ClassVar[str] = "planner_jax.sims.tasks.block:BlockFlight"
    RATE: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        seen = self.perception
        fast = seen and self.arm is None  # another arm has limits of its own
        usual = {"suite": "short" if seen else "pole", "regime": "R1" if fast else "R2"}
        for name, value in {**usual, "wide": seen}.items():
            if vars(self)[name] is None:
                object.__setattr__(self, name, value)
        require_one_of(ENCODERS, "encoders", self.encoders)
        require_one_of(REGIMES, "regime", self.regime)
        self.require_own_limits(str(self.regime))
        require_one_of(BLOCK.suites, "suite", self.suite)
        for name in ("observe", "planning_budget", "noise", "lag", "latency"):
            require_moderate(name, getattr(self, name))
        require(abs(self.mass_error) < 1.0, "mass_error", "> -1 and < 1", self.mass_error)
        require(0.0 < self.frame_rate < math.inf, "frame_rate", "finite and > 0", self.frame_rate)
        rule = f"from 1 to {_FASTEST_CAMERA:g}"
        require(1.0 <= self.frame_rate <= _FASTEST_CAMERA, "frame_rate", rule, self.frame_rate)
        own = self.planner.partition(":")[0] != "library"
        require(
            own or not self.perception,
            "planner",
            "one other than 'library' with perception",
            self.planner,
        )
        require(0.0 < self.torque < math.inf, "torque", "finite and > 0", self.torque)
        least, most = SCALES
        rule = f"from {least:g} to {most:g}"
        require(least <= self.torque <= most, "torque", rule, self.torque)
        super().__post_init__()

    @property
    def until_known(self) -> float:
        """The time [s] for which a ball is observed before the arm plans."""
        # The default without perception is the sum of two times in [Natarajan2024, Section VI-B]:
        # 82.9 ms for perception and 50 ms for all other parts of the system.
        usual = 0.25 if self.perception else 0.133
        return usual if self.observe is None else self.observe

    @property
    def until_set(self) -> float:
        """The time [s] for planning: from the end of the observation until the arm starts."""
        usual = 0.05 if self.perception else 0.03
        return usual if self.planning_budget is None else self.planning_budget

    def drives(self, torques: tuple[float, ...] = TORQUES) -> Drives:
        """Return the drives with scaled limits `torques` [N m], and the errors of the encoders.

        Raises:
            ValueError: a value is out of its range.
        """
        angle_std, rate_std = ENCODERS[self.encoders]
        return Drives(
            torques=tuple(self.torque * each for each in torques),
            lag=self.lag,
            latency=self.latency,
            angle_std=angle_std,
            rate_std=rate_std,
            mass_error=self.mass_error,
        )

    def flight(self) -> Any:
        """Return the task's `sims.task.FlightTask` with these settings.

        Raises:
            ArgumentError: FILE of the planner `library:FILE` is no library of motions, or was built
                for another scene or other limits.
        """
        if BLOCK.split_planner(self.planner)[1]:
            from planner_jax.task.block import draw

            planner = BLOCK.make_planner(self.planner, {})
            planner.check(draw(1, self.suite, **self.draw_options()))  # type: ignore[attr-defined]
        return super().flight()

    def draw_options(self) -> Options:
        """Return the arguments of `pj.block.draw` that these settings specify."""
        return {"regime": self.regime, "wide": self.wide} | self.arm_options()

    def check_rate(self) -> None:
        """Raise `ValueError` for invalid drives of the arm, or for replanning without a camera.

        Without a camera (`perception`) the planner knows the ball's true flight, and plans once.
        """
        rule = ">= 0, and 0 without perception: a block is planned once"
        most = math.inf if self.perception else 1e-9
        require(0.0 <= self.rate < most, "replan", rule, self.rate)
        _ = self.drives()
