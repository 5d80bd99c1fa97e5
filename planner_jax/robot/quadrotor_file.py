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
import difflib
import math
import os
import re
from collections.abc import Iterable, Mapping
from fractions import Fraction
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

STANDARD_GRAVITY = "9.80665"  # [m/s^2], exact by definition

_SQUARES = {
    f"{mass} {length}^2": Fraction(of_mass) * Fraction(of_length) ** 2
    for mass, of_mass in (("kg", "1"), ("g", "1e-3"))
    for length, of_length in (("m", "1"), ("cm", "1e-2"), ("mm", "1e-3"))
}
_DEGREE = Fraction(math.pi) / 180
# What can be measured, and its units in those of SI, that one first.
UNITS: dict[str, dict[str, Fraction]] = {
    name: {unit: Fraction(value) for unit, value in units.items()}
    for name, units in {
        "mass": {"kg": "1", "g": "1e-3"},
        "inertia": _SQUARES,
        "length": {"m": "1", "cm": "1e-2", "mm": "1e-3"},
        "time": {"s": "1", "ms": "1e-3"},
        "speed": {"m/s": "1", "cm/s": "1e-2", "km/h": "5/18"},
        "acceleration": {"m/s^2": "1", "g": STANDARD_GRAVITY},
        "force": {"N": "1", "mN": "1e-3", "gf": f"{Fraction(STANDARD_GRAVITY) / 1000}"},
        "rate": {"rad/s": "1", "deg/s": _DEGREE},
        "angle": {"rad": "1", "deg": _DEGREE},
        "share": {"": "1", "%": "1e-2"},
    }.items()
}
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?"
_WRITTEN = re.compile(rf"\s*({_NUMBER}(?:(?:\s*,\s*|\s+){_NUMBER})*)\s*(\D.*?)?\s*", re.ASCII)
_LONGEST = 200  # characters

Value = Any  # of a field: text, a number, a list of these, fields of a part, or None
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


def read_robot(path: str | os.PathLike, **given: Value) -> QuadrotorModel:
    """Return the quadrotor of a file.

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


def model_of(described: Mapping[str, Value], place: str = "robot") -> QuadrotorModel:
    """Return the quadrotor of a description: the fields of a YAML file, or `dataclasses.asdict`.

    Raises:
        RobotError: a field breaks a rule, is not known or is missing; one line that names `place`.
    """
    _only(described, [*_FIELDS[""], *_PARTS], "", place)
    parts: dict[str, Value] = {}
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
    """Return a quadrotor as YAML; `read_robot` restores it to the last digit."""
    plain: dict[str, Value] = dataclasses.asdict(model)
    shown: dict[str, Value] = {"name": plain["name"]}
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


def _text(value: Value, quantity: _Quantity | None) -> Value:
    """Return a value with its SI unit."""
    if quantity is None or value is None or quantity.kind == "share":
        return value
    unit = next(iter(UNITS[quantity.kind]))
    if quantity.count == 8:
        return [_text(place, _Quantity(quantity.kind, 2)) for place in value]
    between = " to " if quantity.span else " "
    numbers = value if isinstance(value, list | tuple) else [value]
    return f"{between.join(repr(float(number)) for number in numbers)} {unit}"


def _described(path: Path) -> dict[str, Value]:
    """Return the description in a file, without what keyword arguments say."""
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


def _require_units(described: Mapping[str, Value], place: str) -> None:
    """Raise `RobotError` where numbers stand alone that have to be written with their unit."""
    for name, quantity in _FIELDS[""].items():
        if quantity is None or not quantity.example or name not in described:
            continue
        if not has_unit(value := described[name]):
            units = ", ".join(UNITS[quantity.kind])
            rule = f"must have its unit, one of {units}, as in {quantity.example!r}"
            raise RobotError(f"{place}: {name} {rule}, got {value!r:.60}")


def _merged(under: Mapping[str, Value], over: Mapping[str, Value]) -> dict[str, Value]:
    """Merge two descriptions field by field; the second one overrides the first."""
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

    def compose_node(self, parent: yaml.Node | None, index: Value) -> yaml.Node | None:
        """Refuse references, by which a short text can become endless."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.MarkedYAMLError(None, None, "no *reference", self.peek_event().start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> Value:
        """Refuse a field that stands there twice."""
        names = [key.value for key, _ in node.value]
        for key, _ in node.value:
            if names.count(key.value) > 1:
                problem = f"{key.value} only once"
                raise yaml.MarkedYAMLError(None, None, problem, key.start_mark)
        return super().construct_mapping(node, deep)


def _only(given: Mapping[str, Value], known: list[str], prefix: str, place: str) -> None:
    """Raise `RobotError` for a field that is not known."""
    for name in given:
        if name not in known:
            hint = suggestion(str(name), known)
            rule = f"must be one of {', '.join(known)}"
            raise RobotError(f"{place}: {prefix}field {rule}, got {str(name)!r:.60}{hint}")


def _values(given: Mapping[str, Value], part: str, place: str) -> dict[str, Value]:
    """Return the fields of a part in SI units."""
    fields, prefix = _FIELDS[part], f"{part}." if part else ""
    _only(given, list(fields), f"{part} " if part else "", place)
    found: dict[str, Value] = {}
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


def _number(value: Value, quantity: _Quantity, name: str) -> Value:
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


def _with_places(rotors: dict[str, Value], place: str) -> dict[str, Value]:
    """Return rotors whose places are said, by themselves or by their diagonal."""
    if "diagonal" not in rotors:
        return rotors
    if "places" in rotors:
        raise RobotError(f"{place}: rotors must have diagonal or places, not both")
    diagonal = rotors.pop("diagonal")
    return {"places": cross(diagonal), **rotors}


def _require_all(kind: type, given: Mapping[str, Value], prefix: str, place: str) -> None:
    """Raise `RobotError` unless all fields are given that have no usual value."""
    for field in dataclasses.fields(kind):
        if field.default is dataclasses.MISSING and field.name not in given:
            name = "places or diagonal" if field.name == "places" else field.name
            raise RobotError(f"{place}: {prefix}{name} must be given, got nothing")


class QuantityError(PlannerJaxError, ValueError):
    """A value is not the quantity that is asked for; what it has to be, in one line."""


def numbers_in(value: Value, kind: str, count: int, *, span: bool = False) -> tuple[float, ...]:
    """Return numbers in SI units.

    Args:
        value: text such as "3 3 5 g m^2", whose unit is that of all its numbers; a number or a
            list of numbers in SI units; or a list of texts.
        kind: a key of `UNITS`.
        count: of the numbers.
        span: whether "to" stands between two numbers.

    Raises:
        QuantityError: another unit, another count, or no numbers.
    """
    parts = value if isinstance(value, list | tuple) else [value]
    found = tuple(number for part in parts for number in _numbers(part, kind, span))
    if len(found) != count:
        what = "a number" if count == 1 else f"{count} numbers"
        raise QuantityError(f"must be {what} in {_units(kind)}, got {_shown(value)}")
    return found


def has_unit(value: Value) -> bool:
    """Return whether every number of a value as `numbers_in` takes it has a unit, known or not."""
    if isinstance(value, list | tuple):
        return all(map(has_unit, value))
    if isinstance(value, str):
        written = _WRITTEN.fullmatch(value)
        return written is None or bool(written[2])
    return not isinstance(value, int | float)


def _numbers(part: Value, kind: str, span: bool) -> list[float]:
    rule = f"must be in {_units(kind)}"
    if isinstance(part, int | float) and not isinstance(part, bool):
        if not math.isfinite(part):
            raise QuantityError(f"must be finite, got {part}")
        return [float(part)]
    if not isinstance(part, str) or len(part) > _LONGEST:
        raise QuantityError(f"{rule}, got {_shown(part)}")
    written = _WRITTEN.fullmatch(part.replace(" to ", " ") if span else part)
    if written is None:
        raise QuantityError(f"{rule}, got {_shown(part)}")
    unit = " ".join((written[2] or "").replace("*", " ").split())
    known = UNITS[kind]
    if unit and unit not in known:
        raise QuantityError(f"{rule}, got {_shown(part)}{suggestion(unit, known)}")
    factor = known[unit] if unit else Fraction(1)
    try:  # exact until the end, so that 33 g are 0.033 kg to the last digit
        return [float(Fraction(number) * factor) for number in re.findall(_NUMBER, written[1])]
    except OverflowError:
        raise QuantityError(f"must be finite, got {_shown(part)}") from None


def suggestion(given: str, known: Iterable[str] | Mapping[str, Value]) -> str:
    """Return a suggestion as the end of a message; empty if no known name is similar."""
    near = difflib.get_close_matches(given, [name for name in known if name], n=1, cutoff=0.5)
    return f"; did you mean {near[0]}?" if near else ""


def _units(kind: str) -> str:
    return ", ".join(unit or "no unit" for unit in UNITS[kind])


def _shown(value: Value) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
