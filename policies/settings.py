"""What `planner-jax train` is asked to do; imports no JAX."""

import dataclasses
import math
from typing import Any, ClassVar

from planner_jax.host.memory import require_memory
from planner_jax.runs.settings import SettingError, option, require, require_count, require_seed
from planner_jax.task.catch.spec import SUITES

_MOST_DECISIONS = 1e12
_CASE_BYTES = 20_000  # of memory, as estimated, of a case that is decided with others
NETWORK_NAMES = ("attention", "mlp")
# Of the terms of a reward, see `environment.judged`.
WEIGHTS = {"solved": 1.0, "last": 5.0, "ratio": -5.0, "caught": 5.0, "violation": -0.5}
_PAPER = ("parabola1", "parabola2", "harmonic2", "triangle3", "hexagon6")


def _each(values: tuple[float, ...]) -> float | tuple[float, ...]:
    """One number, or one a suite."""
    return values if len(values) > 1 else next(iter(values))


@dataclasses.dataclass(frozen=True)
class TrainSettings:
    """The arguments of a training.

    Raises:
        SettingError: a value breaks its rule.
    """

    suite: str = option(",".join(_PAPER), "A,B", "whose cases are decided on, one or more")
    network: str = option("attention", "NAME", "attention, for any number of targets, or mlp")
    decisions: tuple[float, ...] = option(
        (2e6, 4e6, 4e6, 4e6), "N", "of each part, after which the run may be interrupted"
    )
    estimated: int = option(0, "P", "parts, the first ones, in which the estimate judges")
    iterations: tuple[int, ...] = option(
        (),
        "K",
        "of the planner, one a suite; 0: the estimate judges, as it does optional targets by "
        "default (default: else 25 for up to three targets, and 80)",
    )
    last: tuple[float, ...] = option(
        (WEIGHTS["last"],), "W", "weight of how early the last catch is, one or one a suite"
    )
    ratio: tuple[float, ...] = option(
        (-WEIGHTS["ratio"],),
        "W",
        "weight of how far decided times are from the optimised ones, one or one a suite",
    )
    solved: tuple[float, ...] = option(
        (WEIGHTS["solved"],), "W", "weight of a case that is solved, one or one a suite"
    )
    caught: tuple[float, ...] = option(
        (WEIGHTS["caught"],), "W", "weight of optional targets that are taken, one or one a suite"
    )
    lessons: int = option(0, "N", "cases of each suite whose best decisions are imitated first")
    begin: str | None = option(
        None,
        "FILE",
        "a checkpoint by whose weights it begins, or the name of one that is shipped: catch, rush6",
    )
    kept: float = option(0.0, "F", "share of these weights in those that it ends with")
    lanes: int | None = option(None, "B", "decided at once (default: 8190, 510 on a CPU)")
    judged: int = option(256, "N", "cases of each suite by which it is watched")
    seed: int = option(0, "K", "of weights and cases")

    DESCRIPTION: ClassVar[str] = (
        "Train a policy that decides when and in what order to catch, by Brax's PPO with the\n"
        "planner in its environment. The same command goes on with a run that was interrupted."
    )

    def __post_init__(self) -> None:
        for suite in self.suites:
            known = ", ".join(SUITES)
            require(suite in SUITES, "suite", f"one or more of {known}", repr(suite))
        require(self.network in NETWORK_NAMES, "network", " or ".join(NETWORK_NAMES), self.network)
        require(len(self.decisions) > 0, "decisions", "a number for each part", "none")
        for each in self.decisions:
            rule = f"from 1 to {_MOST_DECISIONS:g} in each part"
            require(1.0 <= each <= _MOST_DECISIONS, "decisions", rule, each)
        require(0 <= self.estimated <= len(self.decisions), "estimated", ">= 0", self.estimated)
        if self.iterations and len(self.iterations) != len(self.suites):
            raise SettingError(
                f"iterations must be {len(self.suites)} numbers, one a suite, got "
                f"{len(self.iterations)}"
            )
        for number in self.iterations:
            require(number >= 0, "iterations", ">= 0", number)
        for name in ("last", "ratio", "solved", "caught"):
            values = getattr(self, name)
            if len(values) not in (1, len(self.suites)):
                raise SettingError(
                    f"{name} must be one number, or one for each of {len(self.suites)} suites, "
                    f"got {len(values)}"
                )
            for value in values:
                require(0.0 <= value < math.inf, name, "finite and >= 0", value)
        require(0.0 <= self.kept <= 1.0, "kept", "from 0 to 1", self.kept)
        require(self.kept == 0.0 or self.begin is not None, "kept", "left out without begin", "it")
        require_seed(self.seed)
        for name, least in (("lessons", 0), ("judged", 0), ("lanes", 60)):
            value = getattr(self, name)
            require_count(name, value, least, none=True)
            try:
                require_memory(name, value or 0, _CASE_BYTES)
            except ValueError as error:
                raise SettingError(str(error)) from None

    @property
    def suites(self) -> tuple[str, ...]:
        """Names of the suites."""
        return tuple(self.suite.split(","))

    def training(self, lanes: int) -> dict[str, Any]:
        """Arguments of `Training`, but for its parts.

        Args:
            lanes: at most.
        """
        step = len(self.suites) * 6  # one share a suite, and even minibatches
        return {
            "suites": self.suites,
            "network": self.network,
            "seed": self.seed,
            "lanes": lanes // step * step,
            "minibatches": 6,
            "lessons": self.lessons,
            "weights": tuple(
                {
                    "solved": _each(self.solved),
                    "last": _each(self.last),
                    "ratio": _each(tuple(-value for value in self.ratio)),
                    "caught": _each(self.caught),
                    "violation": WEIGHTS["violation"],
                }.items()
            ),
            "begin": self.begin,
            "kept": self.kept,
            "judged": self.judged,
        }

    def iterations_of(self, part: int) -> tuple[int, ...]:
        """Of the planner in a part, one a suite; none where the estimate judges."""
        if part < self.estimated:
            return ()

        def usual(suite: str) -> int:
            if SUITES[suite].optional:
                return 0
            return 25 if SUITES[suite].num_targets <= 3 else 80

        return tuple(self.iterations) or tuple(map(usual, self.suites))
