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

MOST_DAMPING = 1e4  # of a lane of Newton's method


@struct.dataclass
class Evaluation:
    """An objective at one point."""

    cost: Array  # (), what is minimised
    violation: Array  # (), largest relative excess over a limit; <= 0 is feasible


Objective = Callable[[Array], Evaluation]


# Of a damping, the solver of about the damped Hessian's system: (n,) of a right side (n,).
Preconditioner = Callable[[Array], Callable[[Array], Array]]


class Curvature(NamedTuple):
    """What Newton's method takes of an objective at a point (n,)."""

    evaluation: Evaluation
    gradient: Array  # (n,)
    # What makes products of the Hessian with a direction (n,); called where they are needed.
    products: Callable[[], Callable[[Array], Array]]
    # Of a positive damping (), what solves about the damped Hessian's system, (n,) of a right side
    # (n,), by a matrix that is symmetric and positive definite.
    preconditioner: Preconditioner


Curved = Callable[[Array], Curvature]


@dataclasses.dataclass(frozen=True)
class LbfgsConfig:
    """Sizes and switches of the solver: hashable, so static under jit."""

    max_steps: int = 10  # 0 for the start itself
    memory: int = 6
    trial_steps: tuple[float, ...] = (1.0, 2.5, 0.3)
    step_cap: float = 2.0  # largest Euclidean length of a unit step
    tolerance: float = 1e-4  # relative decrease of the cost that counts as none
    patience: int = 2  # iterations without a decrease before a lane is stationary

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
    subspace: int = 4  # vectors; 0 for the preconditioner's step alone, without products
    damping: float = 1e-4  # at first
    # Tried at once, as multiples of the preconditioner's curvature. The damping is multiplied by
    # the one that does best, or by `ease` if that is greater, or by `tighten` if none does better.
    trial_dampings: tuple[float, ...] = (0.0, 0.3, 3.0, 30.0)
    ease: float = 0.03
    tighten: float = 1e3
    step_cap: float = 3.0  # largest Euclidean length of a step
    tolerance: float = 1e-4  # decrease that is expected, relative to the cost, that counts as none
    trusted: float = MOST_DAMPING  # up to which the decrease that is expected counts
    patience: int = 3  # iterations that lead no nearer before a lane is stationary
    # Relative difference of two costs, in roundings of their type, that says nothing. Steps that
    # cost no more are made, and lead nearer where what is expected falls by half.
    slack: float = 0.0
    # Lanes that go on while any has something to gain, those with most first: their share in a
    # batch, iterations of each such group, and how many groups there are at most.
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
