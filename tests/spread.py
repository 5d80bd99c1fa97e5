"""Run by `test_devices.py` in processes of its own: plans on several devices or processes.

python spread.py devices             needs --xla_force_host_platform_device_count=4
python spread.py process INDEX PORT  of two
"""

import sys

import jax
import numpy as np
from test_solve import Well, WellPlanner

from planner_jax.planning.plan import plan, plan_across_processes

GOALS = np.linspace(-1.0, 5.0, 203).astype(np.float32)


def equal(found, expected):
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(np.asarray(ours), theirs, rtol=1e-5, atol=1e-5)


def on_devices():
    """All of four, three, and one other than the first; from NumPy and from jax arrays."""
    devices = jax.local_devices()
    assert len(devices) == 4
    alone = plan(WellPlanner(), Well(GOALS), devices=devices[:1])
    for some in (None, devices[:3], devices[2:3]):
        for chunk in (None, 16):
            equal(plan(WellPlanner(), Well(GOALS), devices=some, chunk=chunk), alone)
            resident = Well(jax.numpy.asarray(GOALS))
            resident = plan(WellPlanner(), resident, devices=some, chunk=chunk)
            equal(resident, alone)
            assert isinstance(resident.point, jax.Array)
            assert resident.point.sharding.device_set == {(some or devices)[0]}
    even = plan(WellPlanner(), Well(jax.numpy.asarray(GOALS[:200])))
    assert len(even.point.sharding.device_set) == 4
    broken = GOALS.copy()
    broken[::100] = np.nan
    spoiled = plan(WellPlanner(), Well(broken))
    others = np.isfinite(broken)
    clean = plan(WellPlanner(), Well(GOALS))
    np.testing.assert_array_equal(spoiled.point[others], clean.point[others])


def on_processes(index, port):
    """Each of two processes plans its half and has the whole in the end."""
    jax.distributed.initialize(f"127.0.0.1:{port}", num_processes=2, process_id=index)
    alone = plan(WellPlanner(), Well(GOALS))
    equal(plan_across_processes(WellPlanner(), Well(GOALS)), alone)
    try:
        plan_across_processes(WellPlanner(), Well(GOALS[:1]))
    except ValueError as error:
        assert "a lane for each of 2 processes, got 1" in str(error)
    else:
        raise AssertionError("one lane for two processes was accepted")


if __name__ == "__main__":
    if sys.argv[1] == "devices":
        on_devices()
    else:
        on_processes(int(sys.argv[2]), int(sys.argv[3]))
    print("equal")
