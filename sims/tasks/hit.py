"""Hits in closed loop: a quadrotor volleys a served ball to a target with a racket [Yu2023bat]."""

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError
from planner_jax.core.planner import Planner
from planner_jax.optimise.planner import SearchPlanner
from planner_jax.optimise.settings import Attempt, LbfgsConfig
from planner_jax.planning.plan import plan as plan_all
from planner_jax.planning.replan import Replanning
from planner_jax.planning.replanner import Replanner
from planner_jax.robot.quadrotor_model import PAPER_HITTER, QuadrotorModel
from planner_jax.runs.columns import BOOL, NUMBER, VECTOR, Column
from planner_jax.runs.summary import percent
from planner_jax.sims.launch import (
    begin_filters,
    flight_keys,
    launch_ball,
    ready,
    require_plan,
    require_world,
    turn_robots,
)
from planner_jax.sims.loop import begin_compiling, fly_leg, predict_balls
from planner_jax.sims.loop_state import (
    FlightState,
    Flown,
    Loop,
    Outlook,
    collect_flights,
    shapes_of_plans,
)
from planner_jax.sims.model import World
from planner_jax.sims.recording import Launches
from planner_jax.sims.robots.quadrotor.robot import Quadrotor
from planner_jax.sims.scenery import Part
from planner_jax.sims.scoring import Contact, passage, racket_impact
from planner_jax.sims.settings import LATEST_PLAN, HitFly
from planner_jax.sims.task import BallFlightTask, FlightCases, Flights
from planner_jax.task.hit import court
from planner_jax.task.hit.api import planner as hit_planner
from planner_jax.task.hit.case import HitCase
from planner_jax.task.hit.court import landing
from planner_jax.task.hit.default_planner import HitProblem
from planner_jax.task.hit.plan import HitPlan
from planner_jax.task.hit.replan import REMAINDER
from planner_jax.task.hit.spec import REAL_SCENARIOS
from planner_jax.task.hit.suites import DEPTH, GRAVITY, SERVE_HEIGHT, generate_serves, to_cases

# [s], usual time from a serve to the first plan; the ball flies more than 2 m [Yu2023catch, VII-A].
SEEN = HitFly.seen
_AFTER = 0.1  # [s], simulated time after the last planned impact
_LONGEST = 1.9  # [s], duration of the longest flight of a serve
_NEAR, _FAR = 0.5, 1.0  # [m], distances from the target: the two success radii of [Yu2023bat]

_LINE_COLOUR, _MIDDLE_COLOUR, _DEAD_COLOUR = "#FFFFFF", "#24292F", "#D98880"
_LINE, _THIN = 0.03, 0.002  # [m], width and height of the court's lines


def court_parts() -> list[Part]:
    """Return the court of [Yu2023bat] as flat boxes: its lines, and the dead zone at the net."""
    length, width = court.HALF_LENGTH, court.HALF_WIDTH
    lines = [((0.0, -width), (0.0, width))]  # the first line is at the net
    for side in (-1.0, 1.0):
        lines.append(((-length, side * width), (length, side * width)))
        lines.append(((side * length, -width), (side * length, width)))
        near, dead = side * court.NEAR_LINE, side * court.DEAD_ZONE
        lines.append(((near, -court.LANE_LINE), (near, court.LANE_LINE)))
        lines += [
            ((dead, lane), (side * length, lane)) for lane in (-court.LANE_LINE, court.LANE_LINE)
        ]
    zone = (2.0 * court.DEAD_ZONE, 2.0 * width, _THIN)
    parts = [Part("box", zone, (0.0, 0.0, 0.5 * _THIN), _DEAD_COLOUR)]
    for number, (a, b) in enumerate(np.array(lines)):
        length, width = np.abs(b - a) + _LINE
        x, y = 0.5 * (a + b)
        colour = _LINE_COLOUR if number else _MIDDLE_COLOUR
        parts.append(Part("box", (length, width, 2.0 * _THIN), (x, y, _THIN), colour))
    return parts


HIT_WORLD = World(
    Quadrotor(PAPER_HITTER),
    GRAVITY,
    scenery=tuple(court_parts()),
    # The drawn serving machine stands in the centre of the half court beyond the net. Simulated
    # serves start at random points.
    mouth=(0.5 * (court.NEAR_LINE + DEPTH), 0.0, SERVE_HEIGHT),
)


def smooth_planner() -> SearchPlanner:
    """Return a planner whose first search has 60 iterations, with drag of the returned ball.

    Plans have no limit on angular acceleration. After few iterations, a plan may need more torque
    than the rotors have, so that the ball misses its target. A longer search avoids such plans.
    """
    planner = HitProblem.planner(drag_after_impact=True)
    solver = LbfgsConfig(max_steps=60, tolerance=1e-5, patience=6)
    return dataclasses.replace(planner, attempts=(Attempt(1, solver), *planner.attempts[2:]))


@dataclasses.dataclass(frozen=True)
class HitPilot:
    """The part of the closed loop that replans a hit in every period, from the current plan."""

    planner: Replanner = REMAINDER.planner_of(HitProblem(drag_after_impact=True))
    # [s], least time before the impact at which the plan may change. A later change would cause a
    # tracking error that does not decay before the impact.
    shortest: float = 0.3
    # Greatest relative violation of a limit by a new plan that replaces the current plan.
    excess: float = 0.1
    passage = staticmethod(passage)

    def times(self, plan: HitPlan) -> Array:
        """Return the planned time of the hit, (1,) [s] since the start of the plan."""
        return plan.stroke.time[None]

    def plan_shapes(self, cases: HitCase) -> HitPlan:
        """Return the shapes of the plans of a batch of cases, as `jax.ShapeDtypeStruct`."""
        return shapes_of_plans(self.planner.inner.problem, cases)

    def pose_problem(
        self, case: HitCase, plan: HitPlan, outlook: Outlook
    ) -> Replanning[HitCase, HitPlan]:
        """Return the problem of replanning the hit `plan` from the predicted robot and ball."""
        return Replanning(
            case=replace_ball(case, outlook.balls, outlook.drag, outlook.head_state),
            previous=plan,
            elapsed=outlook.elapsed,
        )

    @property
    def searches(self) -> tuple[Callable[[Replanning[HitCase, HitPlan]], HitPlan], ...]:
        """The only search of replanning: a short search that starts at the current plan."""
        return (lambda task: self.planner.solve(task, self.planner.attempts[0]),)

    def choose(
        self, asked: Replanning[HitCase, HitPlan], outlook: Outlook, found: tuple[HitPlan, ...]
    ) -> tuple[HitPlan, Array]:
        """Return the found plan, and whether it replaces the current plan.

        The plan is replaced if the impact is at least `shortest` [s] ahead and the found plan
        violates no limit by more than the fraction `excess`.
        """
        (plan,) = found
        left = asked.previous.stroke.time - outlook.elapsed
        good = outlook.present[0] & (left >= self.shortest)
        return plan, good & (plan.violation <= self.excess)


def replace_ball(case: HitCase, balls: BallState, drag: Array, head: Array) -> HitCase:
    """Return a case with the ball `balls` (1, 3), its `drag` (1,), and the start state `head`."""
    ball = jax.tree.map(lambda leaf: leaf[0], balls)
    return dataclasses.replace(case, ball=ball, drag=drag[0], head_state=head)


@dataclasses.dataclass(frozen=True)
class Volleys(FlightCases):
    """B cases, each a served ball at the start of its plan, and initial estimates of drag."""

    cases: HitCase  # leaves (B, ...), with the true ball and drag
    believed: np.ndarray  # (B,), initial estimate of K_D [1/m]
    seen: float = SEEN  # [s], time from a serve to its first plan


def volleys(
    num: int,
    names: tuple[str, ...] | None = None,
    seed: int = 0,
    *,
    drag_error: float = 0.0,
    robot: QuadrotorModel = PAPER_HITTER,
    wind: tuple[float, ...] | None = None,
    seen: float = SEEN,
) -> Volleys:
    """Draw serves, and return them at the start of their plans, `seen` seconds after the serve.

    Args:
        num: B >= 1, number of serves.
        names: names of scenarios (keys of `court.SCENARIOS`); by default all scenarios.
        seed: >= 0, of the serves and of the signs of the drag's errors.
        drag_error: relative error of the initial estimate of K_D, of random sign.
        robot: a quadrotor with a racket.
        wind: (3,) [m/s], velocity of the air, for a robot with drag.
        seen: [s], > 0 and <= 1.
    """
    if not 0.0 <= drag_error < 1.0:
        raise ArgumentError("drag_error", ">= 0 and < 1", drag_error)
    require(0.0 < seen <= LATEST_PLAN, "seen", f"> 0 and <= {LATEST_PLAN:g}", seen)
    cases = to_cases(generate_serves(num, seed, names), delay=seen, robot=robot, wind=wind)
    sign = np.random.default_rng([seed, 1]).choice([-1.0, 1.0], num)
    true = np.asarray(cases.drag)
    believed = (true * (1.0 + drag_error * sign)).astype(np.float32)
    return Volleys(np.arange(num), jax.tree.map(np.asarray, cases), believed, seen)


@dataclasses.dataclass(frozen=True)
class HitFlights(Flights):
    """The result of a batch of B serves with one ball each; arrays have the leading axis B."""

    landing: np.ndarray  # (B, 3) [m], landing point of the returned ball; NaN without a contact
    miss: np.ndarray  # (B,) [m], landing point's distance from the target; inf without a contact

    @property
    def success(self) -> np.ndarray:
        """Mask (B,) of the B balls that landed within 0.5 m of the target."""
        return self.miss <= _NEAR


def reflect_ball(contact: Contact, restitution: Array) -> BallState:
    """Return one ball just after its impact on the racket [Yu2023bat, eq. 3]."""
    vel = racket_impact(contact.ball_vel, contact.tool_vel, contact.normal, restitution)
    return BallState(pos=contact.ball_pos, vel=vel)


@functools.partial(jax.jit, static_argnames="loop")
def _predict_cases(loop: Loop, flights: FlightState, truth: HitCase) -> HitCase:

    def one(flight: FlightState, case: HitCase) -> HitCase:
        balls = predict_balls(loop, flight.earlier, loop.period)
        return replace_ball(case, balls, flight.earlier.drag, case.head_state)

    return jax.vmap(one)(flights, truth)


def _reflect_balls(contact: Contact, truth: HitCase) -> BallState:
    one = jax.tree.map(lambda leaf: leaf[:, 0], contact)
    balls = jax.device_get(jax.vmap(reflect_ball)(one, truth.restitution))
    return jax.tree.map(lambda leaf: np.where(np.asarray(one.met)[:, None], leaf, np.nan), balls)


def fly_hits(
    loop: Loop,
    cases: Volleys,
    seed: int = 0,
    *,
    planner: Planner[HitCase, HitPlan] | None = None,
    pilot: HitPilot | None = None,
    plan: HitPlan | None = None,
) -> HitFlights:
    """Plan and simulate a batch of flights, each with one served ball.

    Args:
        loop: settings of the closed loop: world, sensing and rates.
        cases: the serves.
        seed: random seed of the noise, >= 0.
        planner: planner of the first plan, by default `smooth_planner()`.
        pilot: part of the loop that replans after the first plan starts.
        plan: first plan of each flight; by default it is made here.

    Raises:
        ValueError: the world or a plan does not match the cases.
    """
    planner, pilot = planner or smooth_planner(), pilot or HitPilot()
    truth = cases.cases
    sizes = {name: getattr(truth, name) for name in ("gravity", "racket_height", "racket_radius")}
    known = {name: size for name, size in sizes.items() if size is not None}
    require_world(loop, "racket", 1, **known)
    if truth.lift is not None:
        raise ArgumentError("spin", "left out, as simulated balls do not spin", shown="a spin")
    truth = jax.tree.map(jnp.asarray, truth)
    keys = flight_keys(seed, cases.index)
    drag = truth.drag[:, None]
    flight = turn_robots(ready(loop, truth.head_state[:, 0], keys), truth.heading)
    flight = begin_filters(loop, flight)
    compiled = begin_compiling(loop, pilot, flight, truth, drag)
    balls = jax.tree.map(lambda leaf: leaf[:, None], truth.ball)
    guess = jnp.asarray(cases.believed)[:, None]
    flight = launch_ball(loop, flight, balls, drag, guess, ball=0, seen=cases.seen)
    known = jax.block_until_ready(_predict_cases(loop, flight, truth))
    clock = time.perf_counter()
    first = jax.block_until_ready(plan_all(planner, known)) if plan is None else plan
    planning = time.perf_counter() - clock
    require_plan(first, HitPlan, known.head_state)
    # The plan is copied through the host. Otherwise its arrays would be committed to a device, the
    # arrays of later plans would not, and JAX would compile the programs twice.
    begun = jax.tree.map(jnp.asarray, jax.device_get(first))
    flight = dataclasses.replace(flight, plan=begun, began=flight.time, present=flight.launched)
    periods = loop.num_periods(_LONGEST - cases.seen + _AFTER)
    compiled()
    flight, records = fly_leg(loop, pilot, flight, known, drag, num_periods=periods)
    back, truth = _reflect_balls(flight.contact, truth), cases.cases
    point = landing(back.pos, back.vel, truth.drag, truth.gravity)[1]
    miss = np.nan_to_num(np.linalg.norm(point - truth.target, axis=1), nan=np.inf)
    return HitFlights(first, collect_flights(flight, records), planning, point, miss)


class HitFlight(BallFlightTask):
    """The simulation of hits, which `sims/run.py` calls to simulate, score and draw a run."""

    settings: HitFly

    CONTACT = "hit"
    SUCCESS = f"landed within {_NEAR:g} m of the target"
    # [Yu2023bat] shows its success rates in a figure without numbers.
    PUBLISHED = "Bat, 600 real serves: within 0.5 m and 1 m, in a figure without numbers"
    COLUMNS = (
        Column("met", "", "by the racket", BOOL, lambda b: b.verdict.flown.contact.met[:, 0]),
        Column("landing", "m", "of the returned ball", VECTOR, lambda b: b.verdict.landing),
        Column("miss", "m", "from the target", NUMBER, lambda b: b.verdict.miss),
    )

    def world(self) -> World:
        """Return the simulated world with the drawn court."""
        return dataclasses.replace(HIT_WORLD, robot=Quadrotor(self.robot, **self.settings.air()))

    @property
    def robot(self) -> QuadrotorModel:
        """The quadrotor as plans know it; by default the quadrotor of [Yu2023bat]."""
        return self.settings.known_robot() or PAPER_HITTER

    def cases(self) -> Volleys:
        """Draw all serves of the run from its suite (family of random serves) and seed."""
        settings = self.settings
        regions = REAL_SCENARIOS.get(settings.suite)
        return volleys(
            settings.num,
            regions,
            settings.seed,
            drag_error=settings.drag_error,
            robot=self.robot,
            wind=settings.wind,
            seen=settings.seen,
        )

    def fly(self, cases: Volleys, record: bool) -> HitFlights:
        """Plan and simulate the flights of `cases`; `record` is whether states are stored."""
        name = self.settings.planner
        planner = None if name == "exact" else hit_planner(name)
        return fly_hits(self.loop(record), cases, self.settings.seed, planner=planner)

    def launches(self, cases: Volleys, flown: Flown) -> Launches:
        """Return the balls' states at the start of the plan and just after the racket's impact."""
        truth = cases.cases
        back = _reflect_balls(flown.contact, truth)
        balls = jax.tree.map(lambda leaf: leaf[:, None], truth.ball)
        drag = truth.drag[:, None]
        return Launches(balls, drag, np.zeros(1), cases.seen, returned=back, target=truth.target)

    @property
    def suite(self) -> str:
        """The name of the suite, the family of random serves, for the report."""
        return self.settings.suite

    def counts(self, rows: Any) -> dict[str, int]:
        """Return the number of hit balls, and the number that landed within 1 m of the target."""
        miss, met = np.asarray(rows["miss"]), np.asarray(rows["met"])
        return {"within_1_m": int((miss <= _FAR).sum()), "met": int(met.sum())}

    def findings(self, summary: Mapping[str, Any]) -> list[str]:
        """Return a sentence with two shares of balls: within 1 m of the target, and hit at all."""
        within, met = (percent(summary[name], summary["num"]) for name in ("within_1_m", "met"))
        return [f"{within} % within 1 m; the racket met the ball in {met} %."]
