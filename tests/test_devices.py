"""One batch on several devices and in several processes gives the plans of one device."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("spread.py")


def start(*arguments, devices=1):
    flags = f"--xla_force_host_platform_device_count={devices}"
    return subprocess.Popen(
        [sys.executable, str(SCRIPT), *map(str, arguments)],
        env={**os.environ, "XLA_FLAGS": flags},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process):
    output, errors = process.communicate(timeout=240)
    assert process.returncode == 0, errors[-2000:]
    assert output.endswith("equal\n")


@pytest.mark.slow
def test_several_devices_give_the_plans_of_one():
    finish(start("devices", devices=4))


@pytest.mark.slow
def test_two_processes_give_the_plans_of_one():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    pair = [start("process", index, port) for index in range(2)]
    for process in pair:
        finish(process)
