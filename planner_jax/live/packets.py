"""The packets of a live loop: little-endian, packed, with a version; `docs/live.md` has the table.

A request is a header and, by its kind, the body of a ball that was seen or of a robot's state. An
answer is a header, which repeats that of the request, what the answer is, and K setpoints.
"""

import dataclasses
import enum
import math
import struct

import numpy as np

MAGIC, VERSION = b"PJLV", 1
BALL, ROBOT, ANSWER = 1, 2, 129
MOST_SETPOINTS = 17  # that an Ethernet frame takes
LONGEST = 2048  # bytes that are read of a packet
FARTHEST = 1e4  # greatest size of any coordinate, in SI units
OLDEST = 1.0  # [s], greatest age of what was measured

_HEADER = struct.Struct("<4sBBHId")  # magic, version, kind, ball, sequence, time sent
_MEASURED = struct.Struct("<d")  # when
_VALUES = {BALL: struct.Struct("<3d"), ROBOT: struct.Struct("<9d")}
_SIZES = {kind: _HEADER.size + 8 + body.size for kind, body in _VALUES.items()}
_ANSWERED = struct.Struct("<BBBxddd")  # motion, fault, K, time of the first, period, contact
FIELDS = {"pos": 3, "vel": 3, "acc": 3, "jerk": 3, "quat_wxyz": 4, "body_rate": 3, "thrust": 1}
WIDTH = sum(FIELDS.values())


class Fault(enum.IntEnum):
    """What is wrong with a packet; what has one is not used."""

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
        """As the report names it."""
        return self.name.lower().replace("_", " ")


# Those without a header that could be answered, and what a packet does that has one.
SILENT = {
    Fault.STRANGE: f"does not begin with {MAGIC.decode()}",
    Fault.CUT: "has another length than its kind",
    Fault.OTHER_VERSION: f"is of another version than {VERSION}",
    Fault.UNKNOWN_KIND: "is neither of a ball nor of a robot",
}


class Motion(enum.IntEnum):
    """What the setpoints of an answer belong to."""

    NONE = 0  # there are none, as no state of the robot has come yet
    SAFE = 1  # to rest, or at rest
    PLAN = 2  # a plan, with the way to rest behind its end


@dataclasses.dataclass(frozen=True, slots=True)
class Packet:
    """A request that could be read."""

    kind: int  # BALL or ROBOT
    ball: int  # number of the ball; another number is another ball
    sequence: int
    sent: float  # [s], by the sender's clock
    measured: float  # [s], by the sender's clock
    values: tuple[float, ...]  # position (3), of a robot velocity (3) and acceleration (3), too
    fault: Fault = Fault.NONE


@dataclasses.dataclass(frozen=True)
class Answer:
    """What comes back for a request; the K setpoints are `period` apart."""

    sequence: int  # of the request
    sent: float  # [s], of the request
    motion: Motion
    fault: Fault  # of the request
    begin: float  # [s], sender's clock, of the first setpoint
    period: float  # [s]
    contact: float  # [s], sender's clock, when the plan meets the ball; NaN without a plan
    setpoints: np.ndarray  # (K, 20), the columns of `FIELDS`

    def column(self, name: str) -> np.ndarray:
        """A field of all setpoints, (K, N), such as "pos" or "quat_wxyz"."""
        names = list(FIELDS)
        before = sum(FIELDS[each] for each in names[: names.index(name)])
        return self.setpoints[:, before : before + FIELDS[name]]


def request(
    kind: int, sequence: int, sent: float, measured: float, values: tuple, ball: int = 0
) -> bytes:
    """The packet of a ball that was seen, or of a robot's state."""
    head = _HEADER.pack(MAGIC, VERSION, kind, ball, sequence, sent)
    return head + _MEASURED.pack(measured) + _VALUES[kind].pack(*values)


def read_request(data: bytes) -> Packet | Fault:
    """What a packet holds, maybe with a fault, or the fault by which it could not be read."""
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

    `times` [s] are of the first setpoint, from one to the next, and of the contact.
    """
    head = _HEADER.pack(MAGIC, VERSION, ANSWER, packet.ball, packet.sequence, packet.sent)
    return head + _ANSWERED.pack(motion, fault, len(setpoints), *times) + setpoints.tobytes()


def read_answer(data: bytes) -> Answer | None:
    """What an answer holds; None of anything else."""
    first = _HEADER.size + _ANSWERED.size
    if len(data) < first or data[:4] != MAGIC:
        return None
    _, version, kind, _, sequence, sent = _HEADER.unpack_from(data)
    motion, fault, num, begin, period, contact = _ANSWERED.unpack_from(data, _HEADER.size)
    if (version, kind, len(data)) != (VERSION, ANSWER, first + 4 * WIDTH * num):
        return None
    setpoints = np.frombuffer(data, "<f4", offset=first).reshape(num, WIDTH)
    return Answer(sequence, sent, Motion(motion), Fault(fault), begin, period, contact, setpoints)
