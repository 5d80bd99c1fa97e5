"""The catch planners by name: one signature, chosen on the command line or by a benchmark."""

from typing import Any

from planner_jax.task.by_name import make_planner

PLANNERS = {
    "exact": "planner_jax.task.catch.exact:ExactCatch",
    "catch": "planner_jax.task.catch.paper:PaperCatch",
    "mpp": "planner_jax.task.catch.mpp:MppCatch",
}


def catch_planner(name: str, **options: Any) -> Any:
    """The catch planner of a name, with some of its fields set.

    * `exact`: the ball is in the net by construction; the one to use.
    * `catch`: the published planner of paper 000, which meets the ball by penalties.
    * `mpp`: the motion primitives that paper 000 compares with; nothing is optimised.

    Args:
        name: one of these.
        **options: fields of that planner's dataclass, for example `rounds`.

    Returns:
        `ExactCatch`, `PaperCatch` or `MppCatch`, for `plan` and `plan_catches`.

    Raises:
        ValueError: there is no planner of that name.
        TypeError: the planner has no such field.
    """
    return make_planner(PLANNERS, name, options)
