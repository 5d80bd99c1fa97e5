"""The state of a simulated flight, the settings of its closed loop, and its records."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Protocol

import jax
import numpy as np
from flax import struct
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.core.choices import require, require_one_of
from planner_jax.optimise.planner import Problem
from planner_jax.perception.robot_filter import BodyState, RobotFilterState
from planner_jax.sims.model import World
from planner_jax.sims.noise import OBSERVERS, RobotSensing, Sensing, require_whole
from planner_jax.sims.robot import Physics
from planner_jax.sims.scoring import Contact
from planner_jax.sims.sensing import Estimate


@struct.dataclass
class Outlook:
    """The expected situation at the end of a planning period, when a new plan takes effect."""

    time: Array  # () [s], time of this situation
    elapsed: Array  # () [s], time since the start of the current plan
    balls: BallState  # leaves (N, 3), predicted states of the balls
    drag: Array  # (N,), estimated K_D [1/m]; (N, 3) K_i [1/s] by the observer "linear"
    present: Array  # (N,) bool, whether each ball is in flight and not yet met
    head_state: Array  # planned state of the robot, (4, 3) for a quadrotor


class Pilot(Protocol):
    """A task's part of the closed loop, which poses planning problems and selects plans."""

    def pose_problem(self, case: Any, plan: Any, outlook: Outlook) -> Any:
        """Return the planning problem of the predicted situation `outlook` and the current plan."""
        ...

    @property
    def searches(self) -> tuple[Callable[[Any], Any], ...]:
        """Independent searches, each a function from a planning problem to a plan."""
        ...

    def choose(self, asked: Any, outlook: Outlook, found: tuple[Any, ...]) -> tuple[Any, Array]:
        """Select one of the new plans; return the plan, and whether it replaces the current plan.

        Each task compares the plans' violations of limits, and the task `catch` also their costs.

        Args:
            asked: the planning problem that `pose_problem` returned.
            outlook: the predicted situation at the time when the new plan would take effect.
            found: the plans for this problem, one for each function in `searches`.
        """
        ...

    def times(self, plan: Any) -> Array:
        """Return the planned contact times of N balls, (N,) [s] since the plan's start."""
        ...

    def plan_shapes(self, cases: Any) -> Any:
        """Return the shapes of the plans of a batch of cases, as `jax.ShapeDtypeStruct`."""
        ...

    @property
    def passage(self) -> Callable[..., tuple[Array, Contact]]:
        """The function, such as `scoring.passage`, that finds contacts with balls in one step."""
        ...


def shapes_of_plans(problem: Problem, cases: Any) -> Any:
    """Return the shapes of the plans of a batch of cases, as `jax.ShapeDtypeStruct`.

    Leaves of the cases may be arrays or `jax.ShapeDtypeStruct`.
    """

    def plan(case: Any) -> Any:
        context = problem.prepare(case)
        return problem.decode(problem.guesses(context, 1)[0], context)

    return jax.eval_shape(jax.vmap(plan), cases)


@dataclasses.dataclass(frozen=True)
class Loop:
    """The settings that determine a flight's compiled program; static under `jax.jit`.

    Raises:
        ValueError: the observer is unknown or needs the Kalman filter; the time between plans or a
            latency is not a multiple of the observation period; or the observation period is not a
            multiple of the time step.
    """

    world: World
    sensing: Sensing = Sensing()
    replan: float = 0.0  # [Hz], rate of replanning; 0 flies the first plan to its end
    kalman: bool = True  # whether the observations of the balls are filtered
    estimate_drag: bool = True  # whether drag is estimated from the energy that a ball loses
    observer: str = "energy"  # key of `noise.OBSERVERS`
    # Sensors of the robot's own state, which a Kalman filter estimates; None: errors `robot_stds`
    robot_filter: RobotSensing | None = None
    record: bool = False  # whether path and prediction errors are stored at every observation

    def __post_init__(self) -> None:
        require_one_of(OBSERVERS, "observer", self.observer)
        is_usual = self.observer == "energy"
        require(self.kalman or is_usual, "observer", "energy without filter", self.observer)
        sensing, control_rate = self.sensing, 1.0 / self.world.timestep
        rule = f"a divisor of {control_rate:g} Hz"
        require_whole(control_rate / sensing.rate, "rate", rule, sensing.rate)
        rule = f"a multiple of the observations' {1.0 / sensing.rate:g} s"
        for each in (sensing, self.robot_filter or sensing):
            require_whole(each.latency * sensing.rate, "latency", rule, each.latency)
        sensing.observations_per_plan(self.replan)

    @property
    def steps_per_observation(self) -> int:
        """The number of physics steps from one observation to the next."""
        return round(1.0 / (self.sensing.rate * self.world.timestep))

    @property
    def observations_per_plan(self) -> int:
        """The number of observations from one plan to the next; 1 without replanning."""
        return self.sensing.observations_per_plan(self.replan)

    @property
    def period(self) -> float:
        """The time [s] from one plan to the next."""
        return self.observations_per_plan / self.sensing.rate

    @property
    def late_observations(self) -> int:
        """The latency of an observation, as a number of observation periods."""
        return round(self.sensing.latency * self.sensing.rate)

    @property
    def late_poses(self) -> int:
        """The latency of a captured pose of the robot, as a number of observation periods."""
        return round(self.robot_filter.latency * self.sensing.rate) if self.robot_filter else 0

    def num_periods(self, duration: float) -> int:
        """Return the number of planning periods that cover a duration [s]."""
        return int(np.ceil(duration / self.period - 1e-6))


@struct.dataclass
class RobotBelief:
    """A quadrotor's estimate of its own state, and the measurements that are not yet used."""

    past: RobotFilterState  # at the capture of the last pose that has arrived
    imu: Array  # (M, 6), measured specific forces [m/s^2] and body rates [rad/s] since then
    poses: Array  # (L, 7), captured positions [m] and quaternions that have not arrived
    now: BodyState  # mean that `imu` predicts from `past`
    rate: Array  # (3,) [rad/s], last measured body rate
    biases: Array  # (6,), true biases of accelerometer [m/s^2] and gyroscope [rad/s]


@struct.dataclass
class FlightState:
    """The variables that change during a flight: physics, estimates, plan and scores."""

    physics: Physics
    shown: Array  # (L, N, 3) [m], true ball positions that are still to be observed
    estimates: Estimate  # leaves (N, ...), current estimates of the balls
    earlier: Estimate  # the estimates of one planning period ago
    launched: Array  # (N,) bool, whether the ball's simulation has started
    present: Array  # (N,) bool, balls with a plan whose contact time has not passed
    plan: Any
    began: Array  # () [s], start time of the plan
    contact: Contact  # leaves (N, ...), nearest passage of each ball so far
    worst_tracking: Array  # () [m], greatest distance from the plan, up to the last contact
    squared_tracking: Array  # () [m^2 s], integral of the squared distance
    tracked: Array  # () [s], duration over which the squared distance is integrated
    time: Array  # () [s]
    key: Array
    belief: RobotBelief | None = None  # the robot's estimate of its own state, by its filter


@struct.dataclass
class Record:
    """The state of a flight at one observation."""

    time: Array  # () [s]
    physics: Physics
    wanted: Array  # (3,) [m], planned position of the robot
    horizon: Array  # (N,) [s], time until the planned contact with each ball
    error: Array  # (N, 3) [m], error of the predicted ball position at the contact


@dataclasses.dataclass(frozen=True)
class Flown:
    """The result of a batch of B flights, on the host; arrays have the leading axis B."""

    contact: Contact  # leaves (B, N, ...)
    plan: Any  # the last plan of each flight
    began: np.ndarray  # (B,) [s], start time of the last plan
    tracking: np.ndarray  # (B, 2) [m], rms and worst tracking error up to the last contact
    record: Record | None  # leaves (B, K, ...), for K observations


def collect_flights(flights: FlightState, records: list[Record]) -> Flown:
    """Return the result of finished flights, with their records in the order of time."""
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
