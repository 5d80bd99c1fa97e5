"""Catches in flight: one to three balls, thrown a service interval apart (paper 000).

When a ball comes into sight the one before it is about to be caught, and the state in which that
leaves the quadrotor decides whether the next catch is possible. So every plan has one more catch
than there are balls: the next one is awaited as the shortest throw that the machine makes, which
leaves the least time, and is planned anew once it is seen.
"""

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.ball.prediction import PathTable, predict_path
from planner_jax.ball.target import BallPath
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import is_solved
from planner_jax.optimise.lbfgs import LbfgsConfig
from planner_jax.optimise.problem import Round
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.planning.plan import plan as plan_all
from planner_jax.planning.replan import Replanning
from planner_jax.planning.warmup import compile_attempts
from planner_jax.robot.quadrotor_model import QuadrotorModel
from planner_jax.robot.quadrotor_models import PAPER_CATCHER
from planner_jax.runs.columns import BOOL, Column, list_of
from planner_jax.sims.launch import (
    awaited,
    flight_keys,
    launched,
    ready,
    require_plan,
    require_world,
)
from planner_jax.sims.loop import (
    FlightState,
    Flown,
    Loop,
    Outlook,
    begin_compiling,
    expected,
    flown,
    fly_leg,
    in_parts,
)
from planner_jax.sims.model import World
from planner_jax.sims.recording import Launches
from planner_jax.sims.robots.quadrotor.robot import Quadrotor
from planner_jax.sims.scoring import passage
from planner_jax.sims.settings import INTERVAL, CatchFly, require_interval
from planner_jax.sims.task import BallFlightTask, FlightCases, Flights
from planner_jax.task.catch.api import planner as catch_planner
from planner_jax.task.catch.case import GRAVITY, START, CatchCase
from planner_jax.task.catch.case import case as catch_case
from planner_jax.task.catch.default_planner import ExactCatch
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.catch.replan import ReplanCatch
from planner_jax.task.catch.spec import DECISIONS, TRAINED
from planner_jax.task.catch.suites import LAUNCH, draw, earliest_throw
from planner_jax.task.hit.case import DRAG  # of the published serves; paper 000 gives none
from planner_jax.task.named_decision import named_decision

CATCH_WORLD = World(Quadrotor(PAPER_CATCHER), GRAVITY, mouth=LAUNCH)
SEEN = 0.3  # [s], a throw's flight before it is planned for: 2 m and more (paper 000, VII-A)
_TABLE_NODES = 36
_AIM = 0.4  # share of the net's radius that plans are made for; the rest is left for errors
# How far plans stay from the robot's least thrust, of the way from there to hover, and their share
# of its body rate. A weak thrust and a fast turn leave control little; the first catch stays away
# from them, so that the next can begin within bounds. Plans of later catches begin with the second
# limits. Where no plan keeps them, the next ones count; the last are as wide as the robot's own.
_LIMITS = ((2.0 / 7.0, 0.6), (1.0 / 7.0, 0.9), (0.0, 1.0))
_BORNE = 0.1  # share of a limit by which a plan may break it and is still flown
_KEPT = 0.01  # relative excess up to which limits count as kept by a plan of the loop
_CHEAPER = 0.95  # share of the cost below which a plan from scratch replaces one that keeps them
_INSTANT = 1e-3  # [s], shorter than any look
_AFTER = 0.05  # [s] flown after the last ball has come down to where it may be caught


_LIFT = 0.1  # of guesses in flight, at every catch: a little more thrust than the weight


def _steadier(
    planner: Planner[CatchCase, CatchPlan],
) -> Planner[CatchCase, CatchPlan]:
    """The planner with guesses for flights, where it is `exact` behind a decision."""
    if isinstance(planner, DecidedPlanner) and isinstance(planner.planner, ExactCatch):
        own = dataclasses.replace(planner.planner, lift=_LIFT)
        return dataclasses.replace(planner, planner=own)
    return planner


@dataclasses.dataclass(frozen=True)
class CatchPilot:
    """Plans catches anew from the plan that is flown, and from order and times decided anew."""

    # Later than 0.2 s before a catch a new plan shakes more than the news of the ball is worth.
    planner: ReplanCatch = ReplanCatch(ExactCatch(lift=_LIFT), shortest=0.2)
    # By which share of a limit a new plan may break it and is still flown; one that breaks it by
    # more is flown only if the old plan breaks its limits by as much. The first share holds for
    # the last catch, the second while several are left: then most of the excess lies on the
    # way to catches that will be planned from scratch later, and keeping the old plan would miss
    # the ball that comes first.
    excess: tuple[float, float] = (_BORNE, 1.0)
    # The name of a decision about catches, or "policy:FILE"; "given" keeps order and times of the
    # plan that is flown, and only its way is searched for from scratch.
    decide: str = "greedy"
    redecide: float = (
        100.0  # [Hz], of deciding anew, a divisor of the rate of planning; 0 for never
    )
    search: Round = Round(starts=1, solver=LbfgsConfig(max_steps=25))  # of what is decided anew
    passage = staticmethod(passage)

    def times(self, plan: CatchPlan) -> Array:
        """When each ball is to be caught (N,) [s], in the balls' order."""
        return jnp.zeros_like(plan.times).at[plan.order].set(plan.times)

    def plan_shapes(self, cases: CatchCase) -> CatchPlan:
        """Those of the planner behind the re-planner."""
        return self.planner.planner.plan_shapes(cases)

    def asked(
        self, case: CatchCase, plan: CatchPlan, outlook: Outlook
    ) -> Replanning[CatchCase, CatchPlan]:
        """What is still to be caught, while a plan is flown."""
        made = plan.times <= outlook.elapsed
        first = jnp.argsort(made, stable=True)  # what is still to be caught
        order, times = plan.order[first], plan.times[first] - outlook.elapsed
        horizon = case.horizon - outlook.time
        left = dataclasses.replace(
            case,
            targets=tables(outlook.balls, outlook.drag, horizon, case.gravity),
            present=outlook.present,
            horizon=horizon,
            order=order,
            times=jnp.maximum(times, 0.01),
            head_state=outlook.head_state,
        )
        return Replanning(case=left, previous=plan, elapsed=outlook.elapsed)

    @property
    def searches(self) -> tuple[Callable[[Replanning[CatchCase, CatchPlan]], CatchPlan], ...]:
        """From the plan that is flown, and from scratch as is decided for this moment.

        The first is a short round of the re-planner.
        """
        from_last = lambda task: self.planner.solve(task, self.planner.rounds[0])  # noqa: E731
        return (from_last, self._decided_anew) if self.redecide > 0.0 else (from_last,)

    def chosen(
        self,
        asked: Replanning[CatchCase, CatchPlan],
        outlook: Outlook,
        found: tuple[CatchPlan, ...],
    ) -> tuple[CatchPlan, Array]:
        """The better of the plans, and whether it is good enough.

        One from scratch is taken where it breaks the limits less, or keeps them at a cost that is
        clearly lower.
        """
        plan, left = found[0], asked.case
        if self.redecide > 0.0:
            fresh = found[1]
            since = jnp.mod(outlook.time + _INSTANT, 1.0 / self.redecide)  # the last time was due
            take = (since < 2.0 * _INSTANT) & (fresh.times[0] >= self.planner.shortest)
            take &= is_better(fresh, plan)
            plan = jax.tree.map(lambda new, old: jnp.where(take, new, old), fresh, plan)
        good = left.present[left.order[0]] & (left.times[0] >= self.planner.shortest)
        excess = jnp.where(jnp.sum(left.present) > 1, self.excess[1], self.excess[0])
        return plan, good & (plan.violation <= jnp.maximum(excess, asked.previous.violation))

    def _decided_anew(self, asked: Replanning[CatchCase, CatchPlan]) -> CatchPlan:
        """A plan from scratch of what is left, with the decision's first choice."""
        left = asked.case
        choices = named_decision(DECISIONS, self.decide, TRAINED).propose(left)
        choice = jax.tree.map(lambda leaf: leaf[0], choices)
        return self.planner.planner.solve(left.decided(choice), self.search)


def is_better(fresh: CatchPlan, warm: CatchPlan) -> Array:
    """Whether () bool a plan from scratch is to be preferred to one from the plan that is flown."""
    keeps = warm.violation <= _KEPT
    cheaper = (fresh.violation <= _KEPT) & (fresh.cost < _CHEAPER * warm.cost)
    nearer = jnp.isfinite(fresh.violation) & jnp.logical_not(warm.violation <= fresh.violation)
    return jnp.isfinite(fresh.cost) & jnp.where(keeps, cheaper, nearer)


def tables(balls: BallState, drag: Array, horizon: Array, gravity: Array) -> PathTable:
    """Predicted paths with quadratic drag of balls (N, ...) up to a horizon (N,) [s]."""
    predict = functools.partial(predict_path, num_nodes=_TABLE_NODES)
    horizon = jnp.maximum(horizon, 0.1)
    return jax.vmap(predict, in_axes=(0, 0, 0, None))(balls, horizon, drag, gravity)


@dataclasses.dataclass(frozen=True)
class Throws(FlightCases):
    """B flights of N balls each, NumPy leaves. A ball's own time begins when it is planned for."""

    balls: BallState  # leaves (B, N, 3), each at its own time 0
    horizon: np.ndarray  # (B, N) [s], until when each may be caught, its own time
    drag: np.ndarray  # (B, N) K_D [1/m], the true one
    believed: np.ndarray  # (B, N) K_D [1/m]
    gravity: np.ndarray  # (B,) [m/s^2], magnitude
    net_height: np.ndarray  # (B,) [m], of the hoop above the propeller plane
    net_radius: np.ndarray  # (B,) [m]


def throws(
    num: int,
    num_balls: int = 1,
    seed: int = 0,
    *,
    drag: float = DRAG,
    drag_error: float = 0.0,
    robot: QuadrotorModel = PAPER_CATCHER,
) -> Throws:
    """Balls of the suite `throws`, which from there on fly with quadratic drag.

    Args:
        num: B >= 1.
        num_balls: N, 1 to 3 in the paper.
        seed: >= 0, of the throws and of the signs of the drag's errors.
        drag: K_D [1/m], the true one.
        drag_error: relative error of what is believed of it, either way.
        robot: with a net.
    """
    if num_balls < 1:
        raise ValueError(f"num_balls must be >= 1, got {num_balls}")
    if not 0.0 <= drag_error < 1.0:
        raise ValueError(f"drag_error must be >= 0 and < 1, got {drag_error}")
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
    """What came of a batch of throws; leaves with a leading axis B."""

    @property
    def caught(self) -> np.ndarray:
        """Which balls fell into the net, (B, N) bool."""
        return np.asarray(self.flown.contact.met)

    @property
    def success(self) -> np.ndarray:
        """Which flights caught all balls, (B,) bool."""
        return np.all(self.caught, axis=1)


@functools.partial(jax.jit, static_argnames="loop")
def believed(loop: Loop, flights: FlightState, new: Array, horizon: Array) -> CatchCase:
    """What is believed of a ball that has come into sight and of the next one, to be planned.

    The plans begin where and when the last catch of a ball seen before will have been made, or
    now where no such catch is left; times count from there.

    Args:
        loop: of the flights.
        flights: leaves (B, ...).
        new: (N,) bool, the balls that are to be planned.
        horizon: (B, N) [s] from now, until when each may be caught.
    """
    robot = loop.world.carrier
    # Their targets are those that are seen, filled in below.
    zeros = jnp.zeros((*horizon.shape, 3), horizon.dtype)
    nowhere = BallPath(BallState(zeros, zeros), drag=zeros, gravity=zeros[..., 0])
    empty = catch_case(
        nowhere,
        np.zeros(horizon.shape),
        robot=robot.model,
        gravity=loop.world.gravity,
        net_radius=_AIM * robot.tool.radius,
        **bounds(loop, _LIMITS[0 if flights.plan is None else 1]),
    )

    def one(case: CatchCase, flight: FlightState, horizon: Array) -> CatchCase:
        head, after = case.head_state, jnp.zeros_like(flight.time)
        if flight.plan is None:
            head = head.at[0].set(robot.state(flight.physics).pos)
        else:
            after = until_last_catch(flight, new)
            head = robot.head_state(flight.plan, flight.time - flight.began + after)
        balls = expected(loop, flight.earlier, loop.period + after)
        horizon = horizon - after
        return dataclasses.replace(
            case,
            targets=tables(balls, flight.earlier.drag, horizon, case.gravity),
            present=new,
            horizon=horizon,
            head_state=head,
        )

    return jax.vmap(one)(empty, flights, horizon)


def until_last_catch(flight: FlightState, new: Array) -> Array:
    """Time () [s] to the last catch that is planned of balls not `new` (N,); 0 if none is left."""
    planned = CatchPilot().times(flight.plan) - (flight.time - flight.began)
    return jnp.maximum(jnp.max(jnp.where(flight.present & ~new, planned, 0.0)), 0.0)


@jax.jit
def with_catch(flights: FlightState, found: CatchPlan, new: Array) -> FlightState:
    """Flights (B, ...) whose plans go on with new catches after those of the balls seen before.

    Where a ball seen before is still to be caught, the new plan is appended to the one that is
    flown, after its last such catch. Elsewhere the new plan is flown alone, from now on.

    Args:
        flights: the ones for which `believed` was called.
        found: plans (B, ...) of the cases that it returned.
        new: (B, N) bool, the balls that `found` catches.
    """

    def one(flight: FlightState, found: CatchPlan, new: Array) -> FlightState:
        present = flight.present | new
        alone = dataclasses.replace(flight, plan=found, began=flight.time, present=present)
        if flight.plan is None:
            return alone
        old, number = flight.plan, new.size
        each = found.trajectory.durations.size // number
        used = jnp.sum(old.trajectory.durations.reshape(number, each), axis=1) > 0.0
        # How many catches of the old plan are kept, those already made included. The catch that
        # was only awaited comes last in the old plan; the found plan replaces it.
        num_kept = jnp.sum(used & ~new[old.order])
        place = jnp.arange(number)
        kept = place < num_kept

        def behind(old: Array, found: Array) -> Array:
            """Rows (N, ...), one a catch: those kept of the old plan, then the found plan's."""
            rows = jnp.where(kept, 0, place - num_kept)
            shape = (number, *(1,) * (old.ndim - 1))
            return jnp.where(kept.reshape(shape), old, found[rows])

        split = lambda leaf: leaf.reshape(number, each, *leaf.shape[1:])  # noqa: E731
        flat = lambda leaf: leaf.reshape(-1, *leaf.shape[2:])  # noqa: E731
        trajectory = jax.tree.map(
            lambda a, b: flat(behind(split(a), split(b))), old.trajectory, found.trajectory
        )
        end = old.times[num_kept - 1]
        rank = jnp.zeros_like(place).at[old.order].set(jnp.where(kept, place, 2 * number))
        behind_rank = jnp.zeros_like(place).at[found.order].set(number + place)
        order = jnp.argsort(jnp.where(new, behind_rank, rank), stable=True)
        joined = dataclasses.replace(
            found,
            trajectory=trajectory,
            order=order.astype(old.order.dtype),
            decided_times=behind(old.decided_times, end + found.decided_times),
            times=behind(old.times, end + found.times),
        )
        joined = dataclasses.replace(flight, plan=joined, present=present)
        busy = until_last_catch(flight, new) > 0.0  # a ball seen before is still to be caught
        return jax.tree.map(lambda a, b: jnp.where(busy, a, b), joined, alone)

    return jax.vmap(one)(flights, found, new)


def fly_catches(
    loop: Loop,
    cases: Throws,
    seed: int = 0,
    *,
    planner: Planner[CatchCase, CatchPlan] | None = None,
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
        planner: of the plans from scratch, by default `exact` that decides greedily.
        pilot: of the plans in between.
        plan: first plan of each flight, of the first ball, instead of one made here.

    Raises:
        ValueError: a world, plan or number does not fit.
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
    nothing = np.zeros(num_balls, bool), np.zeros(cases.horizon.shape, np.float32)
    compiled = begin_compiling(
        loop, pilot, flight, believed.eval_shape(loop, flight, *nothing), drag
    )
    first: Any = plan
    records, planning = [], 0.0
    shortest, window = earliest_throw("throws")
    for ball in range(num_balls):
        flight = launched(loop, flight, balls, drag, guess, ball=ball, seen=SEEN)
        until = cases.horizon + INTERVAL * (np.arange(num_balls) - ball)
        given, last = plan is not None and ball == 0, ball == num_balls - 1
        if not last:
            coming = jax.tree.map(jnp.asarray, shortest)
            flight = awaited(loop, flight, coming, guess, ball=ball + 1, ahead=INTERVAL)
            until[:, ball + 1] = INTERVAL + window
        horizon = jnp.asarray(until, jnp.float32)
        new = np.isin(np.arange(num_balls), [ball] if given else [ball, ball + 1])
        known = believed(loop, flight, jnp.asarray(new), horizon)
        if given:
            found: Any = plan
            require_plan(found, CatchPlan, known.head_state)
            if found.times.shape[-1] != num_balls:
                raise ValueError(f"plan must be of {num_balls} balls, got {found.times.shape[-1]}")
        else:
            known = jax.tree.map(np.asarray, known)
            began = time.perf_counter()
            limits = [bounds(loop, each) for each in _LIMITS]
            if ball == 0 and not last and in_parts(flight):  # some lanes will need all attempts
                compile_attempts(planner, known)
            known, found = planned_ahead(planner, known, ball, limits)
            planning += time.perf_counter() - began
        first = found if first is None else first
        begun = jax.tree.map(jnp.asarray, found)
        flight = with_catch(flight, begun, jnp.asarray(known.present))
        compiled()
        flight, looks = fly_leg(
            loop,
            pilot,
            flight,
            dataclasses.replace(known, horizon=horizon + flight.time[:, None]),
            drag,
            num_periods=loop.num_periods(float(cases.horizon.max()) + _AFTER if last else INTERVAL),
        )
        records += looks
    return CatchFlights(first, flown(flight, records), planning)


def planned_ahead(
    planner: Planner[CatchCase, CatchPlan],
    known: CatchCase,
    ball: int,
    limits: Sequence[dict[str, Any]],
) -> tuple[CatchCase, CatchPlan]:
    """Plans from scratch that catch a ball and, where that is possible too, the next one.

    Where no plan of both is found within the limits, both are planned for within wider ones:
    what catches the ball alone leaves the quadrotor where the next may be out of reach. Where that
    breaks a limit by more than is flown in the loop, the ball is planned for alone, and if nothing
    is solved, the plan of it that breaks its limits least is left.

    Args:
        planner: of catches, which also decides about their order.
        known: of both balls, or of the last one, a batch with NumPy leaves.
        ball: its place among the targets.
        limits: ever wider ones, as `bounds` has them, of which the first are those of `known` for
            the first ball and the second those for the others.

    Returns:
        The cases and their plans; `present` says which catches each has.
    """
    alone = np.arange(known.num_targets) == ball
    both = np.ones_like(alone)
    wider = limits[1 if ball == 0 else 2 :]
    tries: list[tuple[np.ndarray, dict[str, Any] | None]] = [(both, each) for each in wider]
    if ball < known.num_targets - 1:
        tries += [(alone, each) for each in (None, *wider)]
    cases, plans = known, plan_all(planner, known)
    for balls, wide in tries:
        tried = known.present & balls
        same = (tried == cases.present).all(axis=1)
        unsolved = ~is_solved(np.asarray(plans.status))
        lanes = np.flatnonzero(unsolved & (same | ~(plans.violation <= _BORNE)))
        if not lanes.size:
            continue
        part = dataclasses.replace(known, present=tried)
        part = jax.tree.map(lambda leaf, lanes=lanes: np.asarray(leaf)[lanes], part)
        part = within(part, wide)
        found = plan_all(planner, part)
        before = np.where(same, plans.violation, np.inf)[lanes]
        better = is_solved(np.asarray(found.status)) | (found.violation < before)
        to, chosen = lanes[better], np.flatnonzero(better)

        def merged(old: Any, new: Any, to: np.ndarray = to, chosen: np.ndarray = chosen) -> Any:
            old = np.array(old)
            old[to] = np.asarray(new)[chosen]
            return old

        cases, plans = jax.tree.map(merged, (cases, plans), (part, found))
    return cases, plans


def within(cases: CatchCase, limits: dict[str, Any] | None) -> CatchCase:
    """Cases with NumPy leaves with other limits, as `bounds` has them."""
    if limits is None:
        return cases
    leaves = {
        name: np.full_like(getattr(cases.limits, name), value) for name, value in limits.items()
    }
    return dataclasses.replace(cases, limits=dataclasses.replace(cases.limits, **leaves))


def bounds(loop: Loop, distance: tuple[float, float]) -> dict[str, Any]:
    """Least thrust [m/s^2] and greatest body rate [rad/s] of plans, as `_LIMITS` has them."""
    model, gravity = loop.world.carrier.model, loop.world.gravity
    least, _ = model.thrust_bounds
    above, share = distance
    return {
        "min_thrust": least + above * (gravity - least),
        "body_rate": share * model.limits.body_rate,
    }


class CatchFlight(BallFlightTask):
    """Catches as a run of flights knows them; the settings are `CatchFly`."""

    settings: CatchFly

    CONTACT = "caught"
    SUCCESS = "caught all balls"
    PUBLISHED = "Catch Planner, 50 real throws: 64 % caught"  # paper 000, Table I
    COLUMNS = (Column("caught", "", "each ball", list_of(BOOL), lambda b: b.verdict.caught),)

    def world(self) -> World:
        """The simulated world, with as many balls as are thrown."""
        robot = Quadrotor(self.robot)
        return dataclasses.replace(CATCH_WORLD, robot=robot, num_balls=self.settings.balls)

    @property
    def robot(self) -> QuadrotorModel:
        """Which quadrotor flies."""
        return self.settings.robot or PAPER_CATCHER

    def cases(self) -> Throws:
        """All throws of the run."""
        settings = self.settings
        return throws(
            settings.num,
            settings.balls,
            settings.seed,
            drag_error=settings.drag_error,
            robot=self.robot,
        )

    def fly(self, cases: Throws, record: bool) -> CatchFlights:
        """Flights of some throws."""
        settings = self.settings
        return fly_catches(
            self.loop(record),
            cases,
            settings.seed,
            planner=catch_planner(settings.planner, decide=settings.decide),
            pilot=CatchPilot(decide=settings.decide, redecide=settings.redecide_rate),
        )

    def parameters(self) -> dict[str, Any]:
        """Those of the closed loop, and the rate of deciding anew."""
        return {**super().parameters(), "redecide": self.settings.redecide_rate}

    def launches(self, cases: Throws, flown: Flown) -> Launches:
        """The throws; no ball comes back."""
        begins = INTERVAL * np.arange(self.settings.balls)
        return Launches(cases.balls, cases.drag, begins, SEEN)

    @property
    def suite(self) -> str:
        """How many balls are thrown."""
        return "1 ball" if self.settings.balls == 1 else f"{self.settings.balls} balls"
