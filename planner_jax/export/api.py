"""Export of one plan to a controller: `export` writes a file, `stream` sends it to a UDP port."""

import dataclasses
import difflib
import os
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from planner_jax.core.checks import require_path_name
from planner_jax.core.choices import RECOVERIES, require, require_one_of
from planner_jax.core.errors import ArgumentError, NoRecovery, UnknownName, format_value
from planner_jax.core.missing_extra import MissingExtra
from planner_jax.core.protocol import Plan
from planner_jax.core.rules import Case
from planner_jax.export.setpoints import DEFAULT_RATE, joints_of, require_one, robot_of
from planner_jax.host.files import new_file_problem, replacing
from planner_jax.recovery.after_plan import append_recovery, is_rested
from planner_jax.robot.arm import ArmPlan
from planner_jax.robot.quadrotor import QuadrotorPlan

Writer = Callable[..., None]  # arguments: plan, rate [Hz] or None, binary file; of arms: joints
_ALL = ("quadrotor", "car", "arm")


@dataclasses.dataclass(frozen=True)
class Format:
    """A file format in which plans can be exported, and the functions that write it."""

    summary: str  # short description for the command's help
    robots: tuple[str, ...]  # kinds of robots that are supported: quadrotor, car, arm
    # For each file extension, the function "module:name" that writes it; the first is the default.
    writers: Mapping[str, str]
    is_sampled: bool = True  # True for setpoints at equal time steps, False for polynomials


FORMATS = {
    "csv": Format("a table of setpoints with units", _ALL, {".csv": "csv_rows:write"}),
    "ros2": Format("a message of trajectory_msgs", _ALL, {".mcap": "mcap_files:write_trajectory"}),
    "urscript": Format(
        "a program for arms of Universal Robots", ("arm",), {".script": "urscript:write"}
    ),
    "px4": Format(
        "setpoints over MAVLink, or as messages TrajectorySetpoint",
        ("quadrotor",),
        {
            ".tlog": "mavlink:write_tlog",
            ".mcap": "mcap_files:write_setpoints",
            ".csv": "px4:write_csv",
        },
    ),
    "crazyflie": Format(
        "polynomials for the high-level commander",
        ("quadrotor",),
        {".csv": "crazyflie:write_csv", ".bin": "crazyflie:write_bin"},
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
    joint_names: Sequence[str] | None = None,
) -> Path:
    """Write one plan for a controller into a new file; after an error there is no partial file.

    | `to` | file | content | frame |
    |---|---|---|---|
    | `csv` | `.csv` | setpoints, header with units | ENU, FLU |
    | `ros2` | `.mcap` | a message of `trajectory_msgs` (extra `export`) | ENU, FLU |
    | `urscript` | `.script` | a program with `movej` and `servoj` | angles of 6 joints |
    | `px4` | `.tlog` | MAVLink SET_POSITION_TARGET_LOCAL_NED (extra `export`) | NED, FRD |
    | `px4` | `.mcap`, `.csv` | messages or rows of TrajectorySetpoint (extra `export`) | NED, FRD |
    | `crazyflie` | `.csv`, `.bin` | polynomials of degree 7, a row or 132 bytes a piece | ENU |

    ENU and NED are world frames (x east, y north, z up; x north, y east, z down), FLU and FRD body
    frames (forward, left, up; forward, right, down). `csv` and `ros2` support quadrotors, cars and
    arms, `urscript` arms, and the other formats quadrotors only. All units are SI.

    Args:
        plan: one solved plan. `pj.take(plans, k)` selects one from a batch.
        to: name of the format.
        out: path of the new file, whose extension selects the variant of the format.
        rate: setpoints per second [Hz], 100 by default; not allowed for `crazyflie`.
        recovery: which trajectory to standstill is appended to a plan that does not end at
            standstill. "brake" stops at any position, "home" at the robot's first position. None
            exports the plan up to its last contact.
        case: case of the plan, whose limits the recovery trajectory keeps. The files of arms
            contain the names and limits of its arm's joints.
        joint_names: names of an arm's joints in the file, by default the names of the case's arm,
            or joint_1, joint_2, ... without a case.

    Returns:
        The path of the file.

    Raises:
        UnknownName: no format has the name `to`.
        ArgumentError: an argument is invalid; the message states which values are valid.
        MissingExtra: a package that the format needs is not installed.
        OSError: the file cannot be written; the exception's `filename` is the path.
    """
    form = _require_format(to, plan)
    require_path_name("out", out)
    path = Path(out)
    if path.suffix not in form.writers:
        rule = f"{' or '.join(form.writers)} for {to}"
        raise ArgumentError("out", rule, str(out), verb="end in")
    if problem := new_file_problem(path):
        raise ArgumentError("out", problem, str(path))
    write: Writer = _resolve(form.writers[path.suffix], f"export to {path.suffix}")
    if form.is_sampled:
        rate = DEFAULT_RATE if rate is None else rate
    elif rate is not None:
        raise ArgumentError("rate", f"given for {to}, which has polynomials", rate, verb="not be")
    is_arm = isinstance(plan, ArmPlan)
    require(joint_names is None or is_arm, "joint_names", "left out but for arms", joint_names)
    of_arm = {"joints": joints_of(plan, joint_names, case)} if is_arm else {}
    plan = bring_to_rest(plan, recovery, case)
    with replacing(path) as scratch, open(scratch, "wb") as file:
        write(plan, rate, file, **of_arm)
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

    Only the format "px4" can be sent. `udp` is the number of the port, and `rate` the number of
    messages per second [Hz], 100 by default. `recovery` and `case` append a trajectory to
    standstill, as in `export`.

    Raises:
        ArgumentError: an argument is invalid, or no program listens on the port.
    """
    if _require_name(to) != "px4":
        raise ArgumentError("udp", f"given for {to}, only for px4", udp, verb="not be")
    _require_format(to, plan)
    send = _resolve("mavlink:stream", "export over UDP")
    return send(bring_to_rest(plan, recovery, case), udp, DEFAULT_RATE if rate is None else rate)


def default_name(source: str | os.PathLike, row: int | None, to: str) -> str:
    """Return the default name, SOURCE-ROW-FORMAT, of an exported file; no ROW if `row` is None."""
    extension = next(iter(FORMATS[_require_name(to)].writers))
    index = "" if row is None else f"-{row}"
    return f"{Path(os.path.abspath(source)).stem}{index}-{to}{extension}"


def bring_to_rest(plan: Plan, recovery: str | None, case: Case | None = None) -> Plan:
    """Return one plan with a recovery trajectory, so that the robot ends at standstill.

    Args:
        plan: solved plan of a robot. If it ends at standstill, it is returned unchanged.
        recovery: "brake" stops at any position, "home" at the robot's first position. None removes
            the recovery trajectory.
        case: case of the plan; needed unless the plan ends at standstill.

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
    can_stop = robot.name == "quadrotor" or recovery == "brake"
    require(can_stop, "recovery", "brake, as only quadrotors go home", recovery)
    if case is None:
        rule = "given, whose limits the recovery trajectory keeps, or recovery=None to omit it"
        raise ArgumentError("case", rule, shown="neither")
    is_robots = isinstance(case, Case) and robot.case_field in vars(case)
    require(is_robots, "case", f"the case of a {robot.name}", shown=type(case).__name__)
    require_one("case", "cases", case.batch_shape)
    try:
        return append_recovery(case, plan, recovery)
    except NoRecovery as error:
        rule = "none for a plan after which no recovery trajectory keeps every limit"
        raise ArgumentError("recovery", rule, shown=f"{recovery!r} ({error})") from None


def lacks_recovery(plan: Plan) -> bool:
    """Test whether a plan does not end at standstill; raise if the plan cannot be exported."""
    robot_of(plan)
    return not is_rested(plan)


def _require_name(to: str) -> str:
    if not isinstance(to, str) or to not in FORMATS:
        alike = difflib.get_close_matches(str(to).lower(), FORMATS, n=1)
        hint = f"; did you mean {alike[0]!r}?" if alike else ""
        raise UnknownName("to", f"one of {', '.join(FORMATS)}", shown=f"{format_value(to)}{hint}")
    return to


def _require_format(to: str, plan: Plan) -> Format:
    form, robot = FORMATS[_require_name(to)], robot_of(plan)
    shown = f"{to!r}, which is for {', '.join(form.robots)}"
    fits, rule = robot.name in form.robots, f"a format for plans of the {robot.name}"
    require(fits, "to", rule, shown=shown)
    return form


def _resolve(writer: str, purpose: str) -> Callable:
    try:
        return pkgutil.resolve_name(f"planner_jax.export.{writer}")
    except ModuleNotFoundError as error:
        raise MissingExtra(purpose, error.name, "export") from None
