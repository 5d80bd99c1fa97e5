"""The socket of a live loop: UDP on localhost, one process, one robot."""

import collections
import contextlib
import gc
import math
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator

import jax

from planner_jax.live.packets import LONGEST, SILENT, Fault, read_request
from planner_jax.live.planner import LivePlanner

HOST = "127.0.0.1"
_LISTENED = 0.25  # [s], without a packet, after which is asked whether to stop
_REHEARSED = 1e-3  # [s], without a packet, after which is rehearsed what the next one will ask for
_TIDIED = 1.0  # [s], between two looks for garbage, which are made behind an answer
# Option of a socket by which Linux says when a packet has come, [s] and [ns] of its clock.
_STAMPS, _STAMP = 35, struct.Struct("@ll")
_SWITCH = 5e-4  # [s], for which a thread may keep others waiting


class Server:
    """Answers packets until it is told to stop.

    Args:
        planner: that answers.
        port: 0 takes a free one.
        idle: do nothing between packets. Otherwise, while a plan is flown towards a ball, the next
            one is rehearsed each millisecond, so that it finds what it needs in the core's caches.

    Raises:
        OSError: the port cannot be had; its `filename` names the port.
    """

    def __init__(self, planner: LivePlanner, port: int, *, idle: bool = False) -> None:
        self.planner, self._idle = planner, idle
        self._told: set[Fault] = set()
        # When it was listened of late, by `time.perf_counter()`, and what this process had
        # computed by then, by `time.process_time()`.
        self._listened: collections.deque[tuple[float, float]] = collections.deque(maxlen=16)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((HOST, port))
            self._socket.setsockopt(socket.SOL_SOCKET, _STAMPS, 1)
        except OSError as error:
            self._socket.close()
            raise OSError(error.errno, error.strerror, f"port {port}") from None
        self.port: int = self._socket.getsockname()[1]

    def warm_up(self) -> None:
        """Have all compiled, and drop what has come by then."""
        self.planner.warm_up()
        self._socket.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                self._socket.recv(LONGEST)
        self._socket.settimeout(_LISTENED)

    def run(self, goes_on: Callable[[], bool]) -> None:
        """Answer while `goes_on()`, which is asked after every packet, and where none come."""
        tidied = time.perf_counter()
        while goes_on():
            try:
                data, sender, received = self._received()
            except TimeoutError:
                self._listen(rehearsed=not self._idle and self.planner.rehearse())
                continue
            self._listen(rehearsed=not self._idle)
            self._answer(data, sender, received)
            if time.perf_counter() - tidied > _TIDIED:
                gc.collect()
                tidied = time.perf_counter()

    def _listen(self, rehearsed: bool) -> None:
        """For how long the next packet is waited for, after an answer or a rehearsal."""
        self._socket.settimeout(_REHEARSED if rehearsed else _LISTENED)

    def _received(self) -> tuple[bytes, tuple[str, int], float]:
        """The next packet, who sent it, and when it came, by `time.perf_counter()`.

        It may have come a while ago, during an answer or a rehearsal.
        """
        self._listened.append((time.perf_counter(), time.process_time()))
        data, others, _, sender = self._socket.recvmsg(LONGEST, socket.CMSG_SPACE(_STAMP.size))
        now, received = time.time(), time.perf_counter()
        for level, kind, stamp in others:
            if (level, kind) == (socket.SOL_SOCKET, _STAMPS):
                seconds, nanoseconds = _STAMP.unpack(stamp)
                received -= max(now - (seconds + 1e-9 * nanoseconds), 0.0)
        return data, sender, received

    def _answer(self, data: bytes, sender: tuple[str, int], received: float) -> None:
        answer = self.planner.answer(data, sender, received)
        if answer is None:
            self._tell(data, sender)
            return
        try:
            self._socket.sendto(answer, sender)
        except OSError:
            self.planner.report.counts["unsent"] += 1
            return
        self.planner.sent(data, received, self._computed_since(received))

    def _computed_since(self, when: float) -> float:
        """Processor time [s] of this process since some time or shortly before it."""
        at = [computed for listened, computed in self._listened if listened <= when]
        return time.process_time() - at[-1] if at else math.inf

    def _tell(self, data: bytes, sender: tuple[str, int]) -> None:
        """Say what is wrong with a packet that gets no answer, the first time that it happens."""
        fault = read_request(data)
        assert isinstance(fault, Fault)
        if fault in self._told:
            return
        self._told.add(fault)
        print(
            f"planner-jax: warning: a packet from {sender[0]}:{sender[1]} {SILENT[fault]}; "
            "this is not said again",
            file=sys.stderr,
            flush=True,
        )

    def close(self) -> None:
        """Give the port back, and end the planner's thread."""
        self._socket.close()
        self.planner.close()


def compute_in_place() -> None:
    """Have a CPU compute in the thread that calls; before JAX's first use of it.

    To hand each call over to a thread of JAX takes as long as the smaller calls themselves.
    """
    jax.config.update("jax_cpu_enable_async_dispatch", False)


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Neither garbage collection nor another thread gets in the way of an answer.

    To begin takes some 0.1 s.
    """
    was_on, before = gc.isenabled(), sys.getswitchinterval()
    gc.collect()
    gc.freeze()  # what is there now is not looked at again
    gc.disable()
    sys.setswitchinterval(_SWITCH)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
        gc.unfreeze()
        if was_on:
            gc.enable()
