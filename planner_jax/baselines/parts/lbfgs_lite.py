"""L-BFGS with the rules of LBFGS-Lite, the solver of [Yu2023catch], for the published planners.

LBFGS-Lite (github.com/ZJU-FAST-Lab/LBFGS-Lite) is a C++ program. This module implements its
published rules anew: the line search of [Lewis2013], which accepts steps by the weak Wolfe
conditions; the cautious update of [Li2001], which stores no pair of small curvature; and its
stopping rule. The recursion for the direction is the library's own, `optimise.lbfgs`.
"""

import dataclasses
from collections.abc import Callable
from typing import ClassVar, Self

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.core.choices import EFFORTS, require_one_of
from planner_jax.core.errors import ArgumentError
from planner_jax.core.planner import CaseT, Planner, PlanT
from planner_jax.core.protocol import BaseAttempt
from planner_jax.optimise.lbfgs import Memory, search_direction
from planner_jax.optimise.multistart import Optimum, plan_at
from planner_jax.optimise.planner import Problem, SearchPlanner
from planner_jax.optimise.settings import Evaluation

_MEMORY = 8  # number of stored pairs: a step, and the change of the gradient along it
_ARMIJO, _WOLFE = 1e-4, 0.9  # least decrease of cost and slope that a step must reach
_CAUTIOUS = 1e-6  # least curvature of a stored pair, relative to the norm of the gradient
_PAST = 3  # number of iterations over which the decrease of the cost is measured
_TRIALS = 64  # greatest number of trial steps of one line search


@dataclasses.dataclass(frozen=True)
class LiteRule:
    """The rule that stops a search; the defaults of LBFGS-Lite, but for the iterations."""

    gradient: float = 1e-5  # least |gradient| / max(1, |x|), in greatest components
    decrease: float = 1e-6  # least decrease in 3 iterations over max(1, |cost|); 0: none
    max_steps: int = 10000  # greatest number of iterations; LBFGS-Lite has no limit


@struct.dataclass
class _Search:
    """The state between two evaluations; x is the last accepted point in n variables."""

    point: Array  # (n,), x
    cost: Array  # (), at x; infinite before the first evaluation
    grad: Array  # (n,), at x
    direction: Array  # (n,)
    length: Array  # (), next trial step along the direction
    low: Array  # (), greatest step that was too short
    high: Array  # (), least step that was too long; infinite without one
    trials: Array  # () int32, number of rejected steps along the direction
    memory: Memory
    past: Array  # (3,), costs of the last iterations, oldest first
    iteration: Array  # () int32, number of accepted steps
    stationary: Array  # () bool
    failed: Array  # () bool, whether no step along the direction is acceptable


def minimise_lite(
    cost: Callable[[Array], Array], start: Array, rule: LiteRule
) -> tuple[Array, Array, Array, Array]:
    """Minimise a function of n variables by L-BFGS with the rules of LBFGS-Lite.

    Each pass of the loop evaluates one trial step, so that the searches of a batch need not wait
    for each other's line searches. A cost that is not finite counts as too large. The search also
    ends if a line search fails, for example because of rounding errors.

    Args:
        cost: function of a point (n,) that returns a cost ().
        start: (n,).
        rule: when the search stops.

    Returns:
        The point (n,), its cost (), the number of iterations () int32, and whether the stopping
        rule was met () bool. The cost is infinite if the cost at the start is not finite.
    """
    zero, infinite = jnp.zeros_like(start), jnp.full((), jnp.inf, start.dtype)
    empty = jnp.zeros((_MEMORY, *start.shape), start.dtype)
    no = jnp.zeros((), bool)
    state = _Search(
        point=start,
        cost=infinite,
        grad=zero,
        direction=zero,
        **_new_line(infinite),
        memory=Memory(empty, empty, empty[:, 0]),
        past=jnp.full((_PAST,), jnp.inf, start.dtype),
        iteration=jnp.full((), -1, jnp.int32),  # the first evaluation, of the start, makes it 0
        stationary=no,
        failed=no,
    )

    def is_unfinished(state: _Search) -> Array:
        return ~(state.stationary | state.failed) & (state.iteration < rule.max_steps)

    def advance(state: _Search) -> _Search:
        point = state.point + state.length * state.direction
        value, grad = jax.value_and_grad(cost)(point)
        slope = jnp.sum(state.grad * state.direction)
        is_low = value <= state.cost + _ARMIJO * state.length * slope
        is_flat = jnp.sum(grad * state.direction) >= _WOLFE * slope
        accepted = _accept(state, point, value, grad, rule)
        rejected = _reject(state, is_low, slope)
        return jax.tree.map(lambda a, b: jnp.where(is_low & is_flat, a, b), accepted, rejected)

    end = lax.while_loop(is_unfinished, advance, state)
    return end.point, end.cost, jnp.maximum(end.iteration, 0), end.stationary


def _new_line(cost: Array) -> dict[str, Array]:
    """Return the fields of `_Search` at the start of a line search: a step of 1, and no bounds."""
    zero = jnp.zeros_like(cost)
    steps = {"length": zero + 1.0, "low": zero, "high": zero + jnp.inf}
    return {**steps, "trials": jnp.zeros((), jnp.int32)}


def _accept(state: _Search, point: Array, cost: Array, grad: Array, rule: LiteRule) -> _Search:
    """Return the state at a new point, with the direction of the next line search."""
    step, change = point - state.point, grad - state.grad
    curvature, norm = jnp.sum(step * change), jnp.sqrt(jnp.sum(state.grad**2))
    keep = curvature > _CAUTIOUS * norm * jnp.sum(step**2)
    newest = Memory(step, change, 1.0 / jnp.where(keep, curvature, 1.0))
    memory = jax.tree.map(
        lambda old, new: jnp.where(keep, jnp.concatenate([old[1:], new[None]]), old),
        state.memory,
        newest,
    )
    # Without stored pairs, `search_direction` returns the unit vector of steepest descent.
    is_first = state.iteration < 0
    direction = jnp.where(keep | is_first, search_direction(memory, grad, jnp.inf), -grad)
    steepness = jnp.max(jnp.abs(grad)) / jnp.maximum(1.0, jnp.max(jnp.abs(point)))
    decrease = jnp.abs(state.past[0] - cost) / jnp.maximum(1.0, jnp.abs(cost))
    return _Search(
        point=point,
        cost=cost,
        grad=grad,
        direction=direction,
        **_new_line(cost),
        memory=memory,
        past=jnp.concatenate([state.past[1:], cost[None]]),
        iteration=state.iteration + 1,
        stationary=(steepness < rule.gradient) | (decrease < rule.decrease),
        failed=state.failed,
    )


def _reject(state: _Search, is_short: Array, slope: Array) -> _Search:
    """Return the state with the next trial step: twice the step, or the middle of its bounds."""
    low = jnp.where(is_short, state.length, state.low)
    high = jnp.where(is_short, state.high, state.length)
    bracketed, trials = jnp.isfinite(high), state.trials + 1
    width = jnp.finfo(high.dtype).eps * high
    return dataclasses.replace(
        state,
        low=low,
        high=high,
        trials=trials,
        length=jnp.where(bracketed, 0.5 * (low + high), 2.0 * state.length),
        failed=(slope > 0.0) | (trials >= _TRIALS) | bracketed & (high - low < width),
    )


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class LitePlanner(Planner[CaseT, PlanT]):
    """A planner that minimises the cost of a problem by `minimise_lite` from its first guess."""

    problem: Problem
    cost_unit: float = 1.0  # factor on the problem's cost, to which the stopping rule applies
    rule: LiteRule = LiteRule()
    is_sequential: ClassVar[bool] = True  # searches of a batch differ much in their iterations
    attempts: ClassVar[tuple[BaseAttempt, ...]] = (BaseAttempt(),)  # pyright: ignore[reportIncompatibleMethodOverride]
    title = SearchPlanner.title  # pyright: ignore[reportIncompatibleMethodOverride]
    case_type = SearchPlanner.case_type  # pyright: ignore[reportAssignmentType]

    def settle(
        self, cases: CaseT, plan_of: Callable[[Planner, PyTree], PyTree] | None = None
    ) -> tuple[SearchPlanner, CaseT]:
        """Return a planner of the same problem in its usual units, for `pj.gradient`."""
        return SearchPlanner(self.problem.with_usual(("scale",))), cases

    def with_effort(self, effort: str) -> Self:
        """Return the planner itself for "feasible"; its search has one stopping rule.

        Raises:
            ArgumentError: another effort.
        """
        require_one_of(EFFORTS, "effort", effort)
        if effort != EFFORTS[0]:
            rule = f"{EFFORTS[0]} for a {self.title}, whose stopping rule is published"
            raise ArgumentError("effort", rule, effort)
        return self

    def solve(self, case: CaseT, attempt: BaseAttempt) -> PlanT:
        """Return the plan of one case at the end of the search."""
        context = self.problem.prepare(case)
        cost = lambda point: self.cost_unit * self.problem.objective(point, context)[0]  # noqa: E731
        found = minimise_lite(cost, self.problem.first_guess(context), self.rule)
        point, value, iterations, stationary = found
        value = value / self.cost_unit
        reached = Evaluation(value, jnp.zeros_like(value))
        return plan_at(self.problem, Optimum(point, reached, iterations, stationary), context)
