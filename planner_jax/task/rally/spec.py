"""Names of planners and suites of the task `rally` (a quadrotor keeps a ball up), without JAX."""

from planner_jax.core.registry import Task

SUITES = {
    "juggle": "One robot keeps a ball up inside a volume.",
    "target": "Every third hit of one robot sends the ball to a circle of 0.25 m.",
    "volley": "Two robots hit a ball to each other over a net.",
    "volleybots-juggle": "Robot, ball and starts of the task Solo Bump of VolleyBots.",
    "volleybots-hit": "Robot, ball and starts of the task Hit the Ball of VolleyBots.",
}

TASK = Task(
    name="rally",
    summary="a quadrotor hits a ball again and again with a racket",
    home="planner_jax.task.rally",
    planners={"exact": "planner_jax.task.rally.default_planner:RallyProblem.planner"},
    suites=SUITES,
    contact="strokes.time",
    flight="planner_jax.sims.settings:RallyFly",
)
