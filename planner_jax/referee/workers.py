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
from typing import TypeVar

from planner_jax.referee.judging import cores

Given = TypeVar("Given")
Found = TypeVar("Found")
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

    def call(self, function: Callable[[Given], Found], argument: Given) -> Found:
        """Return the function's result, computed there; its exception, raised here."""
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


class Workers:
    """As many processes as the referee has cores."""

    def __init__(self, num: int) -> None:
        self._threads = ThreadPoolExecutor(num, initializer=self._start_worker)
        self._own = threading.local()
        self._all: list[_Worker] = []

    def map(self, function: Callable[[Given], Found], arguments: list[Given]) -> list[Found]:
        """Return `function` of each argument; both must be known to `pickle`."""
        return list(
            self._threads.map(lambda each: self._own.worker.call(function, each), arguments)
        )

    def _start_worker(self) -> None:
        """Start the process of the thread that calls this."""
        self._own.worker = _Worker()
        self._all.append(self._own.worker)

    def stop(self) -> None:
        """End all processes."""
        self._threads.shutdown()
        for worker in self._all:
            worker.stop()


@functools.cache
def workers() -> Workers:
    """Return the processes of this program, begun when they are first asked for."""
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
