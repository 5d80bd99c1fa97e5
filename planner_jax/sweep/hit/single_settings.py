"""One hit in a few numbers."""

import dataclasses
from typing import ClassVar

from planner_jax.runs.settings import option
from planner_jax.sweep.single_settings import SingleSettings
from planner_jax.task.hit.spec import DRAG


@dataclasses.dataclass(frozen=True, kw_only=True)
class SingleHitSettings(SingleSettings):
    """A ball, a target, and what may be other than in the paper."""

    pos: tuple[float, ...] = option(dataclasses.MISSING, "X Y Z", "of the ball now [m]")
    vel: tuple[float, ...] = option(dataclasses.MISSING, "X Y Z", "of the ball now [m/s]")
    target: tuple[float, ...] = option(dataclasses.MISSING, "X Y Z", "where it is to land [m]")
    acceleration: float | None = option(None, "A", "greatest [m/s^2] (default: the robot's)")
    hitting_speed: tuple[float, ...] | None = option(
        None, "X Y Z", "greatest at the impact, by axis [m/s] (default: 4 3 4)"
    )
    min_apex: float | None = option(None, "Z", "of the returned ball [m] (default: 2.2)")
    max_apex: float | None = option(None, "Z", "of the returned ball [m] (default: 6.2)")
    restitution: float | None = option(None, "B", "of the racket (default: the robot's)")
    drag: float | None = option(None, "K", f"of the ball, quadratic [1/m] (default: {DRAG})")

    TOOL: ClassVar[str] = "racket"
    RUN: ClassVar[str] = "planner_jax.sweep.hit.single:SingleHit"
    ELSEWHERE: ClassVar[tuple[str, ...]] = ("pos", "vel", "target")
