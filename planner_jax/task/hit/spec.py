"""Names of planners and suites of the task `hit` (quadrotor returns a ball), without JAX."""

from planner_jax.core.registry import Task

# [1/m], coefficient K_D of the ball's quadratic drag, fitted to the landing points of [Yu2023bat].
DRAG = 0.0616
# [m], hover position of the quadrotor at time 0. [Yu2023bat] gives no numbers; its figure shows the
# quadrotor at the line between the near and the far region of its half court.
START = (-3.0, 0.0, 1.5)

# The six scenarios of the real experiments of [Yu2023bat, Section VI-C] as names of serve, landing
# and target region (N near, F far, L left, R right), for example "FNL". The names are an
# assumption, because the paper describes the scenarios only in words.
REAL_SCENARIOS = {
    "S.1": ("FNN", "FFN"),  # serves from different distances
    "S.2": ("FFF", "LFF"),  # serves from different directions
    "S.3": ("FFN", "FLN"),  # balls that are hit from different directions
    "S.4": ("FFL", "FNL"),  # balls that come straight and are returned sideways
    "S.5": ("FLL", "LLL"),  # balls that come from a side and are returned to the same side
    "S.6": ("FLR", "LLR"),  # balls that come from a side and are returned to the other side
}

TASK = Task(
    name="hit",
    summary="a quadrotor hits served balls to a target with a racket",
    home="planner_jax.task.hit",
    planners={
        "exact": "planner_jax.task.hit.default_planner:HitProblem.planner",
        "bat": "planner_jax.baselines.hit.bat:bat",
        "bat-lite": "planner_jax.baselines.hit.bat:bat_lite",
        "bat-fitted": "planner_jax.baselines.hit.bat:BatHit.planner",
        "bat-lite-fitted": "planner_jax.baselines.hit.bat:bat_lite_fitted",
        "juggle": "planner_jax.baselines.hit.juggle:JuggleHit",
    },
    suites={
        "court": "Serves distributed as the published ones, all 36 scenarios of the court.",
        "S.1": "Serves from different distances.",
        "S.2": "Serves from different directions.",
        "S.3": "Balls that are hit from different directions.",
        "S.4": "Balls that come straight and go sideways.",
        "S.5": "Balls that come from one side and go to the same side.",
        "S.6": "Balls that come from one side and go to the other side.",
    },
    sweep="planner_jax.sweep.hit.settings:HitSettings",
    single="planner_jax.cli.plan.settings:SingleHitSettings",
    flight="planner_jax.sims.settings:HitFly",
    contact="stroke.time",
)
