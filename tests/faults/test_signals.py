"""A signal ends a command with its own exit code and one line, even if other threads are busy."""

import signal
import subprocess
import sys
import time

import pytest

from tests.faults.commands import is_stopped, start, wait_for, wait_until_listening
from tests.faults.runs import make_flights

PREPARED = """
import os, signal, sys, time
from planner_jax.host import signals as stopping
stopping.listen()
"""
READY = 'print("ready", flush=True)'
NOTHING_UNDER_WAY = f"{READY}\ntime.sleep(30.0)"
CHECKING = f"""
with stopping.under_way(lambda: "continue with: this", bar=False):
    {READY}
    try:
        while True:
            time.sleep(0.01)
            stopping.check()
    except stopping.Stopped:
        print("tidy", flush=True)
        stopping.leave()
"""
BUSY = f"""
stopping.GRACE = 0.3
with stopping.under_way(lambda: "continue with: this", bar=False):
    {READY}
    time.sleep(30.0)
"""
NUMBERS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


def stop_script(script, *numbers, ignored=()):
    heard = {number: "SIG_IGN" if number in ignored else "SIG_DFL" for number in NUMBERS}
    before = "".join(
        f"import signal; signal.signal({int(n)}, signal.{how})\n" for n, how in heard.items()
    )
    command = [sys.executable, "-c", before + PREPARED + script]
    pipes: dict = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(command, **pipes)
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    for number in numbers:
        process.send_signal(number)
        time.sleep(0.1)  # otherwise the system merges two signals
    return wait_for(process)


@pytest.mark.parametrize("number", NUMBERS)
@pytest.mark.parametrize(
    ("script", "rest", "out"),
    [
        (NOTHING_UNDER_WAY, "there is nothing to resume", ""),
        (CHECKING, "continue with: this", "tidy\n"),
        (BUSY, "continue with: this", ""),
    ],
    ids=["nothing under way", "one that checks", "one that is busy"],
)
def test_a_signal_ends_a_command_with_its_code_and_a_line(number, script, rest, out):
    ended = stop_script(script, number)
    assert is_stopped(ended, number) and ended.out == out
    assert ended.err.count("\n") == 1 and ended.err.endswith(f"; {rest}\n")


def test_a_second_signal_ends_a_busy_command_at_once():
    busy = BUSY.replace("0.3", "60.0")
    ended = stop_script(busy, signal.SIGINT, signal.SIGINT, signal.SIGINT)
    assert is_stopped(ended, signal.SIGINT)


def test_nohup_is_respected_and_a_background_job_hears_ctrl_c():
    both = signal.SIGHUP, signal.SIGINT
    ended = stop_script(NOTHING_UNDER_WAY, *both, ignored=both)
    assert is_stopped(ended, signal.SIGINT)


def test_a_command_that_imports_is_ended_without_a_traceback(tmp_path):
    process = start("sweep", "hit", "--out", "run", cwd=tmp_path)
    wait_until_listening(process)
    process.send_signal(signal.SIGINT)
    ended = wait_for(process)
    assert is_stopped(ended, signal.SIGINT) and "there is nothing to resume" in ended.err
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("number", NUMBERS)
def test_a_viewer_is_ended_with_its_code_and_a_line(tmp_path, number):
    pytest.importorskip("viser", reason="viser is not installed; it comes with the extra view")
    make_flights(tmp_path / "flights")
    process = start("view", "flights", "--port", "0", cwd=tmp_path)
    assert process.stdout is not None
    while not process.stdout.readline().startswith("Playing 1 flights"):
        assert process.poll() is None
    process.send_signal(number)
    ended = wait_for(process, within=20.0)
    assert is_stopped(ended, number) and "there is nothing to resume" in ended.err
