"""Processes that judge, for batches so large that threads would wait for the interpreter.

A worker is this module run by itself: it imports the referee and NumPy and nothing of the
program that asks, so that a caller needs no `if __name__ == "__main__"`.
"""

import atexit
import functools
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # a core is one worker's


class _Worker:
    """One process, and the pipes to it."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={
                **os.environ,
                "PYTHONPATH": os.pathsep.join(sys.path),
                **_ENVIRONMENT,
            },
        )

    def call(self, function: Callable, argument: Any) -> Any:
        """The function's result, computed there; its exception, raised here."""
        process = self._process
        assert process.stdin is not None and process.stdout is not None
        try:
            pickle.dump((function, argument), process.stdin, pickle.HIGHEST_PROTOCOL)
            process.stdin.flush()
            failed, result = pickle.load(process.stdout)
        except (BrokenPipeError, EOFError) as error:
            code = process.wait()
            raise RuntimeError(f"a process of the referee ended with code {code}") from error
        if failed:
            raise result
        return result

    def stop(self) -> None:
        """Let the process end: it does when there is no more to read."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


def cores() -> int:
    """How many cores the referee keeps busy: as NPROC says, which XLA minds too, or all it may."""
    told = os.environ.get("NPROC", "")
    if told.isdecimal():
        return max(int(told), 1)
    # As `processors.usable_cores`, of which the referee, like of all that it judges, knows nothing.
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Workers:
    """As many processes as the referee has cores."""

    def __init__(self, num: int) -> None:
        self._threads = ThreadPoolExecutor(num)
        self._own = threading.local()
        self._all: list[_Worker] = []

    def map(self, function: Callable, arguments: list[Any]) -> list[Any]:
        """`function` of each argument; both must be known to `pickle`."""

        def call(argument: Any) -> Any:
            worker = getattr(self._own, "worker", None)
            if worker is None:
                worker = self._own.worker = _Worker()
                self._all.append(worker)
            return worker.call(function, argument)

        return list(self._threads.map(call, arguments))

    def stop(self) -> None:
        """End all processes."""
        self._threads.shutdown()
        for worker in self._all:
            worker.stop()


@functools.cache
def workers() -> Workers:
    """The processes of this program, begun when they are first asked for."""
    pool = Workers(cores())
    atexit.register(pool.stop)
    return pool


def _serve() -> None:
    """Answer until there is nothing more to read."""
    calls, answers = sys.stdin.buffer, sys.stdout.buffer
    while True:
        try:
            function, argument = pickle.load(calls)
        except EOFError:
            return
        try:
            answer = False, function(argument)
        except Exception as error:  # whatever it is, it belongs to the caller
            answer = True, error
        pickle.dump(answer, answers, pickle.HIGHEST_PROTOCOL)
        answers.flush()


if __name__ == "__main__":
    _serve()
