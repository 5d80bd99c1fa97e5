"""Scenes and shields of blocks from YAML files, and shields from short texts; `docs/arms.md`."""

import dataclasses
import os
import re
from typing import Any

import numpy as np

from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.checks import require_path_name
from planner_jax.core.errors import ArgumentError
from planner_jax.host.yaml_files import read_fields
from planner_jax.robot.arm import Arm
from planner_jax.robot.arm_file import irb1600, read_shield_arm
from planner_jax.robot.arm_scene import SOLIDS, Scene, make_scene, read_numbers
from planner_jax.robot.arm_shield import Shield

_USUAL = {"turn": [1.0, 0.0, 0.0, 0.0], "scale": 1.0, "position": [0.0, 0.0, 0.0]}
_SINGLE = ("floor", "protected_box", "outer")
_SHIELD = {"half": (2,), "radius": (), "position": (3,), "turn": (4,), "mass": ()}


def read_scene(path: str | os.PathLike) -> Scene:
    """Read obstacles and protected body of a scene from a YAML file; its fields are optional.

    Raises:
        ArgumentError: a field is unknown or wrong. The line names the file and the element.
    """
    require_path_name("path", path)
    source, scene = os.fspath(path), {}
    for name, value in _fields("scene", source).items():
        if name in _SINGLE:
            scene[name] = value
        elif name not in SOLIDS:
            raise ArgumentError(
                source, f"fields of {', '.join((*SOLIDS, *_SINGLE))}", name, verb="have"
            )
        elif name == "protected_capsule":
            scene[name] = _element(f"{source}: {name}", value, name)
        elif isinstance(value, list):
            parts = [(f"{source}: {name}[{k}]", each, name) for k, each in enumerate(value)]
            scene[name] = [_element(*part, os.path.dirname(source)) for part in parts]
        else:
            raise ArgumentError(f"{source}: {name}", "a list of obstacles", value)
    try:
        return make_scene(**scene)
    except ArgumentError as error:
        raise error.with_names({error.name: f"{source}: {error.name}"}) from None


def read_shield(text: str) -> Shield:
    """Return the shield that a text describes: WIDTHxHEIGHT or disc:RADIUS [m], or a YAML file.

    The fields of the file are the arguments of `Shield`.
    """
    number = r"(\d+\.?\d*|\.\d+)"
    if found := re.fullmatch(f"{number}x{number}", text):
        return Shield(half=(0.5 * float(found[1]), 0.5 * float(found[2])))
    if found := re.fullmatch(f"disc:{number}", text):
        return Shield(radius=float(found[1]))
    given: dict[str, Any] = {}
    for name, value in _fields("shield", text).items():
        shape = (np.shape(value)[:1] + (2,)) if name == "corners" else _SHIELD.get(name)
        if shape is None:
            known = ", ".join(("corners", *_SHIELD))
            raise ArgumentError(text, f"fields of {known}", name, verb="have")
        numbers = read_numbers(f"{text}: {name}", value, shape).tolist()
        numbers = [*map(tuple, numbers)] if name == "corners" else numbers
        given[name] = tuple(numbers) if shape else numbers
    try:
        return Shield(**given)
    except ArgumentError as error:
        raise error.with_names({error.name: f"{text}: {error.name}"}) from None


def shield_arm(path: str | None, tip: str | None, shield: str | None) -> Arm:
    """Return the arm of a file, or the IRB 1600 for None, with the shield that a text describes.

    The IRB 1600 keeps the position and the mass of its shield.
    """
    own = None if shield is None else read_shield(shield)
    if path is not None:
        return read_shield_arm(path, tip, own)
    arm = irb1600()
    if own is None:
        return arm
    corners = host_leaf(own.outline, np.float32)
    half = np.max(np.abs(corners), axis=0)
    return dataclasses.replace(arm, shield_corners=corners, shield_half=host_leaf(half))


def _fields(name: str, source: str) -> dict[str, Any]:
    try:
        return read_fields(source)
    except OSError as error:
        rule = "a YAML file" if name == "scene" else "WIDTHxHEIGHT, disc:RADIUS or a YAML file"
        raise ArgumentError(name, rule, shown=f"{source} ({error.strerror})") from None
    except ValueError as error:
        raise ArgumentError(source, str(error).removeprefix("must "), verb="", shown="") from None


def _element(place: str, value: object, kind: str, folder: str = "") -> tuple:
    """Return one obstacle's fields; the path of a file is relative to `folder`."""
    shapes = SOLIDS[kind]
    if not isinstance(value, dict) or {*value} - {*shapes} or "file" in {*shapes} - {*value}:
        raise ArgumentError(place, f"the fields {', '.join(shapes)}", value, verb="have")
    if "radius" in value and value["radius"] == 0.0:
        raise ArgumentError(f"{place}.radius", "> 0", value["radius"])
    found = {name: value.get(name, _USUAL.get(name)) for name in shapes}
    if "file" in shapes:
        found["file"] = os.path.join(folder, str(found["file"]))
    return tuple(found.values())
