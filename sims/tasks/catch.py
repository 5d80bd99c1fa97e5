"""Catches in closed loop: a quadrotor's net catches balls, thrown at intervals [Yu2023catch].

When a ball comes into sight, the previous ball is about to be caught. The state of the quadrotor
after that catch decides whether the next catch is possible. Every plan therefore includes one more
catch than there are visible balls. The next ball is assumed to be the shortest throw of the
machine, which leaves the least time. Its catch is planned again once the ball is seen.
"""

import dataclasses
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.ball.flight import BallState
from planner_jax.baselines.protocols import BY_ROW
from planner_jax.core import GRAVITY
from planner_jax.core.errors import ArgumentError
from planner_jax.core.planner import Planner
from planner_jax.optimise.planner import SearchPlanner
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.robot.quadrotor_model import PAPER_CATCHER, QuadrotorModel
from planner_jax.runs.columns import BOOL, Column, list_of
from planner_jax.sims.launch import (
    await_ball,
    begin_filters,
    flight_keys,
    launch_ball,
    ready,
    require_plan,
    require_world,
)
from planner_jax.sims.loop import begin_compiling, fly_leg, in_parts
from planner_jax.sims.loop_state import Flown, Loop, collect_flights
from planner_jax.sims.model import World
from planner_jax.sims.recording import Launches
from planner_jax.sims.robots.quadrotor.robot import Quadrotor
from planner_jax.sims.settings import INTERVAL, CatchFly, require_interval
from planner_jax.sims.task import BallFlightTask, FlightCases, Flights
from planner_jax.sims.tasks.catch_ahead import (
    LIMITS,
    bounds,
    compile_attempts,
    plan_ahead,
    predict_case,
    with_catch,
)
from planner_jax.sims.tasks.catch_pilot import LIFT, CatchPilot
from planner_jax.task.catch.api import planner as catch_planner
from planner_jax.task.catch.case import START, CatchCase
from planner_jax.task.catch.default_planner import CatchProblem
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.catch.suites import LAUNCH, draw, earliest_throw
from planner_jax.task.hit.spec import DRAG  # of hits, since [Yu2023catch] reports none

CATCH_WORLD = World(Quadrotor(PAPER_CATCHER), GRAVITY, mouth=LAUNCH)
# [s], time from a throw to the ball's plan; the ball flies more than 2 m [Yu2023catch, VII-A].
SEEN = 0.3
_AFTER = 0.05  # [s], simulated time after the end of the last ball's horizon


def _steadier(
    planner: Planner[CatchCase, CatchPlan],
) -> Planner[CatchCase, CatchPlan]:
    if isinstance(planner, DecidedPlanner) and isinstance(planner.planner, SearchPlanner):
        own = planner.planner
        if isinstance(own.problem, CatchProblem):
            return dataclasses.replace(planner, planner=own.with_settings((("lift", LIFT),)))
    return planner


@dataclasses.dataclass(frozen=True)
class Throws(FlightCases):
    """B flights of N thrown balls each, in NumPy arrays.

    A ball's own time 0 is the start of the plan for this ball.
    """

    balls: BallState  # leaves (B, N, 3), each at its own time 0
    horizon: np.ndarray  # (B, N) [s], last time at which each ball may be caught, in its own time
    drag: np.ndarray  # (B, N), true drag coefficient K_D [1/m]
    believed: np.ndarray  # (B, N), initial estimate of K_D [1/m]
    gravity: np.ndarray  # (B,) [m/s^2], magnitude
    net_height: np.ndarray  # (B,) [m], height of the hoop above the propeller plane
    net_radius: np.ndarray  # (B,) [m], radius of the hoop


def throws(
    num: int,
    num_balls: int = 1,
    seed: int = 0,
    *,
    drag: float = DRAG,
    drag_error: float = 0.0,
    robot: QuadrotorModel = PAPER_CATCHER,
) -> Throws:
    """Draw B flights, each with N balls of the suite `throws`, which fly with quadratic drag.

    Args:
        num: B >= 1, number of flights.
        num_balls: N, number of balls per flight, 1 to 3 in [Yu2023catch].
        seed: >= 0, of the throws and of the signs of the drag's errors.
        drag: true drag coefficient K_D [1/m] of all balls.
        drag_error: relative error of the initial estimate of K_D, of random sign.
        robot: a quadrotor with a net.
    """
    if num_balls < 1:
        raise ArgumentError("num_balls", ">= 1", num_balls)
    if not 0.0 <= drag_error < 1.0:
        raise ArgumentError("drag_error", ">= 0 and < 1", drag_error)
    suite = jax.tree.map(np.asarray, draw(num * num_balls, "throws", seed, robot=robot))
    shaped = lambda leaf: leaf[:, 0].reshape(num, num_balls, *leaf.shape[2:])  # noqa: E731
    first = lambda leaf: leaf[::num_balls]  # noqa: E731
    true = np.full((num, num_balls), drag, np.float32)
    sign = np.random.default_rng([seed, 1]).choice([-1.0, 1.0], (num, 1))
    return Throws(
        index=np.arange(num),
        balls=jax.tree.map(shaped, suite.targets.ball),
        horizon=shaped(suite.horizon),
        drag=true,
        believed=(true * (1.0 + drag_error * sign)).astype(np.float32),
        gravity=first(suite.gravity),
        net_height=first(suite.net.height),
        net_radius=first(suite.net.radius),
    )


class CatchFlights(Flights):
    """The result of B flights with N thrown balls each; arrays have the leading axis B."""

    @property
    def caught(self) -> np.ndarray:
        """Mask (B, N) of the balls that fell into the net, N balls in each of B flights."""
        return np.asarray(self.flown.contact.met)

    @property
    def success(self) -> np.ndarray:
        """Mask (B,) of the B flights in which all balls were caught."""
        return np.all(self.caught, axis=1)


def fly_catches(
    loop: Loop,
    cases: Throws,
    seed: int = 0,
    *,
    planner: Planner[CatchCase, CatchPlan] | None = None,
    pilot: CatchPilot | None = None,
    plan: CatchPlan | None = None,
) -> CatchFlights:
    """Plan and simulate a batch of flights with thrown balls.

    In each flight a quadrotor with a net catches balls that are thrown at fixed intervals. When a
    ball comes into sight, its catch is planned without an earlier plan as first guess, together
    with the catch of the next ball (`plan_ahead`). The next ball is not thrown yet, so its flight
    is guessed: the shortest throw of the suite (`earliest_throw`). The plan starts at the last
    planned catch of an earlier ball, or at once if no such catch remains. Until the next ball comes
    into sight, the loop replans all remaining catches.

    Args:
        loop: settings of the closed loop: world, sensing and rates.
        cases: the thrown balls.
        seed: random seed of the noise, >= 0.
        planner: planner of `plan_ahead`, by default the planner `exact` with a greedy order.
        pilot: part of the loop that replans remaining catches.
        plan: first plan of each flight, for the first ball; by default it is made here.

    Raises:
        ValueError: the world, the plan or the number of balls does not match the cases.
    """
    num_balls = cases.horizon.shape[1]
    sizes = {name: getattr(cases, name) for name in ("gravity", "net_height", "net_radius")}
    require_world(loop, "net", num_balls, **sizes)
    if num_balls > 1:
        require_interval(loop.sensing, loop.replan)
    planner, pilot = planner or catch_planner(decide="greedy"), pilot or CatchPilot()
    planner = _steadier(planner)
    drag = jnp.asarray(cases.drag)
    balls, guess = jax.tree.map(jnp.asarray, (cases.balls, cases.believed))
    keys = flight_keys(seed, cases.index)
    flight = ready(loop, jnp.tile(jnp.array(START), (len(cases), 1)), keys)
    flight = begin_filters(loop, flight)
    nothing = np.zeros(num_balls, bool), np.zeros(cases.horizon.shape, np.float32)
    compiled = begin_compiling(
        loop, pilot, flight, predict_case.eval_shape(loop, flight, *nothing), drag
    )
    first: Any = plan
    records, planning = [], 0.0
    shortest, window = earliest_throw("throws")
    last_leg = loop.num_periods(float(cases.horizon.max()) + _AFTER)
    legs = [loop.num_periods(INTERVAL)] * (num_balls - 1) + [last_leg]
    for ball in range(num_balls):
        flight = launch_ball(loop, flight, balls, drag, guess, ball=ball, seen=SEEN)
        until = cases.horizon + INTERVAL * (np.arange(num_balls) - ball)
        given, last = plan is not None and ball == 0, ball == num_balls - 1
        if not last:
            coming = jax.tree.map(jnp.asarray, shortest)
            flight = await_ball(loop, flight, coming, guess, ball=ball + 1, ahead=INTERVAL)
            until[:, ball + 1] = INTERVAL + window
        horizon = jnp.asarray(until, jnp.float32)
        new = np.isin(np.arange(num_balls), [ball] if given else [ball, ball + 1])
        known = predict_case(loop, flight, jnp.asarray(new), horizon)
        if given:
            found: Any = plan
            require_plan(found, CatchPlan, known.head_state)
            if found.times.shape[-1] != num_balls:
                raise ArgumentError("plan", f"of {num_balls} balls", found.times.shape[-1])
        else:
            known = jax.tree.map(np.asarray, known)
            began = time.perf_counter()
            limits = [bounds(loop, each) for each in LIMITS]
            if ball == 0 and not last and in_parts(flight):  # some flights need all attempts
                compile_attempts(planner, known)
            known, found = plan_ahead(planner, known, ball, limits)
            planning += time.perf_counter() - began
        first = found if first is None else first
        begun = jax.tree.map(jnp.asarray, found)
        flight = with_catch(flight, begun, jnp.asarray(known.present))
        compiled()
        flight, leg = fly_leg(
            loop,
            pilot,
            flight,
            dataclasses.replace(known, horizon=horizon + flight.time[:, None]),
            drag,
            num_periods=legs[ball],
            most_periods=max(legs),
        )
        records += leg
    return CatchFlights(first, collect_flights(flight, records), planning)


class CatchFlight(BallFlightTask):
    """The simulation of catches, which `sims/run.py` calls to simulate, score and draw a run."""

    settings: CatchFly

    CONTACT = "caught"
    SUCCESS = "caught all balls"
    _caught = BY_ROW["Yu2023catch", "Table I", "caught throws"]
    PUBLISHED = f"[Yu2023catch], {_caught.num} throws, {_caught.what_counts}: {_caught}"
    COLUMNS = (Column("caught", "", "each ball", list_of(BOOL), lambda b: b.verdict.caught),)

    def world(self) -> World:
        """Return the simulated world, with as many balls as the settings request."""
        robot = Quadrotor(self.robot, **self.settings.air())
        return dataclasses.replace(CATCH_WORLD, robot=robot, num_balls=self.settings.balls)

    @property
    def robot(self) -> QuadrotorModel:
        """The quadrotor as plans know it; by default the quadrotor of [Yu2023catch]."""
        return self.settings.known_robot() or PAPER_CATCHER

    def cases(self) -> Throws:
        """Draw all flights of the run from its seed."""
        settings = self.settings
        return throws(
            settings.num,
            settings.balls,
            settings.seed,
            drag_error=settings.drag_error,
            robot=self.robot,
        )

    def fly(self, cases: Throws, record: bool) -> CatchFlights:
        """Plan and simulate the flights of `cases`; `record` is whether states are stored."""
        settings = self.settings
        return fly_catches(
            self.loop(record),
            cases,
            settings.seed,
            planner=catch_planner(settings.planner, decide=settings.decide),
            pilot=CatchPilot(decide=settings.decide, redecide=settings.redecide_rate),
        )

    def parameters(self) -> dict[str, Any]:
        """Return the loop's settings, and the rate [Hz] at which the catch order is chosen anew."""
        return {**super().parameters(), "redecide": self.settings.redecide_rate}

    def launches(self, cases: Throws, flown: Flown) -> Launches:
        """Return each ball's state at the start of the plan for it; caught balls do not rebound."""
        begins = INTERVAL * np.arange(self.settings.balls)
        return Launches(cases.balls, cases.drag, begins, SEEN)

    @property
    def suite(self) -> str:
        """Name of the set of flights in reports: the number of balls per flight, "2 balls"."""
        return "1 ball" if self.settings.balls == 1 else f"{self.settings.balls} balls"
