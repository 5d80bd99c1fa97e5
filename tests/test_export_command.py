import socket
import threading
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from flown_plans import PLANS, bag, export_plan, quadrotor

import planner_jax as pj
from planner_jax.cli.main import main
from planner_jax.core.errors import ArgumentError
from planner_jax.core.plan_files import PlanFileError, load_fitting
from planner_jax.export.setpoints import load_plan
from planner_jax.robot.car import CarPlan
from planner_jax.robot.quadrotor import QuadrotorPlan
from planner_jax.runs import columns as known
from planner_jax.runs.run_folder import RunFolder
from planner_jax.runs.source import Chunk
from planner_jax.sweep import rows as sweep_rows
from planner_jax.sweep.block.columns import COLUMNS as BLOCK
from planner_jax.sweep.catch.columns import COLUMNS as CATCH
from planner_jax.sweep.hit.columns import COLUMNS as HIT
from planner_jax.sweep.intercept.columns import COLUMNS as INTERCEPT
from planner_jax.sweep.rows import read_plan
from planner_jax.task.hit.plan import HitPlan
from tests.sweeps import write_rows
from tests.trees import assert_same

NUM = 3
TASKS = {"hit": ("quadrotor", HIT), "catch": ("quadrotor", CATCH)}
TASKS |= {"intercept": ("car", INTERCEPT), "block": ("arm", BLOCK)}
READ = {"index", "success", "sentence", "cost", "violation", "iterations", "status"}
READ |= {"durations", "coeffs", "meeting_time", "start", "speed", "curvature"}
READ |= {"motion_coeffs", "motion_durations"}


def batch(robot):
    """Return a batch of three different plans for a robot, of which the last is not solved."""

    def scale(place, leaf):
        """Return three factors times an array, but the same durations, so that pieces meet."""
        factors = (1.0, 1.0, 1.0) if "durations" in str(place[-1]) else (1.0, 0.75, 0.5)
        return np.stack([factor * leaf for factor in factors]).astype(leaf.dtype)

    plans = jax.tree_util.tree_map_with_path(scale, PLANS[robot])
    if robot == "quadrotor":  # All plans of a run have the same gravity.
        plans = plans.replace(gravity=np.full(NUM, 9.81, np.float32))
    return plans.replace(status=np.array([0, 1, 2], np.int32))


def write_run(folder, task="hit", *, finished=True):
    """Write the folder of a run of three plans, with the columns that are needed to read a plan."""
    robot, columns = TASKS[task]
    plans = batch(robot)
    success, sentence = np.array([True, False, False]), lambda k: f"plan {k} is too fast"
    verdict = SimpleNamespace(success=success, sentence=sentence)
    cases = SimpleNamespace(start=getattr(plans, "start", None))
    refereed = known.RefereedBatch(Chunk(np.arange(NUM), cases), plans, verdict)
    names = READ if robot == "car" else READ - {"start"}
    rows = known.rows_of([each for each in columns if each.name in names], refereed, "world")
    return write_rows(folder, rows, kind=f"sweep {task}", is_finished=finished)


@pytest.mark.parametrize("task", TASKS)
def test_a_row_is_read_back_bit_for_bit_with_what_the_referee_says(tmp_path, task):
    run, plans = write_run(tmp_path / "run", task), batch(TASKS[task][0])
    for row in range(NUM):
        plan, sentence = read_plan(run, row)
        assert_same(plan, pj.take(plans, row))
        assert sentence == ("" if row == 0 else f"plan {row} is too fast")


def test_a_row_that_is_not_there_and_a_run_that_is_not_finished_or_damaged_or_of_flights(tmp_path):
    run = write_run(tmp_path / "run")
    for row in (-1, 3, None):
        shown = "nothing" if row is None else row
        with pytest.raises(ArgumentError, match=f"^row must be from 0 to 2, got {shown}$"):
            read_plan(run, row)
    with pytest.raises(ArgumentError, match="^RUN must be finished, got .*; resume it first$"):
        read_plan(write_run(tmp_path / "half", finished=False), 0)
    run = write_run(tmp_path / "damaged")
    (part,) = run.plans.files()
    content = bytearray(part.read_bytes())
    content[len(content) // 2] ^= 0xFF
    part.write_bytes(content)
    with pytest.raises(ArgumentError, match="^RUN must be a run whose plans/part-000000-"):
        read_plan(run, 0)
    flown = RunFolder(tmp_path / "flown", name="RUN")
    manifest = {"kind": "fly hit", "state": "running", "parameters": {}}
    with flown.create({**manifest, "seed": 0, "device": {}, "loop": {}}):
        pass
    with pytest.raises(ArgumentError, match="^RUN must be the folder of a sweep, got a fly hit$"):
        read_plan(flown, 0)


@pytest.mark.parametrize("robot", PLANS)
def test_a_saved_batch_is_read_as_what_its_robot_knows(tmp_path, robot):
    plans = batch(robot)
    plans.save(tmp_path / "a.npz")
    for row in range(NUM):
        plan = load_plan(tmp_path / "a.npz", row)
        assert type(plan) is type(plans)
        assert_same(plan, pj.take(plans, row))


def test_fields_of_a_task_are_left_out_and_files_of_something_else_are_refused(tmp_path):
    vector, number = np.zeros(3, np.float32), np.float32(0.0)
    stroke = pj.hit.Stroke(number, vector, vector, vector, vector, number)
    plan = quadrotor()
    HitPlan(**vars(plan), stroke=stroke).save(tmp_path / "a.npz")
    read = load_plan(tmp_path / "a.npz")
    assert type(read) is QuadrotorPlan
    assert_same(read, plan)
    pj.Plan(plan.cost, plan.violation, plan.iterations, plan.status).save(tmp_path / "a.npz")
    says = "^path must be a file of QuadrotorPlan or CarPlan of version 1, got Plan of version 1 in"
    with pytest.raises(PlanFileError, match=says):
        load_fitting(tmp_path / "a.npz", [QuadrotorPlan, CarPlan])
    batch("quadrotor").replace(gravity=np.ones(2, np.float32)).save(tmp_path / "a.npz")
    with pytest.raises(PlanFileError, match="^path must hold as much of every plan, got"):
        load_plan(tmp_path / "a.npz", 1)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_run(tmp_path / "run")
    write_run(tmp_path / "arms", "block")
    block = jax.tree.map(np.asarray, pj.block.case((9.0, 0.5, 0.3), (-8.0, -0.4, 5.4)))
    monkeypatch.setattr(sweep_rows, "case_of_row", lambda folder, row: block)
    batch("quadrotor").save("three.npz")
    quadrotor().save("one.npz")
    return tmp_path


def run_export(capsys, words, recovery="none"):
    """Run `planner-jax export`; return its exit code, and what it wrote to stdout and stderr."""
    try:
        code = main(["export", *words.split(), *(["--recovery", recovery] if recovery else [])])
    except SystemExit as stop:
        code = stop.code
    return code, *capsys.readouterr()


@pytest.mark.parametrize(
    ("words", "name"),
    [
        ("run --row 0 --to csv", "run-0-csv.csv"),
        ("run --row 0 --to px4 --rate 50", "run-0-px4.tlog"),
        ("run --row 0 --to crazyflie --out b.bin", "b.bin"),
        ("arms --row 0 --to csv", "arms-0-csv.csv"),
        ("arms --row 0 --to urscript", "arms-0-urscript.script"),
        ("three.npz --row 1 --to csv", "three-1-csv.csv"),
        ("one.npz --to csv --out a.csv", "a.csv"),
    ],
)
def test_a_plan_is_written_and_its_file_is_named(capsys, here, words, name):
    before = set(here.iterdir())
    assert run_export(capsys, words) == (0, f"{name}\n", "")
    assert {path.name for path in set(here.iterdir()) - before} == {name}
    assert (here / name).stat().st_size > 0


def test_a_row_is_written_as_pj_export_writes_it_and_a_plan_that_fails_with_a_warning(capsys, here):
    assert run_export(capsys, "run --row 0 --to px4 --out a.csv --rate 25")[0] == 0
    export_plan(pj.take(batch("quadrotor"), 0), to="px4", out="b.csv", rate=25.0)
    assert (here / "a.csv").read_bytes() == (here / "b.csv").read_bytes()
    warning = "planner-jax: warning: row 1 fails the referee: plan 1 is too fast\n"
    assert run_export(capsys, "run --row 1 --to csv") == (0, "run-1-csv.csv\n", warning)


def test_an_arm_that_ends_moving_is_reported_and_its_joints_are_named(capsys, here):
    code, out, err = run_export(capsys, "arms --row 0 --to ros2 --joint-names a,b,c,d,e,f")
    assert (code, out) == (0, "arms-0-ros2.mcap\n")
    assert err.startswith("planner-jax: warning: the plan ends at ") and err.count("\n") == 1
    assert bag(here / out.strip())[1][0][3].joint_names == list("abcdef")
    for names, shown in (("a,b", "('a', 'b')"), ("a,a,c,d,e,f", "('a', 'a', ")):
        code, _, err = run_export(capsys, f"arms --row 0 --to csv --joint-names {names}")
        says = f"planner-jax: error: --joint-names must be 6 different names, got {shown}"
        assert code == 2 and err.startswith(says) and err.count("\n") == 1
    code, _, err = run_export(capsys, "run --row 0 --to csv --joint-names a")
    assert code == 2 and "--joint-names must be left out but for arms, got ['a']" in err


def test_setpoints_are_sent_to_a_port(capsys, here):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(5.0)
        packets = []
        hear = threading.Thread(target=lambda: packets.extend(ear.recv(300) for _ in range(21)))
        hear.start()
        result = run_export(capsys, f"run --row 0 --to px4 --udp {ear.getsockname()[1]} --rate 50")
        hear.join()
    assert result == (0, "21 setpoints sent\n", "") and len(packets) == 21


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("run --row 0", "the following arguments are required: --to"),
        (
            "run --row 0 --to cvs",
            "--to must be one of csv, ros2, urscript, px4, crazyflie, got 'cvs'; did",
        ),
        ("run --to csv", "--row must be from 0 to 2, got nothing"),
        ("run --row 2 --to csv", "plan must be solved, got the status INFEASIBLE: stationary with"),
        ("arms --row 0 --to px4", "--to must be a format for plans of the arm, got 'px4'"),
        ("run --row 0 --to csv --rate 1e9", "--rate must be from "),
        ("run --row 0 --to csv --out old.csv", "--out must be a new file, got 'old.csv'"),
        ("run --row 0 --to csv --out one.npz", "--out must end in .csv for csv, got 'one.npz'"),
        ("run --row 0 --to csv --udp 9", "--udp must not be given for csv, only for px4, got 9"),
        ("run --row 0 --to px4 --udp 9 --out a.tlog", "--udp must not be given with --out, got 9"),
        ("one.npz --row 0 --to csv", "--row must not be given for a file of one plan, got 0"),
        ("three.npz --row 3 --to csv", "--row must be from 0 to 2, got 3"),
        ("gone --to csv", "RUN must be the folder of a sweep or a file of plans, got 'gone'"),
        (". --row 0 --to csv", "RUN must be the folder of a run, with its manifest.json"),
        ("run/manifest.json --to csv", "RUN must be a whole file of plans, got"),
    ],
)
def test_what_cannot_be_exported_is_refused_in_one_line_and_leaves_nothing(
    capsys, here, words, says
):
    (here / "old.csv").write_text("mine")
    before = sorted(here.rglob("*"))
    code, out, err = run_export(capsys, words)
    assert (code, out) == (2, "")
    assert err.startswith(f"planner-jax: error: {says}") and err.count("\n") == 1
    assert sorted(here.rglob("*")) == before and (here / "old.csv").read_text() == "mine"
