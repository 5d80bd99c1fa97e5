"""The other side of a live loop, for programs in Python; others find the packets in the docs."""

import socket
import time
from typing import Any, Self

from planner_jax.live.packets import BALL, LONGEST, ROBOT, Answer, read_answer, request
from planner_jax.live.server import HOST
from planner_jax.live.settings import PORT


class Client:
    """Sends what was measured, and waits for the setpoints; its socket is closed with its block.

    Args:
        port: of the loop.
        timeout: [s], for which an answer is waited for.
    """

    def __init__(self, port: int = PORT, *, timeout: float = 0.1) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((HOST, port))
        self._timeout, self._sequence = timeout, 0

    def ball(self, pos: tuple, *, measured: float | None = None, number: int = 0) -> Answer | None:
        """The answer to a ball that was seen at a place (3,) [m]; None if none comes in time.

        Args:
            pos: (3,) [m].
            measured: [s], when, by `time.monotonic()`; now if not given.
            number: of the ball, from 0 to 65535; another number is another ball.
        """
        return self._asked(BALL, measured, (*map(float, pos),), number)

    def robot(
        self,
        pos: tuple,
        vel: tuple = (0.0,) * 3,
        acc: tuple = (0.0,) * 3,
        *,
        measured: float | None = None,
    ) -> Answer | None:
        """The answer to the robot's position [m], velocity [m/s] and acceleration [m/s^2]."""
        return self._asked(ROBOT, measured, (*map(float, (*pos, *vel, *acc)),), 0)

    def _asked(self, kind: int, measured: float | None, values: tuple, ball: int) -> Answer | None:
        sent = time.monotonic()
        self._sequence = (self._sequence + 1) % 2**32
        when = sent if measured is None else measured
        try:
            self._socket.send(request(kind, self._sequence, sent, when, values, ball))
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

    def __exit__(self, *_: Any) -> None:
        self._socket.close()
