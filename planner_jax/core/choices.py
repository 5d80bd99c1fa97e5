"""Named choices and ranges that planners, settings and exports share; no import of JAX."""

from collections.abc import Iterable
from numbers import Integral

from planner_jax.core.errors import ArgumentError, ArgumentTypeError

EFFORTS = ("feasible", "good", "best")  # how long a planner searches; the first is the default
RECOVERIES = ("brake", "home")  # come to standstill anywhere, or at the case's initial position
NONE = "none"  # setting for plans that end at their last contact, without a recovery
CHOICES = (NONE, *RECOVERIES)
STARTS = ("hover", "random")  # states of a quadrotor at time 0 that a suite may draw
SCALES = (1e-3, 1e3)  # least and greatest plausible factor on the limits of a case


def require(
    holds: bool, name: str, rule: str, value: object = None, *, shown: str | None = None
) -> None:
    """Raise "NAME must be RULE, got VALUE" unless `holds` is true; `shown` replaces the value."""
    if not holds:
        raise ArgumentError(name, rule, value, shown=shown)


def require_one_of(names: Iterable[str], name: str, value: object) -> None:
    """Raise `ArgumentError` unless a value is one of the allowed names."""
    names = tuple(names)
    require(isinstance(value, str) and value in names, name, f"one of {', '.join(names)}", value)


def require_size(name: str, value: object, least: int = 1) -> None:
    """Raise unless an argument is a whole number >= `least` that fits in 64 bits."""
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise ArgumentTypeError(name, "a whole number", value)
    require(int(value) >= least, name, f">= {least}", value)
    require(int(value) < 2**63, name, "< 2**63", value)


def require_seed(value: object) -> None:
    """Raise unless the argument `seed` is a whole number >= 0, as random generators need."""
    require_size("seed", value, 0)


def require_scale(value: float) -> None:
    """Raise `ArgumentError` unless `limit_scale`, the factor on all limits, is from 1e-3 to 1e3."""
    least, most = SCALES
    require(least <= value <= most, "limit_scale", f"from {least:g} to {most:g}", value)
