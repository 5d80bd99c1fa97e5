"""Scenes and shields of blocks from YAML files, and shields from short texts; `docs/arms.md`."""

import dataclasses
import os
import re
from typing import Any

import numpy as np

from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.errors import ArgumentError
from planner_jax.host.yaml_files import read_fields
from planner_jax.robot.arm import Arm
from planner_jax.robot.arm_file import Shield, irb1600, read_shield_arm
from planner_jax.task.block.scene import Scene, make_scene

_ROD = {"ends": (2, 3), "radius": ()}
_USUAL = {"turn": [1.0, 0.0, 0.0, 0.0], "scale": 1.0, "position": [0.0, 0.0, 0.0]}
# Fields of an element of each list of obstacles in a file, with their shapes; None is a file.
_KINDS: dict[str, dict[str, tuple[int, ...] | None]] = {
    "boxes": {"middle": (3,), "size": (3,), "turn": (4,)},
    "spheres": {"middle": (3,), "radius": ()},
    "capsules": _ROD,
    "cylinders": _ROD,
    "meshes": {"file": None, "scale": (), "position": (3,), "turn": (4,)},
}
_SINGLE: dict[str, tuple[int, ...]] = {"floor": (), "protected_box": (2, 3), "outer": (2, 3)}
_SHIELD = {"half": (2,), "radius": (), "position": (3,), "turn": (4,), "mass": ()}


def read_scene(path: str | os.PathLike) -> Scene:
    """Read obstacles and protected body of a scene from a YAML file; its fields are optional.

    Raises:
        ArgumentError: a field is unknown or wrong. The line names the file and the element.
    """
    source, scene = os.fspath(path), {}
    for name, value in _fields("scene", source).items():
        if name in _KINDS:
            if not isinstance(value, list):
                raise ArgumentError(f"{source}: {name}", "a list of obstacles", value)
            places = [f"{source}: {name}[{k}]" for k in range(len(value))]
            folder, of = os.path.dirname(source), _KINDS[name]
            parts = [_element(*each, of, folder) for each in zip(places, value, strict=True)]
            scene[name] = [tuple(each.values()) for each in parts]
        elif name == "protected_capsule":
            scene[name] = tuple(_element(f"{source}: {name}", value, _ROD).values())
        elif name in _SINGLE:
            scene[name] = _numbers(f"{source}: {name}", value, _SINGLE[name])
        else:
            known = ", ".join((*_KINDS, "protected_capsule", *_SINGLE))
            raise ArgumentError(source, f"fields of {known}", name, verb="have")
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
        numbers = _numbers(f"{text}: {name}", value, shape).tolist()
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


def _element(place: str, value: Any, shapes: dict[str, Any], folder: str = "") -> dict[str, Any]:
    """Return one obstacle's fields; the path of a file is relative to `folder`."""
    if not isinstance(value, dict) or {*value} - {*shapes} or "file" in {*shapes} - {*value}:
        raise ArgumentError(place, f"the fields {', '.join(shapes)}", value, verb="have")
    found: dict[str, Any] = {}
    for name, shape in shapes.items():
        own = value.get(name, _USUAL.get(name))
        is_file = shape is None
        found[name] = (
            os.path.join(folder, str(own)) if is_file else _numbers(f"{place}.{name}", own, shape)
        )
    name = next(each for each in ("radius", "size", "scale") if each in found)
    if not np.all(found[name] > 0.0):
        raise ArgumentError(f"{place}.{name}", "> 0", value[name])
    if "cylinders" in place and np.array_equal(*found["ends"]):
        raise ArgumentError(f"{place}.ends", "two different points", value["ends"])
    return found


def _numbers(place: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    try:
        found = np.array(value, float)
    except (TypeError, ValueError):
        found = np.full(0, np.nan)
    if found.shape != shape or not np.isfinite(found).all():
        rule = (
            f"{' lists of '.join(map(str, shape))} finite numbers" if shape else "a finite number"
        )
        raise ArgumentError(place, rule, value)
    return found
