"""Packet format of live planning (`planner-jax serve`): little-endian, packed, with a version.

A request has a header, and an observation of a ball or a state of the robot. An answer has the
header of its request, a description and the setpoints. `docs/live.md` lists all fields.
"""

import dataclasses
import enum
import math
import struct

import numpy as np

MAGIC, VERSION = b"PJLV", 1  # first bytes of every packet, and version of the format
BALL, ROBOT, ANSWER = 1, 2, 129  # kinds of packets
MOST_SETPOINTS = 17  # greatest number of setpoints that fit an Ethernet frame
LONGEST = 2048  # [bytes], greatest length of a packet; longer packets are cut
FARTHEST = 1e4  # greatest accepted magnitude of a measured value, in SI units
OLDEST = 1.0  # [s], greatest accepted age of a measurement when it is sent

_HEADER = struct.Struct("<4sBBHId")  # magic, version, kind, ball, sequence, time sent
_MEASURED = struct.Struct("<d")  # time of the measurement
_VALUES = {BALL: struct.Struct("<3d"), ROBOT: struct.Struct("<9d")}
_SIZES = {kind: _HEADER.size + 8 + body.size for kind, body in _VALUES.items()}
# Description in an answer: kind of motion, fault of the request, number of setpoints, reason why
# there is no plan, time of the first setpoint, period between setpoints, time of the contact with
# the ball.
_ANSWERED = struct.Struct("<BBBBddd")
FIELDS = {"pos": 3, "vel": 3, "acc": 3, "jerk": 3, "quat_wxyz": 4, "body_rate": 3, "thrust": 1}
WIDTH = sum(FIELDS.values())


class Fault(enum.IntEnum):
    """Reason why a packet is not used; `NONE` for a packet that is used."""

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
    OTHER_SENDER = 12
    CROWDED = 13
    TOO_FAST = 14

    @property
    def words(self) -> str:
        """Name of the fault as the report prints it, in lower case with spaces."""
        return self.name.lower().replace("_", " ")


# Faults of packets that are no requests, and get no answer.
SILENT = (Fault.STRANGE, Fault.CUT, Fault.OTHER_VERSION, Fault.UNKNOWN_KIND)
# Faults of packets from correct senders, whose answers have setpoints.
USUAL = (Fault.STALE, Fault.OUTLIER)
# Faults that the server prints; the texts complete "a packet from ADDRESS ...".
PRINTED = {
    Fault.STRANGE: f"does not begin with {MAGIC.decode()}",
    Fault.CUT: "has another length than its kind",
    Fault.OTHER_VERSION: f"is of another version than {VERSION}",
    Fault.UNKNOWN_KIND: "is neither of a ball nor of a robot",
    Fault.NOT_FINITE: "has a number that is NaN or infinite",
    Fault.ABSURD: "has an absurd position, velocity, acceleration or time",
    Fault.OTHER_CLOCK: "has another clock than the packets before",
    Fault.OTHER_SENDER: "is of a ball or robot that belongs to another address",
    Fault.CROWDED: "is of too many balls, or there are too many other senders",
    Fault.TOO_FAST: "follows the packets before too fast",
}


class Motion(enum.IntEnum):
    """Kind of trajectory from which the setpoints in an answer are sampled."""

    NONE = 0  # no setpoints: no state of the robot has arrived, or the request is refused
    SAFE = 1  # a trajectory to standstill, or standstill
    PLAN = 2  # a plan that meets the ball, followed by a trajectory to standstill


class Reason(enum.IntEnum):
    """Reason why an answer has no plan; `NONE` for an answer with a plan."""

    NONE = 0
    NO_BALL = 1  # no ball has been observed
    UNCERTAIN = 2  # the ball's velocity is not known well enough
    SEARCHING = 3  # the first search is running
    TOO_FAR = 4  # the robot cannot be where the ball is at any time
    NO_PLAN = 5  # no plan was found that keeps every limit
    TOO_LATE = 6  # the plan was found too late to join the flown trajectory
    NO_RECOVERY = 7  # no trajectory from the plan's end to standstill keeps every limit
    DONE = 8  # the robot has hit or caught the ball


@dataclasses.dataclass(frozen=True, slots=True)
class Packet:
    """A decoded request of a client, whose header and length are valid."""

    kind: int  # BALL or ROBOT
    ball: int  # number that identifies the ball
    sequence: int  # number of the packet, counted by its sender
    sent: float  # [s], time of sending by the sender's clock
    measured: float  # [s], time of the measurement by the sender's clock
    values: tuple[float, ...]  # position (3); for a robot also velocity (3), acceleration (3)
    fault: Fault = Fault.NONE


@dataclasses.dataclass(frozen=True)
class Answer:
    """The answer to a request, with K setpoints.

    Attributes:
        sequence: sequence number of the request.
        sent: [s], time at which the request was sent, by the sender's clock.
        motion: kind of trajectory from which the setpoints are sampled.
        fault: fault of the request.
        reason: reason why the motion is not a plan.
        begin: [s], time of the first setpoint, by the sender's clock.
        period: [s], time between setpoints.
        contact: [s], time of the contact with the ball by the sender's clock; NaN without a plan.
        setpoints: (K, 20) setpoints, with the columns of `FIELDS`.
    """

    sequence: int
    sent: float
    motion: Motion
    fault: Fault
    reason: Reason
    begin: float
    period: float
    contact: float
    setpoints: np.ndarray

    def column(self, name: str) -> np.ndarray:
        """Return a field of all setpoints, such as "pos"; `name` is a key of `FIELDS`."""
        names = list(FIELDS)
        before = sum(FIELDS[each] for each in names[: names.index(name)])
        return self.setpoints[:, before : before + FIELDS[name]]


def request(
    kind: int, sequence: int, sent: float, measured: float, values: tuple, ball: int = 0
) -> bytes:
    """Encode a ball's or the robot's state, `values`, `measured` and `sent` at these times [s]."""
    head = _HEADER.pack(MAGIC, VERSION, kind, ball, sequence, sent)
    return head + _MEASURED.pack(measured) + _VALUES[kind].pack(*values)


def read_request(data: bytes) -> Packet | Fault:
    """Decode and check a request; return its content, or the reason why it is not readable."""
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
    reason: Reason,
    times: tuple[float, float, float],
    setpoints: np.ndarray,
) -> bytes:
    """Encode an answer; `times` [s]: first setpoint, period of setpoints, contact with the ball."""
    head = _HEADER.pack(MAGIC, VERSION, ANSWER, packet.ball, packet.sequence, packet.sent)
    return (
        head + _ANSWERED.pack(motion, fault, len(setpoints), reason, *times) + setpoints.tobytes()
    )


def read_answer(data: bytes) -> Answer | None:
    """Decode the packet of an answer; return None if the packet is not an answer."""
    first = _HEADER.size + _ANSWERED.size
    if len(data) < first or data[:4] != MAGIC:
        return None
    _, version, kind, _, sequence, sent = _HEADER.unpack_from(data)
    described = _ANSWERED.unpack_from(data, _HEADER.size)
    motion, fault, num, reason, begin, period, contact = described
    if (version, kind, len(data)) != (VERSION, ANSWER, first + 4 * WIDTH * num):
        return None
    setpoints = np.frombuffer(data, "<f4", offset=first).reshape(num, WIDTH)
    kinds = Motion(motion), Fault(fault), Reason(reason)
    return Answer(sequence, sent, *kinds, begin, period, contact, setpoints)
