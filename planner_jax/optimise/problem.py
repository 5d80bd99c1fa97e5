"""What the solver asks of a planner that minimises: a problem for ONE case, and attempts at it."""

import dataclasses
from typing import Protocol

from jax import Array
from jaxtyping import PyTree

from planner_jax.core.checks import require_kind
from planner_jax.core.choices import require_size
from planner_jax.core.protocol import Attempt
from planner_jax.optimise.evaluation import Evaluation
from planner_jax.optimise.lbfgs import LbfgsConfig
from planner_jax.optimise.newton import Curvature, NewtonConfig

Solver = LbfgsConfig | NewtonConfig
Settings = tuple[tuple[str, object], ...]  # fields of a planner, and the values they take


@dataclasses.dataclass(frozen=True)
class Stage:
    """An easier problem, the end of which is where the next one begins."""

    solver: Solver
    settings: Settings = ()
    keep: int | None = None  # starts of a case that go on, those that cost least; None: all

    def __post_init__(self) -> None:
        require_kind("solver", self.solver, LbfgsConfig, NewtonConfig)
        if self.keep is not None:
            require_size("keep", self.keep, 1)


@dataclasses.dataclass(frozen=True)
class Round(Attempt):
    """An attempt of a planner that minimises: so many starts and iterations."""

    solver: Solver = LbfgsConfig()
    settings: Settings = ()  # of the planner, that differ in this round
    stages: tuple[Stage, ...] = ()  # before it, from easy to hard

    def __post_init__(self) -> None:
        super().__post_init__()
        require_kind("solver", self.solver, LbfgsConfig, NewtonConfig)


class Problem(Protocol):
    """A problem in scaled variables, in which the objective has curvature of order one.

    All functions are pure and written for one case.
    """

    def prepare(self, case: PyTree) -> PyTree:
        """What every evaluation needs and none changes, such as the ball's path table."""
        ...

    def guesses(self, context: PyTree, num: int) -> Array:
        """The first `num` starting points, (num, n), best first."""
        ...

    def objective(self, point: Array, context: PyTree) -> Evaluation:
        """Cost and largest violation at a point (n,)."""
        ...

    def curved(self, point: Array, context: PyTree) -> Curvature:
        """Evaluation, gradient and second derivatives at a point (n,), for Newton's method."""
        ...

    def decode(self, point: Array, context: PyTree) -> PyTree:
        """The plan at a point (n,), its violation looked at more closely.

        The solver fills in `cost`, `iterations` and `status`.
        """
        ...

    def rules_out(self, context: PyTree) -> Array:
        """Whether no plan can exist, by a bound that none can beat, () bool.

        Such a case has the status `TOO_FAR` unless it is solved, and no further attempt is made.
        """
        ...

    def carried(self, point: Array, before: PyTree) -> Array:
        """A point (n,) of this problem with the settings of `before`, a stage's, in its own."""
        ...

    def changed(self, settings: Settings) -> "Problem":
        """The problem with some of the planner's fields set anew; plans keep their shape."""
        ...
