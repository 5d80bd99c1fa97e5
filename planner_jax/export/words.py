"""The calls by which a plan leaves: into a file, or to a port of this machine."""

import os
from pathlib import Path
from typing import Any

from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import Plan
from planner_jax.export.formats import Format, format_named, required
from planner_jax.export.rested import rested
from planner_jax.export.setpoints import DEFAULT_RATE, robot_of
from planner_jax.host.files import new_file_problem, replacing


def export(
    plan: Plan,
    *,
    to: str,
    out: str | os.PathLike,
    rate: float | None = None,
    ending: str | None = "brake",
    case: Any = None,
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
        plan: one that is solved; of a batch `pj.lane(plans, k)`.
        to: the format.
        out: the file, whose ending says which kind of the format it is. It must not exist.
        rate: setpoints a second [Hz], 100 unless given; none for `crazyflie`.
        ending: how the plan comes to rest behind its last contact, unless it does so already:
            "brake" where that is cheapest, "home" where the case begins; None leaves that out.
        case: of the plan, whose limits such a way to rest keeps.

    Returns:
        The path of the file.

    Raises:
        UnknownName: there is no such format.
        ArgumentError: an argument breaks a rule; one line.
        MissingExtra: a package that the format needs is not installed.
        OSError: the file system fails; its `filename` is the path.
    """
    form = format_named(to)
    _require_robot(plan, to, form)
    path = _new_file(out, to, form)
    write = form.writer(path.suffix)
    if form.sampled:
        rate = DEFAULT_RATE if rate is None else rate
    elif rate is not None:
        raise ArgumentError("rate", f"given for {to}, which takes polynomials", rate, verb="not be")
    plan = rested(plan, ending, case)
    with replacing(path) as scratch, open(scratch, "wb") as file:
        write(plan, rate, file)
    return path


def stream(
    plan: Plan,
    *,
    to: str,
    udp: int,
    rate: float | None = None,
    ending: str | None = "brake",
    case: Any = None,
) -> int:
    """Send one plan to a UDP port of this machine, in real time; returns the number of messages.

    Args:
        plan: one of a quadrotor that is solved.
        to: "px4", the one format for this.
        udp: the port.
        rate: messages a second [Hz], 100 unless given.
        ending: as of `export`.
        case: likewise.

    Raises:
        UnknownName: there is no such format.
        ArgumentError: an argument breaks a rule, or nobody listens on the port; one line.
        MissingExtra: pymavlink is not installed.
    """
    form = format_named(to)
    if to != "px4":
        raise ArgumentError("udp", f"given for {to}, only for px4", udp, verb="not be")
    _require_robot(plan, to, form)
    send = required("planner_jax.export.mavlink:stream", "export over UDP")
    return send(rested(plan, ending, case), udp, DEFAULT_RATE if rate is None else rate)


def default_name(source: str | os.PathLike, row: int | None, to: str) -> str:
    """The name of a file for a plan of a run or a saved file, in the current folder."""
    stem = Path(os.path.abspath(source)).stem
    place = "" if row is None else f"-{row}"
    return f"{stem}{place}-{to}{next(iter(format_named(to).writers))}"


def _require_robot(plan: Plan, to: str, form: Format) -> None:
    robot = robot_of(plan)
    if robot.name not in form.robots:
        article = "an" if robot.name[0] in "aeiou" else "a"
        rule = f"a format for plans of {article} {robot.name}"
        raise ArgumentError("to", rule, shown=f"{to!r}, which is for {', '.join(form.robots)}")


def _new_file(out: str | os.PathLike, to: str, form: Format) -> Path:
    """The path, if it is that of a new file with an ending of the format."""
    path = Path(out)
    if path.suffix not in form.writers:
        endings = " or ".join(form.writers)
        raise ArgumentError("out", f"{endings} for {to}", str(out), verb="end in")
    if problem := new_file_problem(path):
        raise ArgumentError("out", problem, str(path))
    return path
