"""Quadrotors from YAML files whose values have units, and back.

    name: mine
    mass: 800 g
    inertia: 3 3 5 g m^2
    rotors: {diagonal: 250 mm, max_thrust: 4.5 N, lag: 30 ms}
    tool: {kind: racket, height: 6 cm, radius: 11 cm}
    limits: {speed: 5 m/s, body_rate: 344 deg/s, thrust: 0.2 to 1.9 g}

A number without a unit is in SI units; an inertia alone has to have one, as 3 is too easily meant
in g m^2. "g" is the standard gravity where an acceleration stands.
`model: mine.xml` takes body and rotors from MJCF; what the YAML says then goes before. Nothing here
imports JAX.
"""

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from planner_jax.core.errors import PlannerJaxError
from planner_jax.host.files import open_plain
from planner_jax.robot.quadrotor_model import (
    NET,
    RACKET,
    FlightLimits,
    QuadrotorModel,
    Rotors,
    Tool,
    cross,
)
from planner_jax.robot.quantities import UNITS, QuantityError, has_unit, numbers_in, suggestion

ENDINGS = (".yaml", ".yml", ".xml")
_LARGEST = 1 << 20  # bytes of a file
_PARTS: dict[str, type] = {"rotors": Rotors, "tool": Tool, "limits": FlightLimits}


class RobotError(PlannerJaxError, ValueError):
    """A robot's description breaks a rule; one line that names file and field."""


class _Quantity(NamedTuple):
    """What a field holds."""

    kind: str  # a key of `UNITS`
    count: int = 1  # pyright: ignore[reportIncompatibleMethodOverride]
    span: bool = False  # "to" stands between its two numbers
    optional: bool = False  # may be null, which is no limit
    example: str = ""  # of what has to be written with its unit; else SI is meant without one


_LENGTH = _Quantity("length")
# By part of the description, "" for the whole; None is text.
_FIELDS: dict[str, dict[str, _Quantity | None]] = {
    "": {
        "name": None,
        "source": None,
        "mass": _Quantity("mass"),
        "inertia": _Quantity("inertia", 3, example="3 3 5 g m^2"),
    },
    "rotors": {
        "diagonal": _LENGTH,
        "places": _Quantity("length", 8),
        "max_thrust": _Quantity("force"),
        "min_thrust": _Quantity("force"),
        "torque_ratio": _LENGTH,
        "lag": _Quantity("time"),
        "radius": _LENGTH,
    },
    "tool": {
        "kind": None,
        "height": _LENGTH,
        "radius": _LENGTH,
        "restitution": _Quantity("share"),
        "max_angle": _Quantity("angle"),
    },
    "limits": {
        "speed": _Quantity("speed"),
        "body_rate": _Quantity("rate"),
        "min_height": _LENGTH,
        "acceleration": _Quantity("acceleration", optional=True),
        "thrust": _Quantity("acceleration", 2, span=True, optional=True),
        "rotor_share": _Quantity("share", optional=True),
    },
}


def read_robot(path: str | os.PathLike, **given: Any) -> QuadrotorModel:
    """The quadrotor of a file.

    Args:
        path: of YAML (.yaml, .yml), or of MJCF (.xml) for MuJoCo, which is read with the extra
            `sims`. MJCF says nothing of tool and limits.
        **given: what is to be had in the place of the file's: `name`, `mass`, `inertia`, `rotors`,
            `tool`, `limits` and `source`, as the YAML has them, as numbers in SI units, or as
            objects, such as a `Tool`.

    Raises:
        RobotError: the file or a field breaks a rule; one line.
        MissingExtra: MuJoCo is not installed.
        OSError: the file cannot be read.
    """
    place = os.fspath(path)
    described = _described(Path(place))
    _require_units({k: v for k, v in given.items() if isinstance(v, str)}, place)
    for name, value in given.items():
        part = isinstance(value, tuple(_PARTS.values()))
        described = _merged(described, {name: dataclasses.asdict(value) if part else value})
    return model_of({"name": Path(place).stem, **described}, place)


def model_of(described: Mapping[str, Any], place: str = "robot") -> QuadrotorModel:
    """The quadrotor of a description with the fields of a YAML file.

    `dataclasses.asdict` of a model is such a description as well.

    Args:
        described: the fields by name.
        place: where they come from, for messages.

    Raises:
        RobotError: a field breaks a rule, is not known or is missing; one line.
    """
    _only(described, [*_FIELDS[""], *_PARTS], "", place)
    parts: dict[str, Any] = {}
    for part in _PARTS:
        value = described.get(part)
        if value is None:
            raise RobotError(f"{place}: {part} must be given, got nothing")
        if not isinstance(value, Mapping):
            raise RobotError(f"{place}: {part} must be fields with values, got {value!r:.60}")
        parts[part] = _values(value, part, place)
    whole = _values({k: v for k, v in described.items() if k not in _PARTS}, "", place)
    parts["rotors"] = _with_places(parts["rotors"], place)
    kind = parts["tool"].get("kind", NET)
    if kind not in (NET, RACKET):
        hint = suggestion(kind, (NET, RACKET))
        raise RobotError(f"{place}: tool.kind must be {NET} or {RACKET}, got {kind!r}{hint}")
    try:
        for part, made in _PARTS.items():
            _require_all(made, parts[part], f"{part}.", place)
            parts[part] = made(**parts[part])
        _require_all(QuadrotorModel, {**whole, **parts}, "", place)
        return QuadrotorModel(**whole, **parts)
    except RobotError:
        raise
    except ValueError as error:
        raise RobotError(f"{place}: {error}") from None


def as_yaml(model: QuadrotorModel) -> str:
    """The YAML file of a quadrotor; `read_robot` makes the same one of it, to the last digit."""
    plain: dict[str, Any] = dataclasses.asdict(model)
    shown: dict[str, Any] = {"name": plain["name"]}
    if model.source:
        shown["source"] = plain["source"]
    shown |= {name: _text(plain[name], _FIELDS[""][name]) for name in ("mass", "inertia")}
    rotors = plain["rotors"]
    diagonal = round(2.0 * float(max(abs(x) for x in rotors["places"][0])) * 2.0**0.5, 12)
    if cross(diagonal) == rotors["places"]:
        del rotors["places"]
        plain["rotors"] = {"diagonal": diagonal, **rotors}
    for part in _PARTS:
        fields = _FIELDS[part]
        shown[part] = {name: _text(value, fields[name]) for name, value in plain[part].items()}
    return yaml.safe_dump(shown, sort_keys=False, allow_unicode=True, width=100)


def _text(value: Any, quantity: _Quantity | None) -> Any:
    """A value with its SI unit."""
    if quantity is None or value is None or quantity.kind == "share":
        return value
    unit = next(iter(UNITS[quantity.kind]))
    if quantity.count == 8:
        return [_text(place, _Quantity(quantity.kind, 2)) for place in value]
    between = " to " if quantity.span else " "
    numbers = value if isinstance(value, list | tuple) else [value]
    return f"{between.join(repr(float(number)) for number in numbers)} {unit}"


def _described(path: Path) -> dict[str, Any]:
    """The description in a file, without what keyword arguments say."""
    if path.suffix.lower() not in ENDINGS:
        raise RobotError(f"path must end in {', '.join(ENDINGS)}, got {str(path)!r}")
    with open_plain(path) as file:
        text = file.read(_LARGEST + 1)
    if len(text) > _LARGEST:
        raise RobotError(f"{path}: must be at most {_LARGEST} bytes")
    if path.suffix.lower() == ".xml":
        from planner_jax.robot.quadrotor_mjcf import described_by

        return described_by(path)
    try:
        found = yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        raise RobotError(f"{path}: must be YAML, {' '.join(str(error).split())}") from None
    except (RecursionError, ValueError) as error:
        raise RobotError(f"{path}: must be YAML, got {str(error)[:60]}") from None
    if not isinstance(found, dict) or not all(isinstance(name, str) for name in found):
        raise RobotError(f"{path}: must be fields with values, got {found!r:.60}")
    _require_units(found, str(path))
    model = found.pop("model", None)
    if model is None:
        return found
    if not isinstance(model, str) or not model.lower().endswith(".xml"):
        raise RobotError(f"{path}: model must name an MJCF file, .xml, got {model!r:.60}")
    return _merged(_described(path.parent / model), found)


def _require_units(described: Mapping[str, Any], place: str) -> None:
    """Raise `RobotError` where numbers stand alone that have to be written with their unit."""
    for name, quantity in _FIELDS[""].items():
        if quantity is None or not quantity.example or name not in described:
            continue
        if not has_unit(value := described[name]):
            units = ", ".join(UNITS[quantity.kind])
            rule = f"must have its unit, one of {units}, as in {quantity.example!r}"
            raise RobotError(f"{place}: {name} {rule}, got {value!r:.60}")


def _merged(under: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of two descriptions; those of the second go before, field by field of a part."""
    found = dict(under)
    for name, value in over.items():
        old = found.get(name)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            dropped = {"diagonal": "places", "places": "diagonal"}
            gone = {dropped.get(field) for field in value}
            found[name] = {**{k: v for k, v in old.items() if k not in gone}, **value}
        else:
            found[name] = value
    return found


class _Loader(yaml.SafeLoader):
    """YAML in which no field is said twice and nothing refers to something else."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Refuse references, by which a short text can become endless."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.MarkedYAMLError(None, None, "no *reference", self.peek_event().start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        """Refuse a field that stands there twice."""
        names = [key.value for key, _ in node.value]
        for key, _ in node.value:
            if names.count(key.value) > 1:
                problem = f"{key.value} only once"
                raise yaml.MarkedYAMLError(None, None, problem, key.start_mark)
        return super().construct_mapping(node, deep)


def _only(given: Mapping[str, Any], known: list[str], prefix: str, place: str) -> None:
    """Raise `RobotError` for a field that is not known."""
    for name in given:
        if name not in known:
            hint = suggestion(str(name), known)
            rule = f"must be one of {', '.join(known)}"
            raise RobotError(f"{place}: {prefix}field {rule}, got {str(name)!r:.60}{hint}")


def _values(given: Mapping[str, Any], part: str, place: str) -> dict[str, Any]:
    """The fields of a part in SI units."""
    fields, prefix = _FIELDS[part], f"{part}." if part else ""
    _only(given, list(fields), f"{part} " if part else "", place)
    found: dict[str, Any] = {}
    for name, value in given.items():
        quantity = fields[name]
        if quantity is None:
            if not isinstance(value, str) or not (value or name == "source"):
                raise RobotError(f"{place}: {prefix}{name} must be text, got {value!r:.60}")
            found[name] = value
        elif value is None and quantity.optional:
            found[name] = None
        else:
            found[name] = _number(value, quantity, f"{place}: {prefix}{name}")
    return found


def _number(value: Any, quantity: _Quantity, name: str) -> Any:
    if quantity.count == 8 and isinstance(value, list | tuple):  # four pairs
        value = [
            each for pair in value for each in (pair if isinstance(pair, list | tuple) else [pair])
        ]
    try:
        numbers = numbers_in(value, quantity.kind, quantity.count, span=quantity.span)
    except QuantityError as error:
        raise RobotError(f"{name} {error}") from None
    if quantity.count == 8:
        return tuple(zip(numbers[::2], numbers[1::2], strict=True))
    return numbers[0] if quantity.count == 1 else numbers


def _with_places(rotors: dict[str, Any], place: str) -> dict[str, Any]:
    """Rotors whose places are said, by themselves or by their diagonal."""
    if "diagonal" not in rotors:
        return rotors
    if "places" in rotors:
        raise RobotError(f"{place}: rotors must have diagonal or places, not both")
    diagonal = rotors.pop("diagonal")
    return {"places": cross(diagonal), **rotors}


def _require_all(kind: type, given: Mapping[str, Any], prefix: str, place: str) -> None:
    """Raise `RobotError` unless all fields are given that have no usual value."""
    for field in dataclasses.fields(kind):
        if field.default is dataclasses.MISSING and field.name not in given:
            name = "places or diagonal" if field.name == "places" else field.name
            raise RobotError(f"{place}: {prefix}{name} must be given, got nothing")
