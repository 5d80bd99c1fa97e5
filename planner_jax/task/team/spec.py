"""Names of planners and suites of the task `team` (several quadrotors catch), without JAX."""

from typing import NamedTuple

from planner_jax.core.registry import Task


class Suite(NamedTuple):
    """A family of random team cases: robots that share the targets of a suite of catches."""

    catches: str  # suite of the task `catch`
    num_robots: int
    description: str


SUITES = {
    "team2-swarm12": Suite("swarm12", 2, "Two robots share the twelve balls of `swarm12`."),
    "team3-swarm12": Suite("swarm12", 3, "Three robots share the twelve balls of `swarm12`."),
}

TASK = Task(
    name="team",
    summary="several quadrotors catch flying targets and keep a distance from each other",
    home="planner_jax.task.team",
    planners={"exact": "planner_jax.task.catch.default_planner:ExactCatch"},
    suites={name: suite.description for name, suite in SUITES.items()},
    bench={"decide": "greedy"},
)
