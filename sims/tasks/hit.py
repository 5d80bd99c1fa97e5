"""Hits in flight: one served ball, volleyed to a target with a racket (paper 002)."""

import dataclasses
import functools
import time
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.optimise.lbfgs import LbfgsConfig
from planner_jax.optimise.multistart import solve_round
from planner_jax.optimise.problem import Planner, Round
from planner_jax.sims.closed_loop import Flight, Flown, Loop, Outlook, expected, flown, fly_leg
from planner_jax.sims.launch import flight_keys, launched, ready, require_hovering, require_world
from planner_jax.sims.model import RACKET
from planner_jax.sims.scoring import Contact, landing_point, returned
from planner_jax.task.hit.exact import ExactHit
from planner_jax.task.hit.plan import HitPlan
from planner_jax.task.hit.replan import ReplanHit, ReplanHitScenario
from planner_jax.task.hit.scenario import HitScenario
from planner_jax.task.hit.serves import advance, generate_serves, to_scenarios
from planner_jax.task.solve import plan as plan_all

SEEN = 0.25  # [s], a serve's flight before it is planned for: 2 m and more (paper 000, VII-A)
_AFTER = 0.1  # [s] flown after the last impact planned
_LONGEST = 1.9  # [s], the longest flight

# Serve, landing and target region of the simulated court (`court.SCENARIOS`) for the six real
# scenarios of paper 002, Section VI-C, which it names in words alone: an assumption.
SCENARIOS: Mapping[str, tuple[str, ...]] = {
    "S.1": ("FNN", "FFN"),  # from different distances
    "S.2": ("FFF", "LFF"),  # serves from different directions
    "S.3": ("FFN", "FLN"),  # hit from different directions
    "S.4": ("FFL", "FNL"),  # hit straight, shoot sideways
    "S.5": ("FLL", "LLL"),  # hit and shoot sideways to the same side
    "S.6": ("FLR", "LLR"),  # hit and shoot sideways to different sides
}


def smooth_planner() -> ExactHit:
    """`ExactHit` with a first search of 60 iterations, of drag after the impact.

    What the first few iterations find meets the limits, which know no angular acceleration: one
    plan in 150 asks more of the rotors than they have, and the ball lands up to 30 cm beside.
    The smoother plan at the end of a longer search does not.
    """
    planner = ExactHit(drag_after_impact=True)
    solver = LbfgsConfig(max_steps=60, tolerance=1e-5, patience=6)
    return dataclasses.replace(planner, rounds=(Round(1, solver), *planner.rounds[2:]))


@dataclasses.dataclass(frozen=True)
class HitPilot:
    """Plans a hit anew from the plan that is flown."""

    planner: ReplanHit = ReplanHit(ExactHit(drag_after_impact=True))
    shortest: float = (
        0.3  # [s], least time to the impact that is planned anew: the racket must settle
    )
    excess: float = 0.1  # relative, over a limit, with which a new plan is still flown

    def times(self, plan: HitPlan) -> Array:
        """When the ball is to be hit (1,) [s]."""
        return plan.stroke.time[None]

    def plan_anew(
        self, scenario: HitScenario, plan: HitPlan, outlook: Outlook
    ) -> tuple[HitPlan, Array]:
        """One short round of the re-planner, and whether its plan is good enough."""
        task = ReplanHitScenario(
            scenario=believed(scenario, outlook.balls, outlook.drag, outlook.head_state),
            previous=plan,
            elapsed=outlook.elapsed,
        )
        found = solve_round(self.planner, self.planner.rounds[0], task)
        good = outlook.present[0] & (plan.stroke.time - outlook.elapsed >= self.shortest)
        return found, good & (found.violation <= self.excess)


def believed(scenario: HitScenario, balls: BallState, drag: Array, head: Array) -> HitScenario:
    """One scenario for what its ball (leaves (1, 3)) seems to do, drag (1,)."""
    ball = jax.tree.map(lambda leaf: leaf[0], balls)
    return dataclasses.replace(scenario, ball=ball, drag=drag[0], head_state=head)


@dataclasses.dataclass(frozen=True)
class Volleys:
    """B serves, as they are when they are planned for."""

    scenarios: HitScenario  # leaves (B, ...), with the true ball and drag
    believed: np.ndarray  # (B,) K_D [1/m]
    index: np.ndarray  # (B,) place in the whole, which decides the noise

    def __len__(self) -> int:
        return self.believed.size

    def __getitem__(self, rows: Any) -> "Volleys":
        """Some of them, picked as NumPy does."""
        columns = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return Volleys(**jax.tree.map(lambda leaf: leaf[rows], columns))


def volleys(
    num: int, names: tuple[str, ...] | None = None, seed: int = 0, *, drag_error: float = 0.0
) -> Volleys:
    """Drawn serves, seen for `SEEN` seconds.

    Args:
        num: B >= 1.
        names: out of `court.SCENARIOS`; all of them by default.
        seed: >= 0, of the serves and of the signs of the drag's errors.
        drag_error: relative error of what is believed of K_D, either way.
    """
    if not 0.0 <= drag_error < 1.0:
        raise ValueError(f"drag_error must be >= 0 and < 1, got {drag_error}")
    serves = advance(generate_serves(num, seed, names), SEEN)
    scenarios = to_scenarios(serves)
    sign = np.random.default_rng([seed, 1]).choice([-1.0, 1.0], num)
    true = np.asarray(scenarios.drag)
    believed = (true * (1.0 + drag_error * sign)).astype(np.float32)
    return Volleys(jax.tree.map(np.asarray, scenarios), believed, np.arange(num))


@dataclasses.dataclass(frozen=True)
class HitFlights:
    """What came of a batch of serves; leaves with a leading axis B."""

    first_plan: HitPlan
    flown: Flown  # times from the first plan; N = 1
    landing: np.ndarray  # (B, 3) [m], of the returned ball; NaN where it was missed
    miss: np.ndarray  # (B,) [m], from the target; inf where the ball was missed
    planning_seconds: float  # of the host's clock, spent on plans from scratch


@functools.partial(jax.jit, static_argnames="loop")
def _scenarios(loop: Loop, flights: Flight, truth: HitScenario) -> HitScenario:
    """What is to be hit, as it is believed."""

    def one(flight: Flight, scenario: HitScenario) -> HitScenario:
        balls = expected(loop, flight.earlier, loop.period)
        return believed(scenario, balls, flight.earlier.drag, scenario.head_state)

    return jax.vmap(one)(flights, truth)


@jax.jit
def _landings(contact: Contact, truth: HitScenario) -> tuple[Array, Array]:
    """Landing points (B, 3) [m] of the balls that were hit, and their distances from target."""

    def one(contact: Contact, scenario: HitScenario) -> tuple[Array, Array]:
        contact = jax.tree.map(lambda leaf: leaf[0], contact)
        ball = returned(contact, scenario.restitution)
        point, _ = landing_point(ball, scenario.drag, scenario.gravity)
        miss = jnp.sqrt(jnp.sum((point - scenario.target) ** 2))
        hit = contact.met & jnp.isfinite(miss)
        return jnp.where(hit, point, jnp.nan), jnp.where(hit, miss, jnp.inf)

    return jax.vmap(one)(contact, truth)


def fly_hits(
    loop: Loop,
    cases: Volleys,
    seed: int = 0,
    *,
    planner: Planner | None = None,
    pilot: HitPilot | None = None,
    plan: HitPlan | None = None,
) -> HitFlights:
    """Plan and fly a batch of serves.

    Args:
        loop: world, sensing, rates and gains.
        cases: the serves.
        seed: of the noise, >= 0.
        planner: of the first plan, by default `smooth_planner()`.
        pilot: of the plans after it.
        plan: first plan of each flight, instead of one made here.

    Raises:
        ValueError: a world or plan does not fit.
    """
    require_world(loop, RACKET, 1)
    planner, pilot = planner or smooth_planner(), pilot or HitPilot()
    truth = jax.tree.map(jnp.asarray, cases.scenarios)
    keys = flight_keys(seed, cases.index)
    drag = truth.drag[:, None]
    flight = ready(loop, truth.head_state[:, 0], keys)
    balls = jax.tree.map(lambda leaf: leaf[:, None], truth.ball)
    guess = jnp.asarray(cases.believed)[:, None]
    flight = launched(loop, flight, balls, drag, guess, ball=0, seen=SEEN)
    scenario = _scenarios(loop, flight, truth)
    jax.block_until_ready(scenario)
    clock = time.perf_counter()
    first = jax.block_until_ready(plan_all(planner, scenario)) if plan is None else plan
    planning = time.perf_counter() - clock
    require_hit_plan(first, scenario)
    begun = jax.tree.map(jnp.asarray, first)
    flight = dataclasses.replace(flight, plan=begun, began=flight.time, present=flight.launched)
    periods = loop.num_periods(_LONGEST - SEEN + _AFTER)
    flight, record = fly_leg(loop, pilot, flight, scenario, drag, num_periods=periods)
    landing, miss = jax.device_get(_landings(flight.contact, truth))
    return HitFlights(first, flown(flight, [record]), landing, miss, planning)


def require_hit_plan(plan: Any, scenario: HitScenario) -> None:
    """Raise `ValueError` unless a plan is one of these hits."""
    if not isinstance(plan, HitPlan):
        raise ValueError(f"plan must be a HitPlan, got a {type(plan).__name__}")
    require_hovering(scenario.head_state, plan)
