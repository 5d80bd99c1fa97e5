"""The seam between a task and the optimiser: what a planner offers for ONE scenario."""

import dataclasses
from typing import Any, Protocol

from jax import Array

from planner_jax.optimise.lbfgs import Evaluation, LbfgsConfig

Settings = tuple[tuple[str, Any], ...]  # fields of a planner, and the values they take


@dataclasses.dataclass(frozen=True)
class Stage:
    """An easier problem, the end of which is where the next one begins."""

    solver: LbfgsConfig
    settings: Settings = ()


@dataclasses.dataclass(frozen=True)
class Round:
    """One attempt at the lanes that earlier rounds left unsolved."""

    starts: int
    solver: LbfgsConfig
    settings: Settings = ()  # of the planner, that differ in this round
    stages: tuple[Stage, ...] = ()  # before it, from easy to hard

    def __post_init__(self) -> None:
        if self.starts < 1:
            raise ValueError(f"starts must be >= 1, got {self.starts}")


class Scenario(Protocol):
    """A pytree of arrays for one case, or for a batch with a leading axis on every leaf."""

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """() for one case, (B,) for a batch."""
        ...


class Planner(Protocol):
    """A small frozen dataclass of sizes and switches, static under jit.

    All functions are pure and written for one scenario, and work in scaled decision
    variables in which the objective has curvature of order one.
    """

    @property
    def rounds(self) -> tuple[Round, ...]:
        """What to try, in order."""
        ...

    def prepare(self, scenario: Any) -> Any:
        """What every evaluation needs and none changes, such as the ball's path table."""
        ...

    def guesses(self, context: Any, num: int) -> Array:
        """The first `num` starting points, (num, n), best first."""
        ...

    def objective(self, point: Array, context: Any) -> Evaluation:
        """Cost and largest violation at a point (n,)."""
        ...

    def decode(self, point: Array, context: Any) -> Any:
        """The plan at a point (n,), its violation looked at more closely.

        The solver fills in `cost`, `iterations` and `status`.
        """
        ...
