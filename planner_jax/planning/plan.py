"""`plan`, for one case or a large batch on any devices."""

import dataclasses
import time
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import PyTree

from planner_jax.core.checks import require_scalar
from planner_jax.core.compiled import has_only_cpu, with_own_precision
from planner_jax.core.errors import ArgumentError, ArgumentTypeError, NotOffered
from planner_jax.core.origin import with_origin, without_origin
from planner_jax.core.planner import CaseT, Kind, Planner, PlanT, require_fit
from planner_jax.core.protocol import (
    BaseAttempt,
    Status,
    is_better,
    is_resident,
    is_unsolved,
    mark_out_of_time,
    select,
    select_into,
)
from planner_jax.core.rules import Case, require_shapes, require_sound
from planner_jax.host.compile_cache import keep_compiled_programs
from planner_jax.planning.programs import BUCKETS, GPU_LEAST_PADDED, Device, is_cpu, solve_one

_ARRAYS = (jax.Array, np.ndarray, np.generic)
_QUIET = 1.0  # [s] least time between two progress reports of one attempt


@dataclasses.dataclass(frozen=True)
class Progress:
    """Report of `plan` on the progress of an attempt (search); `str` formats it as one line.

    Attributes:
        attempt: number of this attempt, counted from 1.
        attempts: greatest number of attempts that the planner makes.
        tried: number of cases that this attempt has tried so far.
        cases: number of cases of this attempt: all that earlier attempts left unsolved.
        seconds: [s], time since the start of planning.
    """

    attempt: int
    attempts: int
    tried: int
    cases: int
    seconds: float

    def __str__(self) -> str:
        return (
            f"attempt {self.attempt} of at most {self.attempts}: {self.tried:,} of {self.cases:,} "
            f"cases tried, after {self.seconds:.1f} s"
        )


class Watch:
    """The clock of one call of `plan`: it reports progress and knows when the time limit passes.

    Args:
        time_limit: [s] time after the construction from which no search starts; None: no limit.
        progress: function that receives a `Progress` for each report; None: no reports.

    Raises:
        TypeError: the time limit is not a number, or `progress` is not callable.
        ValueError: the time limit is negative or NaN.
    """

    def __init__(
        self, time_limit: float | None = None, progress: Callable[[Progress], object] | None = None
    ) -> None:
        if time_limit is not None and not require_scalar("time_limit", time_limit) >= 0.0:
            raise ArgumentError("time_limit", ">= 0 s", time_limit)
        if progress is not None and not callable(progress):
            raise ArgumentTypeError("progress", "callable, such as print", progress)
        self._start, self._limit, self._progress = time.monotonic(), time_limit, progress
        self._reported = (0, 0.0)  # number of the attempt, and time [s], of the last report

    @property
    def waits(self) -> bool:
        """Return whether the host waits for each call, as a time limit or progress reports need."""
        return self._limit is not None or self._progress is not None

    @property
    def is_over(self) -> bool:
        """True if the time limit has passed."""
        return self._limit is not None and time.monotonic() - self._start >= self._limit

    def report(self, planner: Planner, attempt: BaseAttempt, tried: int, cases: int) -> None:
        """Report progress at the start and end of a search, and else at most once a second."""
        if self._progress is None:
            return
        seconds, attempts = time.monotonic() - self._start, tuple(planner.attempts)
        place = attempt.place_among(attempts) + 1
        last_place, last = self._reported
        if 0 < tried < cases and place == last_place and seconds - last < _QUIET:
            return
        self._reported = place, seconds
        self._progress(Progress(place, max(len(attempts), place), int(tried), int(cases), seconds))


def plan(
    planner: Planner[CaseT, PlanT],
    cases: CaseT,
    *,
    chunk: int | None = None,
    devices: Sequence[Device] | None = None,
    time_limit: float | None = None,
    progress: Callable[[Progress], PyTree] | None = None,
) -> PlanT:
    """Plan one case, or a batch of cases with a leading axis on every leaf.

    Inside a compiled function of the caller this is `solve`. A repeated call returns bitwise equal
    plans. With other cases in the batch, another `chunk` or other devices, a case's arithmetic is
    rounded differently. A search that ends before the optimum may then end at
    another point, rarely with another status.

    Args:
        planner: a planner such as `pj.hit.planner("exact")`; its attempts (searches) are made in
            order, each at the cases that are still unsolved.
        cases: one case of the planner's task, or a batch, which has one more leading axis.
        chunk: number of cases that a device solves in one compiled call. The default suits it.
        devices: devices that share a batch. By default all local ones, `jax.local_devices()`. Each
            device plans its share in a thread of its own. A GPU takes no share below 1,024 cases,
            and a CPU none below 16; smaller batches use fewer devices.
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
            rule = "left out inside compiled functions"
            raise ArgumentTypeError("time_limit and progress", rule, shown="")
        from planner_jax.planning.solve import solve  # only compiled functions need it

        return solve(planner, cases)
    keep_compiled_programs()
    require_fit(planner, cases)
    if chunk is not None or devices is not None:
        from planner_jax.planning.spread import require_layout  # by default neither is passed

        require_layout(chunk, devices)
    _require_own_precision(leaves)
    alone, resident = cases.batch_shape == (), is_resident(cases)
    if not alone:
        require_batch(cases)
        if not resident:
            require_sound(cases)
    used = _devices_for(planner, cases, devices)
    if len(used) > 1:
        from planner_jax.planning.spread import plan_shares  # one device does not need it

        solve_share = lambda device, watch, some: Driver(chunk, device, watch)(planner, some)[0]  # noqa: E731
        plans = plan_shares(solve_share, without_origin(cases), used, watch)
    else:
        device = used[0] if len(used) else None
        plans, _ = Driver(chunk, device, watch)(planner, without_origin(cases))
    # To save time, a single case's numbers are checked on the host only after the status BAD_INPUT.
    if alone and not resident and int(plans.status) == Status.BAD_INPUT:
        require_sound(cases)
    if not alone and resident and not is_resident(plans):
        plans = jax.device_put(plans, devices[0] if devices else None)
    return with_origin(plans, cases)


def _devices_for(
    planner: Planner,
    cases: PyTree,
    devices: Sequence[Device] | None,
) -> Sequence[Device]:
    """Return the devices that share a batch, each with enough cases to be worth its thread.

    None means the default device. The local devices are not listed for one case, as it takes time.
    """
    first = () if devices is None else devices[:1]
    if cases.batch_shape == () or planner.kind is Kind.HOST:
        return first
    devices = jax.local_devices() if devices is None else devices
    least = BUCKETS[0] if is_cpu(devices[0]) else GPU_LEAST_PADDED
    used = devices[: max(1, cases.batch_shape[0] // least)]
    return used if len(used) > 1 else first


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
            require_shapes(cases)  # its error names the array of another batch
            name = jax.tree_util.keystr(path)
            raise ArgumentError(
                f"cases{name}", f"{batch[0]} lanes", verb="have", shown=f"shape {np.shape(leaf)}"
            )
    return batch[0]


@dataclasses.dataclass(frozen=True)
class Driver:
    """The loop over a planner's attempts (searches) in `pj.plan` or, with `is_pure`, `pj.solve`."""

    chunk: int | None = None
    device: Device | None = None
    watch: Watch = dataclasses.field(default_factory=Watch)
    is_pure: bool = False  # for use inside a compiled program

    @property
    def is_over(self) -> bool:
        """True if the `time_limit` of `pj.plan` has passed."""
        return self.watch.is_over

    @with_own_precision
    def __call__(
        self, planner: Planner, cases: PyTree, attempts: Sequence[BaseAttempt] | None = None
    ) -> tuple[PyTree, PyTree]:
        """Plan by these attempts (searches), or by all attempts of the planner.

        Returns the plans, and a count or mask of unsolved cases; None for composite planners.
        """
        if planner.kind is Kind.COMPOSITE:
            return planner.plan_by(self, cases), None
        attempts = attempts or planner.attempts_for(cases)
        attempts = planner.group_attempts(attempts, cases, is_whole=self.is_pure)
        if self.is_pure:
            from planner_jax.planning.pure import plan_purely  # only compiled functions need it

            require_pure(planner)
            plans = plan_purely(planner, attempts, cases)
            return plans, is_unsolved(plans.status)
        cases = planner.fit_shapes(cases)
        if planner.kind is Kind.HOST:
            from planner_jax.planning.batch import plan_on_host  # compiled programs do not need it

            return plan_on_host(planner, attempts, cases, self.watch)
        if cases.batch_shape == ():
            plans = _plan_one(planner, attempts, cases, self.watch)
            return plans, is_unsolved(int(plans.status))
        if cases.batch_shape == (1,) and has_only_cpu() and self.device is None:
            case = jax.tree.map(lambda leaf: np.asarray(leaf)[0], cases)
            plan = _plan_one(planner, attempts, case, self.watch)
            plans = jax.tree.map(lambda leaf: np.array(leaf)[None], plan)
            return plans, is_unsolved(plans.status)
        from planner_jax.planning.batch import plan_batch  # single cases do not need it

        return plan_batch(planner, attempts, cases, self.chunk, self.device, self.watch)

    def plan_again(
        self, plan_of: Callable[[PyTree], PyTree], cases: PyTree, plans: PyTree, left: PyTree
    ) -> PyTree:
        """Plan the cases in the mask `left` (B,) again by `plan_of`; keep the better plans."""
        if self.is_pure:
            again = lambda plans: select(plan_of(cases), plans, left)  # noqa: E731
            return lax.cond(jnp.any(left), again, lambda plans: plans, plans)
        lanes = np.flatnonzero(left)
        if not lanes.size:
            return plans
        if self.is_over:
            return mark_out_of_time(plans, left)
        return select_into(plans, plan_of(jax.tree.map(lambda leaf: leaf[lanes], cases)), lanes)


def _plan_one(
    planner: Planner, attempts: Sequence[BaseAttempt], case: PyTree, watch: Watch
) -> PyTree:
    """Return the plan of one case: make searches until one solves the case or the time is over."""
    best: PyTree = None
    for attempt in attempts:
        if best is not None and not attempt.is_due(best):
            continue
        if best is not None and watch.is_over:
            return mark_out_of_time(best, True)
        watch.report(planner, attempt, 0, 1)
        plan = solve_one(planner, case, attempt, best)
        watch.report(planner, attempt, 1, 1)
        if best is None or is_better(plan, best):
            best = plan
        if not is_unsolved(int(best.status)) and not any(each.improves for each in attempts):
            break
    return best


def require_pure(planner: Planner) -> None:
    """Raise `TypeError` for a planner that runs on the host, outside of compiled programs."""
    if planner.kind is Kind.HOST:
        raise NotOffered(
            f"{type(planner).__name__} works on the host: call pj.plan outside compiled functions"
        )
