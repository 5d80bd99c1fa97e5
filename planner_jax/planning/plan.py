"""`plan`: one call for one case or a million, on one device or all of them; and `solve`, pure."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.experimental import multihost_utils

from planner_jax.core.checks import require_size
from planner_jax.core.planner import CaseT, Kind, Planner, PlanT, require_fit
from planner_jax.core.protocol import Attempt, Case, Status, is_unsolved
from planner_jax.core.rules import has_rules, require_shapes, require_sound
from planner_jax.planning.batch import plan_batch
from planner_jax.planning.host_batch import plan_on_host
from planner_jax.planning.programs import solve_cases
from planner_jax.planning.progress import Progress, Watch
from planner_jax.planning.select import better_of
from planner_jax.planning.single import plan_single


def plan(
    planner: Planner[CaseT, PlanT],
    cases: CaseT,
    *,
    chunk: int | None = None,
    devices: Sequence[Any] | None = None,
    time_limit: float | None = None,
    progress: Callable[[Progress], Any] | None = None,
) -> PlanT:
    """Plan one case, or a batch of them with a leading axis on every leaf.

    Args:
        planner: such as `pj.hit.planner("exact")`; its attempts are made in order, each at the
            cases that are still unsolved.
        cases: a pytree; a batch has one more axis than a single case.
        chunk: cases that a device solves in one compiled call. The default suits the device.
        devices: that share a batch. By default all local ones, `jax.local_devices()`.
        time_limit: [s], compiling included, after which nothing more is begun but the first
            attempt; what is under way is finished. A case that is unsolved and has not been through
            all attempts by then has the status `OUT_OF_TIME`, others the bits that they would have.
        progress: told of every attempt as it begins, as chunks of it are done, and as it ends; as
            `print`, which writes a line of a `Progress`.

    Returns:
        The planner's plans with the batch shape of the cases. The leaves are NumPy arrays;
        of a batch in jax arrays they are jax arrays too, and nothing leaves the devices but
        how many cases are unsolved: each device holds its share, or the first one all if the
        batch cannot be shared evenly. Look at `status`: a case that could not be solved says so
        and holds the best that was found. The same call gives the same bits. In other company,
        chunks or devices a case's arithmetic is rounded differently, and where few iterations
        end short of the optimum it may end elsewhere, rarely with another status.
        Inside a compiled function of the caller's own it is `solve`.

    Raises:
        CaseError: a number of a case in NumPy arrays is absurd, such as NaN or a negative limit;
            one line with the field, the rule, the value and the first lane. In jax arrays such a
            lane has the status `BAD_INPUT` instead, and inside of compiled functions, too.
        ValueError: the leaves have not one batch axis or none, or of different lengths or other
            shapes, the batch is empty, `chunk` < 1, the `devices` are none or not different, or
            the `time_limit` is negative.
        TypeError: the cases are of another task than the planner, or their numbers of another
            kind; or within a transformation of JAX that the planner does not allow, see `solve`.
    """
    watch, leaves = Watch(time_limit, progress), jax.tree.leaves(cases)
    kinds = {type(leaf) for leaf in (*leaves, *jax.tree.leaves(planner))}
    if any(issubclass(kind, Tracer) for kind in kinds):
        if watch.waits:
            raise TypeError("time_limit and progress must be left out inside of compiled functions")
        return solve(planner, cases)
    require_fit(planner, cases)
    if chunk is not None or devices is not None:
        _require_layout(chunk, devices)
    _require_own_precision(leaves)
    alone = cases.batch_shape == ()
    if alone and planner.kind is Kind.COMPILED:
        return _named_if_bad(plan_single(planner, planner.attempts, cases, watch), cases)
    if not alone:
        require_batch(cases)
        if not _is_resident(cases):
            require_sound(cases)
    drive = _Drive(chunk, devices, watch)
    if planner.kind is Kind.COMPOSITE:
        plans = planner.plan_by(drive, cases)
    else:
        plans, _ = drive(planner, cases)
    if alone:
        return _named_if_bad(plans, cases)
    if _is_resident(cases) and not _is_resident(plans):
        plans = jax.device_put(plans, devices[0] if devices else None)
    return plans


def _named_if_bad(plan: PlanT, case: Any) -> PlanT:
    """The plan of one case; raises `CaseError` for one on the host that breaks a rule.

    It is looked at afterwards, as that costs nothing where all is well.
    """
    if int(plan.status) == Status.BAD_INPUT and not _is_resident(case):
        require_sound(case)
    return plan


def _require_layout(chunk: Any, devices: Any) -> None:
    """Raise unless a chunk is a number of cases, and devices are some that differ."""
    if chunk is not None:
        require_size("chunk", chunk)
    if devices is not None:
        if not isinstance(devices, Sequence | np.ndarray) or not all(
            isinstance(device, jax.Device) for device in devices
        ):
            raise TypeError(f"devices must be a sequence of jax.Device, got {devices!r:.60}")
        if not len(devices):
            raise ValueError("devices must be at least one, got none")
        if len(set(devices)) < len(devices):
            raise ValueError(f"devices must differ, got {', '.join(map(str, devices))}")


def _require_own_precision(leaves: list[Any]) -> None:
    """Raise `TypeError` for cases in float64 while JAX computes in float32.

    One array of several that NumPy has made in float64 is no such case.
    """
    if jax.config.jax_enable_x64:  # type: ignore[attr-defined]
        return
    kinds = (getattr(leaf, "dtype", None) for leaf in leaves)
    if all(kind == np.float64 for kind in kinds if kind is None or kind.kind == "f"):
        raise TypeError("cases must be in float32 unless jax_enable_x64 is set, got float64")


def _is_resident(tree: Any) -> bool:
    """Whether all leaves are jax arrays."""
    return all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(tree))


@dataclasses.dataclass(frozen=True)
class _Drive:
    """Carries out planners on batches, from the host."""

    chunk: int | None
    devices: Sequence[Any] | None
    watch: Watch
    is_pure = False

    @property
    def is_over(self) -> bool:
        """Whether the caller's time has passed."""
        return self.watch.is_over

    def __call__(
        self, planner: Any, cases: Any, attempts: Sequence[Attempt] | None = None
    ) -> tuple[Any, Any]:
        """Plans of one case or of a batch, and numbers that are all zero if none is unsolved."""
        if planner.kind is Kind.COMPOSITE:
            plans = planner.plan_by(self, cases)
            return plans, is_unsolved(plans.status)
        tried: Sequence[Attempt] = attempts or planner.attempts
        if planner.kind is Kind.HOST:
            return plan_on_host(planner, tried, cases, self.watch)
        if cases.batch_shape == ():
            one = plan_single(planner, tried, cases, self.watch)
            return one, is_unsolved(one.status)
        return plan_batch(planner, tried, cases, self.chunk, self.devices, self.watch)


def solve(planner: Planner[CaseT, PlanT], cases: CaseT) -> PlanT:
    """`plan` as a pure function, for the inside of a compiled function, `vmap` or `scan`.

    Every attempt after the first is made only if some case is unsolved by then, but then at all
    cases of the batch; `plan`, which takes out the solved ones, is quicker where few are left.

    Args:
        planner: as for `plan`.
        cases: one case or a batch, as for `plan`.

    Returns:
        The plans, jax arrays.

    Raises:
        TypeError: the planner works on the host, or the result is differentiated: the way of a
            solver is no derivative of the optimum.
    """
    require_fit(planner, cases)
    _require_pure(planner)
    require_shapes(cases)
    if cases.batch_shape == () and planner.kind is Kind.COMPOSITE:
        plans = solve(planner, jax.tree.map(lambda leaf: leaf[None], cases))
        return jax.tree.map(lambda leaf: leaf[0], plans)
    return _solve(planner, cases)


@jax.custom_jvp
def _solve(planner: Any, cases: Any) -> Any:
    return _drive_purely(planner, cases)[0]


@_solve.defjvp
def _refuse(primals: tuple, tangents: tuple) -> tuple:
    raise TypeError(
        "plan and solve cannot be differentiated: for gradients of plans there are pj.gradient, "
        "and pj.optimal_plan inside a loss"
    )


class _DrivePurely:
    """Carries out planners inside a compiled function."""

    is_pure = True
    is_over = False

    def __call__(
        self, planner: Any, cases: Any, attempts: Sequence[Attempt] | None = None
    ) -> tuple[Any, Any]:
        """Plans, and which cases are unsolved."""
        if planner.kind is Kind.COMPOSITE:
            plans = planner.plan_by(self, cases)
            return plans, is_unsolved(plans.status)
        _require_pure(planner)
        first, *others = planner.attempts if attempts is None else attempts
        plans = solve_cases(planner, cases, first)
        for attempt in others:
            due = attempt.is_due(plans)
            again = lambda plans, attempt=attempt, due=due: better_of(  # noqa: E731
                plans, solve_cases(planner, cases, attempt), due
            )
            plans = lax.cond(jnp.any(due), again, lambda plans: plans, plans)
        return plans, is_unsolved(plans.status)


_drive_purely = _DrivePurely()


def _require_pure(planner: Any) -> None:
    """Raise `TypeError` for a planner that works on the host."""
    if planner.kind is Kind.HOST:
        raise TypeError(
            f"{type(planner).__name__} works on the host: call pj.plan outside of what is compiled"
        )


def require_batch(cases: Case) -> int:
    """The length of a batch; raises `ValueError` unless all leaves have it."""
    batch = cases.batch_shape
    if len(batch) != 1 or batch[0] == 0:
        raise ValueError(f"cases must be a batch of at least one, got batch shape {batch}")
    for path, leaf in jax.tree_util.tree_leaves_with_path(cases):
        if np.shape(leaf)[:1] != batch:
            if has_rules(cases):
                require_shapes(cases)  # which names the one array that is of another batch
            name = jax.tree_util.keystr(path)
            raise ValueError(f"cases{name} must have {batch[0]} lanes, got shape {np.shape(leaf)}")
    return batch[0]


def plan_across_processes(
    planner: Planner[CaseT, PlanT], cases: CaseT, *, chunk: int | None = None
) -> PlanT:
    """`plan` where each process of `jax.distributed` plans its share of one batch.

    Args:
        planner: as for `plan`, the same in every process.
        cases: the whole batch, the same in every process.
        chunk: as for `plan`.

    Returns:
        The whole batch's plans, leaves NumPy arrays, in every process.

    Raises:
        ValueError: as for `plan`, or the batch has fewer cases than there are processes.
    """
    require_fit(planner, cases)
    num = require_batch(cases)
    processes, mine = jax.process_count(), jax.process_index()
    if num < processes:
        raise ValueError(f"cases must have a lane for each of {processes} processes, got {num}")
    shares = np.array_split(np.arange(num), processes)
    longest = shares[0].size  # every process hands in as many
    lanes = np.resize(shares[mine], longest)
    plans = plan(planner, jax.tree.map(lambda leaf: np.asarray(leaf)[lanes], cases), chunk=chunk)
    gathered = multihost_utils.process_allgather(plans)
    kept = np.concatenate([np.arange(share.size) + k * longest for k, share in enumerate(shares)])

    def whole(leaf: np.ndarray) -> np.ndarray:
        return np.asarray(leaf).reshape(-1, *leaf.shape[2:])[kept]

    return jax.tree.map(whole, gathered)
