"""`pj.replan`: it plans again while an earlier plan is executed, for changed circumstances."""

import dataclasses
from typing import Any, ClassVar, Generic

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.core import Tracer
from jaxtyping import PyTree

from planner_jax.core.arithmetic import Numbers, float_type, to_host
from planner_jax.core.checks import numbers_of, require_kind
from planner_jax.core.compiled import with_own_precision
from planner_jax.core.errors import ArgumentError
from planner_jax.core.origin import Located, move, with_origin, without_origin
from planner_jax.core.planner import CaseT, Planner, PlanT, require_planner
from planner_jax.core.rules import Case
from planner_jax.planning.plan import plan
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate, states_at


@struct.dataclass
class Replanning(Generic[CaseT, PlanT]):
    """The input of a re-planner: the present planning problems and the plans being executed."""

    case: CaseT  # the case as known at present; its times count from the present
    previous: PlanT  # the plan being executed, which started `elapsed` seconds ago
    elapsed: Array | np.ndarray  # () [s]

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape () for one case, or (B,) for a batch of B cases."""
        return self.case.batch_shape


def check_elapsed(cases: Case, elapsed: PyTree) -> Numbers:
    """Check and return the time [s] since the plans started: one number, or one for each case.

    A traced time that is negative or infinite becomes NaN.

    Raises:
        TypeError: `elapsed` is not a number.
        ValueError: `elapsed` is negative, not finite, or of another shape.
    """
    elapsed = numbers_of("elapsed", elapsed, cases.batch_shape, ()).astype(float_type(cases))
    if isinstance(elapsed, Tracer):
        return jnp.where((elapsed >= 0.0) & (elapsed < np.inf), elapsed, np.nan)
    # For a single number, minimum and maximum take a third of the time that `np.all` takes.
    least = np.minimum.reduce(elapsed, axis=None, initial=np.inf)
    most = np.maximum.reduce(elapsed, axis=None, initial=0.0)
    if not least >= 0.0:
        raise ArgumentError("elapsed", ">= 0", least)
    if not most < np.inf:
        raise ArgumentError("elapsed", "finite", most)
    return elapsed


def planned_state(trajectory: PiecewisePolynomial, elapsed: Numbers) -> Numbers:
    """Return position, velocity, acceleration and jerk (..., 4, 3) as planned at `elapsed` [s].

    After the end of the trajectory, the state is that at the end.
    """
    if any(isinstance(each, Tracer) for each in (*jax.tree.leaves(trajectory), elapsed)):
        find = _state_at if elapsed.ndim == 0 else jax.vmap(_state_at)
        return find(jax.tree.map(jnp.asarray, trajectory), jnp.asarray(elapsed))
    end = np.sum(trajectory.durations, axis=-1)
    return np.asarray(states_at(trajectory, np.asarray(np.minimum(elapsed, end))))


def _state_at(trajectory: PiecewisePolynomial, elapsed: Array) -> Array:
    time = jnp.minimum(elapsed, jnp.sum(trajectory.durations))
    return jnp.stack([evaluate(trajectory, time, order) for order in range(4)])


def resolve_argument(name: str, given: PyTree, own: PyTree, elapsed: Numbers) -> Numbers:
    """Return an argument's value: `given` by the caller or, if that is None, `own` of the plan.

    Both values are for one case, or for each case. The result has the shape and type of `elapsed`.
    It is NaN where a traced `elapsed` is NaN, which leads to the status `BAD_INPUT`.

    Raises:
        TypeError: the argument does not hold numbers.
        ValueError: the argument has another shape, or is not finite.
    """
    batch, shape = elapsed.shape, np.shape(own)
    found = to_host(own) if given is None else numbers_of(name, given, batch, shape[len(batch) :])
    found = found.astype(elapsed.dtype)
    if isinstance(elapsed, Tracer):
        times = elapsed.reshape(batch + (1,) * (len(shape) - len(batch)))
        return jnp.where(times == times, found, np.nan)
    if given is not None and not isinstance(found, Tracer) and not np.isfinite(found).all():
        raise ArgumentError(name, "finite", given)
    return found


def resolve_arguments(elapsed: Numbers, **arguments: tuple) -> dict[str, Numbers]:
    """Return the values of named arguments, each a pair (given, own), by `resolve_argument`."""
    pairs = arguments.items()
    return {name: resolve_argument(name, given, own, elapsed) for name, (given, own) in pairs}


class ReplanAround(Planner[Replanning, PlanT]):
    """A re-planner that plans cases from scratch by the planner in its field `planner`."""

    case_type: ClassVar[type] = Replanning
    planner: PyTree  # a `Planner`, whose class subclasses state

    @property
    def inner(self) -> Planner:
        """The planner that plans from scratch."""
        return self.planner

    def fit_shapes(self, tasks: Replanning) -> Replanning:
        """Return the tasks with cases that the planner has padded to one of few shapes."""
        return dataclasses.replace(tasks, case=self.planner.fit_shapes(tasks.case))


@with_own_precision
def replan(planner: PyTree, cases: PyTree, previous: PlanT, elapsed: PyTree, **news: Any) -> PlanT:
    """Plan again while a plan is executed, by a few iterations from the remainder of that plan.

    Inside compiled functions, cases, plans, times and changes of hits, catches and rallies may be
    traced. Traced numbers are not checked: an invalid one leads to the status `BAD_INPUT`.

    Args:
        planner: a planner with a `replanner`, such as `pj.catch.planner("exact")`, or a re-planner
            with its own settings, such as `planner.replanner()` with other `attempts`.
        cases: the cases of `previous`, one or a batch; their times count from the plan's start.
        previous: the plan that is being executed.
        elapsed: () or (B,) [s], time since the plan's start, >= 0.
        **news: changed quantities, with times that count from the present. Catches take `targets`
            and `head_state`, hits `ball`, `drag` and `head_state`. The default of `head_state` is
            the robot's state in the plan at this time. Interceptions take `target`, `walls`,
            `movers`, and the car's `start`, `speed` and `curvature`. Blocks take `ball` at time 0
            of the cases, and the arm's present `angles` and `rates`.

    Returns:
        The plans; their times count from the present. Times of blocks count from the first
        observation of the ball, as in their cases.

    Raises:
        TypeError: the planner has no re-planner, or cases, plans or changes are of another task.
        ValueError: `elapsed` is negative, or there is not one plan and one change for each case.
    """
    require_planner(planner)
    again = planner.replanner()
    require_kind("cases", cases, again.inner.case_type)
    require_kind("previous", previous, again.plan_type)
    if np.shape(previous.status) != cases.batch_shape:
        raise ArgumentError(
            "previous",
            f"the batch shape of the cases, {cases.batch_shape}",
            np.shape(previous.status),
            verb="have",
        )
    if not isinstance(cases, Located) or cases.origin is None:
        return plan(again, again.begin(cases, previous, elapsed, **news))
    origin = to_host(cases.origin)
    dtype, by = origin.dtype, -origin.astype(float)
    news |= {k: move(k, news[k], by, dtype, at) for k, at in cases.positions.items() if k in news}
    near = again.begin(without_origin(cases), without_origin(previous), elapsed, **news)
    return with_origin(plan(again, near), cases)
