"""Tests of runs on a Ray cluster, for which most tests substitute an object without processes."""

import dataclasses
import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

import planner_jax as pj
from planner_jax.cli.main import main
from planner_jax.core.errors import ArgumentError
from planner_jax.core.missing_extra import MissingExtra, install_line
from planner_jax.host import machine
from planner_jax.runs.run_folder import RunFolder
from planner_jax.runs.settings import WorkersFailed
from planner_jax.sweep import cluster, run
from planner_jax.sweep.chunks import Maker
from planner_jax.sweep.hit.settings import HitSettings
from planner_jax.sweep.hit.sweep import HitSweep
from planner_jax.sweep.run import SweepInterrupted, resume_sweep, start_sweep
from tests.faults.commands import children_of
from tests.faults.quick import quick_sweeps
from tests.sweeps import rows_of, stop_after

TASK = pj.task_named("hit")
NUM, BATCH = 64, 13  # Numbers of cases and of cases in a chunk, which give five chunks.
SETTINGS = HitSettings(num=NUM, batch=BATCH, seed=3)
SWEEP = [sys.executable, "-m", "planner_jax", "sweep", "hit"]
COMMAND = f"sweep hit --num {NUM} --batch {BATCH} --seed 3".split()


class RayError(Exception):
    """Error of Ray if a worker process dies too often."""


class RayTaskError(RayError):
    """Error of Ray if a task raises an exception."""

    def __init__(self, cause):
        super().__init__("a long traceback\nof many lines")
        self.cause = cause


class StandIn:
    """Object in place of the module ray, which runs tasks in reverse order in this process."""

    exceptions = SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError)

    def __init__(self):
        self.deaths, self.done, self.begun, self.ended, self.options = {}, [], [], 0, {}
        self.resources = {"CPU": 2.0}
        self._waiting, self._found = {}, {}

    def init(self, **how):
        self.begun.append(how)

    def shutdown(self):
        self.ended += 1

    def cluster_resources(self):
        return self.resources

    def put(self, value):
        return value

    def remote(self, **options):
        self.options = options

        def task_of(function):
            def remote(order, number):
                self._waiting[number] = (function, order)
                return number

            return SimpleNamespace(remote=remote)

        return task_of

    def wait(self, asked, timeout):
        while self._waiting:
            number = next(reversed(self._waiting))
            self._found[number] = self._outcome(number, *self._waiting.pop(number))
        return asked, []

    def _outcome(self, number, function, order):
        if self.deaths.get(number, 0) > self.options["max_retries"]:
            return RayError("a worker died\nas did others")
        self.done.append(number)
        try:
            return function(order, number)
        except Exception as error:
            return RayTaskError(error)

    def get(self, number):
        found = self._found.pop(number)
        if isinstance(found, Exception):
            raise found
        return found


def start(out, settings=SETTINGS):
    return start_sweep(TASK, settings, out, progress=False, workers="ray")


@pytest.fixture
def out(tmp_path):
    return tmp_path / "run"


@pytest.fixture(autouse=True, scope="module")
def quick():
    with quick_sweeps():
        yield


@pytest.fixture(autouse=True)
def ray(monkeypatch, request):
    """Replace the module ray, except in tests of a real cluster."""
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    names = "NPROC PJRT_NPROC RAY_USAGE_STATS_ENABLED RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER "
    names += "XLA_PYTHON_CLIENT_PREALLOCATE XLA_CLIENT_MEM_FRACTION CUDA_VISIBLE_DEVICES"
    for name in names.split():
        monkeypatch.setenv(name, "1")  # The value is restored after the test.
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    monkeypatch.setattr(run, "write_report", lambda folder: None)
    cluster._maker_of.cache_clear()
    if "real_cluster" in request.node.name:
        return None
    stand_in = StandIn()
    monkeypatch.setitem(sys.modules, "ray", stand_in)
    return stand_in


def test_rows_are_those_of_a_plain_run_in_whatever_order_they_are_made(finished, out, ray):
    manifest = start(out)
    assert ray.done == [3, 2, 1, 0, 4]  # Each worker starts with two.
    assert rows_of(out) == rows_of(finished[0])
    assert manifest["run"] == finished[1]["run"]
    assert manifest["sessions"][0]["workers"] == "ray"
    assert manifest["summary"]["successes"] == finished[1]["summary"]["successes"]
    assert ray.ended == 1


def test_a_cluster_that_is_begun_is_of_this_machine_alone_and_tells_nobody(out, ray):
    start(out)
    (how,) = ray.begun
    assert how["address"] == "local" and how["_node_ip_address"] == "127.0.0.1"
    assert how["include_dashboard"] is False
    assert how["num_cpus"] == len(os.sched_getaffinity(0))
    assert not os.path.exists(how["_temp_dir"])
    assert os.environ["RAY_USAGE_STATS_ENABLED"] == "0"


def test_a_cluster_is_joined_by_its_address_where_something_answers(monkeypatch, out, ray):
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    with pytest.raises(ArgumentError, match="RAY_ADDRESS must be .* got '127.0.0.1:1'"):
        start(out)
    assert not out.exists() and not ray.begun
    monkeypatch.setenv("RAY_ADDRESS", "auto")
    start(out)
    (how,) = ray.begun
    assert how["address"] == "auto" and "num_cpus" not in how and ray.ended == 1


def test_a_worker_that_dies_costs_nothing_but_time(finished, out, ray):
    ray.deaths = {1: 1, 4: 2}
    start(out)
    assert rows_of(out) == rows_of(finished[0])


def test_a_chunk_in_which_every_worker_dies_leaves_a_run_that_can_be_finished(
    finished, out, ray, capsys
):
    ray.deaths = {2: 99}
    assert main([*COMMAND, "--workers", "ray", "--out", str(out)]) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert "--workers must live" in said and "chunk 2 in 4 tries (a worker died)" in said
    assert f"finish with: planner-jax sweep hit --resume --out {out}" in said
    assert RunFolder(out).read_manifest()["state"] == "interrupted" and ray.ended == 1
    resume_sweep(TASK, out, progress=False)
    assert rows_of(out) == rows_of(finished[0])


def test_a_run_begun_alone_is_finished_by_workers(finished, out, monkeypatch, ray):
    with monkeypatch.context() as patch:
        stop_after(patch, HitSweep, 2)
        with pytest.raises(SweepInterrupted):
            start_sweep(TASK, SETTINGS, out, progress=False)
    manifest = resume_sweep(TASK, out, progress=False, workers="ray", num=NUM)
    assert sorted(ray.done) == [2, 3, 4]  # Existing parts are not planned again.
    assert rows_of(out) == rows_of(finished[0])
    assert [session.get("workers") for session in manifest["sessions"]] == [None, "ray"]


@pytest.mark.parametrize(
    ("other", "told"),
    [
        (lambda made: {"makers": {**made.makers, "jax": "0.0.1"}}, "workers must be of jax "),
        (lambda made: {"run": "0"}, "workers must have the files"),
    ],
)
def test_a_worker_that_would_make_other_rows_is_refused(out, monkeypatch, ray, other, told):
    real = Maker.of

    def change(*given):
        made = real(*given)
        return dataclasses.replace(made, **other(made))

    monkeypatch.setattr(cluster.Maker, "of", change)
    monkeypatch.setattr(run, "_maker_of", lambda sweep, settings: real(sweep, settings, BATCH))
    with pytest.raises(WorkersFailed, match=told):
        start(out)
    assert RunFolder(out).read_manifest()["state"] == "interrupted"


def test_a_serve_drawn_late_by_a_worker_that_breaks_a_rule_leaves_nothing_behind(out, ray):
    late = HitSettings(num=40, batch=4, delay=1.56, seed=0)
    with pytest.raises(ArgumentError, match="delay must be"):
        start(out, late)
    assert not out.exists() and ray.ended == 1


def test_without_ray_the_extra_is_named_in_one_line(out, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main([*COMMAND, "--workers", "ray", "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and install_line("cluster") in said
    with pytest.raises(MissingExtra, match="workers needs ray"):
        start(out)
    assert not out.exists()


@pytest.mark.parametrize(
    ("seen", "first"), [(None, "0"), ("0,1", "0"), ("3", "3"), ("2,0,1", "2"), ("", "")]
)
def test_the_process_that_asks_sees_the_first_gpu_of_those_it_may(
    monkeypatch, out, ray, seen, first
):
    if seen is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", seen)
    start(out)
    assert os.environ["CUDA_VISIBLE_DEVICES"] == first


@pytest.fixture
def gpus(monkeypatch, ray):
    """Pretend that JAX computes on a GPU and that the cluster has two GPUs."""
    monkeypatch.setattr(cluster, "require_backend", lambda: "gpu")
    ray.resources = {"CPU": 8.0, "GPU": 2.0}
    return ray


@pytest.mark.parametrize(
    ("cores", "num", "shared", "threads"),
    [(32.0, 2.0, 8, "4"), (8.0, 2.0, 2, "4"), (2.0, 4.0, 1, "1"), (16.0, 1.0, 8, "4")],
)
def test_workers_share_gpus_their_memory_and_cores(
    finished, out, gpus, cores, num, shared, threads
):
    gpus.resources = {"CPU": cores, "GPU": num}
    start(out)
    assert rows_of(out) == rows_of(finished[0])
    assert gpus.options["num_gpus"] == 1.0 / shared and gpus.options["max_calls"] == 0
    assert os.environ["XLA_CLIENT_MEM_FRACTION"] == f"{0.6 / shared:.4f}"
    assert os.environ["PJRT_NPROC"] == threads


@pytest.mark.parametrize("threads", [1, 3])
def test_workers_on_cores_compute_with_as_many_threads_as_the_run(monkeypatch, out, ray, threads):
    monkeypatch.setattr(cluster, "threads_of_a_computation", lambda: threads)
    start(out)
    assert os.environ["NPROC"] == os.environ["PJRT_NPROC"] == str(threads)
    assert ray.options == {"num_cpus": 1, "max_retries": 3}


@pytest.mark.parametrize(
    ("own", "others", "rule"),
    [(1, 0.0, "of a cluster with GPUs"), (2, 2.0, "requested before JAX .* got 2")],
)
def test_gpus_here_and_not_there_or_several_here_are_refused(
    out, monkeypatch, gpus, own, others, rule
):
    gpus.resources = {"CPU": 64.0, "GPU": others}
    monkeypatch.setattr(cluster.jax, "device_count", lambda: own)
    with pytest.raises(ArgumentError, match=f"workers must be {rule}"):
        start(out)
    assert not out.exists() and gpus.ended == 1


def test_a_worker_whose_jax_has_no_device_ends_a_run_that_can_be_finished(
    out, monkeypatch, ray, capsys
):
    platforms = iter(["cpu"])

    def backend():
        if (platform := next(platforms, None)) is None:
            raise ArgumentError("JAX_PLATFORMS", "a platform", verb="name", shown="'x' (no)")
        return platform

    monkeypatch.setattr(cluster, "require_backend", backend)
    assert main([*COMMAND, "--workers", "ray", "--out", str(out)]) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert "--workers must be able to start the run, got: JAX_PLATFORMS" in said
    assert "finish with" in said
    assert RunFolder(out).read_manifest()["state"] == "interrupted"


@pytest.mark.slow
def test_a_run_with_a_real_cluster_survives_the_death_of_a_worker(tmp_path):
    pytest.importorskip("ray")
    plain, out = tmp_path / "plain", tmp_path / "run"
    command = [*SWEEP, *"--num 64 --batch 2 --planner juggle --out".split()]
    subprocess.run([*command, str(plain)], check=True, capture_output=True)
    pipes: dict = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen([*command, str(out), "--workers", "ray"], **pipes) as sweep:
        until = time.monotonic() + 120.0
        raylets, killed = [], False
        while sweep.poll() is None and not killed and time.monotonic() < until:
            time.sleep(0.02)
            raylets = raylets or children_of(sweep.pid, "raylet")
            if list(out.glob("plans/part-*")):
                for pid in children_of(raylets[0], "ray::_make")[:1]:
                    os.kill(pid, signal.SIGKILL)
                    killed = True
        said, _ = sweep.communicate(timeout=120.0)
    assert killed and sweep.returncode == 0, said
    assert rows_of(out) == rows_of(plain)
    assert not any(os.path.exists(f"/proc/{pid}") for pid in raylets)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:os.fork.. was called:RuntimeWarning")  # JAX may run.
def test_workers_of_a_real_cluster_that_hold_shares_of_gpus_make_the_same_rows(
    tmp_path, monkeypatch
):
    """Let the cluster pretend that it has one GPU, shared by two workers on the CPU."""
    ray = pytest.importorskip("ray")
    init = ray.init
    monkeypatch.setattr(ray, "init", lambda **how: init(**{**how, "num_cpus": 4, "num_gpus": 1}))
    monkeypatch.setenv("NPROC", "4")
    monkeypatch.setenv("PJRT_NPROC", "4")
    plain, out = tmp_path / "plain", tmp_path / "run"
    command = [*SWEEP, *"--num 32 --batch 2 --planner juggle --out".split(), str(plain)]
    subprocess.run(command, check=True, capture_output=True)
    monkeypatch.setattr(cluster, "require_backend", lambda: "gpu")
    machine.threads_of_a_computation.cache_clear()  # This process plans nothing itself.
    try:
        start(out, HitSettings(num=32, batch=2, planner="juggle"))
    finally:
        machine.threads_of_a_computation.cache_clear()
    assert rows_of(out) == rows_of(plain)


@pytest.mark.slow
def test_a_bad_case_of_a_worker_of_a_real_cluster_is_one_line_and_leaves_nothing(tmp_path):
    pytest.importorskip("ray")
    options = "--num 40 --batch 4 --delay 1.56 --planner juggle --workers ray --out run"
    command = [*SWEEP, *options.split()]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    error = ended.stderr.splitlines()[-1]
    assert ended.returncode == 2 and "Traceback" not in ended.stderr
    assert error.startswith("planner-jax: error: --delay must be shorter than each serve's flight")
    assert not list(tmp_path.iterdir())
