"""Checks which received packets live planning may use.

Each packet is used at most once, and only if it was sent after all used packets of its sender. A
ball's number and the robot belong to the sender whose packet was used first, until no packet of
that sender was used for a second. The clock belongs to the sender that is known for longest, and
may differ from this process's clock by any offset. The other senders must use the same clock. If no
sender is known, the next packet may start a new clock.
"""

import dataclasses
import math
from collections.abc import Hashable

from planner_jax.live.packets import BALL, Fault, Packet

LATE = 0.02  # [s], a packet is late if its delay exceeds the least observed delay by more than this
_EARLY = 0.02  # [s], a delay shorter than the least one by more than this is of another clock
_APART = 1.0  # [s], difference of delays above which a packet was sent by another clock
_SILENCE = 1.0  # [s], time without a used packet after which a sender is forgotten
_DRIFT = 1e-4  # greatest relative drift between the senders' clock and the receiver's clock
_SENDERS, _BALLS = 32, 16  # greatest numbers of known senders, and of balls of a sender in a second
_RATE, _BURST = 1000.0, 50.0  # greatest rate of a sender's used packets [1/s], and number at once
_REFUSALS = 32  # greatest number of answers in a second to packets that are refused
_ROBOT = -1  # stands for the robot among the numbers of balls


@dataclasses.dataclass
class _Sender:
    """The newest used packet of a sender, and the balls and the robot that belong to the sender."""

    mark: tuple[float, int] = (-math.inf, 0)  # sending time [s] and sequence number
    used: float = -math.inf  # [s], arrival time
    allowance: float = _BURST  # number of packets that could be used at once at the arrival time
    # Arrival time [s] of the newest packet of each ball and of the robot; the oldest time is first.
    owned: dict[int, float] = dataclasses.field(default_factory=dict)


class Arrivals:
    """The known senders, what belongs to each of them, and their clock."""

    def __init__(self) -> None:
        self.was_late = False  # whether the last packet was late
        self.ahead = 0.0  # [s], how far the sending time of the last used packet is in the future
        self._least = math.nan  # [s], least difference of arrival time and sending time
        self._early = math.nan  # [s], difference of an early packet that the clock's owner sent
        self._senders: dict[Hashable, _Sender] = {}  # the sender that is known for longest is first
        # Start of the current second, and the senders in it whose refused packet was answered.
        self._second, self._refused = -math.inf, set[Hashable]()

    def check(self, packet: Packet, sender: Hashable, now: float) -> tuple[Fault, bool]:
        """Return why a packet that arrives at `now` [s] is rejected, and whether its clock is new.

        A clock is new if no sender is known, and the difference of arrival time and sending time
        differs by more than a second from the difference of earlier packets.
        """
        self.was_late = False
        if packet.fault:
            return packet.fault, False
        for key in [k for k, each in self._senders.items() if now - each.used > _SILENCE]:
            del self._senders[key]
        gap, owns_clock = now - packet.sent, next(iter(self._senders), sender) == sender
        ahead = self._least - gap
        is_other, is_set = not -_APART <= ahead <= _EARLY, False
        if self._senders and is_other:
            # Two packets in a row show that the clock's owner set it forward, or that its first
            # packet was late.
            is_set = owns_clock and 0.0 < ahead <= _APART and abs(gap - self._early) <= _EARLY
            self._early = gap if owns_clock else self._early
            if not is_set:
                return Fault.OTHER_CLOCK, False
        known = self._senders.get(sender, _Sender())
        if fault := self._refuse(packet, sender, known, now):
            return fault, False
        is_anew = not self._senders and abs(ahead) > _APART
        if owns_clock:
            kept = math.inf if is_set else self._least + _DRIFT * (now - known.used)
            self._least, self._early = min(gap, kept), math.nan
        known.allowance = min(_BURST, known.allowance + _RATE * (now - known.used)) - 1.0
        known.mark, known.used = (packet.sent, packet.sequence), now
        self._senders[sender] = known
        self.was_late, self.ahead = gap - self._least > LATE, max(self._least - gap, 0.0)
        return Fault.NONE, is_anew

    def _refuse(self, packet: Packet, sender: Hashable, known: _Sender, now: float) -> Fault:
        """Return why a packet is refused that keeps the clock; else note what its sender owns."""
        if sender not in self._senders and len(self._senders) >= _SENDERS:
            return Fault.CROWDED
        mark = packet.sent, packet.sequence
        if mark <= known.mark:
            return Fault.DUPLICATE if mark == known.mark else Fault.OUT_OF_ORDER
        number, owned = packet.ball if packet.kind == BALL else _ROBOT, known.owned
        if any(number in each.owned for each in self._senders.values() if each is not known):
            return Fault.OTHER_SENDER
        if known.allowance + _RATE * (now - known.used) < 1.0:
            return Fault.TOO_FAST
        if owned.pop(number, None) is None and len(owned) >= _BALLS:
            oldest = next(iter(owned))
            if now - owned[oldest] <= _SILENCE:
                return Fault.CROWDED
            del owned[oldest]
        owned[number] = now
        return Fault.NONE

    def begin_refusal(self, sender: Hashable, now: float) -> bool:
        """Test whether a refused packet is answered: once per sender and second, 32 in a second."""
        if abs(now - self._second) > 1.0:
            self._second, self._refused = now, set()
        if sender in self._refused or len(self._refused) >= _REFUSALS:
            return False
        self._refused.add(sender)
        return True
