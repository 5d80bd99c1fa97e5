"""A batch on several devices has the plans of one device."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("spread.py")


@pytest.mark.slow
def test_several_devices_give_the_plans_of_one():
    flags = "--xla_force_host_platform_device_count=4"
    process = subprocess.run(
        [sys.executable, str(SCRIPT)],
        env={**os.environ, "XLA_FLAGS": flags},
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert process.returncode == 0, process.stderr[-2000:]
    assert process.stdout.endswith("equal\n")
