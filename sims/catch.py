"""Catches in flight: one to three balls, thrown a service interval apart (paper 000)."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.ball.prediction import PathTable, predict_path
from planner_jax.optimise.multistart import solve_round
from planner_jax.optimise.problem import Planner
from planner_jax.task.catch.decide import plan_catches
from planner_jax.task.catch.exact import ExactCatch
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.catch.replan import ReplanCatch, ReplanScenario
from planner_jax.task.catch.scenario import CatchScenario, catch_scenario
from planner_jax.task.catch.suites import make_suite
from sims.closed_loop import (
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
from sims.launch import flight_keys, launched, ready, require_hovering, require_world
from sims.model import NET

HOME = (0.0, 0.0, 1.0)  # [m], where the quadrotor hovers
INTERVAL = 0.8  # [s], from throw to throw (paper 000, Fig. 1)
SEEN = 0.3  # [s], a throw's flight before it is planned for: 2 m and more (paper 000, VII-A)
DRAG = 0.0616  # [1/m], K_D of the published serves; paper 000 gives none
_TABLE_NODES = 36
_AIM_RADIUS = 0.05  # [m], of the net that plans are made for; the rest is left for errors
_AFTER = 0.05  # [s] flown after the last ball has come down to where it may be caught


@dataclasses.dataclass(frozen=True)
class CatchPilot:
    """Plans catches anew from the plan that is flown."""

    # Later than 0.2 s before a catch a new plan shakes more than the news of the ball is worth.
    planner: ReplanCatch = ReplanCatch(shortest=0.2)
    excess: float = 0.1  # relative, over a limit, with which a new plan is still flown

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
        return found, good & (found.violation <= self.excess)


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

    @property
    def caught(self) -> np.ndarray:
        """Which balls fell into the net, (B, N) bool."""
        return np.asarray(self.flown.contact.met)


@functools.partial(jax.jit, static_argnames="loop")
def scenarios(loop: Loop, flights: Flight, horizon: Array) -> CatchScenario:
    """What is to be caught from now on, as it is believed; horizons (B, N) [s] from now."""
    unknown: Any = None
    empty = catch_scenario(
        unknown, np.zeros(horizon.shape), gravity=loop.world.gravity, net_radius=_AIM_RADIUS
    )

    def one(scenario: CatchScenario, flight: Flight, horizon: Array) -> CatchScenario:
        head = scenario.head_state
        if flight.plan is None:
            head = head.at[0].set(flight.physics.qpos[:3])
        else:
            head = state_at(with_rest(flight.plan.trajectory), flight.time - flight.began)
        balls = expected(loop, flight.earlier, loop.period)
        return dataclasses.replace(
            scenario,
            targets=tables(balls, flight.earlier.drag, horizon, scenario.gravity),
            present=flight.present,
            horizon=horizon,
            head_state=head,
        )

    return jax.vmap(one)(empty, flights, horizon)


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

    Whenever a ball comes into sight, all catches still to be made are planned from scratch, next
    whatever can be caught first; in between they are re-planned inside the loop.

    Args:
        loop: world, sensing, rates and gains.
        cases: the balls.
        seed: of the noise, >= 0.
        planner: of the plans from scratch, by default `ExactCatch`.
        pilot: of the plans in between.
        plan: first plan of each flight, instead of one made here.

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
    plans, records = [], []
    for ball in range(num_balls):
        flight = launched(loop, flight, balls, drag, believed, ball=ball, seen=SEEN)
        begins = INTERVAL * (np.arange(num_balls) - ball)  # of the balls' own times, from now
        scenario = scenarios(loop, flight, jnp.asarray(cases.horizon + begins, jnp.float32))
        if plan is None or ball > 0:
            plans.append(plan_catches(planner, jax.tree.map(np.asarray, scenario), "greedy")[1])
        else:
            require_catch_plan(plan, scenario)
            plans.append(plan)
        begun = jax.tree.map(jnp.asarray, plans[-1])
        flight = dataclasses.replace(flight, plan=begun, began=flight.time)
        last = ball == num_balls - 1
        duration = float(cases.horizon.max()) + _AFTER if last else INTERVAL
        flight, record = fly_leg(
            loop,
            pilot,
            flight,
            dataclasses.replace(scenario, horizon=scenario.horizon + INTERVAL * ball),
            drag,
            num_periods=loop.num_periods(duration),
        )
        records.append(record)
    return CatchFlights(first_plan=plans[0], flown=flown(flight, records))


def require_catch_plan(plan: Any, scenario: CatchScenario) -> None:
    """Raise `ValueError` unless a plan is one of these catches."""
    if not isinstance(plan, CatchPlan):
        raise ValueError(f"plan must be a CatchPlan, got a {type(plan).__name__}")
    num = scenario.num_targets
    if np.shape(plan.times)[-1] != num:
        raise ValueError(f"plan must be of {num} balls, got {np.shape(plan.times)[-1]}")
    require_hovering(scenario.head_state, plan)
