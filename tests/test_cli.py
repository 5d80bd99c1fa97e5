import subprocess
import sys

import jax
import pytest

from planner_jax.sweep import run as sweep_run
from planner_jax.sweep.hit.sweep import HitSweep
from tests.faults.commands import is_one_line, run

HEADER = "number,serve position,serve velocity,landing position,target,hit,velocity,attitude"
GOOD, GONE = "2.5 -0.3 2,-4.3 0.02 7.3", "2.5 -0.3 2,4.3 0.02 7.3"


def trial_file(folder, serve, name="1_1_1_p.csv"):
    folder.mkdir(exist_ok=True)
    row = f"1,{serve},-2.9 -0.3 0,1.75 0 0,failed,failed,failed"
    (folder / name).write_text(f"{HEADER}\n{row}\n")
    return str(folder)


def expect_one_line(arguments, *parts):
    ended = run(*arguments)
    assert is_one_line(ended) and ended.code == 2, ended
    for part in parts:
        assert part in ended.err


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


def test_a_throughput_is_measured_with_what_was_asked_for(elsewhere, monkeypatch):
    asked = {}
    monkeypatch.setattr("planner_jax.benchmarks.throughput.report", lambda **k: asked.update(k))
    code, _, err = run("bench", "throughput", "--task", "catch", "--batch", "4", "8")
    assert (code, err) == (0, "")
    assert asked == {"task": "catch", "batch": [4, 8], "out": None}


@pytest.mark.parametrize("command", [["sweep", "hit", "--num", "0"], ["bench", "throughput", "-x"]])
def test_a_command_that_needs_no_flights_needs_no_extra_of_flights(elsewhere, monkeypatch, command):
    monkeypatch.setitem(sys.modules, "planner_jax.sims.settings", None)
    expect_one_line(command)
    with pytest.raises(ModuleNotFoundError):
        run("fly", "hit")


def test_bad_serves_are_named_by_file_and_line_and_too_few_are_counted(elsewhere, tmp_path):
    nan = trial_file(tmp_path / "nan", "nan -0.3 2,-4.3 0.02 7.3")
    gone = trial_file(tmp_path / "gone", GONE)
    empty = trial_file(tmp_path / "empty", "")
    (tmp_path / "empty" / "1_1_1_p.csv").write_text("")
    for folder, part in [
        (nan, "1_1_1_p.csv:2: serve position must be 3 finite numbers, got 'nan -0.3 2'"),
        (gone, "1_1_1_p.csv:2: serve must land in the hitting half"),
        (empty, "1_1_1_p.csv: file must have a row of numbers"),
    ]:
        expect_one_line(["sweep", "hit", "--serves", folder], "--serves must be sound", part)
    arguments = ["sweep", "hit", "--serves", trial_file(tmp_path / "one", GOOD), "--num", "2"]
    expect_one_line(arguments, "--num must be <= 1", "got 2")
    assert not list(elsewhere.iterdir())


def test_a_folder_in_use_or_out_of_reach_is_refused(elsewhere):
    (elsewhere / "used").mkdir()
    (elsewhere / "used" / "file").touch()
    before = sorted(elsewhere.rglob("*"))
    for out, part in [
        ("used", "--out must be a new or empty folder"),
        ("used/file", "--out must be a folder that can be written"),
        ("used/file/below", "--out must be a folder that can be written"),
        ("/proc/nowhere", "--out must be a folder that can be written"),
    ]:
        expect_one_line(["sweep", "hit", "--num", "1", "--out", out], part, repr(out))
    assert sorted(elsewhere.rglob("*")) == before


@pytest.mark.parametrize("command", [["sweep", "hit"], ["sweep", "catch"], ["bench", "throughput"]])
@pytest.mark.parametrize(
    ("error", "part"),
    [
        (AssertionError(), "got 'cuda' (JAX finds no device of it)"),
        (RuntimeError("no such\nplatform"), "got 'cuda' (no such)"),
    ],
)
def test_a_platform_that_does_not_work_gets_one_line_and_leaves_nothing(
    elsewhere, monkeypatch, command, error, part
):
    def default_backend():
        raise error

    monkeypatch.setattr(jax, "default_backend", default_backend)
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    expect_one_line(command, "JAX_PLATFORMS must name a platform that works here", part)
    assert not list(elsewhere.iterdir())


def test_ctrl_c_says_how_to_resume(elsewhere, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(HitSweep, "plan", interrupt)
    code, out, err = run("sweep", "hit", "--num", "3", "--out", "a run")
    assert code == 130 and out == ""
    expected = "planner-jax: interrupted; finish with: planner-jax sweep hit --resume --out 'a run'"
    assert err.splitlines()[-1] == expected


def test_a_sweep_prints_rate_and_speed_together(elsewhere, monkeypatch):
    asked = {}

    def sweep(task, settings, out, workers):
        asked.update(task=task.name, settings=settings, out=out, workers=workers)
        return {
            "kind": "sweep hit",
            "parameters": {"planner": "exact"},
            "device": {"kind": "cpu", "cpu_count": 2},
            "times": {"compile_seconds": 8.0, "referee_seconds": 1.0, "wall_seconds": 12.0},
            "summary": {
                "num": 10,
                "successes": 9,
                "success_rate": 0.9,
                "wilson_95": [0.6, 0.98],
                "plans_per_second_warm": 4000.0,
                "failed_limits": {"speed": 1},
            },
        }

    monkeypatch.setattr(sweep_run, "start_sweep", sweep)
    arguments = ["--start", "uniform", "--delay", "0.3", "--drag-after-impact", "--seed", "5"]
    code, out, err = run("sweep", "hit", "--num", "10", *arguments)
    assert code == 0 and err == ""
    assert "90.00 % success, 9 of 10" in out and "4,000 plans/s warm" in out
    assert asked["out"].startswith("runs/hit-exact-") and asked["out"] in out
    assert asked["workers"] is None
    settings = asked["settings"]
    assert (asked["task"], settings.planner) == ("hit", "exact")
    assert (settings.start, settings.delay, settings.seed) == ("uniform", 0.3, 5)
    assert settings.drag_after_impact


@pytest.mark.parametrize(
    ("task", "parts"),
    [
        ("hit", ("--planner NAME", "default: exact", "default: -3 0 1.5", "runs/hit-PLANNER")),
        ("catch", ("--suite NAME", "triangle3, hexagon6", "default: best", "runs/catch-PLANNER")),
    ],
)
def test_help_names_the_defaults_and_loads_no_jax(task, parts):
    script = (
        "import sys; from planner_jax.cli.main import main\n"
        f"try: main(['sweep', '{task}', '--help'])\n"
        "except SystemExit: pass\n"
        "sys.exit('jax' in sys.modules or 'numpy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    said = " ".join(done.stdout.split())  # Line breaks are removed.
    for part in parts:
        assert part in said


@pytest.mark.parametrize(
    "module", ["sims.run", pytest.param("policies.training", marks=pytest.mark.slow)]
)
def test_imports_of_commands_print_nothing(module):
    script = f"import planner_jax.{module}"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_the_version_is_printed():
    code, out, _ = run("--version")
    assert code == 0 and out.startswith("planner-jax ")
