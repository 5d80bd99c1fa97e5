"""Teams in one simulated world: several quadrotors catch balls that they share.

Each quadrotor tracks its own plan, which is made once for the true paths of the balls. The balls
float: they have no weight, and sink at constant velocity as in the suites. A ball is caught by the
first quadrotor through whose net it passes.
"""

import dataclasses
import functools
import itertools
import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.ball.target import state_at
from planner_jax.core import GRAVITY
from planner_jax.core.compiled import QUICK_OPTIONS
from planner_jax.planning.plan import plan as plan_all
from planner_jax.robot.quadrotor_model import PAPER_CATCHER
from planner_jax.runs.columns import BOOL, COUNT, NUMBER, Column, leaves_of, list_of
from planner_jax.sims.launch import flight_keys
from planner_jax.sims.loop import track
from planner_jax.sims.loop_state import Loop
from planner_jax.sims.model import World, at_rest, ball_states, place_balls
from planner_jax.sims.recording import Recording
from planner_jax.sims.robot import Physics
from planner_jax.sims.robots.quadrotor.robot import Quadrotor
from planner_jax.sims.robots.quadrotor.squad import Squad
from planner_jax.sims.scoring import Contact, Moment, nearest, no_contact, passage
from planner_jax.sims.settings import TeamFly
from planner_jax.sims.task import BallTask, FlightCases, Flights
from planner_jax.sims.tasks.catch_pilot import LIFT
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.team.api import planner as team_planner
from planner_jax.task.team.case import TeamCase
from planner_jax.task.team.plan import TeamPlan
from planner_jax.task.team.suites import draw

# [m], added to the least distance in plans, because two robots do not track their plans exactly.
_TRACKING = 0.1
_AFTER = 0.2  # [s], simulated time after the last robot has stopped


@struct.dataclass
class TeamState:
    """The variables that change during one flight of N robots with M balls."""

    physics: Physics
    contact: Contact  # leaves (M, ...), nearest passage of each ball through a net so far
    catcher: Array  # (M,) int32, index of the robot that has caught each ball; -1 for none
    least_distance: Array  # () [m], of two robots so far; infinite for one robot
    worst_tracking: Array  # () [m], greatest distance of a robot from its plan so far
    squared_tracking: Array  # () [m^2 s], integral of the robots' mean squared distance
    time: Array  # () [s]
    key: Array


@dataclasses.dataclass(frozen=True)
class TeamFlown:
    """The result of a batch of B flights of N robots and M balls; arrays (B, ...)."""

    contact: Contact  # leaves (B, M, ...)
    catcher: np.ndarray  # (B, M), as in `TeamState`
    planned: np.ndarray  # (B, N, M) bool, which robot plans to catch which ball
    least_distance: np.ndarray  # (B,) [m]
    tracking: np.ndarray  # (B, 2) [m], rms and worst tracking error
    time: np.ndarray  # (K,) [s], times of the K recorded states; K is 0 without a record
    qpos: np.ndarray  # (B, K, 7 N + 3 M), joint positions
    wanted: np.ndarray  # (B, K, 3 N) [m], planned positions of the robots


@dataclasses.dataclass(frozen=True)
class TeamFlights(Flights):
    """The result of a batch of B flights of teams; arrays have the leading axis B."""

    flown: TeamFlown
    allowed: np.ndarray  # (B,) [m], least allowed distance of two robots

    @property
    def success(self) -> np.ndarray:
        """Mask (B,) of the flights with all planned catches in which the robots stay apart."""
        missed = self.flown.planned.any(axis=1) & (self.flown.catcher < 0)
        return ~missed.any(axis=1) & (self.flown.least_distance >= self.allowed)


@dataclasses.dataclass(frozen=True)
class Teams(FlightCases):
    """B cases of teams to fly."""

    cases: TeamCase  # leaves (B, ...)


def _moments(world: World, physics: Physics) -> Moment:
    """Return the moments of N robots with the same balls, robot leaves (N, 3)."""
    motions = world.carrier.tool_motion(world.robot.state(physics))
    return Moment(*motions, *ball_states(world, physics))


def _fly_to_observation(
    loop: Loop, state: TeamState, plans: CatchPlan, planned: Array
) -> TeamState:
    world, robot, dtype = loop.world, loop.world.robot, state.time.dtype
    key, noise_key = jax.random.split(state.key)
    noise = jax.random.normal(noise_key, robot.noise_shape, dtype)
    times = state.time + world.timestep * jnp.arange(loop.steps_per_observation, dtype=dtype)
    references = robot.references(plans, times, world)
    no_drag = jnp.zeros(world.num_balls, dtype)
    axes: tuple[Any, ...] = 0, 0, 0, 0, None, None  # of a moment's leaves
    pass_all = jax.vmap(passage, (None, Moment(*axes), Moment(*axes), None, 0, 0))

    def advance(carry: tuple, now: tuple) -> tuple[tuple, None]:
        state, before = carry
        reference, time = now
        physics = track(loop, state.physics, reference, noise, no_drag)[1]
        after = _moments(world, physics)
        contact, catcher = state.contact, state.catcher
        passes, later = pass_all(world, before, after, time, planned, reference.pos)
        for k in range(len(planned)):
            own = jax.tree.map(lambda leaf: leaf[k], later)  # noqa: B023
            contact = nearest(contact, passes[k], own)
            catcher = jnp.where(contact.met & (catcher < 0), k, catcher)
        pairs = itertools.combinations(after.robot_pos, 2)
        apart = [jnp.sqrt(jnp.sum((a - b) ** 2)) for a, b in pairs]
        squared = jnp.sum((before.robot_pos - reference.pos) ** 2, axis=1)
        return (
            dataclasses.replace(
                state,
                physics=physics,
                contact=contact,
                catcher=catcher,
                least_distance=jnp.min(jnp.stack([state.least_distance, *apart])),
                worst_tracking=jnp.maximum(state.worst_tracking, jnp.sqrt(jnp.max(squared))),
                squared_tracking=state.squared_tracking + world.timestep * jnp.mean(squared),
            ),
            after,
        ), None

    start = (state, _moments(world, state.physics))
    (state, _), _ = lax.scan(advance, start, (references, times))
    return dataclasses.replace(state, time=state.time + 1.0 / loop.sensing.rate, key=key)


@functools.partial(
    jax.jit, static_argnames=("loop", "observations"), compiler_options=QUICK_OPTIONS
)
def _fly(
    loop: Loop, cases: TeamCase, plans: CatchPlan, keys: Array, observations: int
) -> tuple[TeamState, Any]:
    """Simulate B flights with plans (B, N, ...); return their ends, and records if requested."""
    world = loop.world

    def one(case: TeamCase, plans: CatchPlan, key: Array) -> tuple[TeamState, Any]:
        zero = jnp.zeros(())
        balls = jax.vmap(state_at, (0, None))(case.shared.targets, zero)
        every = jnp.ones(world.num_balls, bool)
        still = at_rest(world, case.head_states[:, 0])
        state = TeamState(
            physics=place_balls(world, still, balls, jnp.zeros(world.num_balls), every),
            contact=no_contact(world.num_balls),
            catcher=jnp.full(world.num_balls, -1, jnp.int32),
            least_distance=zero + jnp.inf,
            worst_tracking=zero,
            squared_tracking=zero,
            time=zero,
            key=key,
        )
        planned = jax.vmap(lambda plan: jnp.zeros_like(plan.times).at[plan.order].set(plan.times))(
            plans
        )

        def observe(state: TeamState, _: None) -> tuple[TeamState, Any]:
            state = _fly_to_observation(loop, state, plans, planned)
            wanted = world.carrier.head_state(plans, state.time)[:, 0].ravel()
            return state, (state.time, state.physics.qpos, wanted) if loop.record else None

        return lax.scan(observe, state, None, length=observations)

    return jax.vmap(one)(cases, plans, keys)


def fly_teams(
    loop: Loop, teams: Teams, plans: TeamPlan, seed: int = 0, *, planning: float = 0.0
) -> TeamFlights:
    """Simulate B flights in which N robots track the plans of their team.

    Args:
        loop: settings of the loop, whose world has a `Squad` of N robots and M balls that float.
        teams: the cases of the plans.
        plans: plans of teams, leaves (B, ...), with recoveries.
        seed: random seed of the noise of the robots' estimated states, >= 0.
        planning: [s], wall time of the plans.
    """
    robots = plans.robots
    whole = jax.tree.map(np.asarray, jax.vmap(lambda plan: plan.whole)(robots))
    ends = whole.durations.sum(axis=2).max(axis=1)
    observations = loop.num_periods(float(ends.max()) + _AFTER)
    tracked = dataclasses.replace(robots, trajectory=whole, recovery=None)
    cases, tracked = jax.tree.map(jnp.asarray, (teams.cases, tracked))
    end, record = jax.device_get(
        _fly(loop, cases, tracked, flight_keys(seed, teams.index), observations)
    )
    mean = np.sqrt(end.squared_tracking / end.time)
    nothing = np.zeros((1, 0)), np.zeros((len(ends), 0, 0)), np.zeros((len(ends), 0, 0))
    times, qpos, wanted = record if loop.record else nothing
    flown = TeamFlown(
        contact=end.contact,
        catcher=end.catcher,
        planned=np.asarray(plans.taken),
        least_distance=end.least_distance,
        tracking=np.stack([mean, end.worst_tracking], axis=1),
        time=times[0],
        qpos=qpos,
        wanted=wanted,
    )
    return TeamFlights(plans, flown, planning, np.asarray(teams.cases.least_distance))


class TeamFlight(BallTask):
    """The simulation of teams, which `sims/run.py` calls to simulate, score and draw a run."""

    settings: TeamFly  # pyright: ignore[reportIncompatibleVariableOverride]

    CONTACT = "caught"
    SUCCESS = "made all planned catches, with the robots far enough apart"
    PUBLISHED = "-"
    COLUMNS = (
        *leaves_of(
            "verdict.flown",
            ("catcher", "", "robot that catches each ball, -1 for none", list_of(COUNT)),
            ("least_distance", "m", "of two robots", NUMBER),
        ),
        *leaves_of(
            "verdict.flown.contact",
            ("caught", "", "each ball", list_of(BOOL), "met"),
            ("contact_time", "s", "of each ball's nearest passage", list_of(NUMBER), "time"),
            ("offset", "m", "of the ball from the net's centre then", list_of(NUMBER)),
        ),
        Column(
            "planned",
            "",
            "number of planned catches",
            COUNT,
            lambda b: b.verdict.flown.planned.sum(axis=(1, 2)),
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
        """Plan and simulate the flights of `cases`; `record`: whether states are stored."""
        settings, least = self.settings, cases.cases.least_distance
        apart = dataclasses.replace(cases.cases, least_distance=least + least.dtype.type(_TRACKING))
        clock = time.perf_counter()
        plans = plan_all(team_planner(settings.planner, lift=LIFT), apart)
        planning = time.perf_counter() - clock
        return fly_teams(self.loop(record), cases, plans, settings.seed, planning=planning)

    def recording(
        self, cases: Teams, flights: TeamFlights, lanes: Sequence[int] | np.ndarray
    ) -> Recording:
        """Return a recording of the flights with the indices `lanes`."""
        flown, size = flights.flown, self.world().robot.num_pos
        qpos, shape = flown.qpos[lanes].astype(float), (len(lanes), flown.time.size)
        balls = qpos[:, :, size:].reshape(*shape, -1, 3)
        met = np.where(flown.contact.met, flown.contact.time, np.nan)[lanes]
        gone = flown.time[:, None] > np.nan_to_num(met, nan=np.inf)[:, None]
        balls[gone | (balls[..., 2] < 0.0)] = np.nan
        place = flown.contact.ball_pos[lanes]
        return Recording(
            index=cases.index[lanes],
            success=flights.success[lanes],
            time=np.broadcast_to(flown.time, shape),
            robot=qpos[:, :, :size],
            wanted=flown.wanted[lanes].astype(float),
            balls=balls,
            met=met,
            contact=np.where(np.isfinite(met)[..., None], place, np.nan),
            target=np.full((len(lanes), 3), np.nan),
            expected=np.zeros((*shape, 0, 3)),
        )

    def counts(self, rows: Any) -> dict[str, Any]:
        """Return mean numbers of catches, planned and made, and the least distance of robots."""
        caught = [sum(each) for each in rows["caught"].to_pylist()]
        return {
            "mean_caught": float(np.mean(caught)),
            "mean_planned": float(np.mean(rows["planned"])),
            "least_distance": float(np.min(rows["least_distance"])),
        }

    def findings(self, summary: Mapping[str, Any]) -> list[str]:
        """Return a sentence about the catches and the least distance of two robots."""
        return [
            f"{summary['mean_caught']:.2f} balls caught in a flight and "
            f"{summary['mean_planned']:.2f} planned, on average; robots at least "
            f"{summary['least_distance']:.2f} m apart."
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
