"""Objectives of the solvers, and the settings of a search: methods, stages and rounds."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.core.checks import require_kind, require_number, require_numbers
from planner_jax.core.choices import require_size
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.protocol import Attempt
from planner_jax.core.rules import NOT_NEGATIVE, Rule

MOST_DAMPING = 1e4  # greatest damping of a lane in Newton's method


@struct.dataclass
class Evaluation:
    """An objective at one point."""

    cost: Array  # (), to be minimised
    violation: Array  # (), largest relative excess over a limit; feasible if <= 0


Objective = Callable[[Array], Evaluation]
# Takes a positive damping (). Returns an approximate solver of the damped Hessian's system, which
# multiplies a right side (n,) by a symmetric positive definite matrix.
Preconditioner = Callable[[Array], Callable[[Array], Array]]


class Curvature(NamedTuple):
    """An objective's value and derivatives at a point (n,), for Newton's method."""

    evaluation: Evaluation
    gradient: Array  # (n,)
    # Returns a function that multiplies the Hessian by a direction (n,); called only if needed.
    products: Callable[[], Callable[[Array], Array]]
    preconditioner: Preconditioner


Curved = Callable[[Array], Curvature]


@dataclasses.dataclass(frozen=True)
class LbfgsConfig:
    """Sizes and switches of the solver: hashable, so static under jit."""

    max_steps: int = 10  # 0 returns the start itself
    memory: int = 6
    trial_steps: tuple[float, ...] = (1.0, 2.5, 0.3)
    step_cap: float = 2.0  # largest Euclidean length of a unit step
    tolerance: float = 1e-4  # relative decrease of the cost below which progress stalls
    patience: int = 2  # stalled iterations after which a lane is stationary

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
    """Sizes and switches of the solver: hashable, so static under jit."""

    max_steps: int = 6
    subspace: int = 4  # number of vectors; 0 uses the preconditioner alone, without products
    damping: float = 1e-4  # initial damping
    # Multiples of the preconditioner's curvature that are tried at once. The damping is multiplied
    # by the best one or by `ease`, whichever is greater, or by `tighten` if none lowers the cost.
    trial_dampings: tuple[float, ...] = (0.0, 0.3, 3.0, 30.0)
    ease: float = 0.03
    tighten: float = 1e3
    step_cap: float = 3.0  # largest Euclidean length of a step
    tolerance: float = 1e-4  # predicted relative decrease below which a lane is stationary
    trusted: float = MOST_DAMPING  # greatest damping at which the predicted decrease is reliable
    patience: int = 3  # iterations without progress after which a lane is stationary
    # Relative difference between costs, in roundings of their type, that is insignificant. Steps
    # that cost no more are accepted, and count as progress if the predicted decrease halves.
    slack: float = 0.0
    # Groups of lanes that continue while any is unfinished, greatest predicted decrease first: a
    # group's share of the batch, its iterations, and the greatest number of groups.
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
    """An easier problem; the next one starts at its result."""

    solver: Solver
    settings: Settings = ()
    keep: int | None = None  # number of cheapest starts of a case that continue; None for all

    def __post_init__(self) -> None:
        require_kind("solver", self.solver, LbfgsConfig, NewtonConfig)
        if self.keep is not None:
            require_size("keep", self.keep, 1)


@dataclasses.dataclass(frozen=True)
class Round(Attempt):
    """An attempt of a planner that minimises: its starts, iterations and settings."""

    solver: Solver = LbfgsConfig()
    settings: Settings = ()  # of the planner, for this round
    stages: tuple[Stage, ...] = ()  # searches before it, from easy to hard

    def __post_init__(self) -> None:
        super().__post_init__()
        require_kind("solver", self.solver, LbfgsConfig, NewtonConfig)
