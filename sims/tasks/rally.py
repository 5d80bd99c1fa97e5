"""Rallies in closed loop: a quadrotor keeps one ball up with a racket, hit after hit."""

import dataclasses
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.baselines.protocols import BY_ROW
from planner_jax.core.errors import ArgumentError
from planner_jax.core.plan_files import LARGEST, UNREADABLE, read_archive
from planner_jax.host.files import replacing
from planner_jax.planning.plan import plan as plan_all
from planner_jax.runs.columns import COUNT, NUMBER, Column, leaves_of
from planner_jax.runs.summary import percent
from planner_jax.sims.launch import flight_keys
from planner_jax.sims.loop_state import Loop
from planner_jax.sims.model import World
from planner_jax.sims.noise import NOISES
from planner_jax.sims.rally_loop import RallyPilot, begin_trials, first_cases, fly_on, partner_cases
from planner_jax.sims.rally_state import Trial
from planner_jax.sims.recording import Recording
from planner_jax.sims.robots.quadrotor.robot import Quadrotor
from planner_jax.sims.robots.quadrotor.squad import Squad
from planner_jax.sims.scenery import Part
from planner_jax.sims.settings import RallyFly
from planner_jax.sims.task import BallTask, FlightCases, Flights
from planner_jax.sims.tasks.hit import court_parts
from planner_jax.task.hit.court import HALF_WIDTH
from planner_jax.task.rally.case import RallyCase
from planner_jax.task.rally.suites import COURSES, Course, draw

_NET = "#7F8C8D"  # colour of the net in pictures
_AHEAD = 2  # number of hits of one robot that are planned together, at most one for each box
_SEEN = 0.25  # [s], time for which the first ball is observed before the first plan
_CHUNK = 100  # number of planning periods that are simulated by one call of the program
_SHOWN = 12.0  # [s], duration of the recording of a trial, for pictures and films
_LONGEST = 3.0  # [s], longest mean time between two hits; a trial that is slower ends
_STORED = 30.0  # [s], time between two times at which the state of the trials is stored


@dataclasses.dataclass(frozen=True)
class Rallies(FlightCases):
    """B first balls and robots, with the first estimates of the ball's and the racket's numbers."""

    cases: RallyCase  # leaves (B, ...), with the true ball, drag and restitution
    believed_drag: np.ndarray  # (B,) [1/m], initial estimate of K_D
    believed_restitution: np.ndarray  # (B,), initial estimate of the coefficient of restitution


@dataclasses.dataclass(frozen=True)
class FlownRally:
    """The trials at their ends, and the states at their start, on the host."""

    trial: Trial  # leaves (B, ...)
    tracking: np.ndarray  # (B, 2) [m], rms and worst tracking error
    time: np.ndarray  # (K,) [s], times of the K recorded states
    qpos: np.ndarray  # (B, K, N, R + 3), joint positions of each of N robots and the ball
    wanted: np.ndarray  # (B, K, N, 3) [m], planned positions of the robots


@dataclasses.dataclass(frozen=True)
class StateFile:
    """A file with the state of trials, from which an interrupted run continues."""

    path: Path
    identity: str  # text that identifies the run

    def load(self, like: Any) -> Any:
        """Return a stored pytree with the structure of `like`; `like` itself without a file.

        Raises:
            ArgumentError: the file belongs to another run, or cannot be read.
        """
        if not self.path.exists():
            return like
        leaves, structure = jax.tree.flatten(like)
        try:
            identity, stored = read_archive(self.path, "identity", LARGEST)
            found = [stored[f"leaf{k}"] for k in range(len(leaves))]
        except UNREADABLE as error:
            why = " ".join(str(error).split())
            raise ArgumentError("state", f"a whole file: {why}", self.path.name) from None
        if identity != self.identity:
            rule = "the file of a run with these settings, or a new file"
            raise ArgumentError("state", rule, self.path.name)
        return jax.tree.unflatten(structure, found)

    def save(self, tree: Any) -> None:
        """Store a pytree of arrays; a file that exists is replaced at the end."""
        leaves = {f"leaf{k}": leaf for k, leaf in enumerate(jax.tree.leaves(jax.device_get(tree)))}
        with replacing(self.path) as scratch, open(scratch, "wb") as file:
            np.savez(file, identity=self.identity, **leaves)


@dataclasses.dataclass(frozen=True)
class RallyFlights(Flights):
    """The result of a batch of B rallies; arrays have the leading axis B."""

    flown: FlownRally
    required: int  # number of hits after which a trial ends

    @property
    def success(self) -> np.ndarray:
        """Mask (B,) of the trials with all required hits before the ball was lost."""
        return np.asarray(self.flown.trial.hits) >= self.required


def fly_rallies(
    loop: Loop,
    rallies: Rallies,
    hits: int,
    seed: int = 0,
    *,
    pilot: RallyPilot | None = None,
    record: bool = True,
    state: StateFile | None = None,
) -> RallyFlights:
    """Plan and simulate a batch of rallies until each ball is lost or was hit `hits` times.

    Args:
        loop: settings of the closed loop: world, sensing and rates.
        rallies: the first balls and the robots.
        hits: number of hits after which a trial ends.
        seed: random seed of the noise, >= 0.
        pilot: part of the loop that plans again; by default a `RallyPilot`.
        record: whether the first seconds of the trials are kept for pictures.
        state: file from which the trials continue, and in which their state is stored.

    Raises:
        ArgumentError: the file `state` belongs to another run, or cannot be read.
    """
    pilot = pilot or RallyPilot()
    cases = jax.tree.map(jnp.asarray, rallies.cases)
    believed = jnp.asarray(rallies.believed_drag), jnp.asarray(rallies.believed_restitution)
    keys = flight_keys(seed, rallies.index)
    trials = begin_trials(loop, cases, *believed, keys, _SEEN)
    known = first_cases(loop, trials, cases, min(_AHEAD, cases.places.shape[1]))
    clock = time.perf_counter()
    first = jax.device_get(plan_all(pilot.planner.inner, known))
    plans = [first]
    if cases.home is not None:
        plans.append(jax.device_get(plan_all(pilot.planner.inner, partner_cases(known, first))))
    planning = time.perf_counter() - clock
    plan = jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=1), *plans)
    trials = dataclasses.replace(trials, plan=plan)
    steps = loop.observations_per_plan * _CHUNK
    size = steps * (int(np.ceil(_SHOWN / (_CHUNK * loop.period))) if record else 0)
    now = {
        "trials": dataclasses.replace(trials, key=jax.random.key_data(trials.key)),
        "calls": np.zeros((), int),  # number of calls of `fly_on` so far
        "qpos": np.zeros((len(rallies), size, *trials.physics.qpos.shape[1:]), np.float32),
        "wanted": np.zeros((len(rallies), size, len(plans), 3), np.float32),
    }
    now = now if state is None else state.load(now)
    trials = jax.tree.map(jnp.asarray, now["trials"])
    trials = dataclasses.replace(trials, key=jax.random.wrap_key_data(trials.key))
    longest = min(pilot.course.seconds, _LONGEST * (hits + 1))
    stored, limit = time.monotonic(), longest / (_CHUNK * loop.period) - 1e-6
    while now["calls"] < limit:
        if np.all(np.asarray(trials.lost) | (np.asarray(trials.hits) >= hits)):
            break
        trials, frames = fly_on(loop, pilot, trials, cases, _CHUNK)
        part = slice(int(now["calls"]) * steps, (int(now["calls"]) + 1) * steps)
        if part.stop <= size:
            now["qpos"][:, part] = _by_trial(frames.qpos)
            now["wanted"][:, part] = _by_trial(frames.wanted)
        now["calls"] = now["calls"] + 1
        now["trials"] = dataclasses.replace(trials, key=jax.random.key_data(trials.key))
        if state is not None and time.monotonic() - stored > _STORED:
            state.save(now)
            stored = time.monotonic()
    if state is not None:
        state.save(now)
    end = jax.device_get(dataclasses.replace(trials, key=None, plan=None))
    mean = np.sqrt(end.squared_tracking / np.maximum(end.tracked, 1e-6))
    shown = min(size, int(now["calls"]) * steps)
    flown = FlownRally(
        trial=end,
        tracking=np.stack([mean, end.worst_tracking], axis=1),
        time=(np.arange(shown) + 1) / loop.sensing.rate,
        qpos=now["qpos"][:, :shown],
        wanted=now["wanted"][:, :shown],
    )
    return RallyFlights(first, flown, planning, hits)


def _by_trial(frames: Any) -> np.ndarray:
    """Return states (B, P O, N, ...) of B trials from states (P, B, O, ...) of P periods."""
    states = np.moveaxis(np.asarray(frames), 0, 1)
    return states.reshape(states.shape[0], -1, *states.shape[3:])


_LAST = leaves_of(
    "verdict.flown.trial.last",
    (
        "last_offset",
        "m",
        "of the ball from the racket's centre at the end",
        NUMBER,
        "offset",
    ),
    ("last_tracking", "m", "of the robot from its plan then", NUMBER, "tracking"),
    ("last_late", "s", "of that passage after the planned time", NUMBER, "late"),
    ("last_violation", "", "greatest relative excess of the last plan", NUMBER, "violation"),
    ("last_restitution", "", "error of the estimated restitution", NUMBER, "restitution"),
    ("last_drag", "", "relative error of the estimated drag", NUMBER, "drag"),
)


class RallyFlight(BallTask):
    """The simulation of rallies, which `sims/run.py` calls to simulate, score and draw a run."""

    settings: RallyFly

    CONTACT = "hit"
    PUBLISHED = "[Ji2025], {0.num} trials, {0.what_counts}: {0} on average, {1} at best".format(
        *(BY_ROW["Ji2025", "abstract", row] for row in ("mean", "best"))
    )
    COLUMNS = (
        *leaves_of(
            "verdict.flown.trial",
            ("hits", "", "in a row", COUNT),
            ("worst_offset", "m", "of a hit from the racket's centre", NUMBER),
            ("aimed", "", "hits that send the ball to the circle of the suite", COUNT),
            ("inside", "", "of these balls were met in the circle", COUNT),
        ),
        Column(
            "mean_offset",
            "m",
            "of all hits from the racket's centre",
            NUMBER,
            lambda b: b.verdict.flown.trial.sum_offset / np.maximum(b.verdict.flown.trial.hits, 1),
        ),
        *_LAST,
    )

    @property
    def SUCCESS(self) -> str:  # type: ignore[override]
        """The predicate of a successful trial in sentences."""
        return f"had {self.hits:,} hits without a loss of the ball"

    @property
    def course(self) -> Course:
        """The rules of a trial of the suite."""
        return COURSES.get(self.settings.suite, Course())

    @property
    def hits(self) -> int:
        """The number of hits after which a trial ends."""
        return self.settings.hits or self.course.hits

    def world(self) -> World:
        """Return the world that pictures show: all robots, and the net with the court's lines."""
        settings, net = self.settings, self.course.net
        robot = Quadrotor(settings.robot or self.course.robot, **settings.air())
        gravity = float(np.asarray(self._draw(1).gravity)[0])
        if self.course.home is None:
            return World(robot, gravity)
        fabric = Part("box", (0.02, 2.0 * HALF_WIDTH, net), (0.0, 0.0, 0.5 * net), _NET, 0.0, 0.25)
        scenery = (*court_parts(), fabric)
        return World(Squad(robot, 2), gravity, scenery=scenery)

    def loop(self, record: bool) -> Loop:
        """Return the closed loop's settings, with the world of one robot."""
        settings, world = self.settings, self.world()
        own = getattr(world.robot, "member", world.robot)
        world = World(own, world.gravity)
        return Loop(world, NOISES[settings.noise], replan=settings.rate, record=record)

    def _draw(self, num: int) -> RallyCase:
        settings, known = self.settings, self.settings.known_robot()
        return draw(num, settings.suite, settings.seed, robot=known, wind=settings.wind)

    def cases(self) -> Rallies:
        """Draw all trials of the run from its suite and seed, with wrong first estimates."""
        settings = self.settings
        cases = jax.tree.map(np.asarray, self._draw(settings.num))
        signs = np.random.default_rng([settings.seed, 1]).choice([-1.0, 1.0], (2, settings.num))
        drag = cases.drag * (1.0 + settings.drag_error * signs[0])
        restitution = cases.restitution * (1.0 + settings.restitution_error * signs[1])
        return Rallies(
            np.arange(settings.num),
            cases,
            drag.astype(np.float32),
            np.minimum(restitution, 1.0).astype(np.float32),
        )

    def fly(self, cases: Rallies, record: bool) -> RallyFlights:
        """Plan and simulate the trials of `cases`; `record`: whether first states are kept."""
        settings, state = self.settings, None
        if settings.state is not None:
            others = {**dataclasses.asdict(settings), "state": None, "hits": None}
            identity = json.dumps([others, [int(cases.index[0]), len(cases)]], default=str)
            state = StateFile(Path(settings.state), identity)
        return fly_rallies(
            self.loop(False),
            cases,
            self.hits,
            settings.seed,
            pilot=RallyPilot(course=self.course),
            record=record,
            state=state,
        )

    def recording(
        self, cases: Rallies, flights: RallyFlights, lanes: Sequence[int] | np.ndarray
    ) -> Recording:
        """Return a recording of the first seconds of the trials with the indices `lanes`."""
        flown, number = flights.flown, len(lanes)
        qpos, size = flown.qpos[lanes].astype(float), flown.qpos.shape[-1] - 3
        balls = qpos[:, :, :1, size:]
        balls[balls[..., 2] < 0.0] = np.nan
        return Recording(
            index=cases.index[lanes],
            success=flights.success[lanes],
            time=np.broadcast_to(flown.time, (number, flown.time.size)),
            robot=qpos[..., :size].reshape(*qpos.shape[:2], -1),
            wanted=flown.wanted[lanes].astype(float),
            balls=balls,
            met=np.full((number, 1), np.nan),
            contact=np.full((number, 1, 3), np.nan),
            target=np.full((number, 3), np.nan),
            expected=np.zeros((number, flown.time.size, 0, 3)),
        )

    @property
    def suite(self) -> str:
        """The name of the suite for the report."""
        return self.settings.suite

    @property
    def conditions(self) -> str:
        """Sensing noise and errors of first estimates, as the beginning of a sentence."""
        error = 100 * self.settings.restitution_error
        return f"{super().conditions}, {error:g} % error of the estimated restitution"

    def counts(self, rows: Any) -> dict[str, Any]:
        """Return the numbers of all hits and of the fewest hits, and the mean offset of hits."""
        column = lambda name: np.asarray(rows[name])  # noqa: E731
        return {
            "hits": int(column("hits").sum()),
            "fewest_hits": int(column("hits").min()),
            "mean_offset": float(column("mean_offset").mean()),
            "aimed": int(column("aimed").sum()),
            "inside": int(column("inside").sum()),
        }

    def findings(self, summary: Mapping[str, Any]) -> list[str]:
        """Return a sentence about the numbers of hits and their distance from the centre."""
        lines = [
            f"{summary['hits']:,} hits in all, at least {summary['fewest_hits']:,} in a trial, "
            f"{100 * summary['mean_offset']:.1f} cm from the racket's centre on average."
        ]
        inside, aimed = summary["inside"], summary["aimed"]
        if np.isfinite(self.course.circle) and aimed:
            lines.append(
                f"{percent(inside, aimed)} % of {aimed:,} hits to the circle of "
                f"{self.course.circle:g} m sent the ball into it."
            )
        return lines
