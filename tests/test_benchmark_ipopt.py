import dataclasses
import functools
import importlib.util
import json
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.benchmarks import ipopt
from planner_jax.core.missing_extra import install_line
from planner_jax.cost.along import BETWEEN_NODES

HAS_CASADI = importlib.util.find_spec("casadi") is not None
needs_casadi = pytest.mark.skipif(not HAS_CASADI, reason=f"no casadi: {install_line('oracle')}")
if HAS_CASADI:
    from planner_jax.benchmarks.ipopt_peer.peer import Peer
    from planner_jax.benchmarks.ipopt_peer.program import Program

TASKS = ("hit", "catch")


@functools.cache
def setup(name):
    return ipopt.Setup(name, 3, 5)


@functools.cache
def points(name):
    starts = setup(name).batches["smooth"].starts
    return starts + 0.6 * np.random.default_rng(0).normal(size=starts.shape)


@functools.cache
def program(name, penalised):
    problem = setup(name).module.make_problem(setup(name).planner)
    return Program(problem, penalised, BETWEEN_NODES)


def array(matrix):
    return np.asarray(matrix, float)


@needs_casadi
@pytest.mark.parametrize("name", TASKS)
def test_objective_and_greatest_excess_are_those_of_the_planner(name):
    task, written = setup(name), program(name, True)
    with jax.enable_x64(True):
        found = task._objective(jnp.asarray(points(name)), task.contexts)
    params = task.batches["smooth"].params
    pairs = list(zip(points(name), params, strict=True))
    values = [float(written.functions[0](*each)[0]) for each in pairs]
    worst = [float(written.worst(*each)) for each in pairs]
    np.testing.assert_allclose(values, found.cost, rtol=1e-12)
    np.testing.assert_allclose(np.array(worst) + BETWEEN_NODES, found.violation, rtol=1e-12)
    assert max(worst) > 0.0


@needs_casadi
@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("penalised", (True, False))
def test_derivatives_are_those_of_finite_differences(name, penalised):
    written, params = program(name, penalised), setup(name).batches["smooth"].params[0]
    nlp, gradient, jacobian, hessian = written.functions
    point, step = points(name)[0], 1e-5
    multipliers = np.random.default_rng(1).uniform(size=written.num_constraints)

    def slope(x):
        by_g = array(jacobian(x, params)[1]).T @ multipliers if not penalised else 0.0
        return array(gradient(x, params)[1]).ravel() + by_g

    def value(x):
        f, g = nlp(x, params)
        return float(f) + (array(g).ravel() @ multipliers if not penalised else 0.0)

    sides = [(point + step * unit, point - step * unit) for unit in np.eye(point.size)]
    slopes = [(value(more) - value(less)) / (2.0 * step) for more, less in sides]
    bends = [(slope(more) - slope(less)) / (2.0 * step) for more, less in sides]
    upper = array(hessian(point, params, 1.0, multipliers))
    whole = upper + np.triu(upper, 1).T
    np.testing.assert_allclose(slopes, slope(point), atol=1e-6 * np.abs(slopes).max())
    np.testing.assert_allclose(bends, whole, atol=1e-6 * np.abs(whole).max())


@needs_casadi
@pytest.mark.parametrize("name", TASKS)
def test_with_limits_as_constraints_it_costs_no_more_than_the_planner_and_the_referee_accepts(name):
    task = setup(name)
    starts = task.batches["learned"]
    unit = task.cost(task.plans(starts.starts)).mean()
    peer = Peer(task.module, task.planner, "limits", unit, compiled=False)
    setting = (1e-6, {"mu_strategy": "adaptive"}, False)
    found = peer.solve(setting, starts)
    plans = task.plans(found.points)
    assert found.converged.all() and task.judge(plans).all()
    ours = pj.plan(task.card.planner("exact", **task.card.bench), task.cases)
    assert (task.cost(plans) <= task.cost(ours) * (1.0 + 1e-6)).all()
    paths = peer.iterates(setting, starts)
    assert [len(path) - 1 for path in paths] == found.steps.tolist()
    np.testing.assert_allclose([path[-1] for path in paths], found.points, atol=1e-6)
    run = ipopt.Found("planner", task.cost(ours), ours.cost, np.ones(3, bool), np.ones(3))
    seconds, reached = ipopt.seconds_to(task, peer, paths, found.seconds, run)
    assert reached.all() and (seconds <= found.seconds).all() and (seconds > 0.0).all()
    free = dataclasses.replace(run, cost=np.zeros(3))
    never = ipopt.seconds_to(task, peer, paths, found.seconds, free)
    np.testing.assert_array_equal(never[0], found.seconds)
    assert not never[1].any()


def test_without_casadi_it_ends_with_the_line_that_installs_it(monkeypatch, capsys):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr("sys.argv", ["ipopt"])
    with pytest.raises(SystemExit) as ended:
        ipopt.main()
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert said == f"benchmarks.ipopt needs casadi: {install_line('oracle')}\n"


@needs_casadi
@pytest.mark.slow
def test_a_run_has_a_row_for_every_setting_solver_and_effort(monkeypatch, tmp_path):
    monkeypatch.setattr(os, "sched_setaffinity", lambda *_: None)  # Do not bind this process.
    few = {"num": 2, "tune": 2, "repeat": 1, "batch": 16, "tasks": "hit", "out": tmp_path / "run"}
    monkeypatch.setattr("sys.argv", ["ipopt", *(f"--{name}={few[name]}" for name in few)])
    ipopt.main()
    rows = json.loads((tmp_path / "run" / "rows.json").read_text())
    kinds = [row["what"] for row in rows]
    assert (kinds.count("solver"), kinds.count("equal gap")) == (7, 12)
    assert sum(row.get("chosen", False) for row in rows) == 2
    summary = json.loads((tmp_path / "run" / "manifest.json").read_text())["summary"]
    assert summary["num"] == 6 and summary["success_rate"] == 1.0
    assert summary["cost_gap_median"] >= 0.0
    assert summary["hit_best_over_ipopt_penalties_smooth"] > 0.0
