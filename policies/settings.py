"""Settings of the command `planner-jax train`; this module does not import JAX."""

import dataclasses
from typing import ClassVar

from planner_jax.core.choices import STARTS, require, require_one_of, require_seed
from planner_jax.core.room import require_memory
from planner_jax.runs.settings import option, require_count
from planner_jax.task.catch.spec import SUITES

_MOST_DECISIONS = 1e12  # greatest accepted number of decisions in one part of a training
_CASE_BYTES = 20_000  # [bytes] estimated memory of one case in a batch
PUBLISHED = "published"  # name of the policy of [Yu2023catch, Section IV]
PAPER_DECISIONS = 150_000  # usual number of decisions in a training of the policy `published`
NETWORK_NAMES = ("attention", "mlp")  # names of the policy networks that can be trained
# Default weights of the terms of the reward: whether the case is solved, earlier last catch, ratio
# of decided and planned catch times, more catches, and greatest relative excess over a limit.
WEIGHTS = {"solved": 1.0, "last": 5.0, "ratio": -5.0, "caught": 5.0, "violation": -0.5}
LEARNING_RATE = 1e-4  # default learning rate at the start of each part of a training
LEAST_TIME = 0.3  # [s], least time of a catch that the policy `published` proposes
_PAPER = ("parabola1", "parabola2", "harmonic2", "triangle3", "hexagon6")


@dataclasses.dataclass(frozen=True)
class TrainSettings:
    """The options of `planner-jax train`, from which `training.train_from_settings` makes a run.

    Raises:
        ArgumentError: a value has the wrong type or is out of its range.
    """

    suite: str = option(",".join(_PAPER), "A,B", "suites to train on, one or more")
    policy: str = option(
        "extended", "NAME", "extended (as shipped) or published (as in [Yu2023catch], one suite)"
    )
    network: str | None = option(
        None, "NAME", "of the policy `extended`: attention (any number of targets; default) or mlp"
    )
    starts: str | None = option(
        None, "NAME", "state at time 0: hover or random (default: hover; random for `published`)"
    )
    decisions: tuple[float, ...] = option(
        (),
        "N",
        "decisions of each part; a run can be interrupted between parts "
        "(default: 2e6 4e6 4e6 4e6; 150000 for `published`)",
    )
    learning_rate: float = option(LEARNING_RATE, "R", "learning rate at the start of each part")
    init_from: str | None = option(
        None, "FILE", "checkpoint with the initial weights, or a shipped policy: catch, rush6"
    )
    num_envs: int | None = option(
        None,
        "B",
        "cases that are decided in parallel (default: 8190, 510 on a CPU; 100 for `published`)",
    )
    eval_cases: int = option(256, "N", "cases of each suite for the evaluation after each part")
    seed: int = option(0, "K", "seed of weights and cases")

    DESCRIPTION: ClassVar[str] = (
        "Train a policy that decides when and in what order to catch, by Brax's PPO with the\n"
        "planner in its environment. The same command continues a run that was interrupted."
    )

    def __post_init__(self) -> None:
        for suite in self.suites:
            known = ", ".join(SUITES)
            require(suite in SUITES, "suite", f"one or more of {known}", suite)
        require_one_of(("extended", PUBLISHED), "policy", self.policy)
        network = self.network
        require(network in (None, *NETWORK_NAMES), "network", " or ".join(NETWORK_NAMES), network)
        require_one_of(STARTS, "starts", self.first_states)
        if self.policy == PUBLISHED:
            rule = "one suite in which every target must be caught, for the policy `published`"
            alone = len(self.suites) == 1 and not SUITES[self.suite].optional
            require(alone, "suite", rule, self.suite)
            require(network is None, "network", "left out for the policy `published`", network)
        for each in self.decisions:
            rule = f"from 1 to {_MOST_DECISIONS:g} in each part"
            require(1.0 <= each <= _MOST_DECISIONS, "decisions", rule, each)
        rate = self.learning_rate
        require(0.0 < rate <= 1.0, "learning_rate", "> 0 and at most 1", rate)
        require_seed(self.seed)
        for name, value, least in (
            ("eval_cases", self.eval_cases, 0),
            ("num_envs", self.num_envs, 60),
        ):
            require_count(name, value, least, none=True)
            require_memory(name, value or 0, _CASE_BYTES)

    @property
    def suites(self) -> tuple[str, ...]:
        """Names of the suites in `suite`, which is a list separated by commas."""
        return tuple(self.suite.split(","))

    @property
    def first_states(self) -> str:
        """Name of the states of the quadrotor at time 0; "random" is the published choice."""
        return self.starts or STARTS[self.policy == PUBLISHED]

    @property
    def parts(self) -> tuple[float, ...]:
        """Number of decisions of each part, by default 14 million in four parts."""
        usual = (PAPER_DECISIONS,) if self.policy == PUBLISHED else (2e6, 4e6, 4e6, 4e6)
        return self.decisions or usual


def usual_iterations(suite: str) -> int:
    """Return the number of planner iterations for rewards in training on a suite of cases.

    The number is 0 for suites with optional targets, whose rewards come from an estimate of how far
    the quadrotor misses the targets instead of from the planner.
    """
    if SUITES[suite].optional:
        return 0
    return 25 if SUITES[suite].num_targets <= 3 else 80
