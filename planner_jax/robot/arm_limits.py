"""Limits of an arm's joints from its file, a URDF's attributes, and YAML files beside it."""

import math
import os
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

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
    of_urdf = _read_urdf(model.text) if model.is_urdf else {}
    stated, source = _find_limits(model.path, limits, names)
    for given in (of_urdf, stated):
        for kind, values in given.items():
            found[kind] |= values
    lacking = {k: [n for n in names if n not in values] for k, values in found.items()}
    if any(lacking.values()):
        kinds = " and ".join(kind for kind, joints in lacking.items() if joints)
        joints = [name for name in names if any(name in each for each in lacking.values())]
        rule = f"limits of {kinds}; state them in {source} (docs/arms.md)"
        raise model.error(f"joints {', '.join(joints)}", rule)
    return {kind: np.array([values[name] for name in names]) for kind, values in found.items()}


def _find_limits(path: Path | None, limits: Limits, joints: tuple[str, ...]) -> tuple[Stated, str]:
    """Return the limits that a dictionary or a YAML file states, and the name of their source.

    Args:
        path: the arm's file. Without `limits`, `NAME.limits.yaml` beside it is read if it exists.
        limits: the argument of `read_arm`.
        joints: names of the arm's joints in their order.
    """
    source = "limits"
    if limits is None:
        beside = None if path is None else path.with_name(f"{path.stem}.limits.yaml")
        if beside is None or not beside.is_file():
            return {}, "limits=" if beside is None else f"{beside.name} beside it, or in limits="
        limits = beside
    if not isinstance(limits, Mapping):
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
        return _from_moveit(source, limits["joint_limits"], joints), source
    stated: Stated = {}
    for kind, values in limits.items():
        if kind not in _MOVEIT:
            rule = f"fields {', '.join(_MOVEIT)}, or joint_limits"
            raise ArgumentError(source, rule, kind, verb="have")
        if isinstance(values, Mapping):
            unknown = [name for name in values if name not in joints]
            if unknown:
                rule = f"of the joints {', '.join(joints)}"
                raise ArgumentError(f"{source}: {kind}", rule, unknown[0])
        elif isinstance(values, list):
            if len(values) != len(joints):
                rule = f"one value for each of the {len(joints)} joints"
                raise ArgumentError(f"{source}: {kind}", rule, len(values), verb="have")
            values = dict(zip(joints, values, strict=True))
        else:
            values = dict.fromkeys(joints, values)
        stated[kind] = {name: _number(source, kind, name, value) for name, value in values.items()}
    return stated, source


def _read_urdf(text: str) -> Stated:
    """Return velocities and efforts of a URDF's `<limit>` elements; 0 states no limit.

    MuJoCo's compiler ignores the velocity.
    """
    root = ET.fromstring(text)
    stated: Stated = {}
    for joint in root.iterfind("joint"):
        for limit in joint.iterfind("limit"):
            for kind, name in (("velocity", "velocity"), ("torque", "effort")):
                value = float(limit.get(name, 0.0))
                if value > 0.0:
                    stated.setdefault(kind, {})[joint.get("name", "")] = value
    return stated


def _from_moveit(source: str, fields: Any, joints: tuple[str, ...]) -> Stated:
    stated: Stated = {}
    for name, values in fields.items() if isinstance(fields, Mapping) else ():
        for kind, (flag, *names) in _MOVEIT.items():
            has_values = name in joints and isinstance(values, Mapping) and names[0] in values
            if has_values and values.get(flag, True):
                found = [values.get(each) for each in names]
                number = found if kind == "position" else found[0]
                stated.setdefault(kind, {})[name] = _number(source, kind, name, number)
    return stated


def _number(source: str, kind: str, joint: str, value: Any) -> Any:
    """Return a limit, or the two limits of the position; raise unless the numbers are sound."""
    numbers = value if isinstance(value, list | tuple) else [value]
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
