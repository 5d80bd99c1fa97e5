"""Functions that run commands in this process or in another, and check how the commands end."""

import contextlib
import io
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

from planner_jax.cli.main import main

ROOT = Path(__file__).resolve().parents[2]


class Ended(NamedTuple):
    """Exit code, standard output and standard error of a command."""

    code: int
    out: str
    err: str


def run(*arguments: str | Path) -> Ended:
    """Run a command of `planner-jax` in this process, without the command's signal handlers."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(list(map(str, arguments)))
        except SystemExit as stop:
            code = int(str(stop.code))
    return Ended(code, out.getvalue(), err.getvalue())


def start(*arguments, cwd, module="planner_jax", cache=None, blocks=None, cores=None):
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    environment = {"PYTHONFAULTHANDLER": "1", "PYTHONPATH": path}
    if cache:
        environment["JAX_COMPILATION_CACHE_DIR"] = cache
    command = [sys.executable, "-m", module, *map(str, arguments)]
    if cores is not None:
        usable = sorted(os.sched_getaffinity(0))
        some = random.SystemRandom().sample(usable, min(cores, len(usable)))
        command = ["taskset", "--cpu-list", ",".join(map(str, some)), *command]
    if blocks is not None:
        command = ["bash", "-c", f'ulimit -f {blocks}; exec "$@"', "limited", *command]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=cwd, env={**os.environ, **environment}, **pipes)


def wait_for(process: subprocess.Popen, within: float = 300.0) -> Ended:
    try:
        out, err = process.communicate(timeout=within)
    except subprocess.TimeoutExpired:
        process.kill()
        out, err = process.communicate()
    return Ended(process.returncode, out, err)


def wait_until_listening(process: subprocess.Popen) -> None:
    """Wait until a command has installed its handler of SIGTERM, or has ended."""
    caught = 0
    while process.poll() is None and not caught & 1 << signal.SIGTERM - 1:
        time.sleep(0.01)
        with contextlib.suppress(OSError):  # the process has ended meanwhile
            lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
            caught = int(next(line for line in lines if line.startswith("SigCgt")).split()[1], 16)


def children_of(parent: int, name: str) -> list[int]:
    """Return the ids of a process's children whose program's name starts with `name`."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # the process has ended meanwhile
            status = (process / "stat").read_text().rpartition(")")[2].split()
            program = (process / "cmdline").read_text().partition("\0")[0]
            if int(status[1]) == parent and Path(program).name.startswith(name):
                found.append(int(process.name))
    return found


def is_one_line(ended: Ended) -> bool:
    """Return whether a command ended with code 1 or 2 and one error line as its only output."""
    said = ended.err.startswith("planner-jax: error: ") and ended.err.count("\n") == 1
    return ended.code in (1, 2) and said and ended.out == ""


def is_stopped(ended: Ended, number: int) -> bool:
    words = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated", signal.SIGHUP: "hung up"}
    last = ended.err.rstrip("\n").rpartition("\n")[2]
    said = last.startswith(f"planner-jax: {words[signal.Signals(number)]}; ")
    return ended.code == 128 + number and said and "Traceback" not in ended.err
