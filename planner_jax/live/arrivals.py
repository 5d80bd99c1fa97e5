"""Selection of packets: each is used once, in order, and by one clock of the senders.

All senders share a clock, with any offset to the clock of this process. A packet whose sending time
disagrees with earlier packets is ignored. If no packet was used for a second, the senders' clock is
taken to be reset, and earlier times are forgotten.
"""

import math
from collections.abc import Hashable

from planner_jax.live.packets import Fault, Packet

LATE = 0.02  # [s] above the least delay, from which a packet counts as late
_APART = 1.0  # [s], disagreement from which a time is of another clock
_SILENCE = 1.0  # [s] without a used packet, after which another clock is accepted
_DRIFT = 1e-4  # greatest relative drift between the clocks
_SENDERS = 32  # greatest number of senders in memory


class Arrivals:
    """State of the selection, over the packets of all senders."""

    def __init__(self) -> None:
        self.newest = -math.inf  # [s], latest sending time, by the senders' clock
        self.was_late = False  # the last packet was late
        self._least = math.nan  # [s], least difference of arrival time and sending time
        self._used = -math.inf  # [s], arrival of the last used packet
        self._senders: dict[Hashable, tuple[float, int]] = {}  # newest sending time and number

    def check(self, packet: Packet, sender: Hashable, now: float) -> tuple[Fault, bool]:
        """Return the fault of a packet that arrives `now` [s], and whether the clock was reset."""
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
