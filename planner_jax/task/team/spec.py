"""Names of planners and suites of the task `team` (several quadrotors catch), without JAX."""

from planner_jax.core.registry import Task

# Suite -> suite of the task `catch`, and number of robots that share its targets.
SUITES = {"team2-swarm12": ("swarm12", 2), "team3-swarm12": ("swarm12", 3)}

TASK = Task(
    name="team",
    summary="several quadrotors catch flying targets and keep a distance from each other",
    home="planner_jax.task.team",
    planners={"exact": "planner_jax.task.catch.default_planner:CatchProblem.planner"},
    suites={
        k: f"The targets of `{of}`, shared by {num} robots." for k, (of, num) in SUITES.items()
    },
    flight="planner_jax.sims.settings:TeamFly",
    bench={"decide": "greedy"},
)
