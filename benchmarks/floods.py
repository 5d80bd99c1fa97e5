"""Packets of programs that disturb the live planning server; each kind is a flood.

    python -m planner_jax.benchmarks.floods NAME PORT SECONDS

The program sends the flood NAME to a UDP port of this machine at the flood's rate, for at most a
minute, and then prints how many packets it sent. It imports no JAX, so that it starts quickly.
"""

import dataclasses
import random
import socket
import sys
import time
from collections.abc import Callable

from planner_jax.live.packets import BALL, ROBOT, request

HOST, NUMBER = "127.0.0.1", 7  # host of the server; number of the honest client's ball
LONGEST = 60.0  # [s], longest duration of a flood


@dataclasses.dataclass(frozen=True)
class Flood:
    """Packets that one program sends."""

    words: str
    rate: int  # packets per second
    # Returns the packet with a sequence number that is sent at a time [s].
    make: Callable[[int, float], bytes]
    is_moving: bool = False  # whether each packet comes from a new port


def _ball(number: int, sequence: int, now: float, ahead: float = 0.0) -> bytes:
    pos = tuple(random.uniform(-1.0, 3.0) for _ in range(3))
    return request(BALL, sequence, now + ahead, now + ahead, pos, number)


def _robot(sequence: int, now: float, ahead: float = 0.0) -> bytes:
    state = (*(random.uniform(0.5, 3.0) for _ in range(3)), *[0.0] * 6)
    return request(ROBOT, sequence, now + ahead, now + ahead, state)


def _nan(sequence: int, now: float) -> bytes:
    return request(BALL, sequence, float("nan"), now, (1.0, 1.0, 1.0), NUMBER)


FLOODS = {
    "garbage": Flood("60 random bytes", 25000, lambda k, now: random.randbytes(60)),
    "large": Flood("datagrams of 60 kB", 2300, lambda k, now: bytes(60000)),
    "nan": Flood("times that are NaN", 7800, _nan),
    "numbers": Flood(
        "balls with random numbers", 1400, lambda k, now: _ball(random.randrange(2**16), k, now)
    ),
    "ports": Flood("a ball from ever new ports", 800, lambda k, now: _ball(99, k, now), True),
    "lies": Flood("lies about the ball", 95, lambda k, now: _ball(NUMBER, k, now)),
    "future": Flood("the ball, dated 0.9 s ahead", 5, lambda k, now: _ball(NUMBER, k, now, 0.9)),
    "robot": Flood("lies about the robot", 49, _robot),
    "robot-ahead": Flood("the robot, dated 0.99 s ahead", 20, lambda k, now: _robot(k, now, 0.99)),
    "clock": Flood("another clock", 96, lambda k, now: _ball(98, k, now, 1000.0)),
}


def send(flood: Flood, port: int, seconds: float) -> int:
    """Send a flood to a port for a duration; return the number of packets that were sent."""
    begun = now = time.monotonic()
    ends, num, unsent = begun + min(seconds, LONGEST), 0, 0
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    while now < ends:
        while num < flood.rate * (now - begun):
            if flood.is_moving:
                sender.close()
                sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            num += 1
            try:
                sender.sendto(flood.make(num, time.monotonic()), (HOST, port))
            except OSError:
                unsent += 1
        time.sleep(0.0005)
        now = time.monotonic()
    sender.close()
    return num - unsent


if __name__ == "__main__":
    name, port, seconds = sys.argv[1:]
    print(send(FLOODS[name], int(port), float(seconds)))
