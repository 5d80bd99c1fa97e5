"""Names of planners and suites of the task `rally` (a quadrotor keeps a ball up), without JAX."""

from planner_jax.core.registry import Task

SUITES = {
    "juggle": "One robot keeps a ball up inside a volume.",
}

TASK = Task(
    name="rally",
    summary="a quadrotor hits a ball again and again with a racket",
    home="planner_jax.task.rally",
    planners={"exact": "planner_jax.task.rally.default_planner:ExactRally"},
    suites=SUITES,
    contact="strokes.time",
    flight="planner_jax.sims.settings:RallyFly",
)
