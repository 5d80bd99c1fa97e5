import dataclasses
import functools
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import double

import planner_jax as pj
from planner_jax.core.protocol import is_solved
from planner_jax.lanes import kernels, over_lanes
from planner_jax.optimise.multistart import minimise
from planner_jax.optimise.sensitivity import gradient_at
from planner_jax.optimise.settings import Attempt, LbfgsConfig
from planner_jax.planning.plan import plan
from planner_jax.task.catch.suites import draw
from planner_jax.task.hit.default_planner import HitProblem
from planner_jax.task.hit.suites import generate_serves, to_cases

pytestmark = pytest.mark.gpu

LANES = 256


@pytest.fixture(scope="module")
def devices():
    assert jax.default_backend() == "gpu"
    return jax.devices()[0], jax.devices("cpu")[0]


@pytest.fixture(scope="module")
def serves():
    return jax.tree.map(np.asarray, to_cases(generate_serves(LANES, 0)))


def run(device, function, *args):
    with jax.default_device(device):
        return jax.tree.map(np.asarray, function(*jax.device_put(args, device)))


def test_hits_are_those_of_a_cpu(devices, serves):
    ours, theirs = (
        run(device, lambda s, d=device: plan(HitProblem.planner(), s, devices=[d]), serves)
        for device in devices
    )
    np.testing.assert_array_equal(ours.status, theirs.status)
    assert is_solved(ours.status).all()
    np.testing.assert_allclose(ours.stroke.time, theirs.stroke.time, atol=1e-3)


def test_compiled_programs_hold_their_kernels(devices, serves):
    attempt = Attempt(1, LbfgsConfig(max_steps=2))
    hits = jax.jit(lambda cases: HitProblem.planner().solve_lanes(cases, attempt))
    program = hits.lower(jax.device_put(serves, devices[0])).compile().as_text()
    assert program.count('custom_call_target="__gpu$xla.gpu.triton"') >= 5


WITHOUT_KERNELS = """
import sys
import jax, numpy as np
from planner_jax.lanes import kernels
from planner_jax.task.hit.default_planner import HitProblem
from planner_jax.task.hit.suites import generate_serves, to_cases
from planner_jax.planning.plan import plan

assert jax.default_backend() == "gpu" and kernels.kernels() is kernels.Kernels.OFF
cases = jax.tree.map(np.asarray, to_cases(generate_serves(int(sys.argv[1]), 0)))
plans = plan(HitProblem.planner(), cases, devices=jax.devices()[:1])
np.savez(sys.argv[2], status=plans.status, time=plans.stroke.time)
"""


def test_hits_are_those_of_a_process_without_kernels(devices, serves, tmp_path):
    without = tmp_path / "plans.npz"
    off = {kernels.SWITCH: "off", "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    command = [sys.executable, "-c", WITHOUT_KERNELS, str(LANES), str(without)]
    subprocess.run(command, env={**os.environ, **off}, check=True)
    ours = plan(HitProblem.planner(), serves, devices=devices[:1])
    with np.load(without) as theirs:
        np.testing.assert_array_equal(ours.status, theirs["status"])
        np.testing.assert_allclose(ours.stroke.time, theirs["time"], atol=1e-3)


def test_catches_are_those_of_a_cpu(devices):
    throws = draw(LANES, "throws", 0)
    planner = pj.catch.planner(decide="greedy")
    ours, theirs = (
        run(device, lambda s, d=device: plan(planner, s, devices=[d]), throws) for device in devices
    )
    np.testing.assert_array_equal(ours.status, theirs.status)
    np.testing.assert_allclose(ours.times, theirs.times, atol=2e-2)
    assert np.quantile(np.abs(ours.times - theirs.times), 0.95) < 1e-4


def test_gradients_at_the_same_points_are_those_of_a_cpu(devices, serves):
    problem = HitProblem()
    lanes = jax.tree.map(lambda leaf: np.moveaxis(leaf, 0, -1), serves)

    @jax.jit
    def optima(cases):
        contexts = over_lanes(problem.prepare)(cases)
        starts = over_lanes(lambda context: problem.guesses(context, 1)[0])(contexts)
        config = LbfgsConfig(max_steps=60)
        search = lambda start, c: minimise(lambda x: problem.objective(x, c), start, config)  # noqa: E731
        return jax.vmap(search, in_axes=-1, out_axes=-1)(starts, contexts).point

    @jax.jit
    @over_lanes
    def gradients(case, point):
        by = ("drag", "ball", "limits", "target")
        return gradient_at(problem, case, point, "stroke.time", by, steps=2).by

    points = run(devices[1], optima, lanes)
    ours, theirs = (run(device, gradients, lanes, points) for device in devices)
    with jax.enable_x64(True):
        exact = run(devices[1], gradients, *double((lanes, points)))
    is_there = [np.isfinite(by["drag"]) for by in (ours, theirs, exact)]
    assert (is_there[0] == is_there[1]).mean() > 0.98
    all_three = np.all(is_there, axis=0)
    assert all_three.mean() > 0.9

    def off(found, expected):
        return np.quantile(np.abs(found - expected)[..., all_three], 0.95)

    for found, other, expected in zip(*map(jax.tree.leaves, (ours, theirs, exact)), strict=True):
        size = np.abs(expected[..., all_three]).max()
        assert off(found, expected) <= 3.0 * off(other, expected) + 1e-5 * size
        assert off(found, other) <= 1e-3 * size


def test_several_gpus_give_the_plans_of_one(devices, serves):
    gpus = jax.devices("gpu")
    if len(gpus) == 1:
        pytest.skip("there is one GPU")
    planner = HitProblem.planner()
    first = Attempt(1, LbfgsConfig(max_steps=0))  # the guess itself
    planner = dataclasses.replace(planner, attempts=(first, *planner.attempts))
    some = jax.tree.map(lambda leaf: jax.device_put(leaf[:-3], gpus[0]), serves)
    begun = plan(dataclasses.replace(planner, attempts=(first,)), some, devices=gpus[:1])
    assert not is_solved(begun.status).all()
    one, all_of_them = (plan(planner, some, devices=used) for used in (gpus[:1], gpus))
    assert is_solved(one.status).all()
    np.testing.assert_array_equal(all_of_them.status, one.status)
    np.testing.assert_allclose(all_of_them.stroke.time, one.stroke.time, atol=1e-4)


def test_lanes_that_are_not_finite_change_no_bit_of_the_others(devices):
    serves = to_cases(generate_serves(8192, 1))
    broken = np.arange(8192) % 100 == 7
    spoiled = serves.replace(drag=jnp.where(broken, jnp.nan, serves.drag))
    hits = functools.partial(plan, HitProblem.planner(), devices=[devices[0]])
    clean, others = (run(devices[0], hits, each) for each in (serves, spoiled))
    for ours, theirs in zip(jax.tree.leaves(clean), jax.tree.leaves(others), strict=True):
        np.testing.assert_array_equal(ours[~broken], theirs[~broken])
    assert not is_solved(others.status[broken]).any()
