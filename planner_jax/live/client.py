"""Python client of the UDP server `planner-jax serve`; docs/live.md describes the packets."""

import socket
import time
from collections.abc import Sequence
from types import TracebackType
from typing import Self

from planner_jax.live.packets import BALL, LONGEST, ROBOT, Answer, read_answer, request
from planner_jax.live.server import HOST
from planner_jax.live.settings import PORT


class Client:
    """Sends measurements to the server, and waits for setpoints; use it in a `with` block.

    Args:
        port: UDP port of the server on this machine.
        timeout: [s], longest wait for an answer.
    """

    def __init__(self, port: int = PORT, *, timeout: float = 0.1) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((HOST, port))
        self._timeout, self._sequence = timeout, 0

    def ball(
        self, pos: Sequence[float], *, measured: float | None = None, number: int = 0
    ) -> Answer | None:
        """Send the position of a ball; return the answer, or None after the timeout.

        Args:
            pos: (3,) [m].
            measured: [s], time of the observation by `time.monotonic()`; by default, of the call.
            number: number from 0 to 65535 that identifies the ball.
        """
        return self._send(BALL, measured, pos, number)

    def robot(
        self,
        pos: Sequence[float],
        vel: Sequence[float] = (0.0,) * 3,
        acc: Sequence[float] = (0.0,) * 3,
        *,
        measured: float | None = None,
    ) -> Answer | None:
        """Send the robot's state in SI units; return the answer, or None after the timeout.

        `measured` [s] is the time of the observation by `time.monotonic()`, by default now.
        """
        return self._send(ROBOT, measured, (*pos, *vel, *acc), 0)

    def _send(
        self, kind: int, measured: float | None, values: Sequence[float], ball: int
    ) -> Answer | None:
        sent = time.monotonic()
        self._sequence = (self._sequence + 1) % 2**32
        when = sent if measured is None else measured
        try:
            data = request(kind, self._sequence, sent, when, tuple(map(float, values)), ball)
            self._socket.send(data)
            while (left := sent + self._timeout - time.monotonic()) > 0.0:
                self._socket.settimeout(left)
                answer = read_answer(self._socket.recv(LONGEST))
                if answer is not None and answer.sequence == self._sequence:
                    return answer
        except (TimeoutError, ConnectionRefusedError):
            pass
        return None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type | BaseException | TracebackType | None) -> None:
        self._socket.close()
