import dataclasses
import importlib
import itertools
import json
import time
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from matplotlib.figure import Figure

import planner_jax as pj
from planner_jax import benchmarks
from planner_jax.benchmarks import paper_figures, published_policy
from planner_jax.benchmarks.cost_gap import cost_gaps, gap_figures
from planner_jax.benchmarks.first_plan import ROWS as FIRST_PLANS
from planner_jax.benchmarks.first_plan import plan_in_new_process
from planner_jax.benchmarks.flown_by_rotorpy import model_of, track
from planner_jax.benchmarks.real_time import measure as measure_real_time
from planner_jax.benchmarks.run import Bench
from planner_jax.benchmarks.throughput import report
from planner_jax.core import registry, tasks
from planner_jax.core.errors import ArgumentError
from planner_jax.runs import style

BENCHMARKS = sorted(Path(benchmarks.__path__[0]).glob("*.py"))


@pytest.mark.parametrize("path", BENCHMARKS, ids=lambda path: path.stem)
def test_what_a_benchmark_imports_is_there(path):
    importlib.import_module(f"planner_jax.benchmarks.{path.stem}")


PEER = {
    **{"mass": 0.5, "Ixx": 0.003, "Iyy": 0.004, "Izz": 0.006, "tau_m": 0.02},
    **{"k_eta": 1e-6, "k_m": 2e-8, "rotor_speed_max": 2000.0},
    "rotor_pos": {
        f"r{k}": np.array([x, y, 0.0]) / 8.0
        for k, (x, y) in enumerate(((1, 1), (1, -1), (-1, -1), (-1, 1)), 1)
    },
}


def test_a_robot_of_rotorpy_has_the_thrusts_of_its_plan_and_turns_to_the_feedback():
    robot = model_of("peer", PEER, 5.0, pj.Tool("net", 0.1, 0.1))
    assert [place[0] * place[1] > 0.0 for place in robot.rotors.places] == [True, False] * 2
    assert robot.rotors.max_thrust == pytest.approx(4.0) and robot.rotors.torque_ratio == 0.02
    inertia = np.diag(robot.inertia)
    own = SimpleNamespace(kp_pos=6.0, kd_pos=4.0, kp_att=300.0, kd_att=50.0, TM_to_f=np.eye(4))
    own.mass, own.inertia = robot.mass, inertia
    turned = np.array([0.0, np.sin(0.2), 0.0, np.cos(0.2)])  # x y z w, by 0.4 rad about y
    rate, turning = np.array([1.0, -2.0, 0.5]), np.array([3.0, 4.0, 5.0])
    state = {"x": np.ones(3), "v": np.zeros(3), "q": turned, "w": rate}
    at = SimpleNamespace(pos=np.ones(3), vel=np.zeros(3), quat_xyzw=turned, thrust=12.0)
    at.rate, at.turning = rate, turning
    torque = inertia @ turning + np.cross(rate, inertia @ rate)
    np.testing.assert_allclose(track(own, state, at), [6.0, *torque], rtol=1e-9)
    at.rate = state["w"] = np.zeros(3)
    low = track(own, state | {"x": np.array([1.0, 1.0, 0.9])}, at)
    up = np.array([np.sin(0.4), 0.0, np.cos(0.4)])
    force = 12.0 * up + [0.0, 0.0, 0.6]  # with the feedback 6 / s^2 times 0.1 m
    sine = np.cross(up, force)[1] / np.linalg.norm(force)  # of the turn about y to the force
    expected = [0.5 * force @ up, 0.009, 0.004 * (4.0 + 300.0 * sine), 0.03]
    np.testing.assert_allclose(low, expected, rtol=1e-9)


def read(folder, name="manifest.json"):
    return json.loads((folder / name).read_text())


def test_decisions_are_compared_on_the_same_cases(tmp_path, monkeypatch):
    options = "--suites parabola1 --starts random --num 16 --seeds 2 --trained none --out".split()
    monkeypatch.setattr("sys.argv", ["published_policy", *options, str(tmp_path / "run")])
    published_policy.main()
    rows = {row["decide"]: row["seeds"] for row in read(tmp_path / "run", "rows.json")}
    assert {name: len(seeds) for name, seeds in rows.items()} == {
        **{"greedy": 1, "best": 1, "policy": 1},
        "untrained": 2,
    }
    assert rows["greedy"] == rows["best"] and rows["untrained"][0] != rows["untrained"][1]
    for row in (row for seeds in rows.values() for row in seeds):
        assert 0.0 <= row["referee"] <= row["rule"] and row["rule"] >= 0.5 and row["ratio"] > 0.0
    assert read(tmp_path / "run")["summary"]["num"] == 5 * 16


def test_a_run_folder_says_what_was_run_where_and_with_what_success(tmp_path, capsys):
    with Bench("nothing", {"num": np.int64(4), "from": tmp_path}, tmp_path / "run") as bench:
        bench.say("| a | b |", "|---|---|")
        bench.row(name="one", seconds=np.float32(0.5), ratio=np.nan)
        bench.count(np.array([True, True, False, True]), np.array([0.1, 0.3]), None)
    manifest = read(tmp_path / "run")
    assert (manifest["kind"], manifest["state"]) == ("bench nothing", "complete")
    assert manifest["parameters"] == {"num": 4, "from": str(tmp_path)}
    assert {"versions", "device", "git_commit", "started", "times"} <= manifest.keys()
    assert manifest["summary"]["num"] == 4
    assert manifest["summary"]["success_rate"] == 0.75
    assert manifest["summary"]["cost_gap_median"] == pytest.approx(0.2)
    assert read(tmp_path / "run", "rows.json") == [{"name": "one", "seconds": 0.5, "ratio": None}]
    assert (tmp_path / "run" / "table.md").read_text() == capsys.readouterr().out


def test_what_was_not_measured_is_null(tmp_path):
    with Bench("nothing", {}, tmp_path / "run"):
        pass
    assert read(tmp_path / "run")["summary"] == {"num": 0, "success_rate": None}
    names = ("cost_gap_median", "cost_gap_p90", "cost_gap_p99")
    assert gap_figures(None) == dict.fromkeys(names)


def test_a_run_that_fails_says_so_and_no_run_is_overwritten(tmp_path):
    with pytest.raises(ZeroDivisionError), Bench("nothing", {}, tmp_path / "run"):
        _ = 1 / 0
    assert read(tmp_path / "run")["state"] == "failed"
    with pytest.raises(ArgumentError, match="out must be a new or empty folder"):
        Bench("nothing", {}, tmp_path / "run")


@struct.dataclass
class Number:
    """A case of the simplest possible task: one number."""

    value: jax.Array

    @property
    def batch_shape(self):
        return np.shape(self.value)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Half(pj.Planner):
    """A planner without a search, whose cost is half of the case's number."""

    def solve(self, case, attempt):
        violation = jnp.where(case.value < 3.0, -1.0, 1.0)
        return pj.Plan(**pj.outcome(0.5 * case.value, violation))


def draw(num, suite=None, seed=0, *, first=0):
    return Number(value=jnp.arange(first, first + num, dtype=jnp.float32))


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Third(Half):
    """A planner whose plans cost two thirds of the plans of `Half`."""

    def solve(self, case, attempt):
        plan = super().solve(case, attempt)
        return dataclasses.replace(plan, cost=plan.cost / 1.5)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Slow(Half):
    """A planner that sleeps for 50 ms before it plans the case with the number 1."""

    def solve_on_host(self, cases, attempt):
        time.sleep(0.05 * float(np.max(cases.value == 1.0)))
        return jax.tree.map(np.asarray, jax.vmap(lambda case: self.solve(case, attempt))(cases))


def planner(name="half", **options):
    return {"half": Half, "third": Third}[name](**options)


def judge(cases, plans):
    return pj.Verdict(
        success=np.asarray(plans.violation) <= 0.0,
        failed_limit=np.full(len(cases.value), ""),
        failed_time=np.zeros(len(cases.value)),
        failed_excess=np.zeros(len(cases.value)),
    )


@pytest.fixture
def halving(monkeypatch):
    card = registry.Task("halve", "halves numbers", __name__, {"half": ""}, {"counted": ""})
    monkeypatch.setattr(tasks, "all_tasks", lambda: {"halve": card})


def test_a_case_counts_in_real_time_if_its_own_plan_is_good_and_soon():
    cases = jax.tree.map(np.asarray, draw(4))
    good, soon, times = measure_real_time(Slow(), judge, cases, np.inf)
    assert good.tolist() == [True, True, True, False] and soon.all() and (times > 0.0).all()
    good, soon, times = measure_real_time(Slow(), judge, cases, 45.0)
    assert good.tolist() == [True, True, True, False] and not soon[1] and times[1] >= 50.0
    assert not measure_real_time(Slow(), judge, cases, 0.0)[1].any()


def test_throughput_is_measured_of_any_task(halving, tmp_path, capsys):
    report(task="halve", batch=[4, 8], repeat=1, agree=True, out=tmp_path / "run")
    manifest = read(tmp_path / "run")
    assert (manifest["summary"]["num"], manifest["summary"]["success_rate"]) == (12, 0.5)
    assert manifest["summary"]["cost_gap_median"] is None
    assert [row["success"] for row in read(tmp_path / "run", "rows.json")] == [0.75, 0.375]
    out, err = capsys.readouterr()
    assert "status equal on 100.00 %" in out
    told = [line for line in err.splitlines() if "plans/s" in line or "longer" in line]
    assert "the referee accepts 75.000 %" in told[0] and told[1].startswith("Comparing costs")


def test_costs_without_rounds_are_compared_with_those_of_the_tasks_yardstick():
    card = registry.Task(
        "halve", "halves numbers", __name__, {"half": ""}, {}, yardstick={"name": "third"}
    )
    cases = draw(4, first=1)
    plans = pj.plan(Half(), cases)
    # Both `Half` and `Third` solve only the cases 1 and 2, so costs are compared only there.
    np.testing.assert_allclose(cost_gaps(Half(), cases, plans, card=card), [0.5, 0.5], rtol=1e-6)
    no_yardstick = dataclasses.replace(card, yardstick=None)
    assert cost_gaps(Half(), cases, plans, card=no_yardstick) is None


def test_a_yardstick_for_cases_of_another_class_is_none():
    cases = pj.hit.draw(2)
    plans = pj.plan(pj.hit.planner("bat-fitted"), cases)  # test_baselines compiles it, too.
    assert cost_gaps(Half(), cases, plans, card=tasks.task_named("intercept")) is None


def test_a_planner_without_rounds_has_no_iterations_to_set(halving, tmp_path):
    with pytest.raises(ArgumentError, match="iterations must be left out"):
        report(task="halve", batch=[4], repeat=1, iterations=7, out=tmp_path / "run")


def test_a_second_process_loads_the_programs_of_the_first(tmp_path):
    folder = str(tmp_path / "compiled")
    empty, warm = (plan_in_new_process(FIRST_PLANS["hit"], folder) for _ in range(2))
    assert empty["success"] == warm["success"] == [True]
    assert empty["programs"] >= 1 and warm["cpu"] < 0.8 * empty["cpu"]
    assert 0.0 < warm["again"] < 0.1 * warm["cpu"]


@pytest.mark.parametrize("name", ["ALL", "PAPER"])
def test_pairs_and_solved_programs_are_among_the_compared_speed_planners(name):
    compared = getattr(importlib.import_module("planner_jax.benchmarks.intercept_speed"), name)
    assert {*compared.solved}.union(*compared.pairs) <= compared.planners.keys()
    weights = {planner.end_weight for planner in compared.planners.values()}
    assert weights == ({None, 300.0} if name == "PAPER" else {None})


@pytest.mark.parametrize("name", paper_figures.FIGURES)
def test_a_figure_of_a_paper_has_its_axes_and_the_same_data_each_time(name):
    drawing, again = (paper_figures.FIGURES[name](30, 0) for _ in range(2))
    assert drawing.to_csv() == again.to_csv()
    head, *lines = drawing.to_csv().splitlines()
    assert head == "panel,curve,x,y" and len(lines) == sum(each.x.size for each in drawing.curves)
    with style.context():
        paper_figures.draw_panels(figure := Figure(), drawing)
    shown = {axes.get_title("left"): (axes.get_xlabel(), axes.get_ylabel()) for axes in figure.axes}
    assert shown == drawing.panels
    assert all(np.isfinite([*each.x, *each.y]).all() for each in drawing.curves)


def test_only_the_uniform_drive_of_the_figure_of_speeds_enters_an_obstacle():
    curves = [each for each in paper_figures.draw_speeds(30, 0).curves if each.panel == "station"]
    boxes = [each for each in curves if each.name.startswith(paper_figures.OBSTACLE)]
    lines = {each.name: each for each in curves if each not in boxes}
    met = dict.fromkeys(lines, False)
    for name, box in itertools.product(lines, boxes):
        line, times = lines[name], np.linspace(*box.x[:2], 200)
        station = np.interp(times, line.x, line.y)
        lower, upper = (np.interp(times, box.x[:2], each) for each in (box.y[:2], box.y[:1:-1]))
        met[name] |= bool(((station > lower) & (station < upper)).any())
    assert met == {"uniform": True, "EM": False, "lines of the paper": False}


@pytest.mark.parametrize(
    ("plan", "panels", "judge"),
    [
        (paper_figures.plan_hits, paper_figures.HIT_PANELS, pj.hit.judge),
        (paper_figures.plan_three_catches, paper_figures.CATCH_PANELS, pj.catch.judge),
        (paper_figures.plan_throws, paper_figures.CATCH_PANELS, pj.catch.judge),
    ],
)
def test_the_peaks_of_a_figure_of_flights_are_the_referees(plan, panels, judge):
    flights = plan(30, 0)
    curves = paper_figures.draw_flights(flights, panels).curves
    peaks = {(each.name, each.panel): each.y for each in curves}
    for name, (cases, plans) in flights.items():
        verdict = judge(cases, plans)
        for panel in {"speed", "body rate", "thrust"}.intersection(panels):
            (peak,) = getattr(verdict, f"max_{panel.replace(' ', '_')}")
            assert peaks[name, panel].max() == pytest.approx(peak, rel=1e-3)


def test_the_figure_of_mpp_has_the_time_of_the_planner_catch_and_exceeds_a_limit(monkeypatch):
    flights = paper_figures.plan_throws(30, 0)
    (case, catch), (_, mpp) = flights.values()
    np.testing.assert_array_equal(catch.times, mpp.times)
    assert not pj.catch.judge(case, mpp).success.any()
    good = SimpleNamespace(success=np.ones(30, bool))
    monkeypatch.setattr(pj.catch, "judge", lambda *_, **__: good)
    with pytest.raises(LookupError, match="^no throw of 30 has the required outcomes$"):
        paper_figures.plan_throws(30, 0)


def test_a_figure_of_speeds_without_a_suitable_problem_says_so(monkeypatch):
    free = SimpleNamespace(good=np.ones(1, bool))
    monkeypatch.setattr(paper_figures, "judge", lambda *_: free)
    with pytest.raises(LookupError, match="^no problem of 1 has the required outcomes$"):
        paper_figures.draw_speeds(1, 0)
