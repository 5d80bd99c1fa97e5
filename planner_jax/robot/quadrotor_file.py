"""Reading and writing of quadrotors as YAML files whose values have units, as in this example.

    name: mine
    mass: 800 g
    inertia: 3 3 5 g m^2
    rotors: {diagonal: 250 mm, max_thrust: 4.5 N, lag: 30 ms}
    tool: {kind: racket, height: 6 cm, radius: 11 cm}
    limits: {speed: 5 m/s, body_rate: 344 deg/s, thrust: 0.2 to 1.9 g}
    drag: {across: 0.3 1/s, along: 0.5 1/s}

A number without a unit is in SI units. Only an inertia must have its unit, because it is often
stated in g m^2. In an acceleration "g" is the standard gravity, elsewhere the gram. The field
`model`, a path such as mine.xml, reads body and rotors from a MuJoCo model (MJCF); fields of the
YAML file override the model's, which are then not checked. This module imports no JAX.
"""

import dataclasses
import difflib
import math
import os
import pkgutil
import re
from collections.abc import Iterable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import yaml

from planner_jax.core.errors import ArgumentTypeError, PlannerJaxError
from planner_jax.core.missing_extra import MissingExtra
from planner_jax.host.files import open_plain
from planner_jax.host.yaml_files import Value, read_fields
from planner_jax.robot.quadrotor_model import (
    COUNTS,
    NET,
    RACKET,
    FlightLimits,
    QuadrotorModel,
    RotorDrag,
    Rotors,
    Tool,
    place_in_cross,
)

STANDARD_GRAVITY = "9.80665"  # [m/s^2], exact by definition

_INERTIAS = {
    f"{mass} {length}^2": Fraction(of_mass) * Fraction(of_length) ** 2
    for mass, of_mass in (("kg", "1"), ("g", "1e-3"))
    for length, of_length in (("m", "1"), ("cm", "1e-2"), ("mm", "1e-3"))
}
_DEGREE = Fraction(math.pi) / 180
# Kind of quantity -> unit -> factor to SI units. The first unit of each kind is the SI unit.
UNITS: dict[str, dict[str, Fraction]] = {
    name: {unit: Fraction(value) for unit, value in units.items()}
    for name, units in {
        "mass": {"kg": "1", "g": "1e-3"},
        "inertia": _INERTIAS,
        "length": {"m": "1", "cm": "1e-2", "mm": "1e-3"},
        "time": {"s": "1", "ms": "1e-3"},
        "speed": {"m/s": "1", "cm/s": "1e-2", "km/h": "5/18"},
        "acceleration": {"m/s^2": "1", "g": STANDARD_GRAVITY},
        "force": {"N": "1", "mN": "1e-3", "gf": f"{Fraction(STANDARD_GRAVITY) / 1000}"},
        "rate": {"rad/s": "1", "deg/s": _DEGREE},
        "angle": {"rad": "1", "deg": _DEGREE},
        "share": {"": "1", "%": "1e-2"},
        "drag": {"1/s": "1"},
    }.items()
}
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?"
_MORE = rf"(?:\s*,\s*|\s+){_NUMBER}(?!/)"  # the 1 of the unit 1/s is no number
_QUANTITY = re.compile(rf"\s*({_NUMBER}(?:{_MORE})*)\s*(\D.*?|1/s)?\s*", re.ASCII)
_LONGEST = 200  # greatest number of characters in the text of a quantity

ENDINGS = (".yaml", ".yml", ".xml")
_PARTS = {"rotors": Rotors, "tool": Tool, "limits": FlightLimits, "drag": RotorDrag}


class RobotError(PlannerJaxError, ValueError):
    """Error: a quadrotor's description is invalid. The message names file and field."""


class QuantityError(PlannerJaxError, ValueError):
    """Error: a value is not a quantity of the expected kind. The caller adds the field's name."""


class _Quantity(NamedTuple):
    """Format of a field's value: kind of quantity, and how many numbers it has."""

    kind: str  # a key of `UNITS`
    counts: tuple[int, ...] = (1,)
    span: bool = False  # whether the word "to" stands between its two numbers
    optional: bool = False  # whether the value may be null, which means no limit
    example: str = ""  # value for an error message if a unit is obligatory; "": units are optional


_LENGTH, _COORDINATES = _Quantity("length"), tuple(2 * count for count in COUNTS)
# Section of a robot's file -> field -> format of its value, or None for a text. The sections are
# "rotors", "tool", "limits" and, if given, "drag"; "" holds the fields outside of them.
_FIELDS: dict[str, dict[str, _Quantity | None]] = {
    "": {
        "name": None,
        "source": None,
        "mass": _Quantity("mass"),
        "inertia": _Quantity("inertia", (3, 6), example="3 3 5 g m^2"),
    },
    "rotors": {
        "diagonal": _LENGTH,
        "count": _Quantity("share"),
        "places": _Quantity("length", _COORDINATES),
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
        "thrust": _Quantity("acceleration", (2,), span=True, optional=True),
        "rotor_share": _Quantity("share", optional=True),
        "max_tilt": _Quantity("angle", optional=True),
        "recovery_tilt": _Quantity("angle"),
    },
    "drag": {"across": _Quantity("drag"), "along": _Quantity("drag")},
}


def read_robot(path: str | os.PathLike, **given: Value) -> QuadrotorModel:
    """Read a quadrotor from a file.

    Args:
        path: path of a YAML file (.yaml, .yml), or of a MuJoCo model (MJCF, .xml), which needs
            MuJoCo (extra `sims`). MJCF describes neither tool, limits nor drag.
        **given: fields that override the fields in the file: `name`, `mass`, `inertia`, `rotors`,
            `tool`, `limits`, `drag` and `source`. A value has the format of the YAML file, or is a
            number in SI units, or an object such as a `Tool`.

    Raises:
        RobotError: the file, or a field such as a negative mass, is invalid (message of one line).
        MissingExtra: the file is MJCF, and MuJoCo is not installed.
        OSError: the file cannot be read.
    """
    if not isinstance(path, str | os.PathLike):
        raise ArgumentTypeError("path", "the path of a file", path)
    place = os.fspath(path)
    description = _read_description(Path(place), given)
    _require_units({k: v for k, v in given.items() if isinstance(v, str)}, place)
    parts = tuple(_PARTS.values())
    plain = {k: dataclasses.asdict(v) if isinstance(v, parts) else v for k, v in given.items()}
    return model_of({"name": Path(place).stem, **_merge(description, plain)}, place)


def model_of(description: Mapping[str, Value], place: str = "robot") -> QuadrotorModel:
    """Make a quadrotor from a dictionary: the fields of a YAML file, or `dataclasses.asdict`.

    Raises:
        RobotError: a field is invalid; the message begins with `place`, such as a file's name.
    """
    _require_known(description, [*_FIELDS[""], *_PARTS], "", place)
    parts: dict[str, Value] = {}
    for part in [part for part in _PARTS if part != "drag" or description.get(part) is not None]:
        value = description.get(part)
        if value is None:
            raise RobotError(f"{place}: {part} must be given, got nothing")
        if not isinstance(value, Mapping):
            raise RobotError(f"{place}: {part} must be fields with values, got {value!r:.60}")
        parts[part] = _to_si(value, part, place)
    whole = _to_si({k: v for k, v in description.items() if k not in _PARTS}, "", place)
    rotors, kind = parts["rotors"], parts["tool"].get("kind", NET)
    if "diagonal" in rotors:
        if "places" in rotors:
            raise RobotError(f"{place}: rotors must have diagonal or places, not both")
        if (count := rotors.pop("count", 4)) not in COUNTS:
            raise RobotError(f"{place}: rotors.count must be 4, 6 or 8, got {count:g}")
        rotors["places"] = place_in_cross(rotors.pop("diagonal"), int(count))
    elif "count" in rotors:
        raise RobotError(f"{place}: rotors.count must be left out without a diagonal")
    if kind not in (NET, RACKET):
        hint = suggestion(kind, (NET, RACKET))
        raise RobotError(f"{place}: tool.kind must be {NET} or {RACKET}, got {kind!r}{hint}")
    try:
        for part, given in parts.items():
            _require_all(_PARTS[part], given, f"{part}.", place)
            parts[part] = _PARTS[part](**given)
        _require_all(QuadrotorModel, {**whole, **parts}, "", place)
        return QuadrotorModel(**whole, **parts)
    except RobotError:
        raise
    except ValueError as error:
        raise RobotError(f"{place}: {error}") from None


def to_yaml(model: QuadrotorModel) -> str:
    """Format a quadrotor as the text of a YAML file; `read_robot` restores it without rounding."""
    plain: dict[str, Value] = dataclasses.asdict(model)
    rotors = plain["rotors"]
    num, diagonal = len(rotors["places"]), round(2.0 * math.hypot(*rotors["places"][0]), 12)
    if place_in_cross(diagonal, num) == rotors["places"]:
        del rotors["places"]
        plain["rotors"] = {"diagonal": diagonal, **({} if num == 4 else {"count": num}), **rotors}
    shown = {name: _add_unit(plain[name], kind) for name, kind in _FIELDS[""].items()}
    if not model.source:
        del shown["source"]
    for part in [part for part in _PARTS if plain[part]]:
        fields = _FIELDS[part]
        shown[part] = {name: _add_unit(value, fields[name]) for name, value in plain[part].items()}
    return yaml.safe_dump(shown, sort_keys=False, allow_unicode=True, width=100)


def _add_unit(value: Value, quantity: _Quantity | None) -> Value:
    if quantity is None or value is None or quantity.kind == "share":
        return value
    if quantity.counts == _COORDINATES:
        return [_add_unit(pair, _Quantity(quantity.kind, (2,))) for pair in value]
    numbers = value if isinstance(value, list | tuple) else [value]
    text = (" to " if quantity.span else " ").join(repr(float(number)) for number in numbers)
    return f"{text} {next(iter(UNITS[quantity.kind]))}"


def _read_description(path: Path, over: Mapping[str, Value]) -> dict[str, Value]:
    """Return the fields in a YAML or MJCF file, as a dictionary; raise `RobotError` if invalid.

    The fields `over` will replace fields of the file. A model's values for them are not checked.
    """
    if path.suffix.lower() not in ENDINGS:
        raise RobotError(f"path must end in {', '.join(ENDINGS)}, got {str(path)!r}")
    if path.suffix.lower() == ".xml":
        open_plain(path).close()  # raises an error for a folder or a pipe
        try:  # the function needs MuJoCo, which may not be installed
            describe = pkgutil.resolve_name("planner_jax.sims.robots.quadrotor.mjcf:describe_mjcf")
        except MissingExtra as error:
            raise error.with_names({error.feature: path.name}) from None
        return describe(path, over)
    try:
        fields = read_fields(path)
    except ValueError as error:
        raise RobotError(f"{path}: {error}") from None
    _require_units(fields, str(path))
    model = fields.pop("model", None)
    if model is None:
        return fields
    if not isinstance(model, str) or not model.lower().endswith(".xml"):
        raise RobotError(f"{path}: model must name an MJCF file, .xml, got {model!r:.60}")
    return _merge(_read_description(path.parent / model, _merge(fields, over)), fields)


def _merge(under: Mapping[str, Value], over: Mapping[str, Value]) -> dict[str, Value]:
    """Merge two descriptions of a robot field by field; `over` overrides `under`."""
    merged = dict(under)
    for name, value in over.items():
        old = merged.get(name)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            opposite = {"diagonal": "places", "places": "diagonal"}
            replaced = {opposite.get(field) for field in value}
            value = {**{k: v for k, v in old.items() if k not in replaced}, **value}
        merged[name] = value
    return merged


def _require_units(description: Mapping[str, Value], place: str) -> None:
    """Raise `RobotError` if an inertia has no unit: kg m^2 and g m^2 are easily confused."""
    for name, quantity in _FIELDS[""].items():
        if quantity and quantity.example and not _has_unit(value := description.get(name)):
            units = ", ".join(UNITS[quantity.kind])
            rule = f"must have its unit, one of {units}, as in {quantity.example!r}"
            raise RobotError(f"{place}: {name} {rule}, got {value!r:.60}")


def _require_known(given: Mapping[str, Value], known: list[str], prefix: str, place: str) -> None:
    for name in given:
        if name not in known:
            hint = suggestion(str(name), known)
            rule = f"must be one of {', '.join(known)}"
            raise RobotError(f"{place}: {prefix}field {rule}, got {str(name)!r:.60}{hint}")


def _require_all(kind: type, given: Mapping[str, Value], prefix: str, place: str) -> None:
    for field in dataclasses.fields(kind):
        if field.default is dataclasses.MISSING and field.name not in given:
            name = "places or diagonal" if field.name == "places" else field.name
            raise RobotError(f"{place}: {prefix}{name} must be given, got nothing")


def _to_si(given: Mapping[str, Value], part: str, place: str) -> dict[str, Value]:
    """Check the fields of a robot's section `part`, such as "rotors"; convert them to SI units."""
    fields, prefix = _FIELDS[part], f"{part}." if part else ""
    _require_known(given, list(fields), f"{part} " if part else "", place)
    converted = dict(given)
    for name, value in given.items():
        quantity = fields[name]
        if quantity is None:
            if not isinstance(value, str) or not (value or name == "source"):
                raise RobotError(f"{place}: {prefix}{name} must be text, got {value!r:.60}")
        elif value is not None or not quantity.optional:
            try:
                converted[name] = _to_numbers(value, quantity)
            except QuantityError as error:
                raise RobotError(f"{place}: {prefix}{name} {error}") from None
    return converted


def _to_numbers(value: Value, quantity: _Quantity) -> Value:
    """Convert a field's value to SI units; coordinates become positions (x, y) of rotors."""
    is_pairs = quantity.counts == _COORDINATES
    if is_pairs and isinstance(value, list | tuple):
        pairs = (pair if isinstance(pair, list | tuple) else [pair] for pair in value)
        value = [each for pair in pairs for each in pair]
    numbers = parse_numbers(value, quantity.kind, *quantity.counts, span=quantity.span)
    if is_pairs:
        return tuple(zip(numbers[::2], numbers[1::2], strict=True))
    return numbers[0] if quantity.counts == (1,) else numbers


def parse_numbers(value: Value, kind: str, *counts: int, span: bool = False) -> tuple[float, ...]:
    """Parse the numbers of a value, such as "3 3 5 g m^2", and convert them to SI units.

    A value is a text, a number, or a list of them. `kind` is a key of `UNITS`, and `counts` are the
    allowed numbers of numbers. With `span` the word "to" may stand between two numbers.

    Raises:
        QuantityError: the value has another unit or count, or is not made of numbers.
    """
    parts = value if isinstance(value, list | tuple) else [value]
    numbers = tuple(number for part in parts for number in _parse(part, kind, span))
    if len(numbers) not in counts:
        what = "a number" if counts == (1,) else f"{' or '.join(map(str, counts))} numbers"
        what = "x and y of 4, 6 or 8 rotors" if counts == _COORDINATES else what
        raise QuantityError(f"must be {what} in {_list_units(kind)}, got {_shorten(value)}")
    return numbers


def _parse(part: Value, kind: str, span: bool) -> list[float]:
    """Convert one number, or the numbers in one text such as "3 3 5 g m^2", to SI units."""
    rule = f"must be in {_list_units(kind)}, got {_shorten(part)}"
    if isinstance(part, int | float) and not isinstance(part, bool):
        if not math.isfinite(part):
            raise QuantityError(f"must be finite, got {part}")
        return [float(part)]
    match = None
    if isinstance(part, str) and len(part) <= _LONGEST:
        match = _QUANTITY.fullmatch(part.replace(" to ", " ") if span else part)
    if match is None:
        raise QuantityError(rule)
    unit = " ".join((match[2] or "").replace("*", " ").split())
    known = UNITS[kind]
    if unit and unit not in known:
        raise QuantityError(f"{rule}{suggestion(unit, known)}")
    factor = known[unit] if unit else Fraction(1)
    try:  # Fractions avoid rounding of factors: 33 g become exactly the float 0.033 [kg].
        return [float(Fraction(number) * factor) for number in re.findall(_NUMBER, match[1])]
    except OverflowError:
        raise QuantityError(f"must be finite, got {_shorten(part)}") from None


def _has_unit(value: Value) -> bool:
    if isinstance(value, list | tuple):
        return all(map(_has_unit, value))
    if isinstance(value, str):
        match = _QUANTITY.fullmatch(value)
        return match is None or bool(match[2])
    return not isinstance(value, int | float)


def suggestion(given: str, known: Iterable[str] | Mapping[str, Value]) -> str:
    """Return "; did you mean NAME?" for the most similar known name, or "" if none is similar."""
    near = difflib.get_close_matches(given, [name for name in known if name], n=1, cutoff=0.5)
    return f"; did you mean {near[0]}?" if near else ""


def _list_units(kind: str) -> str:
    return ", ".join(unit or "no unit" for unit in UNITS[kind])


def _shorten(value: Value) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
