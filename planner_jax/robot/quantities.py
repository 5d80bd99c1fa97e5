"""Physical quantities as people write them, "800 g" or "0.2 to 1.9 g", in SI units."""

import difflib
import math
import re
from collections.abc import Iterable, Mapping
from fractions import Fraction
from typing import Any

from planner_jax.core.errors import PlannerJaxError

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


class QuantityError(PlannerJaxError, ValueError):
    """A value is not the quantity that is asked for; what it has to be, in one line."""


def numbers_in(value: Any, kind: str, count: int, *, span: bool = False) -> tuple[float, ...]:
    """Numbers in SI units.

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


def has_unit(value: Any) -> bool:
    """Whether every number of a value as `numbers_in` takes it has a unit, known or not."""
    if isinstance(value, list | tuple):
        return all(map(has_unit, value))
    if isinstance(value, str):
        written = _WRITTEN.fullmatch(value)
        return written is None or bool(written[2])
    return not isinstance(value, int | float)


def _numbers(part: Any, kind: str, span: bool) -> list[float]:
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


def suggestion(given: str, known: Iterable[str] | Mapping[str, Any]) -> str:
    """What was perhaps meant, as the end of a message; empty where nothing is near."""
    near = difflib.get_close_matches(given, [name for name in known if name], n=1, cutoff=0.5)
    return f"; did you mean {near[0]}?" if near else ""


def _units(kind: str) -> str:
    return ", ".join(unit or "no unit" for unit in UNITS[kind])


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
