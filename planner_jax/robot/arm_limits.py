"""Limits of an arm's joints from its file, a URDF's attributes, and YAML files beside it."""

import contextlib
import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from planner_jax.core.checks import require_path_name
from planner_jax.core.errors import ArgumentError
from planner_jax.host.yaml_files import read_fields
from planner_jax.robot.arm_chain import ArmModel

Limits = str | os.PathLike | Mapping[str, Any] | None
Stated = dict[str, dict[str, Any]]  # kind of limit -> name of a joint -> value

# Kinds of limits in the project's files -> names of the kind in MoveIt's `joint_limits.yaml`.
_MOVEIT = {
    "position": ("has_position_limits", "min_position", "max_position"),
    "velocity": ("has_velocity_limits", "max_velocity"),
    "acceleration": ("has_acceleration_limits", "max_acceleration"),
    "torque": ("has_effort_limits", "max_effort"),
}


def limits_of(model: ArmModel, limits: Limits) -> dict[str, np.ndarray]:
    """Return the limits of positions (n, 2) [rad], and of velocity, acceleration and torque (n,).

    Values that a YAML file or a dictionary states replace the values of the arm's file. A torque
    without a limit is infinite, which a file may state, too.

    Raises:
        ArgumentError: a joint has no limit of its position, velocity or acceleration.
    """
    names = model.joint_names
    found: Stated = {"position": {}, "velocity": {}, "acceleration": {}, "torque": {}}
    for name, joint in zip(names, model.joints, strict=True):
        if model.model.jnt_limited[joint]:
            found["position"][name] = model.model.jnt_range[joint]
        found["torque"][name] = model.torque(joint)
    stated, source = _find_limits(model, limits)
    of_urdf = _of_urdf(model, stated) if model.source.is_urdf else {}
    for given in (of_urdf, stated):
        for kind, values in given.items():
            found[kind] |= values
    lacking = {k: [n for n in names if n not in values] for k, values in found.items()}
    if any(lacking.values()):
        kinds = " and ".join(kind for kind, joints in lacking.items() if joints)
        joints = [name for name in names if any(name in each for each in lacking.values())]
        rule = f"limits of {kinds}; state them in {source} (docs/arms.md)"
        raise model.error(f"joints {', '.join(joints)}", rule)
    for name, torque in found["torque"].items():
        if not torque > 0.0:
            rule = f"a range of forces on both sides of 0; state a torque in {source}"
            raise model.error(f'joint "{name}"', rule)
    return {kind: np.array([values[name] for name in names]) for kind, values in found.items()}


def _find_limits(model: ArmModel, limits: Limits) -> tuple[Stated, str]:
    """Return the limits that a dictionary or a YAML file states, and the name of their source.

    Args:
        model: the arm. Without `limits`, `NAME.limits.yaml` beside its file is read if it exists.
        limits: the argument of `read_arm`.
    """
    path, joints = model.path, model.joint_names
    source = "limits"
    if limits is None:
        beside = None if path is None else path.with_name(f"{path.stem}.limits.yaml")
        if beside is None or not beside.is_file():
            return {}, "limits=" if beside is None else f"{beside.name} beside it, or in limits="
        limits = beside
    if not isinstance(limits, Mapping):
        require_path_name("limits", limits)
        source = os.fspath(limits)
        try:
            limits = read_fields(source)
        except OSError as error:
            raise ArgumentError("limits", "a YAML file", f"{source} ({error.strerror})") from None
        except ValueError as error:
            raise ArgumentError(
                source, str(error).removeprefix("must "), verb="", shown=""
            ) from None
    if "joint_limits" in limits:
        return _from_moveit(source, limits["joint_limits"], model), source
    stated: Stated = {}
    for kind, values in limits.items():
        values = _plain(values)
        if kind not in _MOVEIT:
            rule = f"fields {', '.join(_MOVEIT)}, or joint_limits"
            raise ArgumentError(source, rule, kind, verb="have")
        if isinstance(values, Mapping):
            unknown = [name for name in values if name not in joints]
            if unknown:
                rule = f"of the joints {', '.join(joints)}"
                raise ArgumentError(f"{source}: {kind}", rule, unknown[0])
        elif isinstance(values, list) and not (kind == "position" and _is_pair(values)):
            if len(values) != len(joints):
                rule = f"one value for each of the {len(joints)} joints"
                raise ArgumentError(f"{source}: {kind}", rule, len(values), verb="have")
            values = dict(zip(joints, values, strict=True))
        else:
            values = dict.fromkeys(joints, values)
        stated[kind] = {name: _number(source, kind, name, value) for name, value in values.items()}
    return stated, source


def _of_urdf(model: ArmModel, others: Stated) -> Stated:
    """Return velocities and efforts of a URDF's `<limit>` elements; 0 states no limit.

    MuJoCo's compiler ignores the velocity. Limits that `others` states are left out.
    """
    stated: Stated = {}
    for joint in model.joint_names:
        fields = model.source.limits.get(joint, {})
        for kind, name in (("velocity", "velocity"), ("torque", "effort")):
            value: Any = fields.get(name, "0")
            with contextlib.suppress(ValueError):
                value = float(value)
            if value != 0.0 and joint not in others.get(kind, {}):
                stated.setdefault(kind, {})[joint] = _number(model.name, kind, joint, value)
    return stated


def _from_moveit(source: str, fields: object, model: ArmModel) -> Stated:
    stated: Stated = {}
    if not isinstance(fields, Mapping):
        raise ArgumentError(f"{source}: joint_limits", "fields with the names of joints", fields)
    known = [model.model.joint(k).name for k in range(model.model.njnt)]
    for name, values in fields.items():
        place = f"{source}: joint_limits"
        if name not in known and name not in model.joint_names:
            raise ArgumentError(place, f"of the joints {', '.join(model.joint_names)}", name)
        if not isinstance(values, Mapping):
            raise ArgumentError(f"{place} of {name}", "fields with values", values)
        for kind, (flag, *names) in _MOVEIT.items():
            if name in model.joint_names and names[0] in values and values.get(flag, True):
                found = [values.get(each) for each in names]
                number = found if kind == "position" else found[0]
                stated.setdefault(kind, {})[name] = _number(source, kind, name, number)
    return stated


def _plain(value: Any) -> Any:
    """Return numbers and lists instead of scalars and arrays of NumPy and instead of tuples."""
    value = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    return [*map(_plain, value)] if isinstance(value, list | tuple) else value


def _is_pair(values: list[Any]) -> bool:
    return len(values) == 2 and not any(isinstance(each, list) for each in values)


def _number(source: str, kind: str, joint: str, value: Any) -> Any:
    """Return a limit, or the two limits of the position; raise unless the numbers are sound."""
    value = _plain(value)
    numbers = value if isinstance(value, list) else [value]
    are_numbers = all(isinstance(x, int | float) and not isinstance(x, bool) for x in numbers)
    if kind == "position":
        rule, is_sound = "two finite numbers in ascending order", len(numbers) == 2 and are_numbers
        is_sound = is_sound and all(map(math.isfinite, numbers)) and numbers[0] < numbers[1]
    else:
        may_be_infinite = kind == "torque"  # no limit
        rule = "a number > 0" if may_be_infinite else "a finite number > 0"
        is_sound = len(numbers) == 1 and are_numbers and numbers[0] > 0.0
        is_sound = is_sound and (may_be_infinite or math.isfinite(numbers[0]))
    if not is_sound:
        raise ArgumentError(f"{source}: {kind} of {joint}", rule, value)
    return np.array(numbers, float) if kind == "position" else float(numbers[0])
