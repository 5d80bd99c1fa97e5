"""The catch planners by name: one signature, chosen on the command line or by a benchmark."""

from typing import Any

from planner_jax.task.by_name import make_planner

PLANNERS = {
    "exact": "planner_jax.task.catch.exact:ExactCatch",
    "catch": "planner_jax.task.catch.paper:PaperCatch",
    "mpp": "planner_jax.task.catch.mpp:MppCatch",
}


def catch_planner(name: str, **options: Any) -> Any:
    """The planner of a name with some fields set; see `make_planner`."""
    return make_planner(PLANNERS, name, options)
