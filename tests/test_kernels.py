"""Programs that are lowered for CUDA contain the expected GPU kernels; no GPU is needed."""

import re
import sys

import jax
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.cli import doctor
from planner_jax.core.errors import ArgumentError
from planner_jax.lanes import kernels, over_lanes
from planner_jax.optimise.preconditioner import positive_inverse
from planner_jax.optimise.sensitivity import gradient_at
from planner_jax.optimise.settings import Attempt, LbfgsConfig
from planner_jax.runs.environment import require_backend
from planner_jax.task.catch.default_planner import CatchProblem
from planner_jax.task.hit.default_planner import HitProblem

LANES = 128
# Number of GPU kernels by name in the compiled program of one search of the planner of hits.
ATTEMPT = {"flight_table": 1, "integrate_along": 2, "lbfgs_turn": 1, "greatest_along": 1}
# Number of GPU kernels by name in the compiled program that differentiates a plan of a hit.
GRADIENT = {"flight_table": 2, "integrate_along": 2, "positive_inverse": 1}


@pytest.fixture
def gpu(monkeypatch):
    """Simulate a machine with a GPU, for which programs are lowered, but not compiled."""
    monkeypatch.delenv(kernels.SWITCH, raising=False)
    monkeypatch.setattr(kernels, "has_gpu", lambda: True)


def kernels_in(function, *args):
    device = jax.sharding.AbstractDevice("NVIDIA H100", None, "gpu")
    mesh = jax.sharding.AbstractMesh((), (), abstract_device=device)
    with jax.sharding.use_abstract_mesh(mesh):  # later versions of JAX need the kind of GPU
        lowered = jax.jit(function).trace(*args).lower(lowering_platforms=("cuda",))
    names = re.findall(r'\bname = "(\w+)"', lowered.as_text())
    return {name: names.count(name) for name in set(names)}


def attempt_of(planner):
    attempt = Attempt(1, LbfgsConfig(max_steps=2))
    return lambda cases: planner.solve_lanes(cases, attempt)


def serves():
    return jax.tree.map(np.asarray, pj.hit.draw(LANES))


def small():
    return over_lanes(lambda x: positive_inverse(x))


X = np.broadcast_to(np.eye(3, dtype=np.float32)[..., None], (3, 3, LANES))


def test_a_round_of_hits_contains_its_kernels(gpu):
    assert kernels_in(attempt_of(HitProblem.planner()), serves()) == ATTEMPT


@pytest.mark.slow
def test_a_round_of_catches_contains_its_kernels(gpu):
    held = kernels_in(attempt_of(CatchProblem.planner()), pj.catch.draw(LANES, "throws"))
    assert held | {"flight_table": 1} == ATTEMPT and "flight_table" not in held


@pytest.mark.slow
def test_gradients_contain_their_kernels(gpu):
    problem, lanes = HitProblem(), jax.tree.map(lambda leaf: np.moveaxis(leaf, 0, -1), serves())
    starts = jax.vmap(lambda case: problem.guesses(problem.prepare(case), 1)[0], out_axes=-1)

    def gradients(case, point):
        wrt = ("drag", "ball", "limits", "target")
        return gradient_at(problem, case, point, "stroke.time", wrt, steps=2).by

    points = np.asarray(starts(serves()))
    held = kernels_in(over_lanes(gradients), lanes, points)
    assert held == GRADIENT


def test_the_switch_removes_all_kernels(gpu, monkeypatch):
    monkeypatch.setenv(kernels.SWITCH, "on")
    assert kernels_in(small(), X) == {"positive_inverse": 1}
    monkeypatch.setenv(kernels.SWITCH, "off")
    assert kernels_in(small(), X) == {}


def test_without_triton_programs_have_no_kernels_and_the_doctor_reports_it(gpu, monkeypatch):
    monkeypatch.setitem(sys.modules, "jax.experimental.pallas.triton", None)
    monkeypatch.delitem(sys.modules, "planner_jax.lanes.pallas", raising=False)
    assert kernels.kernels() is kernels.Kernels.MISSING
    assert kernels_in(small(), X) == {}
    finding = doctor._kernels()
    assert finding.text.startswith("unavailable") and not finding.good


def test_a_wrong_value_of_the_switch_raises_one_line(monkeypatch):
    monkeypatch.setenv(kernels.SWITCH, "no")
    line = "^PLANNER_JAX_KERNELS must be one of on, off, got 'no'$"
    for call in (lambda: small()(X), kernels.kernels, require_backend):
        with pytest.raises(ArgumentError, match=line):
            call()


def test_the_doctor_reports_the_state_of_kernels(gpu, monkeypatch):
    assert doctor._kernels() == doctor.Finding("kernels", "on")
    monkeypatch.setenv(kernels.SWITCH, "off")
    assert doctor._kernels() == doctor.Finding("kernels", "off, by PLANNER_JAX_KERNELS")
    monkeypatch.setattr(kernels, "has_gpu", lambda: False)
    assert "no GPU" in doctor._kernels().text
