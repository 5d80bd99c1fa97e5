"""Catches in flight: one to three balls, thrown a service interval apart (paper 000).

When a ball comes into sight the one before it is about to be caught, and the state in which that
leaves the quadrotor decides whether the next catch is possible. So every plan has one more catch
than there are balls: the next one is awaited as the shortest throw that the machine makes, which
leaves the least time, and is planned anew once it is seen.
"""

import dataclasses
import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.ball.prediction import PathTable, predict_path
from planner_jax.optimise.multistart import solve_round
from planner_jax.optimise.problem import Planner
from planner_jax.optimise.status import is_unsolved
from planner_jax.sims.closed_loop import (
    Flight,
    Flown,
    Loop,
    Outlook,
    expected,
    flown,
    fly_leg,
    state_at,
    whole,
    with_rest,
)
from planner_jax.sims.launch import (
    awaited,
    flight_keys,
    launched,
    ready,
    require_hovering,
    require_world,
)
from planner_jax.sims.model import NET
from planner_jax.task.catch.decide import plan_catches
from planner_jax.task.catch.exact import ExactCatch
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.catch.replan import ReplanCatch, ReplanScenario
from planner_jax.task.catch.scenario import CatchScenario, catch_scenario
from planner_jax.task.catch.suites import earliest_throw, make_suite

HOME = (0.0, 0.0, 1.0)  # [m], where the quadrotor hovers
INTERVAL = 0.8  # [s], from throw to throw (paper 000, Fig. 1)
SEEN = 0.3  # [s], a throw's flight before it is planned for: 2 m and more (paper 000, VII-A)
DRAG = 0.0616  # [1/m], K_D of the published serves; paper 000 gives none
_TABLE_NODES = 36
_AIM_RADIUS = 0.05  # [m], of the net that plans are made for; the rest is left for errors
# Least thrust [g] and greatest body rate [rad/s] of plans. A weak thrust and a fast turn leave
# control little; the first catch stays away from them, so that the next can begin within bounds.
# Where nothing else is left, plans go as far as the shared protocol admits.
_FIRST, _BEHIND, _WIDEST = (0.5, 3.0), (0.4, 4.5), (0.3, 5.0)
_AFTER = 0.05  # [s] flown after the last ball has come down to where it may be caught


@dataclasses.dataclass(frozen=True)
class CatchPilot:
    """Plans catches anew from the plan that is flown."""

    # Later than 0.2 s before a catch a new plan shakes more than the news of the ball is worth.
    planner: ReplanCatch = ReplanCatch(shortest=0.2)
    # Relative, over a limit, with which a new plan is still flown, unless the old one has more:
    # of the last catch, and of more, where the excess is mostly on the way to those that are
    # planned from scratch later, and an old plan would miss the ball that comes first.
    excess: tuple[float, float] = (0.1, 1.0)

    def times(self, plan: CatchPlan) -> Array:
        """When each ball is to be caught (N,) [s], in the balls' order."""
        return jnp.zeros_like(plan.times).at[plan.order].set(plan.times)

    def plan_anew(
        self, scenario: CatchScenario, plan: CatchPlan, outlook: Outlook
    ) -> tuple[CatchPlan, Array]:
        """One short round of the re-planner, and whether its plan is good enough."""
        made = plan.times <= outlook.elapsed
        first = jnp.argsort(made, stable=True)  # what is still to be caught
        order, times = plan.order[first], plan.times[first] - outlook.elapsed
        horizon = scenario.horizon - outlook.time
        left = dataclasses.replace(
            scenario,
            targets=tables(outlook.balls, outlook.drag, horizon, scenario.gravity),
            present=outlook.present,
            horizon=horizon,
            order=order,
            times=jnp.maximum(times, 0.01),
            head_state=outlook.head_state,
        )
        task = ReplanScenario(scenario=left, previous=plan, elapsed=outlook.elapsed)
        found = solve_round(self.planner, self.planner.rounds[0], task)
        good = outlook.present[order[0]] & (times[0] >= self.planner.shortest)
        excess = jnp.where(jnp.sum(outlook.present) > 1, self.excess[1], self.excess[0])
        return found, good & (found.violation <= jnp.maximum(excess, plan.violation))


def tables(balls: BallState, drag: Array, horizon: Array, gravity: Array) -> PathTable:
    """Predicted paths with quadratic drag of balls (N, ...) up to a horizon (N,) [s]."""
    predict = functools.partial(predict_path, num_nodes=_TABLE_NODES)
    horizon = jnp.maximum(horizon, 0.1)
    return jax.vmap(predict, in_axes=(0, 0, 0, None))(balls, horizon, drag, gravity)


@dataclasses.dataclass(frozen=True)
class Throws:
    """B flights of N balls each, NumPy leaves. A ball's own time begins when it is planned for."""

    balls: BallState  # leaves (B, N, 3), each at its own time 0
    horizon: np.ndarray  # (B, N) [s], until when each may be caught, its own time
    drag: np.ndarray  # (B, N) K_D [1/m], the true one
    believed: np.ndarray  # (B, N) K_D [1/m]
    index: np.ndarray  # (B,) place in the whole, which decides the noise

    def __len__(self) -> int:
        return self.horizon.shape[0]

    def __getitem__(self, rows: Any) -> "Throws":
        """Some of them, picked as NumPy does."""
        columns = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return Throws(**jax.tree.map(lambda leaf: leaf[rows], columns))


def throws(
    num: int, num_balls: int = 1, seed: int = 0, *, drag: float = DRAG, drag_error: float = 0.0
) -> Throws:
    """Balls of the suite `throws`, which from there on fly with quadratic drag.

    Args:
        num: B >= 1.
        num_balls: N, 1 to 3 in the paper.
        seed: >= 0, of the throws and of the signs of the drag's errors.
        drag: K_D [1/m], the true one.
        drag_error: relative error of what is believed of it, either way.
    """
    if num_balls < 1:
        raise ValueError(f"num_balls must be >= 1, got {num_balls}")
    if not 0.0 <= drag_error < 1.0:
        raise ValueError(f"drag_error must be >= 0 and < 1, got {drag_error}")
    suite = jax.tree.map(np.asarray, make_suite("throws", num * num_balls, seed))
    shaped = lambda leaf: leaf[:, 0].reshape(num, num_balls, *leaf.shape[2:])  # noqa: E731
    true = np.full((num, num_balls), drag, np.float32)
    sign = np.random.default_rng([seed, 1]).choice([-1.0, 1.0], (num, 1))
    return Throws(
        balls=jax.tree.map(shaped, suite.targets.ball),
        horizon=shaped(suite.horizon),
        drag=true,
        believed=(true * (1.0 + drag_error * sign)).astype(np.float32),
        index=np.arange(num),
    )


@dataclasses.dataclass(frozen=True)
class CatchFlights:
    """What came of a batch of throws; leaves with a leading axis B."""

    first_plan: CatchPlan
    flown: Flown  # times from the first plan
    planning_seconds: float  # of the host's clock, spent on plans from scratch

    @property
    def caught(self) -> np.ndarray:
        """Which balls fell into the net, (B, N) bool."""
        return np.asarray(self.flown.contact.met)


@functools.partial(jax.jit, static_argnames="loop")
def scenarios(loop: Loop, flights: Flight, new: Array, horizon: Array) -> CatchScenario:
    """The catches of a ball that has come into sight and of the next, as they are believed.

    They are to be planned from where the last catch of a ball seen before will have been made,
    or from now where none is left; times count from then.

    Args:
        loop: of the flights.
        flights: leaves (B, ...).
        new: (N,) bool, which balls these are.
        horizon: (B, N) [s] from now, until when each may be caught.
    """
    unknown: Any = None
    least_thrust, body_rate = _FIRST if flights.plan is None else _BEHIND
    empty = catch_scenario(
        unknown,
        np.zeros(horizon.shape),
        gravity=loop.world.gravity,
        net_radius=_AIM_RADIUS,
        min_thrust=least_thrust * loop.world.gravity,
        body_rate=body_rate,
    )

    def one(scenario: CatchScenario, flight: Flight, horizon: Array) -> CatchScenario:
        head, after = scenario.head_state, jnp.zeros_like(flight.time)
        if flight.plan is None:
            head = head.at[0].set(flight.physics.qpos[:3])
        else:
            after = until_last_catch(flight, new)
            path = with_rest(flight.plan.trajectory)
            head = state_at(path, flight.time - flight.began + after)
        balls = expected(loop, flight.earlier, loop.period + after)
        horizon = horizon - after
        return dataclasses.replace(
            scenario,
            targets=tables(balls, flight.earlier.drag, horizon, scenario.gravity),
            present=new,
            horizon=horizon,
            head_state=head,
        )

    return jax.vmap(one)(empty, flights, horizon)


def until_last_catch(flight: Flight, new: Array) -> Array:
    """Time () [s] to the last catch that is planned of balls not `new` (N,); 0 if none is left."""
    planned = CatchPilot().times(flight.plan) - (flight.time - flight.began)
    return jnp.maximum(jnp.max(jnp.where(flight.present & ~new, planned, 0.0)), 0.0)


@jax.jit
def with_catch(flights: Flight, found: CatchPlan, new: Array) -> Flight:
    """Flights (B, ...) with new catches behind those of the balls that were seen before.

    Args:
        flights: as `scenarios` saw them.
        found: plans (B, ...) of its scenarios.
        new: (B, N) bool, of which balls.
    """

    def one(flight: Flight, found: CatchPlan, new: Array) -> Flight:
        present = flight.present | new
        alone = dataclasses.replace(flight, plan=found, began=flight.time, present=present)
        if flight.plan is None:
            return alone
        old, number = flight.plan, new.size
        each = found.trajectory.durations.size // number
        lasts = jnp.sum(old.trajectory.durations.reshape(number, each), axis=1) > 0.0
        # Of the old plan, catches that are made included; what was awaited comes last in it.
        segments = jnp.sum(lasts & ~new[old.order])
        place = jnp.arange(number)
        before = place < segments

        def behind(old: Array, found: Array) -> Array:
            rows = jnp.where(before, 0, place - segments)
            shape = (number, *(1,) * (old.ndim - 1))
            return jnp.where(before.reshape(shape), old, found[rows])

        split = lambda leaf: leaf.reshape(number, each, *leaf.shape[1:])  # noqa: E731
        flat = lambda leaf: leaf.reshape(-1, *leaf.shape[2:])  # noqa: E731
        trajectory = jax.tree.map(
            lambda a, b: flat(behind(split(a), split(b))), old.trajectory, found.trajectory
        )
        end = old.times[segments - 1]
        rank = jnp.zeros_like(place).at[old.order].set(jnp.where(before, place, 2 * number))
        behind_rank = jnp.zeros_like(place).at[found.order].set(number + place)
        order = jnp.argsort(jnp.where(new, behind_rank, rank), stable=True)
        joined = dataclasses.replace(
            found,
            trajectory=trajectory,
            order=order.astype(old.order.dtype),
            times=behind(old.times, end + found.times),
        )
        joined = dataclasses.replace(flight, plan=joined, present=present)
        going = until_last_catch(flight, new) > 0.0
        return jax.tree.map(lambda a, b: jnp.where(going, a, b), joined, alone)

    return jax.vmap(one)(flights, found, new)


def fly_catches(
    loop: Loop,
    cases: Throws,
    seed: int = 0,
    *,
    planner: Planner | None = None,
    pilot: CatchPilot | None = None,
    plan: CatchPlan | None = None,
) -> CatchFlights:
    """Plan and fly a batch of throws.

    Whenever a ball comes into sight, its catch and that of the one awaited next are planned from
    scratch (`planned_ahead`), from where the last of those seen before will have been made; all
    that are left are then re-planned inside the loop.

    Args:
        loop: world, sensing, rates and gains.
        cases: the balls.
        seed: of the noise, >= 0.
        planner: of the plans from scratch, by default `ExactCatch`.
        pilot: of the plans in between.
        plan: first plan of each flight, of the first ball, instead of one made here.

    Raises:
        ValueError: a world, plan or number does not fit.
    """
    num_balls = cases.horizon.shape[1]
    require_world(loop, NET, num_balls)
    if num_balls > 1:
        whole(INTERVAL / loop.period, "replan", f"such that it divides {INTERVAL} s", loop.replan)
    planner, pilot = planner or ExactCatch(), pilot or CatchPilot()
    drag = jnp.asarray(cases.drag)
    balls, believed = jax.tree.map(jnp.asarray, (cases.balls, cases.believed))
    keys = flight_keys(seed, cases.index)
    flight = ready(loop, jnp.tile(jnp.array(HOME), (len(cases), 1)), keys)
    first: Any = plan
    records, planning = [], 0.0
    shortest, window = earliest_throw("throws")
    for ball in range(num_balls):
        flight = launched(loop, flight, balls, drag, believed, ball=ball, seen=SEEN)
        until = cases.horizon + INTERVAL * (np.arange(num_balls) - ball)
        given, last = plan is not None and ball == 0, ball == num_balls - 1
        if not last:
            coming = jax.tree.map(jnp.asarray, shortest)
            flight = awaited(loop, flight, coming, believed, ball=ball + 1, ahead=INTERVAL)
            until[:, ball + 1] = INTERVAL + window
        horizon = jnp.asarray(until, jnp.float32)
        new = np.isin(np.arange(num_balls), [ball] if given else [ball, ball + 1])
        scenario = scenarios(loop, flight, jnp.asarray(new), horizon)
        if given:
            require_catch_plan(plan, scenario)
            found = plan
        else:
            known = jax.tree.map(np.asarray, scenario)
            began = time.perf_counter()
            scenario, found = planned_ahead(planner, known, ball)
            planning += time.perf_counter() - began
        first = found if first is None else first
        begun = jax.tree.map(jnp.asarray, found)
        flight = with_catch(flight, begun, jnp.asarray(scenario.present))
        flight, record = fly_leg(
            loop,
            pilot,
            flight,
            dataclasses.replace(scenario, horizon=horizon + flight.time[:, None]),
            drag,
            num_periods=loop.num_periods(float(cases.horizon.max()) + _AFTER if last else INTERVAL),
        )
        records.append(record)
    return CatchFlights(first, flown(flight, records), planning)


def planned_ahead(
    planner: Planner, known: CatchScenario, ball: int
) -> tuple[CatchScenario, CatchPlan]:
    """Plans from scratch of a ball's catch and, where that is possible too, of the next one's.

    Where no plan of both is found the ball is planned for alone, and where that fails as well,
    within the widest limits. If nothing is solved, the plan that breaks its limits least is left.

    Args:
        planner: of catches.
        known: of both balls, or of the last one, a batch with NumPy leaves.
        ball: its place among the targets.

    Returns:
        The scenarios and their plans; `present` says which catches each has.
    """
    alone = np.arange(known.num_targets) == ball
    scenarios, plans = plan_catches(planner, known, "greedy")
    last = ball == known.num_targets - 1
    for limits in (_WIDEST,) if last else (None, _WIDEST):
        lanes = np.flatnonzero(is_unsolved(np.asarray(plans.status)))
        if not lanes.size:
            break
        part = jax.tree.map(lambda leaf, lanes=lanes: np.asarray(leaf)[lanes], scenarios)
        before = np.where((part.present == alone).all(axis=1), plans.violation[lanes], np.inf)
        part = within(dataclasses.replace(part, present=part.present & alone), limits)
        tried, found = plan_catches(planner, part, "greedy")
        better = ~is_unsolved(np.asarray(found.status)) | (found.violation < before)
        to, chosen = lanes[better], np.flatnonzero(better)

        def merged(old: Any, new: Any, to: np.ndarray = to, chosen: np.ndarray = chosen) -> Any:
            old = np.array(old)
            old[to] = np.asarray(new)[chosen]
            return old

        scenarios, plans = jax.tree.map(merged, (scenarios, plans), (tried, found))
    return scenarios, plans


def within(scenarios: CatchScenario, limits: tuple[float, float] | None) -> CatchScenario:
    """Scenarios with NumPy leaves with another least thrust [g] and greatest body rate [rad/s]."""
    if limits is None:
        return scenarios
    thrust, rate = limits
    gravity, old = scenarios.gravity, scenarios.limits
    new = dataclasses.replace(
        old, min_thrust=thrust * gravity, body_rate=np.full_like(old.body_rate, rate)
    )
    return dataclasses.replace(scenarios, limits=new)


def require_catch_plan(plan: Any, scenario: CatchScenario) -> None:
    """Raise `ValueError` unless a plan is one of these catches."""
    if not isinstance(plan, CatchPlan):
        raise ValueError(f"plan must be a CatchPlan, got a {type(plan).__name__}")
    num = scenario.num_targets
    if np.shape(plan.times)[-1] != num:
        raise ValueError(f"plan must be of {num} balls, got {np.shape(plan.times)[-1]}")
    require_hovering(scenario.head_state, plan)
