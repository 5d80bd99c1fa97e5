"""`pj.sensitivity`: derivatives of a plan's main numbers by every number of its case."""

import functools
from collections.abc import Sequence
from typing import Generic

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.checks import require_values
from planner_jax.core.errors import NotOffered
from planner_jax.core.planner import PlanT
from planner_jax.core.registry import Task
from planner_jax.core.tasks import all_tasks
from planner_jax.cost.quadrotor import flight_excess, flight_names, relative_excess
from planner_jax.optimise.sensitivity import Numbers, members_of, part_of
from planner_jax.planning.gradient import gradient
from planner_jax.planning.programs import Device
from planner_jax.robot.car import CarLimits, CarPlan
from planner_jax.robot.quadrotor import QuadrotorPlan
from planner_jax.trajectory.polynomial import sample_pieces

_NODES = 32  # intervals of a polynomial piece, at whose ends margins are evaluated
# Tasks whose programs end the process by a segmentation fault (JAX 0.10.2, CPU).
_REFUSED = ("rally",)
_ROWS = 5  # greatest number of rows that a table shows for each number


@struct.dataclass
class Sensitivity(Generic[PlanT]):
    """Derivatives of numbers of plans by numbers of their cases, for one case or a batch.

    The leaves of a batch have a leading axis B. `str` makes a table, and `relative` has the
    sensitivities without units.
    """

    plans: PlanT
    # Numbers () by name: times of contact [s], "cost", and "margin.LIMIT".
    values: dict[str, Array]
    case: dict[str, PyTree]  # floating numbers of the case by dotted name
    # For a name of `values` and a name of `case`: d value / d leaf, with the shape of the leaf. NaN
    # where the plan is no optimum.
    by: dict[str, dict[str, Array]]
    stationarity: Array  # (), as in the result of `pj.gradient`
    residual: dict[str, Array]  # () for each name of `values`, as in the result of `pj.gradient`

    def relative(self, number: str) -> dict[str, np.ndarray]:
        """Return (theta / q) dq / dtheta for a number q and every number theta of the case.

        It is the change of q in percent if theta grows by 1 percent; 0 where theta is 0. For a
        margin, the result is theta dq / dtheta, as a margin is already relative to its limit.
        """
        value, batch = np.asarray(self.values[number], float), np.ndim(self.stationarity)
        if number.startswith("margin."):
            value = np.ones_like(value)

        def scale(theta: Array, slope: Array) -> np.ndarray:
            unit = value.reshape(value.shape + (1,) * (np.ndim(theta) - batch))
            size = np.asarray(theta, float)
            with np.errstate(all="ignore"):  # numbers without a limit are infinite
                found = np.where(size == 0.0, 0.0, size * np.asarray(slope, float) / unit)
            return np.where(np.isinf(size), 0.0, found)

        return {name: scale(self.case[name], slope) for name, slope in self.by[number].items()}

    def table(self, number: str, rows: int = _ROWS) -> list[tuple[str, float]]:
        """Return the numbers of the case to which a number is most sensitive, most first.

        Each row has the name with its index, and the relative sensitivity; for a batch the median
        over the cases that have a gradient.
        """
        batch, found = np.ndim(self.stationarity), []
        for name, each in self.relative(number).items():
            if batch:
                each = each[np.isfinite(each).reshape(len(each), -1).all(axis=1)]
                each = np.median(each, axis=0) if len(each) else np.full(each.shape[1:], np.nan)
            for index in np.ndindex(each.shape):
                where = f"[{', '.join(map(str, index))}]" if index else ""
                found.append((name + where, float(each[index])))
        known = [row for row in found if np.isfinite(row[1]) and row[1] != 0.0]
        return sorted(known, key=lambda row: -abs(row[1]))[:rows]

    def __str__(self) -> str:
        """Return a table of every number, with the largest relative sensitivities first."""
        lines = ["| number | value | by | relative sensitivity |", "|---|---|---|---|"]
        for number, value in self.values.items():
            middle = f"{np.median(np.asarray(value, float)):.4g}"
            rows = self.table(number) or [("no gradient, or none that is not zero", np.nan)]
            lines += [f"| {number} | {middle} | {name} | {each:+.3g} |" for name, each in rows]
        return "\n".join(lines)


def sensitivity(
    planner: PyTree,
    cases: PyTree,
    *,
    chunk: int | None = None,
    devices: Sequence[Device] | None = None,
) -> Sensitivity:
    """Plan cases, and differentiate the main numbers of every plan by all numbers of its case.

    The numbers are the times of contact, which the task names (`stroke.time` of a hit), the cost,
    and for quadrotors and cars the margin of each limit of motion: 1 - q / limit for the greatest q
    along the trajectory, and for the least height the height above it [m]. One program computes all
    derivatives, as `pj.gradient` does.

    Args:
        planner: a planner that minimises, as for `pj.gradient`.
        cases: one case or a batch.
        chunk: as for `pj.plan`.
        devices: as for `pj.plan`.

    Raises:
        TypeError: the planner does not minimise, the cases have a wrong type, or they are rallies.
    """
    require_values("sensitivity", planner, cases)
    task = _task_of(cases)
    if task is not None and task.name in _REFUSED:
        raise NotOffered(
            f"pj.sensitivity does not offer the task {task.name}, as XLA's program ends the process"
            " on a CPU: use pj.gradient by the parts that you need"
        )
    names, contact = tuple(_floating_names(cases)), None if task is None else task.contact
    found = gradient(
        planner, cases, of=_numbers_of(contact), by=names, chunk=chunk, devices=devices
    )
    labels = _labels(found.plans, cases, contact)
    batch = np.ndim(found.stationarity)
    pick = lambda leaf, k: leaf[:, k] if batch else leaf[k]  # noqa: E731
    return Sensitivity(
        plans=found.plans,
        values={label: pick(found.value, k) for k, label in enumerate(labels)},
        case={name: np.asarray(part_of(cases, name)) for name in names},
        by={
            label: {name: pick(leaf, k) for name, leaf in found.by.items()}
            for k, label in enumerate(labels)
        },
        stationarity=found.stationarity,
        residual={label: pick(found.residual, k) for k, label in enumerate(labels)},
    )


def _floating_names(tree: PyTree, before: str = "") -> list[str]:
    """Return the dotted names of the floating leaves of a case, without positions of origins."""
    if members := members_of(tree):
        parts = [_floating_names(each, f"{before}{name}.") for name, each in members.items()]
        return [name for part in parts for name in part]
    name = before.removesuffix(".")
    is_array = isinstance(tree, Array | np.ndarray | np.floating) and not name.endswith("origin")
    return [name] if is_array and jnp.issubdtype(jnp.result_type(tree), jnp.floating) else []


def _task_of(cases: PyTree) -> Task | None:
    """Return the registered task of cases; None for cases of a user's own task."""
    home = type(cases).__module__.rpartition(".")[0]
    return next((task for task in all_tasks().values() if task.home == home), None)


@functools.cache  # each new function would compile a new program
def _numbers_of(contact: str | None) -> Numbers:
    def numbers(plan: PyTree, case: PyTree) -> Array:
        return jnp.stack([value for _, value in _list_numbers(plan, case, contact)])

    return Numbers(numbers)


def _labels(plans: PyTree, cases: PyTree, contact: str | None) -> list[str]:
    """Return the names of the numbers of plans; nothing is computed."""
    labels: list[str] = []

    def collect(plan: PyTree, case: PyTree) -> Array:
        labels[:] = [label for label, _ in _list_numbers(plan, case, contact)]
        return plan.cost

    jax.eval_shape(jax.vmap(collect) if cases.batch_shape else collect, plans, cases)
    return labels


def _list_numbers(plan: PyTree, case: PyTree, contact: str | None) -> list[tuple[str, Array]]:
    """Return pairs of a name and a number () of one plan."""
    found = []
    if contact is not None:
        times = functools.reduce(getattr, contact.split("."), plan)
        single = times.shape == ()
        found += (
            [(contact, times)]
            if single
            else [(f"{contact}.{k}", times[k]) for k in range(times.shape[0])]
        )
    found += [("cost", plan.cost)] if contact != "cost" else []
    if isinstance(plan, QuadrotorPlan):
        found += _flight_margins(plan, case)
    elif isinstance(plan, CarPlan):
        found += _car_margins(plan, case.limits)
    return found


def _flight_margins(plan: QuadrotorPlan, case: PyTree) -> list[tuple[str, Array]]:
    motion = sample_pieces(plan.trajectory, _NODES)
    excess = flight_excess(motion, case.gravity, case.limits)
    greatest = relative_excess(case.limits, [_greatest(each) for each in excess])
    margins: dict[str, Array] = {}
    for name, each in zip(flight_names(case.limits), greatest, strict=True):
        margins[name] = jnp.minimum(margins.get(name, jnp.inf), -each)
    return [(f"margin.{name}", each) for name, each in margins.items()]


def _greatest(values: Array) -> Array:
    """Return the greatest of values (N,); unlike `jnp.max`, the derivative is always finite.

    `jnp.max` divides by the number of values that are equal to the greatest one. This number is 0
    if XLA computes the values again with other rounding.
    """
    return values[jnp.argmax(values)]


def _car_margins(plan: CarPlan, limits: CarLimits) -> list[tuple[str, Array]]:
    step = plan.time / (plan.speed.shape[0] - 1)
    quantities = {
        "speed": plan.speed,
        "acceleration": jnp.diff(plan.speed) / step,
        "lateral_acceleration": plan.speed**2 * plan.curvature,
        "curvature": plan.curvature,
    }

    def margin(limit: Array, values: Array) -> Array:
        is_finite = jnp.isfinite(limit)
        return 1.0 - jnp.where(is_finite, _greatest(jnp.abs(values)), 0.0) / jnp.where(
            is_finite, limit, 1.0
        )

    return [(f"margin.{k}", margin(vars(limits)[k], each)) for k, each in quantities.items()]
