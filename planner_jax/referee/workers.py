"""Worker processes that judge batches of more than 16,000 plans faster than threads.

A worker runs this module with `python -m`. It does not import the calling program, so that the
program needs no `if __name__ == "__main__"`.
"""

import atexit
import functools
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue
from typing import TypeVar

from planner_jax.referee.judging import cores

ArgumentT = TypeVar("ArgumentT")
ResultT = TypeVar("ResultT")
# Environment of a worker: NumPy uses one thread, since there is one worker for each core.
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


def map_in_processes(
    function: Callable[[ArgumentT], ResultT], arguments: list[ArgumentT]
) -> list[ResultT]:
    """Return function(argument) for each argument, computed in processes; all must be picklable."""
    threads, idle = _start_workers()

    def call(argument: ArgumentT) -> ResultT:
        worker = idle.get()
        try:
            return _call(worker, function, argument)
        finally:
            idle.put(worker)

    return list(threads.map(call, arguments))


def _call(
    worker: subprocess.Popen, function: Callable[[ArgumentT], ResultT], argument: ArgumentT
) -> ResultT:
    """Compute function(argument) in a worker process; raise the exception that it raises there."""
    assert worker.stdin is not None and worker.stdout is not None
    try:
        pickle.dump((function, argument), worker.stdin, pickle.HIGHEST_PROTOCOL)
        worker.stdin.flush()
        failed, result = pickle.load(worker.stdout)
    except (BrokenPipeError, EOFError) as error:
        code = worker.wait()
        raise RuntimeError(f"a process of the referee ended with code {code}") from error
    if failed:
        raise result
    return result


@functools.cache
def _start_workers() -> tuple[ThreadPoolExecutor, SimpleQueue]:
    num, idle = cores(), SimpleQueue()
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **_ONE_THREAD}
    pipe, command = subprocess.PIPE, [sys.executable, "-m", __name__]
    for _ in range(num):
        idle.put(subprocess.Popen(command, stdin=pipe, stdout=pipe, env=environment))
    threads = ThreadPoolExecutor(num)
    atexit.register(_stop_workers, threads, idle)
    return threads, idle


def _stop_workers(threads: ThreadPoolExecutor, idle: SimpleQueue) -> None:
    threads.shutdown()
    while not idle.empty():
        idle.get().communicate()  # closes the pipe from which the worker reads, so that it ends


def _serve() -> None:
    """Read pickled calls from stdin and write their results to stdout until stdin is closed."""
    calls, answers = sys.stdin.buffer, sys.stdout.buffer
    while True:
        try:
            function, argument = pickle.load(calls)
        except EOFError:
            return
        try:
            answer = False, function(argument)
        except Exception as error:  # sent to the calling process, which raises it
            answer = True, error
        pickle.dump(answer, answers, pickle.HIGHEST_PROTOCOL)
        answers.flush()


if __name__ == "__main__":
    _serve()
