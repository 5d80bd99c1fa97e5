"""The chunks of a sweep as tasks of a Ray cluster, for sweeps that outgrow a machine.

Every chunk is one task, which draws, plans, judges and encodes it and sends back what is written.
The process that asks is the only one that knows of the run's folder. A worker is refused unless it
would make the same rows: by the same code, packages, settings and cases.

Of a run on CPUs Ray hands tasks to free workers, one for each core of the cluster, and begins a
task again elsewhere where its worker dies. Of a run on GPUs the workers are actors, of which each
holds a share of one GPU as long as it lives: a process whose JAX has begun cannot go to another
GPU, and Ray would give one to it with its next task.
"""

import contextlib
import dataclasses
import functools
import itertools
import logging
import os
import signal
import socket
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from planner_jax.core.registry import MissingExtra, Task, install_line
from planner_jax.host import signals as stopping
from planner_jax.host.compile_cache import keep_compiled_programs
from planner_jax.host.processors import threads_of_a_computation
from planner_jax.runs.environment import environment, require_backend
from planner_jax.runs.settings import (
    SettingError,
    SweepSettings,
    WorkersFailed,
    require,
)
from planner_jax.runs.timing import CompileClock
from planner_jax.sweep.chunks import Made, Maker, Making, SweepRun, Workers
from planner_jax.sweep.identity import differences, settings_digest
from planner_jax.sweep.sweep import sweep_of

_ADDRESS = "RAY_ADDRESS"  # environment variable that names a cluster to join
_HOST = "127.0.0.1"  # nothing else reaches a cluster that is begun here
_RETRIES = 3  # of a chunk whose worker dies
_AHEAD = 2  # chunks for each worker that are made or wait for their turn to be written
_PATIENCE = 10.0  # seconds for a cluster to answer
_LOOKS = 0.5  # seconds between looks whether the process was told to stop
_GPUS = "CUDA_VISIBLE_DEVICES"  # environment variable that names those a process sees
WORKERS_OF_GPU = 8  # at most: a GPU idles while a worker draws and judges
# Cores for each of them, at least, and processes that judge for each core: a core idles while a
# worker's one thread draws or encodes.
_CORES, _BUSY = 2, 2
_MEMORY = 0.6  # of a GPU, for all of its workers, each of which takes some more to begin
_BEGIN = 60.0  # seconds for workers to get their shares of GPUs


@contextlib.contextmanager
def workers_of(kind: str | None) -> Iterator[Workers | None]:
    """Workers that make chunks within the block, or None where no kind is asked for.

    A cluster that the environment variable RAY_ADDRESS names is joined and left again; otherwise
    one of this machine's cores and GPUs is begun and ended. Processes are started: it is best done
    before JAX has threads. JAX begins here, with one GPU where there are several, since a run by
    workers is one of one device.

    Args:
        kind: "ray", or None.

    Raises:
        SettingError: there are no such workers, no cluster answers, the cluster has no GPU where
            JAX has one, or JAX has begun with several GPUs before.
        MissingExtra: Ray is not installed.
    """
    if kind is None:
        yield None
        return
    require(kind == "ray", "workers", "ray", repr(kind))
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    if not os.environ.get(_ADDRESS):
        # Ray takes an address that others can reach in the place of the machine's own, unless a
        # cluster is forbidden to have other machines by this switch, which Linux has, too.
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
    try:
        import ray
    except ModuleNotFoundError as error:
        raise MissingExtra(
            f"workers needs {error.name}: {install_line('cluster')}", name=error.name
        ) from None
    with tempfile.TemporaryDirectory(
        prefix="ray-", dir="/tmp", ignore_cleanup_errors=True
    ) as folder:
        _begin(ray, folder)
        try:
            places = _places(_platform(), _machines(ray))
            yield functools.partial(_made, ray, places)
        finally:
            ray.shutdown()


def _begin(ray: Any, folder: str) -> None:
    """Join a cluster, or begin one whose logs and sockets are in a folder."""
    address = os.environ.get(_ADDRESS)
    how: dict[str, Any] = {"address": address}
    if not address:
        how = {
            "address": "local",
            "num_cpus": len(os.sched_getaffinity(0)),
            "include_dashboard": False,
            "_node_ip_address": _HOST,
            "_temp_dir": folder,
        }
    in_main = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGTERM)
    try:
        if address:
            _require_answer(address)
        ray.init(**how, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, ValueError, RuntimeError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        if address:
            rule = "the address of a Ray cluster that answers"
            raise SettingError(f"{_ADDRESS} must be {rule}, got {address!r} ({reason})") from None
        raise SettingError(f"workers must be left out where Ray cannot start ({reason})") from None
    finally:
        if in_main:  # Ray has put its own in the place of what this process does when it is told
            signal.signal(signal.SIGTERM, handler)


def _require_answer(address: str) -> None:
    """Raise `OSError` if nothing listens there; Ray itself would try for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), timeout=_PATIENCE).close()


def _platform() -> str:
    """The platform that JAX computes on in this process, where it may begin with one GPU only.

    Raises:
        SettingError: JAX has begun with several GPUs, or works nowhere.
    """
    with _told(_one_gpu(os.environ)):
        platform = require_backend()
    if platform == "gpu":
        rule = f"asked for before JAX begins with several GPUs, or with one in {_GPUS}"
        require(jax.device_count() == 1, "workers", rule, f"{jax.device_count()} GPUs")
    return platform


def _one_gpu(environ: Mapping[str, str]) -> dict[str, str]:
    """What JAX is told to begin with the first GPU, and without all of its memory at once.

    Args:
        environ: in which some GPUs may be chosen already.
    """
    first = environ.get(_GPUS, "0").partition(",")[0]
    return {_GPUS: first, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}


@contextlib.contextmanager
def _told(entries: Mapping[str, str]) -> Iterator[None]:
    """Entries of the environment within the block; then it is as it was."""
    before = {name: os.environ.get(name) for name in entries}
    os.environ.update(entries)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@dataclasses.dataclass(frozen=True)
class _Places:
    """The workers of a run: how many, and what each may take of its machine."""

    num: int
    gpu: float  # the share of one that each holds; 0.0 in a run on CPUs
    threads: int  # of the host, that each may keep busy

    def environ(self) -> dict[str, str]:
        """What a worker is told, before its JAX begins."""
        told: dict[str, str] = dict.fromkeys(("NPROC", "PJRT_NPROC"), str(self.threads))
        if self.gpu:
            told["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
            told["XLA_CLIENT_MEM_FRACTION"] = f"{_MEMORY * self.gpu:.4f}"
        return told


def _machines(ray: Any) -> list[dict[str, float]]:
    """What the machines of the cluster have, by Ray's names of resources."""
    return [machine["Resources"] for machine in ray.nodes() if machine["Alive"]]


def _gpus(machines: Iterable[Mapping[str, float]]) -> int:
    return sum(int(each.get("GPU", 0)) for each in machines)


def _places(platform: str, machines: Iterable[Mapping[str, float]]) -> _Places:
    """The workers of a run: one for each core, or several for each GPU if there are cores for them.

    Args:
        platform: that JAX computes on in the process that asks.
        machines: what each has, by Ray's names of resources.

    Raises:
        SettingError: the run is one on a GPU, and the cluster has none.
    """
    if platform != "gpu":
        cores = sum(int(each.get("CPU", 0)) for each in machines)
        return _Places(max(cores, 1), 0.0, threads_of_a_computation())  # as here: same digits
    with_gpus = [each for each in machines if _gpus([each])]
    rule = "of a cluster with GPUs where JAX has one, or asked for with JAX_PLATFORMS=cpu"
    require(bool(with_gpus), "workers", rule, "a cluster without")
    cores = min(int(each.get("CPU", 0)) // _gpus([each]) for each in with_gpus)  # of a GPU
    shared = min(max(cores // _CORES, 1), WORKERS_OF_GPU)
    return _Places(_gpus(with_gpus) * shared, 1.0 / shared, max(_BUSY * cores // shared, 1))


@dataclasses.dataclass(frozen=True)
class _Order:
    """What a worker has to know of a run; orders of the same run are equal."""

    run: str
    task: Task = dataclasses.field(compare=False)
    settings: SweepSettings = dataclasses.field(compare=False)  # without gaps
    digest: str = dataclasses.field(compare=False)  # of settings and cases
    asked_by: dict[str, Any] = dataclasses.field(compare=False)  # as of `environment`
    x64: bool = dataclasses.field(compare=False)
    platforms: str | None = dataclasses.field(compare=False)  # that JAX may take; None: any
    places: _Places = dataclasses.field(compare=False)


class _OnGpu:
    """A worker that holds a share of a GPU, as an actor of Ray."""

    def begun(self) -> None:
        """Answer once there is a share."""

    def make(self, order: _Order, number: int) -> Made:
        """Draw, plan, judge and encode a chunk."""
        return _make(order, number)


class _Crew:
    """The workers of a run on GPUs. Ray begins one again, with a share, where it dies.

    Raises:
        WorkersFailed: none has got a share in time.
    """

    def __init__(self, ray: Any, places: _Places):
        what = {"num_cpus": 1, "num_gpus": places.gpu}
        kind = ray.remote(**what, max_restarts=-1, max_task_retries=_RETRIES)(_OnGpu)
        workers = [kind.remote() for _ in range(places.num)]
        begun = {worker.begun.remote(): worker for worker in workers}
        until, there, missing = time.monotonic() + _BEGIN, [], list(begun)
        while missing and time.monotonic() < until:
            there, missing = ray.wait(list(begun), num_returns=len(begun), timeout=_LOOKS)
            stopping.check()
        if not there:
            raise WorkersFailed(
                f"workers must get shares of GPUs within {_BEGIN:.0f} s, got none: other work "
                "holds those of the cluster"
            )
        self._ray, self._asked = ray, [(begun[each], deque()) for each in there]

    def ask(self, order: Any, number: int) -> Any:
        """Have a chunk made by the worker that has the fewest to make."""
        for _, asked in self._asked:
            while asked and self._ray.wait([asked[0]], timeout=0.0)[0]:
                asked.popleft()
        worker, asked = min(self._asked, key=lambda each: len(each[1]))
        asked.append(worker.make.remote(order, number))
        return asked[-1]


def _asking(ray: Any, places: _Places) -> Callable[[Any, int], Any]:
    """What asks for a chunk by the run's order and a number, and gives Ray's promise of it."""
    if places.gpu:
        return _Crew(ray, places).ask
    return ray.remote(num_cpus=1, max_retries=_RETRIES)(_make).remote


def _made(
    ray: Any, places: _Places, run: SweepRun, numbers: Iterable[int]
) -> Generator[Making, None, None]:
    """Chunks of these numbers in their order, each once it is made."""
    identity, x64 = run.parts.identity, jnp.result_type(float) == jnp.float64
    asked = identity["run"], run.sweep.task, run.source.settings, identity["settings"]
    config: Any = jax.config  # whose options are no attributes to a type checker
    platforms = config.jax_platforms if places.gpu else "cpu"
    order = ray.put(_Order(*asked, environment(), x64, platforms, places))
    ask, ahead = _asking(ray, places), _AHEAD * places.num
    waiting, under_way = iter(numbers), deque()
    while True:
        following = itertools.islice(waiting, ahead - len(under_way))
        under_way.extend((number, ask(order, number)) for number in following)
        if not under_way:
            return
        number, made = under_way.popleft()
        while not ray.wait([made], timeout=_LOOKS)[0]:
            stopping.check()
            _require_gpus(ray, places)
        yield functools.partial(_fetched, ray, number, made)


def _require_gpus(ray: Any, places: _Places) -> None:
    """Raise `WorkersFailed` if GPUs are gone: their workers would wait for others for ever."""
    wanted = round(places.num * places.gpu)
    if wanted and (found := _gpus(_machines(ray))) < wanted:
        raise WorkersFailed(
            f"workers must keep the {wanted} GPUs that they began with, got {found}: a machine of "
            "the cluster is gone"
        )


def _fetched(ray: Any, number: int, made: Any) -> Made:
    """Rows and record of a chunk that a worker has made; its exception, raised here."""
    try:
        return ray.get(made)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None
    except ray.exceptions.RayError as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise WorkersFailed(
            f"workers must live long enough to make a chunk, got none for chunk {number} in "
            f"{_RETRIES + 1} tries ({reason})"
        ) from None


def _make(order: _Order, number: int) -> Made:
    """Draw, plan, judge and encode a chunk, in a worker."""
    maker = _maker_of(order)
    with CompileClock() as clock:
        planned = maker.planned(maker.source.chunk(number), clock)
    return maker.encoded(*maker.judged(planned))


@functools.lru_cache(maxsize=1)
def _maker_of(order: _Order) -> Maker:
    """What makes the chunks of a run; kept by a worker, with its compiled programs.

    Raises:
        WorkersFailed: rows that are made here would not be those of the run.
    """
    os.environ.pop("XLA_PYTHON_CLIENT_MEM_FRACTION", None)  # an older name, refused beside the new
    os.environ.update(order.places.environ())
    jax.config.update("jax_platforms", order.platforms)
    jax.config.update("jax_enable_x64", order.x64)
    keep_compiled_programs()
    try:
        require_backend()
    except SettingError as error:
        raise WorkersFailed(
            f"workers must have a device to compute on, got none: {error}"
        ) from None
    for what, wanted, found in differences(order.asked_by, environment()):
        raise WorkersFailed(f"workers must be of {what} {wanted} as the run, got {found}")
    sweep = sweep_of(order.task)
    try:
        source = sweep.open_source(order.settings, order.settings.batch or 1)
        planner = sweep.planner(order.settings)
        found = settings_digest(source, source.description())
    except (ValueError, OSError, ModuleNotFoundError) as error:
        raise WorkersFailed(f"workers must be able to begin the run, got: {error}") from None
    if found != order.digest:
        raise WorkersFailed("workers must have the files that the run's settings name, got others")
    return Maker(sweep, source, planner)
