"""`plan`, for one case or a large batch on any devices, and `solve`, its pure counterpart."""

from collections.abc import Callable, Sequence

import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import PyTree

from planner_jax.core.choices import require_size
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.planner import CaseT, Kind, Planner, PlanT, require_fit
from planner_jax.core.protocol import Status, is_resident
from planner_jax.core.rules import Case, has_rules, require_shapes, require_sound
from planner_jax.host.compile_cache import keep_compiled_programs
from planner_jax.planning.batch import Progress, Watch
from planner_jax.planning.drive import Driver, require_pure

_ARRAYS = (jax.Array, np.ndarray, np.generic)


def plan(
    planner: Planner[CaseT, PlanT],
    cases: CaseT,
    *,
    chunk: int | None = None,
    devices: Sequence[jax.Device] | None = None,  # pyright: ignore[reportInvalidTypeForm]
    time_limit: float | None = None,
    progress: Callable[[Progress], PyTree] | None = None,
) -> PlanT:
    """Plan one case, or a batch of cases with a leading axis on every leaf.

    Inside a compiled function of the caller this is `solve`. A repeated call returns bitwise equal
    plans. With other cases in the batch, other chunks or other devices, a case's arithmetic is
    rounded differently. A search that ends before the optimum may then end at
    another point, rarely with another status.

    Args:
        planner: a planner such as `pj.hit.planner("exact")`; its attempts are made in order, each
            at the cases that are still unsolved.
        cases: one case of the planner's task, or a batch, which has one more leading axis.
        chunk: cases that a device solves in one compiled call. The default suits the device.
        devices: devices that share a batch. By default all local ones, `jax.local_devices()`.
        time_limit: [s] time, compilation included, after which no attempt but the first starts;
            running computations are finished. Unsolved cases that have not been through all
            attempts have the status `OUT_OF_TIME`; a limit does not change other plans.
        progress: function that receives a `Progress` at the start and end of every attempt and
            after its chunks; `print` writes one line for each.

    Returns:
        The planner's plans with the batch shape of the cases; see their `status`. An unsolved case
        has the best plan that was found. The leaves are NumPy arrays, or jax arrays if the batch is
        in jax arrays. Then only the number of unsolved cases is copied to the host, and each device
        holds its part of the plans; the first device holds all if they cannot be divided equally.

    Raises:
        CaseError: a number of a case in NumPy arrays breaks its rule, such as NaN or a negative
            limit. The error names the field, the rule, the value and the first such case. In jax
            arrays, and inside compiled functions, such a case has the status `BAD_INPUT` instead.
        ValueError: the leaves do not all have one batch axis of the same length, or none; a leaf
            has another shape; the batch is empty; `chunk` < 1; the `devices` are none or not
            distinct; or the `time_limit` is negative.
        TypeError: the cases belong to another task than the planner, an array has the wrong type,
            or `solve` cannot be used inside this transformation of JAX.
    """
    watch, leaves = Watch(time_limit, progress), jax.tree.leaves(cases)
    kinds = {type(leaf) for leaf in (*leaves, *jax.tree.leaves(planner))}
    if any(issubclass(kind, Tracer) for kind in kinds):
        if watch.waits:
            raise ArgumentTypeError(
                "time_limit and progress", "left out inside compiled functions", shown=""
            )
        return solve(planner, cases)
    keep_compiled_programs()
    require_fit(planner, cases)
    if chunk is not None or devices is not None:
        _require_layout(chunk, devices)
    _require_own_precision(leaves)
    alone, resident = cases.batch_shape == (), is_resident(cases)
    if not alone:
        require_batch(cases)
        if not resident:
            require_sound(cases)
    plans, _ = Driver(chunk, devices, watch)(planner, cases)
    # A single case is checked only if its plan has the status BAD_INPUT, which is faster.
    if alone and not resident and int(plans.status) == Status.BAD_INPUT:
        require_sound(cases)
    if not alone and resident and not is_resident(plans):
        plans = jax.device_put(plans, devices[0] if devices else None)
    return plans


def _require_layout(chunk: object, devices: object) -> None:
    """Raise unless `chunk` is a whole number >= 1 and `devices` are distinct devices of JAX."""
    if chunk is not None:
        require_size("chunk", chunk)
    if devices is not None:
        if not isinstance(devices, Sequence | np.ndarray) or not all(
            isinstance(device, jax.Device) for device in devices
        ):
            raise ArgumentTypeError("devices", "a sequence of jax.Device", devices)
        if not len(devices):
            raise ArgumentError("devices", "at least one", shown="none")
        if len(set(devices)) < len(devices):
            raise ValueError(f"devices must differ, got {', '.join(map(str, devices))}")


def _require_own_precision(leaves: list[PyTree]) -> None:
    """Raise `TypeError` if all floating-point arrays are float64 while JAX computes in float32."""
    if jax.config.jax_enable_x64:  # type: ignore[attr-defined]
        return
    kinds = (leaf.dtype if isinstance(leaf, _ARRAYS) else None for leaf in leaves)
    if all(kind == np.float64 for kind in kinds if kind is None or kind.kind == "f"):
        raise ArgumentTypeError("cases", "in float32 unless jax_enable_x64 is set", shown="float64")


def require_batch(cases: Case) -> int:
    """Return the number of cases of a batch; raise `ValueError` unless all arrays agree on it."""
    batch = cases.batch_shape
    if len(batch) != 1 or batch[0] == 0:
        raise ArgumentError("cases", "a batch of at least one", shown=f"batch shape {batch}")
    for path, leaf in jax.tree_util.tree_leaves_with_path(cases):
        if np.shape(leaf)[:1] != batch:
            if has_rules(cases):
                require_shapes(cases)  # its error names the array of another batch
            name = jax.tree_util.keystr(path)
            raise ArgumentError(
                f"cases{name}", f"{batch[0]} lanes", verb="have", shown=f"shape {np.shape(leaf)}"
            )
    return batch[0]


def solve(planner: Planner[CaseT, PlanT], cases: CaseT) -> PlanT:
    """Plan cases as a pure function, for compiled functions, `vmap` and `scan`.

    Each attempt after the first is made at all cases of the batch if at least one is unsolved.
    `plan` removes solved cases from the batch, and is faster where few cases are left.

    Args:
        planner: as for `plan`.
        cases: one case or a batch, as for `plan`.

    Returns:
        The plans, with jax arrays as leaves.

    Raises:
        TypeError: the planner works on the host, or the result is differentiated: the derivative of
            a solver's iterations is not the derivative of the optimum.
    """
    require_fit(planner, cases)
    require_pure(planner)
    require_shapes(cases)
    if cases.batch_shape == () and planner.kind is Kind.COMPOSITE:
        plans = solve(planner, jax.tree.map(lambda leaf: leaf[None], cases))
        return jax.tree.map(lambda leaf: leaf[0], plans)
    return _solve(planner, cases)


@jax.custom_jvp
def _solve(planner: PyTree, cases: PyTree) -> PyTree:
    """Return plans; a derivative of this function raises `TypeError`."""
    return Driver(is_pure=True)(planner, cases)[0]


@_solve.defjvp
def _raise(primals: tuple, tangents: tuple) -> tuple:
    raise TypeError(
        "plan and solve cannot be differentiated: for gradients of plans there are pj.gradient, "
        "and pj.optimal_plan inside a loss"
    )
