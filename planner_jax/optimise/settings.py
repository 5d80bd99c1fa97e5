"""Types of objectives, and settings of a planner's attempts, each of several searches."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from planner_jax.core.checks import (
    require_kind,
    require_number,
    require_numbers,
    require_switch,
)
from planner_jax.core.choices import require_size
from planner_jax.core.compiled import with_run_time_numbers
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.protocol import BaseAttempt
from planner_jax.core.rules import NOT_NEGATIVE, Rule

MOST_DAMPING = 1e4  # greatest damping of one problem in Newton's method


class Evaluation(NamedTuple):
    """The pair that objectives return for a point: the cost, and the largest violation."""

    cost: Array  # (), to be minimised
    violation: Array  # (), largest relative excess over a limit; feasible if <= 0


Objective = Callable[[Array], Evaluation]
# A preconditioner is a function of a damping () > 0. It returns a function that nearly solves
# the damped Hessian's system: it multiplies a right side (n,) by a positive definite matrix.
Preconditioner = Callable[[Array], Callable[[Array], Array]]


class Curvature(NamedTuple):
    """An objective's value and derivatives at a point of n variables, for Newton's method."""

    evaluation: Evaluation
    gradient: Array  # (n,)
    # `products()` returns the function that multiplies the Hessian by a direction (n,).
    products: Callable[[], Callable[[Array], Array]]
    preconditioner: Preconditioner


Curved = Callable[[Array], Curvature]


@with_run_time_numbers("max_steps", "tolerance", "patience")
@dataclasses.dataclass(frozen=True)
class LbfgsConfig:
    """Settings of the L-BFGS solver; hashable, so static under jit.

    Attributes:
        max_steps: greatest number of iterations; 0 returns the start itself.
        memory: number of stored pairs: a step, and the change of the gradient along it.
        trial_steps: step lengths that are tried at once in each iteration.
        step_cap: greatest Euclidean length of a step with trial length 1.
        tolerance: relative decrease of the cost below which progress stalls.
        patience: number of stalled iterations after which a problem counts as stationary.
    """

    max_steps: int = 10
    memory: int = 6
    trial_steps: tuple[float, ...] = (1.0, 2.5, 0.3)
    step_cap: float = 2.0
    tolerance: float = 1e-4
    patience: int = 2

    def __post_init__(self) -> None:
        for name, least in (("max_steps", 0), ("memory", 1), ("patience", 0)):
            require_size(name, vars(self)[name], least)
        for name in ("step_cap", "tolerance"):
            require_number(name, vars(self)[name], NOT_NEGATIVE)
        steps = self.trial_steps
        require_numbers("trial_steps", steps)
        if not steps or not all(0.0 < each < jnp.inf for each in steps):
            raise ArgumentError("trial_steps", "finite and > 0, one or more", steps)


_SHARE = Rule("in (0, 1]", lambda value, part: (value > 0.0) & (value <= 1.0))


@dataclasses.dataclass(frozen=True)
class NewtonConfig:
    """Settings of Newton's method; hashable, so static under jit.

    Attributes:
        max_steps: greatest number of iterations.
        subspace: number of vectors of the subspace; 0 uses the preconditioner alone.
        damping: initial damping.
        trial_dampings: each iteration tries one step for each t of these numbers, with t times the
            preconditioner's matrix added to the Hessian. Then `damping` is multiplied by the t of
            the cheapest step, but at least by `ease`; or by `tighten` if no step lowers the cost.
        ease: least factor on `damping` after a step that lowers the cost.
        tighten: factor on `damping` if no step lowers the cost.
        step_cap: greatest Euclidean length of a step.
        tolerance: predicted relative decrease of the cost below which a problem is stationary.
        trusted: greatest damping at which a predicted decrease is reliable.
        patience: number of iterations without progress after which a problem is stationary.
        slack: rounding error of a cost, in units of machine epsilon times the cost. A step that
            raises the cost by less counts as progress if the predicted decrease halves.
        stragglers: size of a group as a fraction of the batch, number of iterations of a group, and
            greatest number of groups. After `max_steps`, unfinished problems continue in groups, by
            falling predicted decrease; None: no problem continues.
    """

    max_steps: int = 6
    subspace: int = 4
    damping: float = 1e-4
    trial_dampings: tuple[float, ...] = (0.0, 0.3, 3.0, 30.0)
    ease: float = 0.03
    tighten: float = 1e3
    step_cap: float = 3.0
    tolerance: float = 1e-4
    trusted: float = MOST_DAMPING
    patience: int = 3
    slack: float = 0.0
    stragglers: tuple[float, int, int] | None = None

    def __post_init__(self) -> None:
        for name, least in (("max_steps", 0), ("subspace", 0), ("patience", 0)):
            require_size(name, vars(self)[name], least)
        for name in ("damping", "ease", "tighten", "step_cap", "tolerance", "trusted", "slack"):
            require_number(name, vars(self)[name], NOT_NEGATIVE)
        trials = self.trial_dampings
        require_numbers("trial_dampings", trials)
        if not trials or not all(0.0 <= each < jnp.inf for each in trials):
            raise ArgumentError("trial_dampings", "finite and >= 0, one or more", trials)
        later = self.stragglers
        if later is None:
            return
        if not isinstance(later, tuple) or len(later) != 3:
            raise ArgumentTypeError("stragglers", "a tuple of three numbers", later)
        share, *counts = later
        require_number("stragglers", share, _SHARE)
        for count in counts:
            require_size("stragglers", count, 1)


Solver = LbfgsConfig | NewtonConfig
Settings = tuple[tuple[str, object], ...]  # fields of a planner, and their values


@dataclasses.dataclass(frozen=True)
class Stage:
    """A preliminary search on an easier problem; its result is the start of the next search."""

    solver: Solver
    settings: Settings = ()
    keep: int | None = None  # number of a case's cheapest starts that continue; None for all
    # Whether L-BFGS leaves the variables unchanged that `Problem.held` marks.
    frozen: bool = False

    def __post_init__(self) -> None:
        require_kind("solver", self.solver, LbfgsConfig, NewtonConfig)
        require_switch("frozen", self.frozen)
        if self.keep is not None:
            require_size("keep", self.keep, 1)


@dataclasses.dataclass(frozen=True)
class Attempt(BaseAttempt):
    """One attempt of a planner that minimises: solver, settings, preliminary searches.

    Attributes:
        solver: solver of the search, an `LbfgsConfig` or another `Solver`.
        settings: values of planner fields during this attempt.
        stages: searches before the search by `solver`, from easy to hard.
        first: index of the first of the `starts` starting points, the planner's `guesses`.
    """

    solver: Solver = LbfgsConfig()
    settings: Settings = ()
    stages: tuple[Stage, ...] = ()
    first: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_kind("solver", self.solver, LbfgsConfig, NewtonConfig)
        require_size("first", self.first, 0)

    @property
    def all_stages(self) -> tuple[Stage, ...]:
        """The preliminary searches of the attempt, and its own search as the last stage."""
        return (*self.stages, Stage(self.solver, self.settings))


Attempts = tuple[Attempt, ...]
