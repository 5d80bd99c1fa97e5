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
    """The hit planner of a name, with some of its fields set.

    * `exact`: contact, impact and landing hold by construction; the one to use.
    * `bat`: the published planner of paper 002, impact and trajectory optimised together.
    * `bat-lite`: `bat` without the transition point before the impact.
    * `juggle`: a primitive to a stroke that is fixed beforehand; nothing is optimised.

    Args:
        name: one of these.
        **options: fields of that planner's dataclass, for example `rounds`.

    Returns:
        `ExactHit`, `BatHit` (`bat` and `bat-lite`) or `JuggleHit`, for `plan`.

    Raises:
        ValueError: there is no planner of that name.
        TypeError: the planner has no such field.
    """
    return make_planner(PLANNERS, name, options)
