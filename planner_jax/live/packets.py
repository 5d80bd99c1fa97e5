"""The packets of a live loop: little-endian, packed, with a version; `docs/live.md` has the table.

A request is a header and a body, either an observation of a ball or a state of the robot. An answer
is a header, which repeats ball, number and time of the request, a description, and K setpoints.
"""

import dataclasses
import enum
import math
import struct

import numpy as np

MAGIC, VERSION = b"PJLV", 1
BALL, ROBOT, ANSWER = 1, 2, 129
MOST_SETPOINTS = 17  # fit an Ethernet frame
LONGEST = 2048  # [bytes], read from a packet
FARTHEST = 1e4  # greatest magnitude of a value, in SI units
OLDEST = 1.0  # [s], greatest age of a measurement

_HEADER = struct.Struct("<4sBBHId")  # magic, version, kind, ball, sequence, time sent
_MEASURED = struct.Struct("<d")  # time of the measurement
_VALUES = {BALL: struct.Struct("<3d"), ROBOT: struct.Struct("<9d")}
_SIZES = {kind: _HEADER.size + 8 + body.size for kind, body in _VALUES.items()}
_ANSWERED = struct.Struct("<BBBxddd")  # motion, fault, K, time of the first, period, contact
FIELDS = {"pos": 3, "vel": 3, "acc": 3, "jerk": 3, "quat_wxyz": 4, "body_rate": 3, "thrust": 1}
WIDTH = sum(FIELDS.values())


class Fault(enum.IntEnum):
    """The fault of a packet, which is then not used."""

    NONE = 0
    STRANGE = 1
    CUT = 2
    OTHER_VERSION = 3
    UNKNOWN_KIND = 4
    NOT_FINITE = 5
    ABSURD = 6
    DUPLICATE = 7
    OUT_OF_ORDER = 8
    OTHER_CLOCK = 9
    STALE = 10
    OUTLIER = 11

    @property
    def words(self) -> str:
        """Name of the fault in the report."""
        return self.name.lower().replace("_", " ")


# Faults without a readable header, so without an answer, and the predicate of the warning.
SILENT = {
    Fault.STRANGE: f"does not begin with {MAGIC.decode()}",
    Fault.CUT: "has another length than its kind",
    Fault.OTHER_VERSION: f"is of another version than {VERSION}",
    Fault.UNKNOWN_KIND: "is neither of a ball nor of a robot",
}


class Motion(enum.IntEnum):
    """The trajectory of the setpoints in an answer."""

    NONE = 0  # no setpoints, since no state of the robot has arrived
    SAFE = 1  # a recovery trajectory, or standstill
    PLAN = 2  # a plan, with its recovery trajectory


@dataclasses.dataclass(frozen=True, slots=True)
class Packet:
    """A readable request."""

    kind: int  # BALL or ROBOT
    ball: int  # number of the ball
    sequence: int
    sent: float  # [s], by the sender's clock
    measured: float  # [s], by the sender's clock
    values: tuple[float, ...]  # position (3); for a robot also velocity (3), acceleration (3)
    fault: Fault = Fault.NONE


@dataclasses.dataclass(frozen=True)
class Answer:
    """The answer to a request, with K setpoints."""

    sequence: int  # of the request
    sent: float  # [s], of the request
    motion: Motion
    fault: Fault  # of the request
    begin: float  # [s], sender's clock, time of the first setpoint
    period: float  # [s], between setpoints
    contact: float  # [s], sender's clock, time of the contact with the ball; NaN without a plan
    setpoints: np.ndarray  # (K, 20), the columns of `FIELDS`

    def column(self, name: str) -> np.ndarray:
        """Return a field of all setpoints, (K, N), such as "pos" or "quat_wxyz"."""
        names = list(FIELDS)
        before = sum(FIELDS[each] for each in names[: names.index(name)])
        return self.setpoints[:, before : before + FIELDS[name]]


def request(
    kind: int, sequence: int, sent: float, measured: float, values: tuple, ball: int = 0
) -> bytes:
    """Return the packet of an observed ball, or of a robot's state."""
    head = _HEADER.pack(MAGIC, VERSION, kind, ball, sequence, sent)
    return head + _MEASURED.pack(measured) + _VALUES[kind].pack(*values)


def read_request(data: bytes) -> Packet | Fault:
    """Return the content of a packet, or the fault of an unreadable one."""
    if data[:4] != MAGIC:
        return Fault.STRANGE
    if len(data) < _HEADER.size:
        return Fault.CUT
    _, version, kind, ball, sequence, sent = _HEADER.unpack_from(data)
    if version != VERSION:
        return Fault.OTHER_VERSION
    if kind not in _VALUES:
        return Fault.UNKNOWN_KIND
    if len(data) != _SIZES[kind]:
        return Fault.CUT
    (measured,) = _MEASURED.unpack_from(data, _HEADER.size)
    values = _VALUES[kind].unpack_from(data, _HEADER.size + _MEASURED.size)
    fault = Fault.NONE
    if not all(map(math.isfinite, (sent, measured, *values))):
        fault = Fault.NOT_FINITE
    elif max(map(abs, values)) > FARTHEST or not 0.0 <= sent - measured <= OLDEST:
        fault = Fault.ABSURD
    return Packet(kind, ball, sequence, sent, measured, values, fault)


def answer(
    packet: Packet,
    fault: Fault,
    motion: Motion,
    times: tuple[float, float, float],
    setpoints: np.ndarray,
) -> bytes:
    """Return the packet of an answer with setpoints (K, 20) float32.

    `times` are `begin`, `period` and `contact` of `Answer` [s].
    """
    head = _HEADER.pack(MAGIC, VERSION, ANSWER, packet.ball, packet.sequence, packet.sent)
    return head + _ANSWERED.pack(motion, fault, len(setpoints), *times) + setpoints.tobytes()


def read_answer(data: bytes) -> Answer | None:
    """Return the content of an answer, or None for any other packet."""
    first = _HEADER.size + _ANSWERED.size
    if len(data) < first or data[:4] != MAGIC:
        return None
    _, version, kind, _, sequence, sent = _HEADER.unpack_from(data)
    motion, fault, num, begin, period, contact = _ANSWERED.unpack_from(data, _HEADER.size)
    if (version, kind, len(data)) != (VERSION, ANSWER, first + 4 * WIDTH * num):
        return None
    setpoints = np.frombuffer(data, "<f4", offset=first).reshape(num, WIDTH)
    return Answer(sequence, sent, Motion(motion), Fault(fault), begin, period, contact, setpoints)
