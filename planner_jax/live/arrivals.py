"""Which packets are used: in order, once, and by one clock.

All senders share a clock, which may differ from ours by any amount. A packet whose time of sending
disagrees with earlier packets is not used, unless none has been used for a second: then the
senders' clock was set anew, and all that was known by the old one is forgotten.
"""

import math
from collections.abc import Hashable

from planner_jax.live.packets import Fault, Packet

LATE = 0.02  # [s], delay beyond the least delay from which on a packet counts as late
_APART = 1.0  # [s], disagreement from which on a time is by another clock
_SILENCE = 1.0  # [s] without a used packet, after which another clock is accepted
_DRIFT = 1e-4  # of one clock against the other
_SENDERS = 32  # that are remembered


class Arrivals:
    """The packets of all senders."""

    def __init__(self) -> None:
        self.newest = -math.inf  # [s], senders' clock, latest time of sending
        self.was_late = False  # the last packet
        self._least = math.nan  # [s], our clock minus the senders', of the quickest packet
        self._used = -math.inf  # [s], our clock, when a packet was used last
        self._senders: dict[Hashable, tuple[float, int]] = {}  # time and number of their newest

    def check(self, packet: Packet, sender: Hashable, now: float) -> tuple[Fault, bool]:
        """Return the fault of a packet that came now [s], and whether the clock was set anew."""
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
