"""Names of planners and suites of the task `catch` (quadrotor catches targets), without JAX."""

import dataclasses

from planner_jax.core.registry import Task


@dataclasses.dataclass(frozen=True)
class Suite:
    """A family of random catch cases: number of targets, and the latest time of a catch."""

    num_targets: int
    horizon: float  # [s], latest time at which a target of the suite may be caught
    description: str
    optional: bool = False  # whether targets may be left out


SUITES = {
    "throws": Suite(1, 1.42, "The paper's throws: with drag, to within 2 m x 0.8 m."),
    "paper-throws": Suite(
        1,
        1.48,
        "Throws that are planned after 2 m of flight above 2.8 m, as the paper's first ball.",
    ),
    "hard": Suite(1, 1.22, "Throws to within 4 m x 3 m, planned for 0.2 s later."),
    "parabola1": Suite(
        1, 1.66, "A throw without drag, to a height that follows from its flight time."
    ),
    "parabola2": Suite(2, 1.96, "Two throws without drag, in the air together."),
    "harmonic2": Suite(2, 7.0, "Two targets that swing in height and drift across."),
    "paper-harmonic2": Suite(
        2, 7.0, "Two targets that swing by the paper's formula: amplitude 1 m, no drift, phase 0."
    ),
    "triangle3": Suite(3, 6.0, "Three targets along the sides of a triangle."),
    "hexagon6": Suite(6, 10.0, "Six targets in parallel, on a hexagon."),
    "square4": Suite(4, 10.0, "Four targets in parallel, on a square."),
    "pentagon5": Suite(5, 10.0, "Five targets in parallel, on a pentagon."),
    "heptagon7": Suite(7, 10.0, "Seven targets in parallel, on a heptagon."),
    "rush3": Suite(3, 4.4, "Three targets of `triangle3`, each with a deadline of its own."),
    "rush6": Suite(6, 8.6, "Six targets of `hexagon6`, each with a deadline of its own."),
    "swarm8": Suite(8, 13.9, "Eight sinking balls, more than can be caught.", optional=True),
    "swarm12": Suite(12, 13.9, "Twelve sinking balls, more than can be caught.", optional=True),
}

DECISIONS = {
    "best": "planner_jax.task.catch.decide:Best",
    "greedy": "planner_jax.task.catch.decide:Greedy",
    "random": "planner_jax.task.catch.decide:Random",
    "given": "planner_jax.task.catch.decide:Given",
    "policy": "planner_jax.policies.policy:policy",
}
TRAINED = ("policy",)  # decisions that can be read from a file, as in "policy:FILE"

TASK = Task(
    name="catch",
    summary="a quadrotor catches flying targets with a net",
    home="planner_jax.task.catch",
    planners={
        "exact": "planner_jax.task.catch.default_planner:CatchProblem.planner",
        "catch": "planner_jax.baselines.catch.paper:PaperCatch.planner",
        "mpp": "planner_jax.baselines.catch.mpp:MppCatch",
    },
    suites={name: suite.description for name, suite in SUITES.items()},
    sweep="planner_jax.sweep.catch.settings:CatchSettings",
    single="planner_jax.cli.plan.settings:SingleCatchSettings",
    flight="planner_jax.sims.settings:CatchFly",
    bench={"decide": "greedy"},
    contact="times",
)
