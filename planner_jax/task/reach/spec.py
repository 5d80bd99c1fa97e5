"""Names of planners and suites of the task `reach`. The module imports no JAX."""

from planner_jax.core.registry import Task

SUITES = {"pillar": "A box stands in front of the arm, between start and goal."}

TASK = Task(
    name="reach",
    summary="an arm moves from one joint state to another, free of collisions",
    home="planner_jax.task.reach",
    planners={"shortcuts": "planner_jax.task.reach.default_planner:ReachPlanner"},
    suites=SUITES,
)
