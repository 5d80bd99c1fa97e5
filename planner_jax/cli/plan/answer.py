"""The answer of `planner-jax plan` for one case: plan, referee's verdict, margins to the limits."""

import abc
import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Generic, SupportsFloat, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from planner_jax.cli.plan.settings import PlanSettings
from planner_jax.core.errors import CaseError
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Status
from planner_jax.core.registry import Task
from planner_jax.planning.plan import plan
from planner_jax.referee.quadrotor import pieces_of, read_flight
from planner_jax.referee.rotors import rotor_range
from planner_jax.robot.quadrotor import QuadrotorPlan
from planner_jax.runs.style import draw
from planner_jax.runs.table import align
from planner_jax.sweep.figures import PANELS
from planner_jax.sweep.quadrotor import SampledMotion, sample_motion
from planner_jax.sweep.sweep import sweep_of

SingleT = TypeVar("SingleT", bound=PlanSettings)

_SAMPLES = 4001  # number of times at which a plan is compared with the limits

# Quantities of a flight with an upper limit, and their units. `sweep.figures.PANELS` has functions
# that compute the quantities from samples of the flight.
_ABOVE = {"speed": "m/s", "acceleration": "m/s^2", "body_rate": "rad/s"}


@dataclasses.dataclass(frozen=True)
class Margin:
    """How close a plan comes to one limit."""

    limit: str  # name and unit of the limit
    reached: float  # value of the limited quantity where the plan is closest to the limit
    allowed: float  # the limit
    time: float  # [s], time at which the plan is closest to the limit
    least: bool = False  # whether the limit is a lower bound

    @property
    def share(self) -> float:
        """Used fraction of the limit: reached / allowed, or its inverse for a lower bound."""
        part, whole = (self.allowed, self.reached) if self.least else (self.reached, self.allowed)
        if whole > 0.0:
            return max(part, 0.0) / whole
        return 0.0 if part <= whole else np.inf


@dataclasses.dataclass(frozen=True)
class Answer:
    """A case, its plan, and the referee's verdict on the plan."""

    case: PyTree
    plan: PyTree
    verdict: PyTree

    @property
    def success(self) -> bool:
        """Whether the referee accepts the plan."""
        return bool(self.verdict.success)


class Single(abc.ABC, Generic[SingleT]):
    """Base class of the command `plan TASK`: make a case from options, plan and describe it."""

    # Field of the case -> option that sets it, if the names differ. Errors name the option.
    NAMES: ClassVar[dict[str, str]] = {"head_state": "start"}

    def __init__(self, task: Task, settings: SingleT):
        self.task, self.settings = task, settings

    @abc.abstractmethod
    def case(self) -> PyTree:
        """Make the case that the command's options specify."""

    @abc.abstractmethod
    def contact(self, answer: Answer) -> list[str]:
        """Describe time and position of each contact with a ball, one sentence per contact."""

    @abc.abstractmethod
    def task_margins(self, answer: Answer) -> list[Margin]:
        """Return how close the plan comes to each limit that only this task has."""

    def play(self, answer: Answer) -> None:
        """Play the plan in a browser, if the task has this option and it is chosen."""

    def planner(self) -> Planner:
        """Make the planner that the command's options specify."""
        return self.task.planner(self.settings.planner, **self.settings.planner_options())

    def answer(self) -> Answer:
        """Plan the case and judge the plan; raise `ArgumentError` if an option is invalid."""
        try:
            # Arrays in float64 become float32, as in all other cases.
            case = jax.tree.map(lambda leaf: np.asarray(jnp.asarray(leaf)), self.case())
            found = plan(self.planner(), case)
        except CaseError as error:
            raise error.with_names(dict(map(self._setting_of, (error.name, error.other)))) from None
        return Answer(case, found, self.task.judge(case, found))

    def _setting_of(self, field: str) -> tuple[str, str]:
        return field, self.NAMES.get(field, field.rpartition(".")[2])

    def describe(self, answer: Answer) -> list[str]:
        """Describe contact, status, verdict and margins in lines of text."""
        status = Status(int(answer.plan.status))
        sentence = answer.verdict.sentence()
        planner = f"Planner {self.settings.planner}: {status.name}, {status.message}."
        if answer.success:
            lines = [*self.contact(answer), planner, f"Referee: {sentence}."]
        else:
            lines = ["No plan that keeps every limit was found.", planner]
            lines.append(f"Referee on the best plan found: {sentence}.")
        return [*lines, "", *_table(self.margins(answer))]

    def margins(self, answer: Answer) -> list[Margin]:
        """Return how close the plan comes to each limit: of flight, of rotors, and of the task."""
        return [*_of_flight(answer), *_of_rotors(answer), *self.task_margins(answer)]

    def write_pictures(self, answer: Answer, out: Path) -> list[Path]:
        """Draw the case and its plan into the folder `out`, and return the pictures' paths."""
        parts = answer.case, answer.plan, answer.verdict
        drawn = sweep_of(self.task).pictures(*parts, str(self.settings.planner))
        for picture in drawn:
            draw(out / picture.name, picture.draw, picture.size)
        return [out / picture.name for picture in drawn]


def sample_plan(found: QuadrotorPlan) -> SampledMotion:
    """Sample a plan of a quadrotor with its recovery trajectory at evenly spaced times."""
    coeffs, durations = _pieces(found)
    return sample_motion(coeffs.ravel(), durations, _SAMPLES, jax.tree.map(np.asarray, found.air))


def _pieces(found: QuadrotorPlan) -> tuple[np.ndarray, np.ndarray]:
    path = found.whole
    coeffs, durations = (np.asarray(each, float) for each in (path.coeffs, path.durations))
    there = durations > 0.0
    return coeffs[there], durations[there]


def closest_to(
    times: np.ndarray, words: str, values: np.ndarray, allowed: SupportsFloat, least: bool = False
) -> Margin:
    """Return the margin of K values at K times [s] to the limit `allowed`."""
    # Values are NaN where the attitude is undefined; such a plan exceeds the limit infinitely.
    values = np.nan_to_num(values, nan=-np.inf if least else np.inf)
    at = int(np.argmin(values) if least else np.argmax(values))
    return Margin(words, float(values[at]), float(allowed), float(times[at]), least)


def _of_flight(answer: Answer) -> list[Margin]:
    limits, gravity = answer.case.limits, float(answer.case.gravity)
    motion = sample_plan(answer.plan)
    sizes = {name: values(motion, gravity) for name, (_, _, values) in PANELS.items()}
    if answer.plan.heading is not None:  # the figures show the body rate at zero heading
        points = answer.plan.sample(_SAMPLES / motion.time[-1])
        rates = np.linalg.norm(points.body_rate, axis=-1)
        sizes["body_rate"] = np.interp(motion.time, points.time, rates)
    closest = functools.partial(closest_to, motion.time)
    found = [
        closest(f"{name.replace('_', ' ')} [{unit}]", sizes[name], vars(limits)[name])
        for name, unit in _ABOVE.items()
        if vars(limits)[name] is not None
    ]
    if limits.max_thrust is not None:
        thrust = sizes["thrust"]
        found.append(closest("thrust, least [m/s^2]", thrust, limits.min_thrust, least=True))
        found.append(closest("thrust, greatest [m/s^2]", thrust, limits.max_thrust))
    return [*found, closest("height, least [m]", motion.pos[:, 2], limits.min_height, least=True)]


def _of_rotors(answer: Answer) -> list[Margin]:
    rotors = answer.case.limits.rotors
    if rotors is None:
        return []
    coeffs, durations = _pieces(answer.plan)
    one = lambda leaf: np.asarray(leaf, float)[None]  # noqa: E731
    leaves = read_flight(*jax.tree.map(one, (answer.case, answer.plan)))
    fractions = np.linspace(0.0, 1.0, _SAMPLES // len(durations))
    with np.errstate(all="ignore"):
        found = rotor_range(pieces_of(coeffs[None], durations[None]), leaves, fractions)
    low, low_at, high, high_at = (float(each[0]) for each in found)
    return [
        Margin("rotor thrust, least [N]", low, float(rotors.min_thrust), low_at, least=True),
        Margin("rotor thrust, greatest [N]", high, float(rotors.max_thrust), high_at),
    ]


def _table(margins: Sequence[Margin]) -> list[str]:
    rows = [("limit", "reached", "allowed", "share", "at [s]")]
    for margin in margins:
        share = f"{100.0 * margin.share:.1f} %" if np.isfinite(margin.share) else "exceeded"
        numbers = (f"{margin.reached:.4g}", f"{margin.allowed:.4g}", share, f"{margin.time:.3f}")
        rows.append((margin.limit, *numbers))
    return align(rows)
