"""Export of one plan: the table of formats, `export` into a file, and `stream` to a port.

Modules that write a format are imported where the format is requested.
"""

import dataclasses
import difflib
import os
import pkgutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import BinaryIO

from planner_jax.core.choices import RECOVERIES, require_one_of
from planner_jax.core.errors import (
    ArgumentError,
    MissingExtra,
    NoRecovery,
    UnknownName,
    format_value,
)
from planner_jax.core.protocol import Plan
from planner_jax.core.rules import Case
from planner_jax.export.setpoints import DEFAULT_RATE, robot_of
from planner_jax.host.files import new_file_problem, replacing
from planner_jax.recovery.after_plan import append_recovery, is_rested
from planner_jax.robot.quadrotor import QuadrotorPlan

Writer = Callable[[Plan, float | None, BinaryIO], None]
_ALL = ("quadrotor", "car", "arm")


@dataclasses.dataclass(frozen=True)
class Format:
    """A format of plans."""

    summary: str  # a few words
    robots: tuple[str, ...]
    writers: Mapping[str, str]  # paths "module:name" by file extension, the default first
    is_sampled: bool = True  # whether it takes a rate


FORMATS = {
    "csv": Format(
        "a table of setpoints with units", _ALL, {".csv": "planner_jax.export.csv_rows:write"}
    ),
    "ros2": Format(
        "a message of trajectory_msgs",
        _ALL,
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
        is_sampled=False,
    ),
}


def export(
    plan: Plan,
    *,
    to: str,
    out: str | os.PathLike,
    rate: float | None = None,
    recovery: str | None = "brake",
    case: Case | None = None,
) -> Path:
    """Write one plan for a controller, into a new file that appears whole or not at all.

    | `to` | file | what it holds | frame |
    |---|---|---|---|
    | `csv` | `.csv` | setpoints, header with units | as `plan.sample`: ENU, FLU |
    | `ros2` | `.mcap` | a message of `trajectory_msgs` (extra `export`) | ENU, FLU |
    | `px4` | `.tlog` | MAVLink SET_POSITION_TARGET_LOCAL_NED (extra `export`) | NED, FRD |
    | `px4` | `.mcap`, `.csv` | messages or rows of TrajectorySetpoint (extra `export`) | NED, FRD |
    | `crazyflie` | `.csv`, `.bin` | polynomials of degree 7, a row or 132 bytes a piece | as ours |

    `csv` and `ros2` take quadrotors, cars and arms, the others quadrotors. All units are SI.

    Args:
        plan: one that is solved; of a batch `pj.take(plans, k)`.
        to: the format.
        out: the file, whose extension selects the kind of the format. It must not exist.
        rate: setpoints a second [Hz], 100 by default; none for `crazyflie`.
        recovery: how the plan comes to rest behind its last contact, unless it does so already:
            "brake" where that is cheapest, "home" where the case begins; None leaves that out.
        case: of the plan, whose limits the recovery trajectory keeps.

    Returns:
        The path of the file.

    Raises:
        UnknownName: there is no such format.
        ArgumentError: an argument breaks a rule; one line.
        MissingExtra: a package that the format needs is not installed.
        OSError: the file system fails; its `filename` is the path.
    """
    form = _require_format(to, plan)
    path = Path(out)
    if path.suffix not in form.writers:
        rule = f"{' or '.join(form.writers)} for {to}"
        raise ArgumentError("out", rule, str(out), verb="end in")
    if problem := new_file_problem(path):
        raise ArgumentError("out", problem, str(path))
    write: Writer = _require(form.writers[path.suffix], f"export to {path.suffix}")
    if form.is_sampled:
        rate = DEFAULT_RATE if rate is None else rate
    elif rate is not None:
        raise ArgumentError("rate", f"given for {to}, which takes polynomials", rate, verb="not be")
    plan = bring_to_rest(plan, recovery, case)
    with replacing(path) as scratch, open(scratch, "wb") as file:
        write(plan, rate, file)
    return path


def stream(
    plan: Plan,
    *,
    to: str,
    udp: int,
    rate: float | None = None,
    recovery: str | None = "brake",
    case: Case | None = None,
) -> int:
    """Send one plan to a UDP port of this machine, in real time; return the number of messages.

    Args:
        plan: one of a quadrotor that is solved.
        to: "px4", the only format for this.
        udp: the port.
        rate: messages a second [Hz], 100 by default.
        recovery: as for `export`.
        case: as for `export`.

    Raises:
        UnknownName: there is no such format.
        ArgumentError: an argument breaks a rule, or nobody listens on the port; one line.
        MissingExtra: pymavlink is not installed.
    """
    if _require_name(to) != "px4":
        raise ArgumentError("udp", f"given for {to}, only for px4", udp, verb="not be")
    _require_format(to, plan)
    send = _require("planner_jax.export.mavlink:stream", "export over UDP")
    return send(bring_to_rest(plan, recovery, case), udp, DEFAULT_RATE if rate is None else rate)


def default_name(source: str | os.PathLike, row: int | None, to: str) -> str:
    """Return the name of a file for a plan of a run or a saved file, in the current folder."""
    extension = next(iter(FORMATS[_require_name(to)].writers))
    index = "" if row is None else f"-{row}"
    return f"{Path(os.path.abspath(source)).stem}{index}-{to}{extension}"


def bring_to_rest(plan: Plan, recovery: str | None, case: Case | None = None) -> Plan:
    """Return one plan with the recovery trajectory with which it is exported.

    Args:
        plan: of a robot of `ROBOTS`, solved.
        recovery: "brake" or "home"; a plan that comes to rest already stays as it is. None: the
            plan up to its last contact, whatever it has behind it.
        case: of the plan, which a plan that does not come to rest needs.

    Raises:
        ArgumentError: the plan cannot be exported, `recovery` is unknown, the case is missing or
            of another robot, or no recovery trajectory keeps every limit.
    """
    robot = robot_of(plan)
    if recovery is None:
        return dataclasses.replace(plan, recovery=None) if isinstance(plan, QuadrotorPlan) else plan
    require_one_of(RECOVERIES, "recovery", recovery)
    if is_rested(plan):
        return plan
    if robot.name != "quadrotor" and recovery != "brake":
        raise ArgumentError("recovery", "brake, as only quadrotors go home", recovery)
    if case is None:
        rule = "given, whose limits the way to rest behind the plan keeps"
        rule += ", or recovery=None to leave that out"
        raise ArgumentError("case", rule, shown="neither")
    if robot.case_field not in vars(case):
        raise ArgumentError("case", "that of the plan", shown=type(case).__name__)
    if case.batch_shape != ():
        shown = f"a batch of shape {case.batch_shape}"
        raise ArgumentError("case", "one, as pj.take(cases, k) gives", shown=shown)
    try:
        return append_recovery(case, plan, recovery)
    except NoRecovery as error:
        rule = "none for a plan behind which no way to rest keeps every limit"
        raise ArgumentError("recovery", rule, shown=f"{recovery!r} ({error})") from None


def lacks_recovery(plan: Plan) -> bool:
    """Return whether one plan does not come to rest; raise `ArgumentError` as `robot_of`."""
    robot_of(plan)
    return not is_rested(plan)


def _require_name(to: str) -> str:
    """Return the name of a format, or raise `UnknownName` with the most similar name."""
    if to not in FORMATS:
        alike = difflib.get_close_matches(str(to).lower(), FORMATS, n=1)
        hint = f"; did you mean {alike[0]!r}?" if alike else ""
        raise UnknownName("to", f"one of {', '.join(FORMATS)}", shown=f"{format_value(to)}{hint}")
    return to


def _require_format(to: str, plan: Plan) -> Format:
    """Return a format, or raise unless it takes plans of this robot."""
    form, robot = FORMATS[_require_name(to)], robot_of(plan)
    if robot.name not in form.robots:
        article = "an" if robot.name[0] in "aeiou" else "a"
        rule = f"a format for plans of {article} {robot.name}"
        raise ArgumentError("to", rule, shown=f"{to!r}, which is for {', '.join(form.robots)}")
    return form


def _require(path: str, purpose: str) -> Callable:
    """Resolve "module:name", or raise `MissingExtra` if its module needs a missing package."""
    try:
        return pkgutil.resolve_name(path)
    except ModuleNotFoundError as error:
        raise MissingExtra(purpose, error.name, "export") from None
