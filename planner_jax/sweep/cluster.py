"""The chunks of a sweep as tasks of a Ray cluster, for sweeps that outgrow a machine.

Every chunk is one task, which draws, plans and judges it and sends back rows and record. The
process that asks is the only one that knows of the run's folder. Ray hands tasks to free workers,
one for each core of the cluster, and begins a task again elsewhere where its worker dies. A worker
is refused unless it would make the same rows: by the same code, packages, settings and cases.
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
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import pyarrow as pa

from planner_jax import stopping
from planner_jax.compile_cache import keep_compiled_programs
from planner_jax.registry import MissingExtra, Task, install_line
from planner_jax.sweep.chunks import Maker, Making, SweepRun, Workers
from planner_jax.sweep.environment import environment
from planner_jax.sweep.identity import differences, settings_digest
from planner_jax.sweep.settings import (
    SettingError,
    SweepSettings,
    WorkersFailed,
    require,
)
from planner_jax.sweep.sweep import sweep_of
from planner_jax.sweep.timing import CompileClock

_ADDRESS = "RAY_ADDRESS"  # environment variable that names a cluster to join
_HOST = "127.0.0.1"  # nothing else reaches a cluster that is begun here
_RETRIES = 3  # of a chunk whose worker dies
_AHEAD = 2  # chunks for each worker that are made or wait for their turn to be written
_PATIENCE = 10.0  # seconds for a cluster to answer
_LOOKS = 0.5  # seconds between looks whether the process was told to stop


@contextlib.contextmanager
def workers_of(kind: str | None) -> Iterator[Workers | None]:
    """Workers that make chunks within the block, or None where no kind is asked for.

    A cluster that the environment variable RAY_ADDRESS names is joined and left again; otherwise
    one of this machine's cores is begun and ended. Processes are started: it is best done before
    JAX has threads.

    Args:
        kind: "ray", or None.

    Raises:
        SettingError: there are no such workers, or no cluster answers.
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
            yield functools.partial(_made, ray)
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


@dataclasses.dataclass(frozen=True)
class _Order:
    """What a worker has to know of a run; orders of the same run are equal."""

    run: str
    task: Task = dataclasses.field(compare=False)
    settings: SweepSettings = dataclasses.field(compare=False)  # without gaps
    digest: str = dataclasses.field(compare=False)  # of settings and cases
    asked_by: dict[str, Any] = dataclasses.field(compare=False)  # as of `environment`
    x64: bool = dataclasses.field(compare=False)


def _made(ray: Any, run: SweepRun, numbers: Iterable[int]) -> Generator[Making, None, None]:
    """Chunks of these numbers in their order, each once it is made."""
    identity, x64 = run.parts.identity, jnp.result_type(float) == jnp.float64
    asked = identity["run"], run.sweep.task, run.source.settings, identity["settings"]
    order = ray.put(_Order(*asked, environment(), x64))
    task = ray.remote(num_cpus=1, max_retries=_RETRIES)(_make)
    ahead = _AHEAD * max(int(ray.cluster_resources().get("CPU", 1)), 1)
    waiting, under_way = iter(numbers), deque()
    while True:
        following = itertools.islice(waiting, ahead - len(under_way))
        under_way.extend((number, task.remote(order, number)) for number in following)
        if not under_way:
            return
        number, made = under_way.popleft()
        while not ray.wait([made], timeout=_LOOKS)[0]:
            stopping.check()
        yield functools.partial(_fetched, ray, number, made)


def _fetched(ray: Any, number: int, made: Any) -> tuple[pa.Table, dict[str, Any]]:
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


def _make(order: _Order, number: int) -> tuple[pa.Table, dict[str, Any]]:
    """Draw, plan and judge a chunk, in a worker."""
    maker = _maker_of(order)
    with CompileClock() as clock:
        return maker.judged(maker.planned(maker.source.chunk(number), clock))


@functools.lru_cache(maxsize=1)
def _maker_of(order: _Order) -> Maker:
    """What makes the chunks of a run; kept by a worker, with its compiled programs.

    Raises:
        WorkersFailed: rows that are made here would not be those of the run.
    """
    os.environ["NPROC"] = "1"  # threads of XLA, which reads it when it computes first
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_enable_x64", order.x64)
    keep_compiled_programs()
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
