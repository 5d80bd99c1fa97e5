"""The formats in which plans leave, by name: endings of files, what writes them, and which robots.

Nothing here imports what a format needs.
"""

import dataclasses
import difflib
import pkgutil
from collections.abc import Callable, Mapping
from typing import Any

from planner_jax.core.errors import MissingExtra, UnknownName, format_value

EXTRA = "export"


@dataclasses.dataclass(frozen=True)
class Format:
    """A format."""

    summary: str  # a few words
    robots: tuple[str, ...]  # that it can carry
    # By the ending of the file, the default first: "module:function" of what takes a plan, a rate
    # [Hz] and a file open for bytes.
    writers: Mapping[str, str]
    sampled: bool = True  # whether there is a rate

    def writer(self, ending: str) -> Callable[[Any, Any, Any], None]:
        """What writes files of an ending.

        Raises:
            MissingExtra: a package that it needs is not installed.
        """
        return required(self.writers[ending], f"export to {ending}")


FORMATS = {
    "csv": Format(
        "a table of setpoints with units",
        ("quadrotor", "car", "arm"),
        {".csv": "planner_jax.export.csv_rows:write"},
    ),
    "ros2": Format(
        "a message of trajectory_msgs",
        ("quadrotor", "car", "arm"),
        {".mcap": "planner_jax.export.mcap_files:write_trajectory"},
    ),
    "px4": Format(
        "setpoints over MAVLink, or as messages TrajectorySetpoint",
        ("quadrotor",),
        {
            ".tlog": "planner_jax.export.mavlink:write_tlog",
            ".mcap": "planner_jax.export.mcap_files:write_setpoints",
            ".csv": "planner_jax.export.px4:write_csv",
        },
    ),
    "crazyflie": Format(
        "polynomials for the high-level commander",
        ("quadrotor",),
        {
            ".csv": "planner_jax.export.crazyflie:write_csv",
            ".bin": "planner_jax.export.crazyflie:write_bin",
        },
        sampled=False,
    ),
}


def format_named(name: str) -> Format:
    """The format of a name.

    Raises:
        UnknownName: there is none; one line with those there are, and the one that is most alike.
    """
    if name not in FORMATS:
        alike = difflib.get_close_matches(str(name).lower(), FORMATS, n=1)
        hint = f"; did you mean {alike[0]!r}?" if alike else ""
        shown = f"{format_value(name)}{hint}"
        raise UnknownName("to", f"one of {', '.join(FORMATS)}", shown=shown)
    return FORMATS[name]


def required(place: str, purpose: str) -> Any:
    """What stands at "module:name", where its module needs packages of the extra `export`.

    Raises:
        MissingExtra: one of them is not installed.
    """
    try:
        return pkgutil.resolve_name(place)
    except ModuleNotFoundError as error:
        raise MissingExtra(purpose, error.name, EXTRA) from None
