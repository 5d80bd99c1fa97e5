"""UDP server of live planning: it receives packets on localhost and sends the planner's answers."""

import contextlib
import math
import socket
import struct
import sys
import time
from collections.abc import Callable

import jax

from planner_jax.live.packets import LONGEST, PRINTED, Fault
from planner_jax.live.planner import LivePlanner

HOST = "127.0.0.1"
_LISTENED = 0.25  # [s], longest wait for a packet before the server checks whether to stop
_REPEATED = 60.0  # [s], least time between two lines about the same fault
_BUFFER = 2**20  # [bytes], requested size of the system's buffer of packets that have arrived
# Number of Linux's socket option SO_TIMESTAMPNS, and format of its value: seconds, nanoseconds.
_STAMPS, _STAMP = 35, struct.Struct("@ll")


class Server:
    """A UDP socket on localhost, and the planner that answers its packets.

    Args:
        planner: planner that computes the answers.
        port: number of the UDP port; 0 selects a free port.

    Raises:
        OSError: the port is not available; the exception's `filename` names the port.
    """

    def __init__(self, planner: LivePlanner, port: int) -> None:
        self.planner = planner
        self._printed: dict[Fault, float] = {}  # times [s] of the last lines about faults
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(_LISTENED)
        try:
            self._socket.bind((HOST, port))
            self._socket.setsockopt(socket.SOL_SOCKET, _STAMPS, 1)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        except OSError as error:
            self._socket.close()
            raise OSError(error.errno, error.strerror, f"port {port}") from None
        self.port: int = self._socket.getsockname()[1]

    def warm_up(self, say: Callable[[str], object] = lambda line: None) -> None:
        """Compile the planner's JAX programs, and discard packets that arrive meanwhile.

        `say` receives a line of text after every part of the compilation.
        """
        self.planner.warm_up(say)
        self._socket.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                self._socket.recv(LONGEST)
        self._socket.settimeout(_LISTENED)

    def run(self, is_running: Callable[[], bool]) -> None:
        """Answer packets while `is_running()` is true; test it after every packet and timeout."""
        while is_running():
            with contextlib.suppress(TimeoutError):
                self._answer(*self._receive())

    def _receive(self) -> tuple[bytes, tuple[str, int], float]:
        """Return the next packet, its sender and its arrival time, from the system's time stamp."""
        data, others, _, sender = self._socket.recvmsg(LONGEST, socket.CMSG_SPACE(_STAMP.size))
        now, received = time.time(), time.perf_counter()
        for level, kind, stamp in others:
            if (level, kind) == (socket.SOL_SOCKET, _STAMPS):
                seconds, nanoseconds = _STAMP.unpack(stamp)
                received -= max(now - (seconds + 1e-9 * nanoseconds), 0.0)
        return data, sender, received

    def _answer(self, data: bytes, sender: tuple[str, int], received: float) -> None:
        answer = self.planner.answer(data, sender, received)
        if self.planner.fault in PRINTED:
            self._warn(self.planner.fault, sender)
        if answer is None:
            return
        try:
            self._socket.sendto(answer, sender)
        except OSError:
            self.planner.report.counts["unsent"] += 1
            return
        self.planner.record_sent(data, received)

    def _warn(self, fault: Fault, sender: tuple[str, int]) -> None:
        now = time.monotonic()
        if now - self._printed.get(fault, -math.inf) < _REPEATED:
            return
        self._printed[fault] = now
        words = f"warning: a packet from {sender[0]}:{sender[1]} {PRINTED[fault]}"
        rule = f"such packets are not used; printed once in {_REPEATED:g} s"
        print(f"planner-jax: {words}; {rule}", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Close the socket, and end the planner's thread."""
        self._socket.close()
        self.planner.close()


def compute_in_place() -> None:
    """Let JAX run CPU computations in the calling thread; call this before any computation.

    By default JAX passes a computation to another thread. For small computations this takes longer
    than the computation itself.
    """
    jax.config.update("jax_cpu_enable_async_dispatch", False)
