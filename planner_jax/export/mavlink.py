"""Export of setpoints as MAVLink messages SET_POSITION_TARGET_LOCAL_NED, to a log or over UDP."""

import socket
import struct
import time
from collections.abc import Iterator
from typing import BinaryIO

from pymavlink.dialects.v20 import common

from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError
from planner_jax.export.px4 import trajectory_setpoints
from planner_jax.export.setpoints import DEFAULT_RATE
from planner_jax.robot.quadrotor import QuadrotorPlan

FASTEST = 1000.0  # [Hz], greatest rate, since the messages' time stamps are in milliseconds
_VEHICLE, _AUTOPILOT = 1, 1  # MAVLink's numbers of the receiving system and component
_SENDER = 255  # MAVLink's system number of a ground station
_NO_FIELD_IGNORED = 0  # type mask of a message in which every field is valid


def packets(plan: QuadrotorPlan, rate: float) -> Iterator[tuple[int, bytes]]:
    """Yield for each setpoint its time [us] since the plan's start, and its MAVLink 2 packet."""
    fields = trajectory_setpoints(plan, rate)
    require(rate <= FASTEST, "rate", f"at most {FASTEST:g} for MAVLink", rate)
    sender = common.MAVLink(None, srcSystem=_SENDER)
    target = (_VEHICLE, _AUTOPILOT, common.MAV_FRAME_LOCAL_NED, _NO_FIELD_IGNORED)
    columns = [values.tolist() for values in fields.values()]
    for stamp, position, velocity, acceleration, _, yaw, yawspeed in zip(*columns, strict=True):
        numbers = (*position, *velocity, *acceleration, yaw, yawspeed)
        time_ms = round(stamp / 1000)
        message = sender.set_position_target_local_ned_encode(time_ms, *target, *numbers)
        yield stamp, bytes(message.pack(sender))
        sender.seq = (sender.seq + 1) % 256


def write_tlog(plan: QuadrotorPlan, rate: float, file: BinaryIO) -> None:
    """Write a telemetry log of a plan at `rate` [Hz]: each packet follows its time [us]."""
    for stamp, packet in packets(plan, rate):
        file.write(struct.pack(">Q", stamp) + packet)


def stream(plan: QuadrotorPlan, port: int, rate: float = DEFAULT_RATE) -> int:
    """Send a plan's packets to a UDP port of this machine in real time; return their number."""
    is_port = isinstance(port, int) and not isinstance(port, bool) and 0 < port < 2**16
    require(is_port, "udp", f"a port from 1 to {2**16 - 1}", port)
    ready = list(packets(plan, rate))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.connect(("127.0.0.1", port))
        start = time.monotonic()
        for stamp, packet in ready:
            time.sleep(max(0.0, start + 1e-6 * stamp - time.monotonic()))
            try:
                out.send(packet)
            except ConnectionRefusedError:
                rule = "a port on which a program of this machine listens"
                raise ArgumentError("udp", rule, port) from None
    return len(ready)
