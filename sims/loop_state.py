"""The state of a flight, the settings of its loop, and its records."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Protocol

import jax
import numpy as np
from flax import struct
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.sims.model import World
from planner_jax.sims.noise import Sensing, require_whole
from planner_jax.sims.robot import Physics
from planner_jax.sims.scoring import Contact
from planner_jax.sims.sensing import Estimate


@struct.dataclass
class Outlook:
    """What a plan is made of: the moment from which it is to be flown, as expected."""

    time: Array  # () [s]
    elapsed: Array  # () [s], since the plan flown until then began
    balls: BallState  # leaves (N, 3), where they are believed to be then
    drag: Array  # (N,) K_D [1/m], believed
    present: Array  # (N,) bool, which are in flight and not yet met
    head_state: Array  # of the robot, (4, 3) for a quadrotor


class Pilot(Protocol):
    """A task's part of the loop: a frozen dataclass, static under jit."""

    def pose_problem(self, case: Any, plan: Any, outlook: Outlook) -> Any:
        """What is to be planned anew, while a plan is flown."""
        ...

    @property
    def searches(self) -> tuple[Callable[[Any], Any], ...]:
        """Each makes a plan of what is asked; none waits for another."""
        ...

    def choose(self, asked: Any, outlook: Outlook, found: tuple[Any, ...]) -> tuple[Any, Array]:
        """One of the plans that the searches found; and () bool, whether to fly it."""
        ...

    def times(self, plan: Any) -> Array:
        """When each ball is to be met (N,) [s] since the plan began, in the balls' order."""
        ...

    def plan_shapes(self, cases: Any) -> Any:
        """What plans (B, ...) of cases (B, ...) look like, leaves `jax.ShapeDtypeStruct`."""
        ...

    @property
    def passage(self) -> Callable[..., tuple[Array, Contact]]:
        """What says which balls are met or missed within a step, like `scoring.passage`."""
        ...


@dataclasses.dataclass(frozen=True)
class Loop:
    """Everything that shapes a flight's program; static under jit.

    Raises:
        ValueError: a period is not a whole number of the next shorter one.
    """

    world: World
    sensing: Sensing = Sensing()
    replan: float = 0.0  # [Hz]; 0 flies the first plan
    kalman: bool = True  # filter of what is seen of the balls
    estimate_drag: bool = True  # from the energy that a ball loses
    record: bool = False  # path and prediction errors, look by look

    def __post_init__(self) -> None:
        sensing, control_rate = self.sensing, 1.0 / self.world.timestep
        rule = f"a divisor of {control_rate:g} Hz"
        require_whole(control_rate / sensing.rate, "rate", rule, sensing.rate)
        rule = f"a multiple of the looks' {1.0 / sensing.rate:g} s"
        require_whole(sensing.latency * sensing.rate, "latency", rule, sensing.latency)
        sensing.looks_per_plan(self.replan)

    @property
    def steps_per_look(self) -> int:
        """Physics steps from look to look."""
        return round(1.0 / (self.sensing.rate * self.world.timestep))

    @property
    def looks_per_plan(self) -> int:
        """Looks from plan to plan; one where nothing is planned anew."""
        return self.sensing.looks_per_plan(self.replan)

    @property
    def period(self) -> float:
        """[s] from plan to plan."""
        return self.looks_per_plan / self.sensing.rate

    @property
    def late_looks(self) -> int:
        """How many looks old is what a look shows."""
        return round(self.sensing.latency * self.sensing.rate)

    def num_periods(self, duration: float) -> int:
        """How many periods cover a duration [s]."""
        return int(np.ceil(duration / self.period - 1e-6))


@struct.dataclass
class FlightState:
    """Everything that changes during a flight."""

    physics: Physics
    shown: Array  # (L, N, 3) [m], true positions of the balls that looks are still to show
    estimates: Estimate  # leaves (N, ...)
    earlier: Estimate  # those of one planning period ago
    launched: Array  # (N,) bool
    present: Array  # (N,) bool, planned for and not yet met by plan
    plan: Any
    began: Array  # () [s], when the plan began
    contact: Contact  # leaves (N, ...)
    worst_tracking: Array  # () [m], of the robot from its plan, up to the last contact
    squared_tracking: Array  # () [m^2 s]
    tracked: Array  # () [s]
    time: Array  # () [s]
    key: Array


@struct.dataclass
class Record:
    """One look of a flight."""

    time: Array  # () [s]
    physics: Physics
    wanted: Array  # (3,) [m], where the robot is to be
    horizon: Array  # (N,) [s], until each ball is to be met
    error: Array  # (N, 3) [m], of the prediction for then


@dataclasses.dataclass(frozen=True)
class Flown:
    """What came of a batch of flights, on the host; leaves with a leading axis B."""

    contact: Contact  # leaves (B, N, ...)
    plan: Any  # the last one
    began: np.ndarray  # (B,) [s], when that began
    tracking: np.ndarray  # (B, 2) [m], root mean square and worst, up to the last contact planned
    record: Record | None  # leaves (B, K, ...)


def collect_flights(flights: FlightState, records: list[Record]) -> Flown:
    """Of flights (B, ...) at their end, and what was recorded of them, in order."""
    there, records = jax.device_get((dataclasses.replace(flights, key=None), records))
    joined = functools.partial(jax.tree.map, lambda *leaves: np.concatenate(leaves, axis=1))
    mean = np.sqrt(there.squared_tracking / np.maximum(there.tracked, 1e-6))
    return Flown(
        contact=there.contact,
        plan=there.plan,
        began=there.began,
        tracking=np.stack([mean, there.worst_tracking], axis=1),
        record=joined(*records) if records else None,
    )
