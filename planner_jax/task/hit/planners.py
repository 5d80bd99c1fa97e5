"""The hit planners by name: one signature, chosen on the command line or by a benchmark."""

from typing import Any

from planner_jax.task.by_name import make_planner

PLANNERS = {
    "exact": "planner_jax.task.hit.exact:ExactHit",
    "bat": "planner_jax.task.hit.bat:BatHit",
    "bat-lite": "planner_jax.task.hit.bat:bat_lite",
    "juggle": "planner_jax.task.hit.juggle:JuggleHit",
}


def planner(name: str, **options: Any) -> Any:
    """The planner of a name with some fields set; see `make_planner`."""
    return make_planner(PLANNERS, name, options)
