"""Sweeps whose chunks are made by a Ray cluster: a stand-in for Ray, and Ray itself (slow)."""

import functools
import itertools
import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pyarrow.parquet as pq
import pytest

import planner_jax as pj
from planner_jax.cli.main import main
from planner_jax.core.registry import MissingExtra, install_line
from planner_jax.runs.run_folder import RunFolder
from planner_jax.runs.settings import SettingError, WorkersFailed
from planner_jax.sweep import cluster, run
from planner_jax.sweep.hit.settings import HitSettings
from planner_jax.sweep.hit.sweep import HitSweep, HitTally
from planner_jax.sweep.run import SweepInterrupted, resume_sweep, start_sweep
from tests.faults.commands import children_of
from tests.faults.runs import quick_sweeps
from tests.sweeps import stop_after

TASK = pj.task_named("hit")
NUM, BATCH = 64, 13  # five chunks
SETTINGS = HitSettings(num=NUM, batch=BATCH, seed=3)
COMMAND = f"sweep hit --num {NUM} --batch {BATCH} --seed 3".split()


class RayError(Exception):
    """As Ray's, where a worker has died too often."""


class RayTaskError(RayError):
    """As Ray's, where a task has raised."""

    def __init__(self, cause):
        super().__init__("a long traceback\nof many lines")
        self.cause = cause


class StandIn:
    """What a sweep asks of Ray, in this process: the task that was asked for last is done first.

    Workers die so often in the chunks of `deaths`, before the task is done. Of actors the first
    `begins` get what they ask for. While `idle` is left, it is taken and nothing is done.
    """

    exceptions = SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError)

    def __init__(self):
        self.deaths, self.done, self.begun, self.ended, self.retries = {}, [], [], 0, None
        self.machines, self.actors, self.begins, self.idle = [{"CPU": 2.0}], [], 99, []
        self._waiting, self._found = {}, {}

    def init(self, **how):
        self.begun.append(how)

    def shutdown(self):
        self.ended += 1

    def nodes(self):
        alive = [{"Alive": True, "Resources": each} for each in self.machines]
        return [*alive, {"Alive": False, "Resources": {"CPU": 64.0, "GPU": 8.0}}]

    def put(self, value):
        return value

    def remote(self, *, num_cpus, max_retries=None, num_gpus=0, **of_actors):
        assert num_cpus == 1
        if num_gpus:
            assert of_actors == {"max_restarts": -1, "max_task_retries": 3} and max_retries is None
            self.retries = of_actors["max_task_retries"]
            return lambda kind: SimpleNamespace(remote=lambda: self._actor(kind(), num_gpus))
        self.retries = max_retries
        return self._task_of

    def _task_of(self, function):
        def remote(order, number):
            self._waiting[number] = (function, order)
            return number

        return SimpleNamespace(remote=remote)

    def _actor(self, worker, share):
        name = f"actor {len(self.actors)}"
        make, asked = self._task_of(worker.make), []
        self.actors.append((share, asked))

        def remote(order, number):
            asked.append(number)
            return make.remote(order, number)

        begun = SimpleNamespace(remote=lambda: name)
        return SimpleNamespace(begun=begun, make=SimpleNamespace(remote=remote))

    def wait(self, asked, timeout, num_returns=1):
        if str(asked[0]).startswith("actor"):
            assert num_returns == len(asked)
            return asked[: self.begins], asked[self.begins :]
        if self.idle and timeout:
            self.idle.pop()()
            return [], asked
        while self._waiting and timeout:
            number = next(reversed(self._waiting))
            self._found[number] = self._outcome(number, *self._waiting.pop(number))
        there = [number for number in asked if number not in self._waiting]
        return there, [number for number in asked if number in self._waiting]

    def _outcome(self, number, function, order):
        if self.deaths.get(number, 0) > self.retries:
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


@pytest.fixture(autouse=True, scope="module")
def quick():
    """Sweeps of this process plan in one round and have no figures."""
    with quick_sweeps():
        yield


@pytest.fixture(autouse=True)
def ray(monkeypatch, request):
    """The stand-in; Ray itself in slow tests. No report."""
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    told = ("RAY_USAGE_STATS_ENABLED", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER")
    for name in ("NPROC", "PJRT_NPROC", *told):
        monkeypatch.setenv(name, "1")  # to be put back
    monkeypatch.setattr(run, "write_report", lambda folder: None)
    cluster._maker_of.cache_clear()
    if request.node.get_closest_marker("slow"):
        return None
    stand_in = StandIn()
    monkeypatch.setitem(sys.modules, "ray", stand_in)
    return stand_in


def rows_of(out):
    return (out / "plans.parquet").read_bytes()


def test_rows_are_those_of_a_plain_run_in_whatever_order_they_are_made(finished, tmp_path, ray):
    out = tmp_path / "run"
    manifest = start_sweep(TASK, SETTINGS, out, progress=False, workers="ray")
    assert ray.done == [3, 2, 1, 0, 4]  # two for each worker at first
    assert rows_of(out) == rows_of(finished[0])
    assert manifest["settings"] == finished[1]["settings"]
    assert manifest["sessions"][0]["workers"] == "ray"
    assert manifest["summary"]["successes"] == finished[1]["summary"]["successes"]
    assert ray.ended == 1


def test_a_worker_sends_what_is_written_and_the_columns_that_are_counted(tmp_path, ray):
    sent, real = [], ray.get
    ray.get = lambda number: sent.append(real(number)) or sent[-1]
    start_sweep(TASK, SETTINGS, tmp_path / "run", progress=False, workers="ray")
    assert len(sent) == 5
    for rows, record in sent:
        assert rows.counted.column_names == [
            name
            for name in pq.read_schema(tmp_path / "run/plans.parquet").names
            if name in HitTally.READS
        ]
        assert rows.file.num_rows == record["num"] == rows.counted.num_rows
        assert "wall_seconds" not in record and b"part" not in rows.file.metadata


def test_a_cluster_that_is_begun_is_of_this_machine_alone_and_tells_nobody(tmp_path, ray):
    start_sweep(TASK, SETTINGS, tmp_path / "run", progress=False, workers="ray")
    (how,) = ray.begun
    assert how["address"] == "local" and how["_node_ip_address"] == "127.0.0.1"
    assert how["include_dashboard"] is False
    assert how["num_cpus"] == len(os.sched_getaffinity(0))
    assert not os.path.exists(how["_temp_dir"])
    assert os.environ["RAY_USAGE_STATS_ENABLED"] == "0"


def test_a_cluster_with_an_address_is_joined(monkeypatch, tmp_path, ray):
    monkeypatch.setenv("RAY_ADDRESS", "auto")
    start_sweep(TASK, SETTINGS, tmp_path / "run", progress=False, workers="ray")
    (how,) = ray.begun
    assert how["address"] == "auto" and "num_cpus" not in how and ray.ended == 1


def test_an_address_at_which_nothing_answers_is_named(monkeypatch, tmp_path, ray):
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    with pytest.raises(SettingError, match="RAY_ADDRESS must be .* got '127.0.0.1:1'"):
        start_sweep(TASK, SETTINGS, tmp_path / "run", progress=False, workers="ray")
    assert not (tmp_path / "run").exists() and not ray.begun


def test_a_worker_that_dies_costs_nothing_but_time(finished, tmp_path, ray):
    ray.deaths = {1: 1, 4: 2}
    out = tmp_path / "run"
    start_sweep(TASK, SETTINGS, out, progress=False, workers="ray")
    assert rows_of(out) == rows_of(finished[0])


def test_a_chunk_in_which_every_worker_dies_leaves_a_run_that_can_be_finished(
    finished, tmp_path, ray, capsys
):
    ray.deaths, out = {2: 99}, tmp_path / "run"
    assert main([*COMMAND, "--workers", "ray", "--out", str(out)]) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert "--workers must live" in said and "chunk 2 in 4 tries (a worker died)" in said
    assert f"finish with: planner-jax sweep hit --resume --out {out}" in said
    assert RunFolder(out).read_manifest()["state"] == "interrupted" and ray.ended == 1
    resume_sweep(TASK, out, progress=False)
    assert rows_of(out) == rows_of(finished[0])


def test_a_run_begun_alone_is_finished_by_workers(finished, tmp_path, monkeypatch, ray):
    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        stop_after(patch, HitSweep, 2)
        with pytest.raises(SweepInterrupted):
            start_sweep(TASK, SETTINGS, out, progress=False)
    manifest = resume_sweep(TASK, out, progress=False, workers="ray", num=NUM)
    assert sorted(ray.done) == [2, 3, 4]  # what was there is not made again
    assert rows_of(out) == rows_of(finished[0])
    assert [session.get("workers") for session in manifest["sessions"]] == [None, "ray"]


@pytest.mark.parametrize("entry", ["code", "settings"])
def test_a_worker_that_would_make_other_rows_is_refused(tmp_path, monkeypatch, ray, entry):
    out = tmp_path / "run"
    if entry == "code":
        asked_by = cluster.environment()
        others = itertools.repeat({**asked_by, "code": "0" * 64})
        found = itertools.chain([asked_by], others)
        monkeypatch.setattr(cluster, "environment", lambda: next(found))
    else:
        monkeypatch.setattr(cluster, "settings_digest", lambda *_: "0" * 64)
    with pytest.raises(WorkersFailed, match="workers must (be of planner-jax of|have the files)"):
        start_sweep(TASK, SETTINGS, out, progress=False, workers="ray")
    assert RunFolder(out).read_manifest()["state"] == "interrupted"


def test_a_serve_drawn_late_by_a_worker_that_breaks_a_rule_leaves_nothing_behind(tmp_path, ray):
    late = HitSettings(num=40, batch=4, delay=1.56, seed=0)
    with pytest.raises(SettingError, match="delay must be"):
        start_sweep(TASK, late, tmp_path / "run", progress=False, workers="ray")
    assert not (tmp_path / "run").exists() and ray.ended == 1


def test_without_ray_the_extra_is_named_in_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    out = tmp_path / "run"
    assert main([*COMMAND, "--workers", "ray", "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and install_line("cluster") in said
    with pytest.raises(MissingExtra, match="workers needs ray"):
        start_sweep(TASK, SETTINGS, out, progress=False, workers="ray")
    assert not out.exists()


@pytest.mark.parametrize(
    ("platform", "machines", "places"),
    [
        ("cpu", [{"CPU": 2.0, "memory": 1e9}], (2, 0.0, 1)),
        ("cpu", [{"CPU": 4.0, "GPU": 1.0}, {"CPU": 3.0}, {}], (7, 0.0, 1)),
        ("cpu", [{}], (1, 0.0, 1)),
        ("gpu", [{"CPU": 32.0, "GPU": 2.0}], (16, 0.125, 4)),
        ("gpu", [{"CPU": 16.0, "GPU": 1.0}], (8, 0.125, 4)),
        ("gpu", [{"CPU": 4.0, "GPU": 2.0}], (2, 1.0, 4)),
        ("gpu", [{"CPU": 2.0, "GPU": 4.0}], (4, 1.0, 1)),
        ("gpu", [{"CPU": 64.0}, {"CPU": 8.0, "GPU": 1.0}, {"CPU": 12.0, "GPU": 4.0}], (5, 1.0, 6)),
        ("gpu", [{"CPU": 64.0}, {"CPU": 6.0, "GPU": 1.0}], (3, 1 / 3, 4)),
    ],
)
def test_workers_are_as_many_as_cores_or_up_to_eight_a_gpu(platform, machines, places, monkeypatch):
    monkeypatch.setattr(cluster, "threads_of_a_computation", lambda: 1)
    assert cluster._places(platform, machines) == cluster._Places(*places)


def test_workers_of_a_gpu_share_its_memory_and_the_cores_of_its_machine():
    told = cluster._places("gpu", [{"CPU": 32.0, "GPU": 2.0}]).environ()
    assert told["NPROC"] == "4" and told["XLA_PYTHON_CLIENT_PREALLOCATE"] == "false"
    assert 8 * float(told["XLA_CLIENT_MEM_FRACTION"]) == 0.6
    assert told["PJRT_NPROC"] == "4"


@pytest.mark.parametrize("threads", [1, 3])
def test_workers_on_cores_compute_with_as_many_threads_as_the_run(monkeypatch, threads):
    monkeypatch.setattr(cluster, "threads_of_a_computation", lambda: threads)
    told = cluster._places("cpu", [{"CPU": 32.0}]).environ()
    assert told == {"NPROC": str(threads), "PJRT_NPROC": str(threads)}


@pytest.mark.parametrize(
    ("seen", "first"),
    [
        (None, "0"),
        ("0,1", "0"),
        ("3", "3"),
        ("2,0,1", "2"),
        ("GPU-8f2a,GPU-17c0", "GPU-8f2a"),
        ("", ""),
        ("-1", "-1"),
    ],
)
def test_the_process_that_asks_sees_the_first_gpu_of_those_it_may(seen, first):
    environ = {"PATH": "/bin"} if seen is None else {"CUDA_VISIBLE_DEVICES": seen}
    told = {"CUDA_VISIBLE_DEVICES": first, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    assert cluster._one_gpu(environ) == told


@pytest.mark.parametrize("seen", [None, "1,0"])
def test_gpus_are_hidden_while_jax_begins_and_no_longer(monkeypatch, seen):
    found = {}
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if seen is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", seen)
    before = dict(os.environ)
    monkeypatch.setattr(cluster, "require_backend", lambda: found.update(os.environ) or "gpu")
    assert cluster._platform() == "gpu"
    assert found["CUDA_VISIBLE_DEVICES"] == ("0" if seen is None else "1")
    assert dict(os.environ) == before


@pytest.fixture
def gpus(monkeypatch, ray):
    """JAX says that it computes on a GPU, and the cluster has two."""
    monkeypatch.setattr(cluster, "require_backend", lambda: "gpu")
    for name in ("XLA_PYTHON_CLIENT_PREALLOCATE", "XLA_CLIENT_MEM_FRACTION"):
        monkeypatch.setenv(name, "")  # to be put back
    ray.machines = [{"CPU": 8.0, "GPU": 2.0}]
    return ray


def test_chunks_of_a_run_on_gpus_are_shared_by_workers_that_hold_parts_of_them(
    finished, tmp_path, gpus
):
    out = tmp_path / "run"
    start_sweep(TASK, SETTINGS, out, progress=False, workers="ray")
    assert rows_of(out) == rows_of(finished[0])
    assert [share for share, _ in gpus.actors] == [0.5] * 4
    assert [asked for _, asked in gpus.actors] == [[0, 4], [1], [2], [3]]
    assert os.environ["XLA_CLIENT_MEM_FRACTION"] == "0.3000"


def test_a_worker_on_a_gpu_that_dies_is_begun_again(finished, tmp_path, gpus):
    gpus.deaths, out = {1: 3}, tmp_path / "run"
    start_sweep(TASK, SETTINGS, out, progress=False, workers="ray")
    assert rows_of(out) == rows_of(finished[0])


def test_workers_that_get_no_share_in_time_are_done_without(finished, tmp_path, monkeypatch, gpus):
    monkeypatch.setattr(cluster, "_BEGIN", 0.01)
    gpus.begins, out = 2, tmp_path / "run"
    start_sweep(TASK, SETTINGS, out, progress=False, workers="ray")
    assert rows_of(out) == rows_of(finished[0])
    assert [len(asked) for _, asked in gpus.actors] == [3, 2, 0, 0]


def test_a_cluster_whose_gpus_are_taken_ends_a_run_that_can_be_finished(
    tmp_path, monkeypatch, gpus
):
    monkeypatch.setattr(cluster, "_BEGIN", 0.01)
    gpus.begins, out = 0, tmp_path / "run"
    with pytest.raises(WorkersFailed, match="workers must get shares of GPUs within"):
        start_sweep(TASK, SETTINGS, out, progress=False, workers="ray")
    assert RunFolder(out).read_manifest()["state"] == "interrupted" and gpus.ended == 1


def test_a_run_on_a_gpu_is_refused_by_a_cluster_without(tmp_path, gpus, capsys):
    gpus.machines, out = [{"CPU": 64.0}], tmp_path / "run"
    assert main([*COMMAND, "--workers", "ray", "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "--workers must be of a cluster with GPUs" in said
    assert not out.exists() and gpus.ended == 1


def test_a_process_whose_jax_has_several_gpus_is_refused(tmp_path, monkeypatch, gpus):
    monkeypatch.setattr(cluster.jax, "device_count", lambda: 2)
    with pytest.raises(SettingError, match="workers must be asked for before JAX .* got 2 GPUs"):
        start_sweep(TASK, SETTINGS, tmp_path / "run", progress=False, workers="ray")
    assert not (tmp_path / "run").exists() and gpus.ended == 1


def test_a_machine_that_is_lost_with_its_gpus_ends_a_run_that_can_be_finished(
    finished, tmp_path, gpus
):
    gpus.machines, out = [{"CPU": 1.0, "GPU": 1.0}] * 2, tmp_path / "run"
    gpus.idle = [lambda: setattr(gpus, "machines", gpus.machines[:1])]
    with pytest.raises(WorkersFailed, match="must keep the 2 GPUs .* got 1: a machine"):
        start_sweep(TASK, SETTINGS, out, progress=False, workers="ray")
    assert RunFolder(out).read_manifest()["state"] == "interrupted"
    resume_sweep(TASK, out, progress=False)
    assert rows_of(out) == rows_of(finished[0])


def test_a_worker_whose_jax_gets_no_gpu_ends_a_run_that_can_be_finished(
    tmp_path, monkeypatch, gpus, capsys
):
    def backend():
        if gpus.actors:
            raise SettingError(
                "JAX_PLATFORMS must name a platform that works here, got 'cuda' (no)"
            )
        return "gpu"

    out = tmp_path / "run"
    monkeypatch.setattr(cluster, "require_backend", backend)
    assert main([*COMMAND, "--workers", "ray", "--out", str(out)]) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert "--workers must have a device to compute on, got none: JAX_PLATFORMS" in said
    assert "finish with" in said
    assert RunFolder(out).read_manifest()["state"] == "interrupted"


@pytest.mark.slow
def test_a_run_with_a_real_cluster_survives_the_death_of_a_worker(tmp_path):
    """One that is killed with the first part; the sweep ends by itself, and so does its cluster."""
    pytest.importorskip("ray")
    plain, out = tmp_path / "plain", tmp_path / "run"
    options = "--num 64 --batch 2 --planner juggle --out".split()
    command = [sys.executable, "-m", "planner_jax", "sweep", "hit", *options]
    subprocess.run([*command, str(plain)], check=True, capture_output=True)
    pipes: dict = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen([*command, str(out), "--workers", "ray"], **pipes) as sweep:
        until = time.monotonic() + 120.0
        raylets, killed = [], False
        while sweep.poll() is None and not killed and time.monotonic() < until:
            time.sleep(0.02)
            raylets = raylets or children_of(sweep.pid, "raylet")
            if list(out.glob("parts/part-*")):
                for pid in children_of(raylets[0], "ray::_make")[:1]:
                    os.kill(pid, signal.SIGKILL)
                    killed = True
        said, _ = sweep.communicate(timeout=120.0)
    assert killed and sweep.returncode == 0, said
    assert rows_of(out) == rows_of(plain)
    assert not any(os.path.exists(f"/proc/{pid}") for pid in raylets)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:os.fork.. was called:RuntimeWarning")  # JAX may have begun here
def test_workers_of_a_real_cluster_that_hold_shares_of_gpus_make_the_same_rows(
    tmp_path, monkeypatch
):
    """The cluster is told of two GPUs, and its workers compute on the CPU."""
    ray = pytest.importorskip("ray")
    plain, out = tmp_path / "plain", tmp_path / "run"
    options = "--num 32 --batch 2 --planner juggle --out".split()
    command = [sys.executable, "-m", "planner_jax", "sweep", "hit", *options, str(plain)]
    subprocess.run(command, check=True, capture_output=True)
    monkeypatch.setattr(ray, "init", functools.partial(ray.init, num_gpus=2))
    monkeypatch.setattr(cluster, "require_backend", lambda: "gpu")
    settings = HitSettings(num=32, batch=2, planner="juggle")
    start_sweep(TASK, settings, out, progress=False, workers="ray")
    assert rows_of(out) == rows_of(plain)
