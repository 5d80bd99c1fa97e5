"""`plan`: one call for one scenario or a million, on one device or all of them."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.core import Tracer
from jax.experimental import multihost_utils

from planner_jax.optimise.problem import Planner, Scenario
from planner_jax.task.batch import plan_batch
from planner_jax.task.single import plan_single


def plan(
    planner: Planner,
    scenarios: Scenario,
    *,
    chunk: int | None = None,
    devices: Sequence[Any] | None = None,
) -> Any:
    """Plan one scenario, or a batch of them with a leading axis on every leaf.

    Args:
        planner: sizes and switches, such as `ExactHit()`; its rounds are tried in order, each
            on the lanes that are still unsolved.
        scenarios: a scenario pytree; a batch has one more axis than a single case.
        chunk: lanes that a device solves in one compiled call. The default suits the device.
        devices: that share a batch. By default all local ones, `jax.local_devices()`.

    Returns:
        The planner's plans with the batch shape of the scenarios. The leaves are NumPy arrays;
        of a batch in jax arrays they are jax arrays too, and nothing leaves the devices but
        how many lanes are unsolved: each device holds its share, or the first one all if the
        batch cannot be shared evenly. Look at `status`: a lane that could not be solved says so
        and holds the best that was found. The same call gives the same bits. In other company,
        chunks or devices a lane's arithmetic is rounded differently, and where few iterations
        end short of the optimum it may end elsewhere, rarely with another status.

    Raises:
        ValueError: the leaves have not one batch axis or none, or of different lengths, the
            batch is empty, `chunk` < 1, or there are no `devices`.
        TypeError: within a transformation of JAX such as `jax.grad`.
    """
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(scenarios)):
        raise TypeError(
            "plan cannot be transformed by JAX: for gradients there are plan_with_gradients and "
            "optimal_plan, and batches need no vmap"
        )
    if scenarios.batch_shape == ():
        return plan_single(planner, scenarios)
    plans, _ = plan_and_count(planner, scenarios, chunk=chunk, devices=devices)
    return plans


def plan_and_count(
    planner: Planner,
    scenarios: Scenario,
    *,
    chunk: int | None = None,
    devices: Sequence[Any] | None = None,
) -> tuple[Any, Any]:
    """`plan` of a batch, and numbers that are all zero if no lane is unsolved.

    Raises:
        ValueError: as for `plan`.
    """
    require_batch(scenarios)
    if chunk is not None and chunk < 1:
        raise ValueError(f"chunk must be >= 1, got {chunk}")
    if devices is not None and not len(devices):
        raise ValueError("devices must be at least one, got none")
    return plan_batch(planner, scenarios, chunk, devices)


def require_batch(scenarios: Scenario) -> int:
    """The length of a batch; raises `ValueError` unless all leaves have it."""
    batch = scenarios.batch_shape
    if len(batch) != 1 or batch[0] == 0:
        raise ValueError(f"scenarios must be a batch of at least one, got batch shape {batch}")
    for path, leaf in jax.tree_util.tree_leaves_with_path(scenarios):
        if np.shape(leaf)[:1] != batch:
            name = jax.tree_util.keystr(path)
            raise ValueError(
                f"scenarios{name} must have {batch[0]} lanes, got shape {np.shape(leaf)}"
            )
    return batch[0]


def plan_across_processes(
    planner: Planner, scenarios: Scenario, *, chunk: int | None = None
) -> Any:
    """`plan` where each process of `jax.distributed` plans its share of one batch.

    Args:
        planner: as for `plan`, the same in every process.
        scenarios: the whole batch, the same in every process.
        chunk: as for `plan`.

    Returns:
        The whole batch's plans, leaves NumPy arrays, in every process.

    Raises:
        ValueError: as for `plan`, or the batch has fewer lanes than there are processes.
    """
    num = require_batch(scenarios)
    processes, mine = jax.process_count(), jax.process_index()
    if num < processes:
        raise ValueError(f"scenarios must have a lane for each of {processes} processes, got {num}")
    shares = np.array_split(np.arange(num), processes)
    longest = shares[0].size  # every process hands in as many
    lanes = np.resize(shares[mine], longest)
    plans = plan(
        planner, jax.tree.map(lambda leaf: np.asarray(leaf)[lanes], scenarios), chunk=chunk
    )
    gathered = multihost_utils.process_allgather(plans)
    kept = np.concatenate([np.arange(share.size) + k * longest for k, share in enumerate(shares)])

    def whole(leaf: np.ndarray) -> np.ndarray:
        return np.asarray(leaf).reshape(-1, *leaf.shape[2:])[kept]

    return jax.tree.map(whole, gathered)
