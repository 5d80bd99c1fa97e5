"""Run by `test_devices.py` in a process of its own: plans on several devices.

It needs --xla_force_host_platform_device_count=4.
"""

import jax
import numpy as np
from test_solve import Well, WellPlanner

from planner_jax.planning.plan import plan

GOALS = np.linspace(-1.0, 5.0, 203).astype(np.float32)


def equal(found, expected):
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(np.asarray(ours), theirs, rtol=1e-5, atol=1e-5)


def on_devices():
    """Compare plans on all of four devices, on three, and on one other than the first."""
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


if __name__ == "__main__":
    on_devices()
    print("equal")
