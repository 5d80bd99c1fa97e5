"""Which packets count: in order, once, and by one clock.

Senders share a clock, which is not ours. What a packet says of it is believed while it agrees with
those before. A clock that was set anew is believed when several packets in a row agree about it;
everything that was known of the old one is then forgotten.
"""

import collections
import dataclasses

from planner_jax.live.packets import Fault, Packet

LATE = 0.02  # [s], by which a packet may be slower than the quickest and is not late
_APART = 1.0  # [s], by which a time is of another clock
_AGREE = 5  # packets in a row that set the clock anew
_DRIFT = 1e-4  # of one clock against the other
_SENDERS = 32  # that are remembered
_REMEMBERED = 64  # sequence numbers of each


@dataclasses.dataclass
class _Sender:
    """What was last heard of an address."""

    newest: tuple[int, float]  # sequence number and time sent
    seen: collections.deque  # the latest of these pairs


class Arrivals:
    """Of the packets of all senders."""

    def __init__(self) -> None:
        self.newest = -float("inf")  # [s], sender's clock, of what was sent so far
        self.was_late = False  # the last packet
        self._quickest: float | None = None  # [s], our clock less the sender's, at least
        self._heard = 0.0  # [s], our clock
        self._other: list[float] = []  # the same of packets in a row of another clock
        self._senders: dict = {}

    def fault(self, packet: Packet, sender: object, now: float) -> tuple[Fault, bool]:
        """What is wrong with a packet that came now [s], and whether the clock was set anew."""
        self.was_late = False
        if packet.fault:
            return packet.fault, False
        set_anew = False
        gap = now - packet.sent
        if self._quickest is None:
            self._quickest = gap
        elif abs(gap - self._quickest) > _APART:
            if not self._agreed(gap):
                return Fault.OTHER_CLOCK, False
            self._quickest, self.newest, self._senders = gap, -float("inf"), {}
            set_anew = True
        self._other.clear()
        if fault := self._order(packet, sender):
            return fault, set_anew
        self._quickest = min(gap, self._quickest + _DRIFT * max(now - self._heard, 0.0))
        self._heard = now
        self.was_late = gap - self._quickest > LATE
        self.newest = max(self.newest, packet.sent)
        return Fault.NONE, set_anew

    def _agreed(self, gap: float) -> bool:
        """Whether as many packets in a row as it takes are of one other clock."""
        if self._other and abs(gap - self._other[0]) > _APART:
            self._other.clear()
        self._other.append(gap)
        return len(self._other) >= _AGREE

    def _order(self, packet: Packet, sender: object) -> Fault:
        """Whether the sender has sent this packet, or later ones, before."""
        mark = (packet.sequence, packet.sent)
        known = self._senders.get(sender)
        if known is None:
            if len(self._senders) >= _SENDERS:
                del self._senders[next(iter(self._senders))]
            self._senders[sender] = _Sender(mark, collections.deque([mark], maxlen=_REMEMBERED))
            return Fault.NONE
        if mark in known.seen:
            return Fault.DUPLICATE
        known.seen.append(mark)
        # One that begins to count anew, or whose counter overflows, goes on in time.
        if packet.sent < known.newest[1] or (
            packet.sent == known.newest[1] and packet.sequence < known.newest[0]
        ):
            return Fault.OUT_OF_ORDER
        known.newest = mark
        return Fault.NONE
