"""Workers of a Ray cluster that plan a run over many cases, for the option `--workers ray`.

A chunk is a block of consecutive cases. One Ray task plans and judges a chunk, and returns the
bytes of the Parquet file with its rows. If a worker dies, Ray repeats its task on another worker.
"""

import contextlib
import functools
import itertools
import logging
import os
import pickle
import signal
import socket
import tempfile
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from types import ModuleType

import jax
import jax.numpy as jnp

from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError
from planner_jax.core.missing_extra import MissingExtra
from planner_jax.host import signals as stopping
from planner_jax.host.compile_cache import keep_compiled_programs
from planner_jax.host.machine import threads_of_a_computation
from planner_jax.runs.environment import require_backend
from planner_jax.runs.settings import WorkersFailed
from planner_jax.sweep.chunks import Made, Maker, Workers
from planner_jax.sweep.sweep import sweep_of

_ADDRESS, _GPUS = "RAY_ADDRESS", "CUDA_VISIBLE_DEVICES"  # names of environment variables
_RETRIES = 3  # number of times that Ray plans a chunk again if its worker died
_AHEAD = 2  # number of chunks for each worker that are being planned or wait to be written
# Greatest number of workers that share one GPU. Several workers keep the GPU busy, because a worker
# judges its plans on the CPU while another worker plans on the GPU.
WORKERS_OF_GPU = 8
# Fraction of a GPU's memory for the arrays of all its workers. The remainder is for CUDA itself,
# which needs memory in each process.
_MEMORY = 0.6


@contextlib.contextmanager
def workers_of(kind: str | None) -> Iterator[Workers | None]:
    """Provide the workers of a Ray cluster within a `with` block; None if `kind` is None.

    The cluster is at the address in the environment variable RAY_ADDRESS. Without this variable it
    is started on this machine, and stopped at the end of the block.
    """
    if kind is None:
        yield None
        return
    require(kind == "ray", "workers", "ray", kind)
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    try:
        import ray
    except ModuleNotFoundError:
        raise MissingExtra("workers", "ray", "cluster") from None
    with tempfile.TemporaryDirectory("", "ray-", "/tmp", ignore_cleanup_errors=True) as folder:
        _start(ray, folder)
        try:
            # Let JAX use one GPU in this process, as in each worker: the device that a run records
            # must be the same in all processes.
            os.environ[_GPUS] = os.environ.get(_GPUS, "0").partition(",")[0]
            os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
            on_gpus = require_backend() == "gpu"
            num = jax.device_count() if on_gpus else 1
            require(num == 1, "workers", "requested before JAX starts with several GPUs", num)
            yield functools.partial(_make_parts, ray, on_gpus)
        finally:
            ray.shutdown()


def _start(ray: ModuleType, folder: str) -> None:
    address, handler = os.environ.get(_ADDRESS), signal.getsignal(signal.SIGTERM)
    try:
        if address:
            host, _, port = address.removeprefix("ray://").rpartition(":")
            # Test the address first, because Ray itself retries a wrong address for minutes.
            if host and port.isdecimal():
                socket.create_connection((host.strip("[]"), int(port)), timeout=10.0).close()
            how = {"address": address}
        else:
            # Without this switch Ray listens on an address that other machines can reach.
            os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
            how = {"address": "local", "_node_ip_address": "127.0.0.1", "_temp_dir": folder}
            how |= {"num_cpus": len(os.sched_getaffinity(0)), "include_dashboard": False}
        ray.init(**how, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, ValueError, RuntimeError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        rule = "the address of a Ray cluster that answers, or left out where Ray starts"
        raise ArgumentError(_ADDRESS, rule, shown=f"{address!r} ({reason})") from None
    finally:
        # Ray has replaced this process's handler of SIGTERM. Restore the original handler.
        with contextlib.suppress(ValueError):
            signal.signal(signal.SIGTERM, handler)


def _make_parts(
    ray: ModuleType, on_gpus: bool, maker: Maker, numbers: Iterable[int]
) -> Generator[Callable[[], Made], None, None]:
    cores, gpus = (int(ray.cluster_resources().get(name, 0)) for name in ("CPU", "GPU"))
    num, threads = max(cores, 1), threads_of_a_computation()
    environ, config, how = {}, {"jax_platforms": "cpu"}, {}
    if on_gpus:
        require(gpus > 0, "workers", "of a cluster with GPUs, as this process has", gpus)
        shared = min(max(cores // (2 * gpus), 1), WORKERS_OF_GPU)
        num, threads = gpus * shared, max(2 * cores // (gpus * shared), 1)
        memory = {"XLA_CLIENT_MEM_FRACTION": f"{_MEMORY / shared:.4f}"}
        environ, config = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", **memory}, {}
        # With `max_calls` 0 a worker process plans any number of chunks, always on the same GPU.
        how = {"num_gpus": 1.0 / shared, "max_calls": 0}
    environ |= dict.fromkeys(("NPROC", "PJRT_NPROC"), str(threads))
    config |= {"jax_enable_x64": jnp.result_type(float) == jnp.float64}
    run = (maker.sweep.task, maker.source.settings, maker.makers, maker.run)
    job = ray.put(pickle.dumps((environ, config, run)))
    make = ray.remote(num_cpus=1, max_retries=_RETRIES, **how)(_make)
    waiting, started = iter(numbers), deque()
    while True:
        following = itertools.islice(waiting, _AHEAD * num - len(started))
        started.extend((number, make.remote(job, number)) for number in following)
        if not started:
            return
        number, promise = started.popleft()
        while not ray.wait([promise], timeout=0.5)[0]:
            stopping.check()
        yield functools.partial(_fetch, ray, number, promise)


def _fetch(ray: ModuleType, number: int, promise: object) -> Made:
    try:
        return ray.get(promise)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None
    except ray.exceptions.RayError as error:
        rule = f"workers must live long enough to make a chunk, got none for chunk {number} in"
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise WorkersFailed(f"{rule} {_RETRIES + 1} tries ({reason})") from None


def _make(job: bytes, number: int) -> Made:
    return _maker_of(job).make(number)


@functools.lru_cache(maxsize=1)
def _maker_of(job: bytes) -> Maker:
    environ, config, (task, settings, makers, run) = pickle.loads(job)
    # JAX raises an error if this variable and XLA_CLIENT_MEM_FRACTION are both set.
    os.environ.pop("XLA_PYTHON_CLIENT_MEM_FRACTION", None)
    os.environ.update(environ)
    for name, value in config.items():
        jax.config.update(name, value)
    keep_compiled_programs()
    try:
        require_backend()
        maker = Maker.of(sweep_of(task), settings, settings.batch or 1)
    except (ValueError, OSError, ModuleNotFoundError) as error:
        raise WorkersFailed(f"workers must be able to start the run, got: {error}") from None
    for what, wanted in makers.items():
        if (found := maker.makers[what]) != wanted:
            raise WorkersFailed(f"workers must be of {what} {wanted} as the run, got {found}")
    if maker.run != run:
        raise WorkersFailed("workers must have the files that the run's settings name, got others")
    return maker
