"""Batches have the same plans on several simulated devices as on one device."""

import os
import subprocess
import sys
import threading
from unittest.mock import Mock

import chex
import jax
import numpy as np
import pytest
from test_solve import Well, WellProblem

import planner_jax as pj
from planner_jax.core.protocol import BaseAttempt, are_solved
from planner_jax.planning.plan import plan
from planner_jax.planning.programs import sizes_of

GOALS = np.linspace(-1.0, 5.0, 203).astype(np.float32)
SOME = GOALS[::6][:32]
TASKS = ("hit", "catch", "rally", "team", "intercept", "group", "block", "reach")


def test_two_devices_give_the_plans_of_one():
    run_on_devices(2, "compare_two()")


def test_calls_on_gpus_have_less_padding_for_attempts_with_many_starts():
    gpu, planner = Mock(spec=jax.Device, platform="gpu"), pj.intercept.planner()
    few, many = (sizes_of(planner, BaseAttempt(starts=starts), None, gpu) for starts in (1, 128))
    assert [few.next(num) for num in (1, 128, 129)] == [128, 128, 1024]
    assert [list(many.cuts(num)) for num in (1, 64, 70)] == [[(0, 64)], [(0, 64)], [(0, 128)]]


@pytest.mark.slow
def test_several_devices_give_the_plans_of_one():
    run_on_devices(4, "compare_devices()")


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_two_devices_give_the_plans_of_one_for_every_task(name):
    run_on_devices(2, f"compare_task({name!r})")


def run_on_devices(num, call):
    """Run a function of this module in a process with `num` CPU devices."""
    # XLA reads the number of devices when a process starts.
    env = {**os.environ, "XLA_FLAGS": f"--xla_force_host_platform_device_count={num}"}
    command = [sys.executable, "-c", f"from test_devices import *; {call}"]
    there = os.path.dirname(__file__)
    process = subprocess.run(
        command, env=env, cwd=there, capture_output=True, text=True, timeout=560
    )
    assert process.returncode == 0, process.stderr[-2000:]


def require_equal(found, expected):
    chex.assert_trees_all_close(found, expected, rtol=1e-5, atol=1e-5)


def compare_two():
    """Check plans, their devices, and reports of progress on two devices."""
    devices, planner = jax.local_devices(), WellProblem.planner()
    goals = jax.numpy.asarray(SOME)
    both = plan(planner, Well(goals))
    assert both.point.sharding.device_set == set(devices)
    require_equal(both, plan(planner, Well(goals), devices=devices[:1]))
    again = plan(planner, Well(jax.device_put(goals, both.cost.sharding)))
    chex.assert_trees_all_equal(again, both)
    assert again.point.sharding == both.point.sharding
    require_equal(plan(planner, Well(SOME)), both)
    few = plan(planner, Well(goals[:16]))
    assert few.point.sharding.device_set == {devices[0]}
    compare_reports(planner, SOME)


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
    even = plan(planner, Well(jax.numpy.asarray(GOALS[:200])))
    assert len(even.point.sharding.device_set) == 4
    broken = GOALS.copy()
    broken[::100] = np.nan
    spoiled = plan(planner, Well(jax.numpy.asarray(broken)))
    others = np.isfinite(broken)
    clean = plan(planner, Well(jax.numpy.asarray(GOALS)))
    np.testing.assert_array_equal(spoiled.point[others], clean.point[others])


def compare_reports(planner, goals):
    """Check that reports count the cases of all devices, and that a time limit ends all."""
    reports, busy = [], threading.Lock()

    def note(report):
        assert busy.acquire(blocking=False)  # one report at a time
        reports.append(report)
        busy.release()

    plans = plan(planner, Well(goals), progress=note)
    first = [report for report in reports if report.attempt == 1]
    assert first[-1].tried == first[-1].cases == goals.size
    assert [report.tried for report in first] == sorted(report.tried for report in first)
    late = plan(planner, Well(goals), time_limit=0.0)
    is_late = late.status == pj.Status.OUT_OF_TIME
    np.testing.assert_array_equal(is_late, ~are_solved(late))
    assert are_solved(late).sum() < are_solved(plans).sum()


def compare_task(name):
    """Check that the plans of a task on two devices have the bits of its plans on one."""
    devices, task = jax.local_devices(), pj.task_named(name)
    assert len(devices) == 2
    planner, cases = task.planner(), jax.tree.map(np.asarray, task.draw(34, None, seed=3))
    # Plans have the same bits if the compiled calls have the same size.
    alone = plan(planner, cases, devices=devices[:1], chunk=16)
    both = plan(planner, cases, devices=devices, chunk=16)
    np.testing.assert_array_equal(both.status, alone.status)
    chex.assert_trees_all_close(both.cost, alone.cost, rtol=1e-4)
    chex.assert_trees_all_equal(both, alone)
