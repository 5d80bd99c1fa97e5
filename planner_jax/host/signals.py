"""Handling of Ctrl-C, SIGTERM and SIGHUP: the command prints one line and exits with its own code.

A separate thread ends the process at once, because the main thread may be inside the compiler. No
file is half-written then, because complete files are renamed into place. Within `under_way` the
first signal only sets a flag, and the main thread has `GRACE` seconds to call `check`, where it can
stop cleanly. The process exits without shutting the interpreter down, because XLA's threads that
still compute would crash.
"""

import atexit
import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from typing import NoReturn

GRACE = 5.0  # [s] time in which the main thread can stop cleanly
NOTHING = "there is nothing to resume"
_WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated", signal.SIGHUP: "hung up"}


class Stopped(KeyboardInterrupt):
    """The process received a signal to stop."""


class _State:
    def __init__(self) -> None:
        self.number: int | None = None  # number of the first signal
        self.patient = False
        self.bar = False
        self.remainder: Callable[[], str] = lambda: NOTHING
        self.leaving = threading.Lock()


_STATE = _State()


def listen() -> None:
    """Start to handle SIGINT, SIGTERM and SIGHUP; call this in the main thread of a command."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    for number in _WORDS:
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, lambda *_: None)  # `_watch` acts on the signal
    threading.Thread(target=_watch, args=(reader,), daemon=True).start()
    # At shutdown Python restores the default handlers. A signal would then end a command without a
    # line, although its work is done.
    atexit.register(_ignore)


def _ignore() -> None:
    for number in _WORDS:
        signal.signal(number, signal.SIG_IGN)


@contextlib.contextmanager
def under_way(
    remainder: Callable[[], str], *, patient: bool = True, bar: bool = True
) -> Iterator[None]:
    """Define what the process prints when a signal stops it within the block.

    Args:
        remainder: called when the process is stopped; returns a text on what is left and how to
            continue, or `NOTHING`, in which case the process ends at once.
        patient: whether the block calls `check`; if not, the process ends at once.
        bar: whether the block shows a progress bar, whose line is ended first.
    """
    before = _STATE.patient, _STATE.bar, _STATE.remainder
    _STATE.patient, _STATE.bar, _STATE.remainder = patient, bar, remainder
    try:
        yield
    finally:
        if not is_stopped():
            _STATE.patient, _STATE.bar, _STATE.remainder = before


def check() -> None:
    """Raise `Stopped` if the process received a signal to stop."""
    if is_stopped():
        raise Stopped


def is_stopped() -> bool:
    """Return whether the process received a signal to stop."""
    return _STATE.number is not None


def leave() -> NoReturn:
    """End a process that received a signal, with one line on the standard error stream."""
    number = _STATE.number or signal.SIGINT
    if not _STATE.leaving.acquire(blocking=False):
        threading.Event().wait()  # wait: another thread ends the process
    try:
        end = "\n" if _STATE.bar else ""
        line = f"planner-jax: {_WORDS[signal.Signals(number)]}; {_STATE.remainder()}\n"
        os.write(2, (end + line).encode(errors="replace"))
    finally:
        os._exit(128 + number)


def _watch(reader: int) -> None:
    """Read the numbers of received signals from a pipe, and stop the process when one arrives."""
    while True:
        for number in os.read(reader, 64):
            if number not in _WORDS:
                continue
            first, _STATE.number = not is_stopped(), _STATE.number or number
            if not first or not _STATE.patient or _STATE.remainder() == NOTHING:
                leave()
            late = threading.Timer(GRACE, leave)
            late.daemon = True
            late.start()
