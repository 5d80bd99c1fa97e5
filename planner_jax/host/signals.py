"""Commands that are stopped from outside: Ctrl-C, SIGTERM or SIGHUP, each with a line and a code.

A signal ends the process at once, wherever its threads are: files appear whole or not at all, and
no help of the main thread is needed, which may be inside the compiler. Within `under_way` the first
signal is left to the main thread, which calls `check` where it can stop tidily, for at most `GRACE`
seconds. Nothing is raised elsewhere, so that no signal is lost or ends in a traceback. The
interpreter is not taken down, since threads of XLA that still compute would crash without it.
"""

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from typing import NoReturn

GRACE = 5.0  # [s]
NOTHING = "there is nothing to resume"
_WORDS = {
    signal.SIGINT: "interrupted",
    signal.SIGTERM: "terminated",
    signal.SIGHUP: "hung up",
}


class Stopped(KeyboardInterrupt):
    """The process was told to stop."""


class _State:
    """Of the process, which has one set of signal handlers."""

    def __init__(self) -> None:
        self.told: int | None = None  # number of the first signal
        self.patient = False
        self.bar = False
        self.rest: Callable[[], str] = lambda: NOTHING
        self.leaving = threading.Lock()


_STATE = _State()


def listen() -> None:
    """Hear SIGINT, SIGTERM and SIGHUP from now on; in the main thread of a command only.

    A shell starts background jobs deaf to SIGINT; it is heard there too. SIGHUP is not, where
    `nohup` has asked for that.
    """
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    for number in _WORDS:
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, lambda *_: None)  # what is done is `_watch`'s
    threading.Thread(target=_watch, args=(reader,), daemon=True).start()


@contextlib.contextmanager
def under_way(rest: Callable[[], str], *, patient: bool = True, bar: bool = True) -> Iterator[None]:
    """Say within the block what a stop leaves; it may be left to the block for a while.

    Args:
        rest: called when the process is stopped; says what is left and how to go on with it, or
            `NOTHING`, where nothing has to be waited for.
        patient: whether the block calls `check`.
        bar: whether it shows a bar, whose line is ended first.
    """
    before = _STATE.patient, _STATE.bar, _STATE.rest
    _STATE.patient, _STATE.bar, _STATE.rest = patient, bar, rest
    try:
        yield
    finally:
        if not is_told():
            _STATE.patient, _STATE.bar, _STATE.rest = before


def check() -> None:
    """Raise `Stopped` if the process has been told to stop."""
    if is_told():
        raise Stopped


def is_told() -> bool:
    """Whether the process has been told to stop."""
    return _STATE.told is not None


def leave() -> NoReturn:
    """End a process that was told to stop, with a line on the standard error stream."""
    told = _STATE.told or signal.SIGINT
    if not _STATE.leaving.acquire(blocking=False):
        threading.Event().wait()  # another thread ends the process
    try:
        end = "\n" if _STATE.bar else ""
        line = f"planner-jax: {_WORDS[signal.Signals(told)]}; {_STATE.rest()}\n"
        os.write(2, (end + line).encode(errors="replace"))
    finally:
        os._exit(128 + told)


def _watch(reader: int) -> None:
    """Read the numbers of signals, as the interpreter's own handler writes them."""
    while True:
        for number in os.read(reader, 64):
            if number not in _WORDS:
                continue
            first, _STATE.told = not is_told(), _STATE.told or number
            if not first or not _STATE.patient or _STATE.rest() == NOTHING:
                leave()
            late = threading.Timer(GRACE, leave)
            late.daemon = True
            late.start()
