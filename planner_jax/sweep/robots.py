"""The robot of a run: a ready one, or that of a file; the manifest holds all of it.

Robots are imported where one is named, so that a command's help needs no NumPy.
"""

from collections.abc import Mapping
from typing import Any

from planner_jax.core.errors import ArgumentError
from planner_jax.runs.settings import option


def robot_option(usual: str) -> Any:
    """The field of settings `robot`, a `QuadrotorModel`, or None for the usual one of the task."""
    words = f"as `planner-jax robots` lists them, or a file .yaml, .yml, .xml (default: {usual})"
    return option(None, "NAME", words)


def checked_robot(given: Any, tool: str) -> Any:
    """The robot that a setting names.

    Args:
        given: a name or a file, a robot, its fields as a manifest has them, or None.
        tool: the kind that it has to carry, "net" or "racket".

    Returns:
        The `QuadrotorModel`, or None.

    Raises:
        ArgumentError: there is no such robot, its file is not sound, or it carries something else.
    """
    if given is None:
        return None
    from planner_jax.robot.quadrotor_file import RobotError, model_of
    from planner_jax.robot.quadrotor_model import QuadrotorModel
    from planner_jax.robot.quadrotor_models import robot_named

    try:
        found = model_of(given) if isinstance(given, Mapping) else given
        found = robot_named(found) if isinstance(found, str) else found
    except RobotError as error:
        raise ArgumentError("robot", f"a sound one: {error}", shown="") from None
    if not isinstance(found, QuadrotorModel):
        raise ArgumentError("robot", "a name, a file or a QuadrotorModel", given)
    if found.tool.kind != tool:
        raise ArgumentError(
            "robot", f"a {tool}", verb="carry", shown=f"{found.name!r} with a {found.tool.kind}"
        )
    return found


def robot_remark(parameters: Mapping[str, Any]) -> list[str]:
    """Which robot a run is of, where one was named, a sentence."""
    robot = parameters.get("robot")
    if robot is None:
        return []
    source = f" ({robot['source']})" if robot["source"] else ""
    return [f"Robot: {robot['name']}{source}; its figures stand in manifest.json."]
