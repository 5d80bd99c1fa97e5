"""Teams in one simulated world: several quadrotors catch balls that they share.

Each quadrotor tracks its own plan, which is made once for the true paths of the balls. The balls
float: they have no weight, and sink at constant velocity as in the suites.
"""

import dataclasses
import functools
import itertools
import time
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.ball.target import state_at
from planner_jax.core import GRAVITY
from planner_jax.planning.plan import plan as plan_all
from planner_jax.robot.quadrotor_model import PAPER_CATCHER
from planner_jax.runs.columns import BOOL, NUMBER, Column, leaves_of, list_of
from planner_jax.sims.launch import flight_keys, ready
from planner_jax.sims.loop import fly_leg
from planner_jax.sims.loop_state import Flown, Loop, collect_flights
from planner_jax.sims.model import World, place_balls
from planner_jax.sims.recording import Launches
from planner_jax.sims.robots.quadrotor.robot import Quadrotor
from planner_jax.sims.robots.quadrotor.squad import Squad
from planner_jax.sims.scoring import Contact, Moment, nearest, no_contact, passage
from planner_jax.sims.settings import TeamFly
from planner_jax.sims.task import BallFlightTask, FlightCases, Flights
from planner_jax.sims.tasks.catch_pilot import LIFT, CatchPilot
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.team.api import planner as team_planner
from planner_jax.task.team.case import TeamCase
from planner_jax.task.team.plan import TeamPlan
from planner_jax.task.team.suites import draw

# Robots do not track their plans exactly. Plans therefore have a least distance that is greater by
# `_TRACKING` [m], nets whose radius is `_INSIDE` times the true radius, and balls that enter a net
# with at least `_ENTRY` [m/s].
_TRACKING, _INSIDE, _ENTRY = 0.1, 0.8, 0.3
_AFTER = 0.2  # [s], simulated time after the last robot has stopped


@dataclasses.dataclass(frozen=True)
class TeamPilot(CatchPilot):
    """The part of the loop that finds the catches of N robots; it never plans again."""

    def times(self, plan: CatchPlan) -> Array:
        """Return the planned catch times of M balls, (M,) [s], of plans with leaves (N, ...)."""
        taken = plan.choice.taken
        times = jax.vmap(super().times)(plan)
        return jnp.max(jnp.where(taken | ~jnp.any(taken, axis=0)[None], times, 0.0), axis=0)

    @staticmethod
    def passage(
        world: World, before: Moment, after: Moment, time: Array, planned: Array, reference: Array
    ) -> tuple[Array, Contact]:
        """Return which of M balls pass a net's plane in a step, and each ball's nearest passage.

        `sims.scoring.passage` explains the arguments. Leaves of robots have a leading axis N.
        """
        axes: tuple[Any, ...] = 0, 0, 0, 0, None, None
        in_axes = None, Moment(*axes), Moment(*axes), None, None, 0
        every, found = jax.vmap(passage, in_axes)(world, before, after, time, planned, reference)
        best = no_contact(world.num_balls, planned.dtype)
        for k, passes in enumerate(every):
            best = nearest(best, passes, jax.tree.map(lambda leaf: leaf[k], found))  # noqa: B023
        return jnp.any(every, axis=0), best


@dataclasses.dataclass(frozen=True)
class TeamFlights(Flights):
    """The result of B flights of N robots and M balls; arrays have the leading axis B."""

    flown: Flown  # its tracking errors are of all robots: roots of the sums of squares
    planned: np.ndarray  # (B, M) bool, whether a plan catches the ball
    least_distance: np.ndarray  # (B,) [m], of two robots at the observations; infinite for N = 1
    allowed: np.ndarray  # (B,) [m], least allowed distance

    @property
    def success(self) -> np.ndarray:
        """Mask (B,) of the flights with all planned catches in which the robots stay apart."""
        caught = (np.asarray(self.flown.contact.met) | ~self.planned).all(axis=1)
        return caught & (self.least_distance >= self.allowed)


@dataclasses.dataclass(frozen=True)
class Teams(FlightCases):
    """B cases of teams to fly."""

    cases: TeamCase  # leaves (B, ...)


def fly_teams(
    loop: Loop, teams: Teams, plans: TeamPlan, seed: int = 0, *, planning: float = 0.0
) -> TeamFlights:
    """Simulate B flights in which the robots of a team track their plans.

    Args:
        loop: settings of the loop, which records; its world has a `Squad` and balls that float.
        teams: the cases of the plans.
        plans: plans of teams with recoveries, leaves (B, ...).
        seed: random seed of the noise of the robots' estimated states, >= 0.
        planning: [s], wall time of the plans.
    """
    world, cases = loop.world, jax.tree.map(jnp.asarray, teams.cases)
    robots = jax.tree.map(jnp.asarray, plans.robots)
    whole = jax.vmap(lambda plan: plan.whole)(robots)
    every = jnp.ones((len(teams), world.num_balls), bool)
    drag = jnp.zeros(every.shape)
    balls = jax.vmap(jax.vmap(state_at, (0, None)), (0, None))(cases.shared.targets, drag[0, 0])
    flight = ready(loop, cases.head_states[:, :, 0], flight_keys(seed, teams.index))
    place = jax.vmap(functools.partial(place_balls, world))
    flight = dataclasses.replace(
        flight,
        physics=place(flight.physics, balls, drag, every),
        launched=every,
        present=every,
        plan=dataclasses.replace(robots, trajectory=whole, recovery=None),
    )
    end = float(whole.durations.sum(axis=2).max()) + _AFTER
    flown = collect_flights(
        *fly_leg(loop, TeamPilot(), flight, None, drag, num_periods=loop.num_periods(end))
    )
    record: Any = flown.record
    poses = record.physics.qpos[:, :, : world.robot.num_pos]
    pos = np.moveaxis(world.robot.place(poses).reshape(*poses.shape[:2], -1, 3), 2, 0)
    pairs = itertools.combinations(pos, 2)
    apart = [np.linalg.norm(a - b, axis=2).min(axis=1) for a, b in pairs]
    return TeamFlights(
        first_plan=plans,
        flown=flown,
        planning_seconds=planning,
        planned=np.any(np.asarray(plans.taken), axis=1),
        least_distance=np.min([np.full(len(teams), np.inf), *apart], axis=0),
        allowed=np.asarray(teams.cases.least_distance),
    )


class TeamFlight(BallFlightTask):
    """The simulation of teams, which `sims/run.py` calls to simulate, score and draw a run."""

    settings: TeamFly  # pyright: ignore[reportIncompatibleVariableOverride]

    CONTACT = "caught"
    SUCCESS = "made all planned catches, with the robots far enough apart"
    PUBLISHED = "-"
    COLUMNS = (
        Column("caught", "", "each ball", list_of(BOOL), lambda b: b.verdict.flown.contact.met),
        *leaves_of(
            "verdict",
            ("planned", "", "whether a plan catches each ball", list_of(BOOL)),
            ("least_distance", "m", "of two robots", NUMBER),
        ),
    )

    def world(self) -> World:
        """Return the simulated world with all robots and balls of the suite."""
        case = self._draw(1)
        squad = Squad(Quadrotor(PAPER_CATCHER), case.num_robots)
        return World(squad, GRAVITY, case.shared.num_targets, floats=True)

    def _draw(self, num: int) -> TeamCase:
        return draw(num, self.settings.suite, self.settings.seed)

    def cases(self) -> Teams:
        """Draw all flights of the run from its suite and seed."""
        num = self.settings.num
        return Teams(np.arange(num), jax.device_get(self._draw(num)))

    def fly(self, cases: Teams, record: bool) -> TeamFlights:
        """Plan and simulate the flights of `cases`, whose states are always recorded."""
        settings, shared = self.settings, cases.cases.shared
        net = dataclasses.replace(shared.net, radius=np.float32(_INSIDE) * shared.net.radius)
        stricter = TeamCase(
            dataclasses.replace(shared, net=net),
            cases.cases.head_states,
            cases.cases.least_distance + np.float32(_TRACKING),
        )
        clock = time.perf_counter()
        plans = plan_all(team_planner(settings.planner, lift=LIFT, entry=_ENTRY), stricter)
        planning = time.perf_counter() - clock
        return fly_teams(self.loop(True), cases, plans, settings.seed, planning=planning)

    def launches(self, cases: Teams, flown: Flown) -> Launches:
        """Return the balls' states at time 0, at which all balls are in flight."""
        targets: Any = cases.cases.shared.targets
        nothing = np.zeros(cases.cases.shared.present.shape)
        return Launches(targets.ball, nothing, nothing[0], 0.0)

    def counts(self, rows: Any) -> dict[str, Any]:
        """Return mean numbers of catches, made and planned, and the least distance of robots."""
        mean = lambda name: float(np.mean([sum(each) for each in rows[name].to_pylist()]))  # noqa: E731
        least = float(np.min(rows["least_distance"]))
        return {name: mean(name) for name in ("caught", "planned")} | {"least_distance": least}

    def findings(self, summary: Mapping[str, Any]) -> list[str]:
        """Return a sentence about the catches and the least distance of two robots."""
        return [
            f"{summary['caught']:.2f} balls caught in a flight and {summary['planned']:.2f} "
            f"planned, on average; robots at least {summary['least_distance']:.2f} m apart."
        ]

    @property
    def suite(self) -> str:
        """The name of the suite for the report."""
        return self.settings.suite

    @property
    def conditions(self) -> str:
        """Sensing noise of the robots, as the beginning of a sentence."""
        return f"Noise {self.settings.noise} of the robots' states, known paths of the balls"

    @property
    def simulated(self) -> str:
        """A description of robots and balls, for the report of a run."""
        return f"{self.world().robot.WORDS}; balls at constant velocity"
