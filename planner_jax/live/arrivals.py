"""Checks which received packets live planning may use.

Each packet is used at most once, and only if it was sent after all used packets of its sender. All
senders use one clock, which may differ from this process's clock by any offset. A packet whose
offset differs by more than a second from the offset of earlier packets is ignored. If no packet was
used for a second, the senders are assumed to have a new clock, and the packet is used.
"""

import math
from collections.abc import Hashable

from planner_jax.live.packets import Fault, Packet

LATE = 0.02  # [s], a packet is late if its delay exceeds the least observed delay by more than this
_APART = 1.0  # [s], difference of delays above which a packet was sent by another clock
_SILENCE = 1.0  # [s], time without a used packet after which another clock is accepted
_DRIFT = 1e-4  # greatest relative drift between the senders' clock and the receiver's clock
_SENDERS = 32  # greatest number of senders whose newest packet is remembered


class Arrivals:
    """Sending times and sequence numbers of the used packets of all senders."""

    def __init__(self) -> None:
        self.newest = -math.inf  # [s], latest sending time, by the senders' clock
        self.was_late = False  # whether the last packet was late
        self._least = math.nan  # [s], least difference of arrival time and sending time
        self._used = -math.inf  # [s], arrival time of the last used packet
        # For each sender, the sending time [s] and the sequence number of its newest packet.
        self._senders: dict[Hashable, tuple[float, int]] = {}

    def check(self, packet: Packet, sender: Hashable, now: float) -> tuple[Fault, bool]:
        """Return why a packet that arrives at `now` [s] is rejected, and whether its clock is new.

        All senders share a clock. It is new if `now` minus the sending time jumps by more than 1 s
        after 1 s without a used packet.
        """
        self.was_late = False
        if packet.fault:
            return packet.fault, False
        gap = now - packet.sent
        is_other = abs(gap - self._least) > _APART
        if is_other and now - self._used <= _SILENCE:
            return Fault.OTHER_CLOCK, False
        if is_other or math.isnan(self._least):
            self._least, self._used = gap, now
            self.newest, self._senders = -math.inf, {}
        mark, known = (packet.sent, packet.sequence), self._senders.get(sender)
        if known is not None and mark <= known:
            return Fault.DUPLICATE if mark == known else Fault.OUT_OF_ORDER, is_other
        if known is None and len(self._senders) >= _SENDERS:
            del self._senders[next(iter(self._senders))]
        self._senders[sender] = mark
        self._least = min(gap, self._least + _DRIFT * max(now - self._used, 0.0))
        self._used = now
        self.was_late = gap - self._least > LATE
        self.newest = max(self.newest, packet.sent)
        return Fault.NONE, is_other
