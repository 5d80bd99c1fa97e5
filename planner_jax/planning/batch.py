"""Batches of plans: chunks of a few fixed sizes, spread over the devices, round after round.

After each round the lanes that are still unsolved are packed together for the next one. Every
device solves its lanes in a loop of its own and waits for no other.
"""

from collections.abc import Sequence
from typing import Any

import jax

from planner_jax.core.protocol import Attempt
from planner_jax.planning.device_batch import plan_resident
from planner_jax.planning.host_batch import plan_from_host
from planner_jax.planning.layout import is_one_cpu, length, on_devices, sharding, sizes_of
from planner_jax.planning.progress import Watch


def plan_batch(
    planner: Any,
    attempts: Sequence[Attempt],
    cases: Any,
    chunk: int | None,
    devices: Sequence[Any] | None,
    watch: Watch,
) -> tuple[Any, Any]:
    """Attempts at B cases, each at the lanes that are still unsolved.

    Args:
        planner: that makes them.
        attempts: in order, one or more.
        cases: a leading axis of B on every leaf.
        chunk: lanes a device solves in one call; None for what suits it.
        devices: that share the work; None for all local ones.
        watch: after whose end no attempt but the first is begun.

    Returns:
        plans: with NumPy leaves, or where all leaves of the cases are jax arrays, with
            those, so that nothing leaves the devices.
        unsolved: numbers that are all zero if no lane is unsolved.
    """
    planner, mesh = on_devices(planner, devices)
    resident = all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(cases))
    num = length(cases)
    in_one_call = num == sizes_of(planner, attempts[0], chunk, mesh).next(num)
    # One CPU's memory is the host's: there a thread for each core plans chunks, and they are cut
    # and joined without programs, which would be compiled for every new size.
    if resident and (in_one_call or not is_one_cpu(mesh)):
        return plan_resident(planner, attempts, cases, chunk, mesh, watch)
    plans, unsolved = plan_from_host(planner, attempts, cases, chunk, mesh, watch)
    return (jax.device_put(plans, sharding(mesh)) if resident else plans), unsolved
