"""When and in what order to catch: by estimated arrival, or the best of all orders.

The estimate sees a point that accelerates evenly to its greatest speed, and a target that may
be caught while it is high enough and does not come from below. It serves to rank orders and to
guess times; the planner then optimises the times together with the trajectory.
"""

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.optimise.problem import Planner, Round
from planner_jax.optimise.status import Status, is_solved, is_unsolved
from planner_jax.task.batch import merged
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.catch.scenario import CatchScenario
from planner_jax.task.solve import plan, plan_and_count, require_batch

DECISIONS = ("best", "greedy", "given")

_GRID = 64  # times at which every target is looked at
_ACCELERATION = 7.0  # [m/s^2], sustained, of the estimate
_TURNING = 0.2  # [s] to begin to move
_STEEPEST = -0.2  # least upward part of the way back along the target's path
_FINALISTS = 6  # orders that `best` plans


@struct.dataclass
class Decision:
    """An order with its estimated times."""

    order: Array  # (N,) int32, present targets first
    times: Array  # (N,) [s], rising, in that order
    shortfall: Array  # () [m], by how much the targets stay out of the estimate's reach


@struct.dataclass
class _Timetable:
    """Where every target is, when, and whether it may be caught there."""

    times: Array  # (N, K) [s]
    places: Array  # (N, K, 3) [m], of the quadrotor
    penalty: Array  # (N, K) [m], above zero where a catch is hardly possible


def _sampled(scenario: CatchScenario) -> tuple[Array, BallState, Array]:
    """Times (N, K) up to the horizon, the targets' states and their speeds (N, K) then."""
    shares = jnp.asarray(np.arange(1, _GRID + 1) / _GRID, scenario.gravity.dtype)
    times = scenario.horizon[:, None] * shares
    states = jax.vmap(lambda target, at: jax.vmap(target.at)(at))(scenario.targets, times)
    speed = jnp.sqrt(jnp.maximum(jnp.sum(states.vel**2, axis=-1), 1e-6))
    return times, states, speed


def _timetable(scenario: CatchScenario) -> _Timetable:
    net, limits = scenario.net, scenario.limits
    times, states, speed = _sampled(scenario)
    up = jnp.array([0.0, 0.0, 1.0], times.dtype)
    from_below = jnp.maximum(states.vel[..., 2] / speed + _STEEPEST, 0.0)
    places = states.pos - net.height * up
    low = jnp.maximum(limits.min_height + 0.1 - places[..., 2], 0.0)
    return _Timetable(times=times, places=places, penalty=10.0 * from_below + 10.0 * low)


def _arrival(
    table: _Timetable, target: Array, begin: Array, place: Array, speed: Array
) -> tuple[Array, Array, Array]:
    """Earliest time (), place (3,) and shortfall () of the next catch."""
    times, places, penalty = table.times[target], table.places[target], table.penalty[target]
    distance = jnp.sqrt(jnp.maximum(jnp.sum((places - place) ** 2, axis=-1), 1e-12))
    span = jnp.maximum(times - begin - _TURNING, 0.0)
    rise = speed / _ACCELERATION
    reach = jnp.where(span < rise, 0.5 * _ACCELERATION * span**2, speed * span - 0.5 * speed * rise)
    late = jnp.where(times > begin, 0.0, 100.0)
    shortfall = jnp.maximum(distance - reach, 0.0) + penalty + late
    possible = shortfall <= 0.0
    first = jnp.where(jnp.any(possible), jnp.argmax(possible), jnp.argmin(shortfall))
    return times[first], places[first], shortfall[first]


def _follow(scenario: CatchScenario, table: _Timetable, order: Array) -> Decision:
    """Estimated times of one order (N,), present targets moved to the front."""
    order = order[jnp.argsort(~scenario.present[order], stable=True)]
    speed = 0.9 * scenario.limits.speed

    def advance(state: tuple, target: Array) -> tuple[tuple, tuple[Array, Array]]:
        begin, place = state
        time, there, shortfall = _arrival(table, target, begin, place, speed)
        here = scenario.present[target]
        time = jnp.where(here, jnp.maximum(time, begin + 0.05), begin + 0.05)
        there = jnp.where(here, there, place)
        return (time, there), (time, jnp.where(here, shortfall, 0.0))

    start = (jnp.zeros_like(scenario.gravity), scenario.head_state[0])
    _, (times, shortfalls) = jax.lax.scan(advance, start, order)
    return Decision(order=order, times=times, shortfall=jnp.sum(shortfalls))


def greedy(scenario: CatchScenario) -> Decision:
    """Catch next whatever can be caught earliest. One scenario; pure."""
    table = _timetable(scenario)
    num, speed = scenario.num_targets, 0.9 * scenario.limits.speed
    begin, place = jnp.zeros_like(scenario.gravity), scenario.head_state[0]
    left, order = jnp.ones(num, bool), []
    for _ in range(num):
        arrive = lambda target, t=begin, p=place: _arrival(table, target, t, p, speed)  # noqa: E731
        times, places, shortfalls = jax.vmap(arrive)(jnp.arange(num))
        # Absent targets come last, in any order.
        rank = jnp.where(scenario.present, times + 10.0 * shortfalls, 1e9)
        target = jnp.argmin(jnp.where(left, rank, jnp.inf))
        here = scenario.present[target]
        begin = jnp.where(here, jnp.maximum(times[target], begin + 0.05), begin)
        place = jnp.where(here, places[target], place)
        left = left & (jnp.arange(num) != target)
        order.append(target)
    return _follow(scenario, table, jnp.stack(order).astype(jnp.int32))


def best_orders(scenario: CatchScenario, finalists: int) -> Decision:
    """The orders with the least shortfall, then the earliest last catch; leaves (F, ...).

    All N! orders are looked at. One scenario; pure.
    """
    orders = jnp.asarray(list(itertools.permutations(range(scenario.num_targets))), jnp.int32)
    table = _timetable(scenario)
    decisions = jax.vmap(functools.partial(_follow, scenario, table))(orders)
    rank = decisions.times[:, -1] + 10.0 * decisions.shortfall
    chosen = jnp.argsort(rank)[: min(finalists, len(orders))]
    return jax.tree.map(lambda leaf: leaf[chosen], decisions)


_greedy = jax.jit(jax.vmap(greedy))
_best_orders = jax.jit(jax.vmap(best_orders, in_axes=(0, None)), static_argnums=1)


def closest_approach(scenario: CatchScenario) -> Array:
    """How near each target comes to where the net could be, (N,) [m]; zero is within reach.

    A bound that no plan can beat, at 64 times up to the horizon: the quadrotor leaves with its
    velocity and flies at its greatest speed in any direction, above the least height. One
    scenario; pure.
    """
    net, limits = scenario.net, scenario.limits
    times, states, speed = _sampled(scenario)
    offset = states.pos - scenario.head_state[0]
    distance = jnp.sqrt(jnp.maximum(jnp.sum(offset**2, axis=-1), 1e-12))
    # The target moves on between two of the times.
    slack = net.height + net.radius + (speed + limits.speed) * scenario.horizon[:, None] / _GRID
    far = distance - limits.speed * times - slack
    low = limits.min_height - states.pos[..., 2] - slack
    gap = jnp.min(jnp.maximum(jnp.maximum(far, low), 0.0), axis=1)
    return jnp.where(scenario.present, gap, 0.0)


@jax.jit
@jax.vmap
def _named(scenario: CatchScenario, status: Array) -> Array:
    """The status, another one where a target proves to be out of reach."""
    away = jnp.max(closest_approach(scenario)) > 0.0
    return jnp.where(is_unsolved(status) & away, jnp.int32(Status.OUT_OF_REACH), status)


def _name_out_of_reach(scenarios: CatchScenario, plans: CatchPlan) -> CatchPlan:
    """The plans, with a status of its own where a target proves to be out of reach."""
    status = _named(scenarios, plans.status)
    resident = isinstance(plans.status, jax.Array)
    return dataclasses.replace(plans, status=status if resident else np.asarray(status))


def decided(scenarios: CatchScenario, decision: Decision) -> CatchScenario:
    """The scenarios with the order and times of a decision."""
    return dataclasses.replace(scenarios, order=decision.order, times=decision.times)


def plan_catches(
    planner: Planner,
    scenarios: CatchScenario,
    decide: str = "best",
    *,
    devices: Sequence[Any] | None = None,
) -> tuple[CatchScenario, CatchPlan]:
    """Decide on orders and times, and plan.

    Args:
        planner: of this task, such as `ExactCatch()`.
        scenarios: a batch.
        decide: "best" plans the most promising of all orders and keeps the earliest last
            catch, "greedy" catches next what it can reach first, "given" takes the order and
            the times of the scenarios.
        devices: that share the batch, as for `plan`.

    Returns:
        scenarios: with the order and times that were decided; times before optimisation.
        plans: of them. An unsolved lane with a target that `closest_approach` puts out of
            reach has the status OUT_OF_REACH.
        The leaves of both are NumPy arrays, or jax arrays if those of the scenarios are.

    Raises:
        ValueError: no such decision, a given order that is not a permutation, or as for `plan`.
    """
    if decide not in DECISIONS:
        raise ValueError(f"decide must be one of {', '.join(DECISIONS)}, got {decide!r}")
    require_batch(scenarios)
    resident = all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(scenarios))
    if decide == "given":
        _require_orders(scenarios)
    elif decide == "greedy" or scenarios.num_targets == 1:
        decision = _greedy(scenarios)
        scenarios = decided(scenarios, decision if resident else jax.device_get(decision))
    else:
        found = _plan_finalists(planner, scenarios, devices)
        return jax.device_put(found, devices[0] if devices else None) if resident else found
    plans, unsolved = plan_and_count(planner, scenarios, devices=devices)
    return scenarios, _name_out_of_reach(scenarios, plans) if np.any(unsolved) else plans


def _plan_finalists(
    planner: Planner, scenarios: CatchScenario, devices: Sequence[Any] | None
) -> tuple[CatchScenario, CatchPlan]:
    """The best of the most promising orders, planned together; NumPy arrays.

    The planner's last round, its longest, is for cases of which no order is solved by then.
    """
    decisions = _best_orders(scenarios, _FINALISTS)
    finalists = decisions.order.shape[1]
    tried = [
        decided(scenarios, jax.tree.map(lambda leaf, k=k: leaf[:, k], decisions))
        for k in range(finalists)
    ]
    together = jax.tree.map(lambda *leaves: np.concatenate(leaves), *tried)
    *rounds, last = planner.rounds
    if not rounds:
        plans = plan(planner, together, devices=devices)
    else:
        plans = plan(_with_rounds(planner, rounds), together, devices=devices)
        cases = is_solved(plans.status).reshape(finalists, -1).any(axis=0)
        lanes = np.flatnonzero(is_unsolved(plans.status) & ~np.tile(cases, finalists))
        if lanes.size:
            left = jax.tree.map(lambda leaf: leaf[lanes], together)
            later = plan(_with_rounds(planner, [last]), left, devices=devices)
            plans = merged(plans, later, lanes)
    shaped = lambda leaf: np.asarray(leaf).reshape(finalists, -1, *np.shape(leaf)[1:])  # noqa: E731
    plans, together = jax.tree.map(shaped, plans), jax.tree.map(shaped, together)
    solved = np.asarray(is_solved(plans.status))
    rank = np.where(solved, plans.times[..., -1], 1e6 + np.nan_to_num(plans.violation, nan=1e9))
    chosen, lanes = rank.argmin(axis=0), np.arange(rank.shape[1])
    pick = lambda leaf: leaf[chosen, lanes]  # noqa: E731
    together, plans = jax.tree.map(pick, together), jax.tree.map(pick, plans)
    return together, plans if solved.any(axis=0).all() else _name_out_of_reach(together, plans)


def _with_rounds(planner: Planner, rounds: list[Round]) -> Planner:
    return dataclasses.replace(planner, rounds=tuple(rounds))  # type: ignore[type-var]


def optimal_time_ratio(scenarios: CatchScenario, plans: CatchPlan) -> np.ndarray:
    """Mean of |T_o - T_p| / T_o over the targets of every case, (B,) (paper 000, eq. 29).

    Args:
        scenarios: with the times T_p that were decided, a batch.
        plans: of them, with the optimised times T_o.
    """
    decided_times, optimised = np.asarray(scenarios.times), np.asarray(plans.times)
    present = np.take_along_axis(np.asarray(scenarios.present), np.asarray(scenarios.order), axis=1)
    with np.errstate(all="ignore"):
        ratio = np.where(present, np.abs(optimised - decided_times) / optimised, 0.0)
        return ratio.sum(axis=1) / present.sum(axis=1)


def _require_orders(scenarios: Any) -> None:
    order = np.asarray(scenarios.order)
    wrong = np.flatnonzero((np.sort(order, axis=-1) != np.arange(order.shape[-1])).any(axis=-1))
    if wrong.size:
        raise ValueError(
            f"order must be a permutation of 0..{order.shape[-1] - 1}, "
            f"got {order[wrong[0]].tolist()} in scenario {wrong[0]}"
        )
