"""`plan`: one call for one scenario or a million, on one device or all of them."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
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
        how many lanes are unsolved. Look at `status`: a lane that could not be solved says so
        and holds the best that was found.

    Raises:
        ValueError: the leaves have not one batch axis or none, or of different lengths.
    """
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
    """`plan` of a batch, and how many lanes are unsolved: numbers whose sum it is.

    Raises:
        ValueError: as for `plan`.
    """
    batch = scenarios.batch_shape
    if len(batch) != 1 or batch[0] == 0:
        raise ValueError(f"scenarios must be one case or a batch of some, got batch shape {batch}")
    for path, leaf in jax.tree_util.tree_leaves_with_path(scenarios):
        if np.shape(leaf)[:1] != batch:
            name = jax.tree_util.keystr(path)
            raise ValueError(
                f"scenarios{name} must have {batch[0]} lanes, got shape {np.shape(leaf)}"
            )
    return plan_batch(planner, scenarios, chunk, devices)


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
        ValueError: the batch has fewer lanes than there are processes.
    """
    (num,) = scenarios.batch_shape
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
