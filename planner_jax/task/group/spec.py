"""Names of planners and suites of the task `group` (a car meets several targets), without JAX."""

from planner_jax.core.registry import Task
from planner_jax.task.intercept.spec import Suite

SUITES = {
    "group": Suite(
        "Two to four targets for one car, five to eight walls, two or three movers.",
        (5, 8),
        (2, 3),
        time=15.0,
        num_targets=(2, 4),
    ),
    "forty": Suite(
        "Forty targets in circles among forty movers, with the densities of `group`, no walls.",
        (0, 0),
        (40, 40),
        time=200.0,
        wall_room=(1, 3),
        mover_room=(40, 3),
        num_targets=(40, 40),
    ),
}

MOST_PERMUTED = 8  # greatest number N of targets for which all N! orders are estimated

DECISIONS = {
    "best": "planner_jax.task.group.decide:Best",
    "greedy": "planner_jax.task.group.decide:Greedy",
    "given": "planner_jax.task.group.decide:Given",
    "search": "planner_jax.task.group.decide:Search",
}

TASK = Task(
    name="group",
    summary="a car meets several moving targets one after another among obstacles",
    home="planner_jax.task.group",
    planners={
        "spacetime": "planner_jax.task.group.default_planner:GroupIntercept",
        "direct": "planner_jax.task.group.direct:DirectGroup",
    },
    suites={name: suite.description for name, suite in SUITES.items()},
    sweep="planner_jax.sweep.intercept.settings:GroupSettings",
    bench={"decide": "greedy"},
    contact="cost",
)
