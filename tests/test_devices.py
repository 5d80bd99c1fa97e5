"""Batches have the same plans on several simulated devices as on one device."""

import os
import subprocess
import sys

import chex
import jax
import numpy as np
import pytest
from test_solve import Well, WellProblem

from planner_jax.planning.plan import plan

GOALS = np.linspace(-1.0, 5.0, 203).astype(np.float32)


@pytest.mark.slow
def test_several_devices_give_the_plans_of_one():
    # XLA reads the number of devices when a process starts.
    env = {**os.environ, "XLA_FLAGS": "--xla_force_host_platform_device_count=4"}
    command = [sys.executable, __file__]
    process = subprocess.run(command, env=env, capture_output=True, text=True, timeout=240)
    assert process.returncode == 0, process.stderr[-2000:]
    assert process.stdout.endswith("equal\n")


def require_equal(found, expected):
    chex.assert_trees_all_close(found, expected, rtol=1e-5, atol=1e-5)


def compare_devices():
    """Check that plans on four, on three, and on the third device equal plans on the first."""
    devices = jax.local_devices()
    assert len(devices) == 4
    planner = WellProblem.planner()
    alone = plan(planner, Well(GOALS), devices=devices[:1])
    for some in (None, devices[:3], devices[2:3]):
        for chunk in (None, 16):
            require_equal(plan(planner, Well(GOALS), devices=some, chunk=chunk), alone)
            resident = Well(jax.numpy.asarray(GOALS))
            resident = plan(WellProblem.planner(), resident, devices=some, chunk=chunk)
            require_equal(resident, alone)
            assert isinstance(resident.point, jax.Array)
            assert resident.point.sharding.device_set == {(some or devices)[0]}
    even = plan(WellProblem.planner(), Well(jax.numpy.asarray(GOALS[:200])))
    assert len(even.point.sharding.device_set) == 4
    broken = GOALS.copy()
    broken[::100] = np.nan
    spoiled = plan(WellProblem.planner(), Well(broken))
    others = np.isfinite(broken)
    clean = plan(WellProblem.planner(), Well(GOALS))
    np.testing.assert_array_equal(spoiled.point[others], clean.point[others])


if __name__ == "__main__":
    compare_devices()
    print("equal")
