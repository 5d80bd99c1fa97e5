"""Blocks in closed loop: an arm with a shield executes plans against thrown balls [Natarajan2024].

A ball's flight is known after a time of observation. Then the arm's motion is planned, and the wall
time of planning is measured. The arm starts when the planning budget is over, or later if its plan
is not ready by then. Only the limited torques of the joints move the arm. The score depends on the
motion of the simulated arm, and is computed in float64 by the package `referee`, which also checks
plans. Balls follow their parabola and need no simulation. Times count from the moment at which the
ball is first seen. Positions are in the robot's base frame; in recordings, in the world frame.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from planner_jax.core import GRAVITY
from planner_jax.core.errors import ArgumentError
from planner_jax.core.plan_files import leaves_by_name
from planner_jax.core.protocol import is_solved
from planner_jax.referee.arm_clearance import clearances, links_of, shield_pose
from planner_jax.referee.ball_in_box import entry_time
from planner_jax.referee.solids import from_segment, rotate, rotate_back
from planner_jax.robot.arm import Arm
from planner_jax.robot.arm_scene import FLOOR
from planner_jax.runs.timing import measure_plans
from planner_jax.sims.execution import FRAME, TIMESTEP, Executed, execute
from planner_jax.sims.launch import flight_keys
from planner_jax.sims.model import World
from planner_jax.sims.perception.receding import Decided
from planner_jax.sims.robots.arm.control import Course, reference_at
from planner_jax.sims.robots.arm.drives import IDEAL, Drives
from planner_jax.sims.robots.arm.robot import ShieldArm
from planner_jax.sims.task import FlightCases, Flights
from planner_jax.task.block.api import planner as block_planner
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan
from planner_jax.task.block.suites import BALL_RADIUS
from planner_jax.task.block.suites import draw as draw_throws

BLOCK_ARM = ShieldArm(base_height=-FLOOR)
BLOCK_WORLD = World(BLOCK_ARM, GRAVITY, num_balls=0, timestep=TIMESTEP)
TOUCH = 1e-3  # [m], least penetration that counts as a contact, as in the referee
_AFTER = 0.3  # [s], simulated time after the contact, in which the joints brake
_LANES = 64  # number of flights for which clearances are computed at once
FALL = np.array([0.0, 0.0, 1.0])  # unit vector along the vertical


@dataclasses.dataclass(frozen=True)
class Throws(FlightCases):
    """B cases, each a thrown ball and the state of an arm, in NumPy arrays."""

    cases: BlockCase  # their field `delay` is the time for sensing and planning


@dataclasses.dataclass(frozen=True)
class Budget:
    """Parts of the times (B,) [s] until B balls enter the inner box [Natarajan2024, eq. 1].

    The arm protects the inner box. The parts add up to a ball's time of flight. An arm whose plan
    takes longer than the planning budget starts late.
    """

    sense: np.ndarray  # [s], until the ball's flight is known
    plan: np.ndarray  # [s], wall time of planning
    wait: np.ndarray  # [s], from the end of planning until the arm starts
    move: np.ndarray  # [s], duration of the plan's motion
    # [s], from the end of the motion to the planned contact; negative if the motion ends later.
    stand: np.ndarray
    rest: np.ndarray  # [s], from the planned contact until the ball enters the inner box

    @property
    def flight(self) -> np.ndarray:
        """The times (B,) [s] until B balls enter the inner (protected) box."""
        return np.sum([getattr(self, field.name) for field in dataclasses.fields(self)], axis=0)


@dataclasses.dataclass(frozen=True)
class BlockFlights(Flights):
    """The result of a batch of B thrown balls; arrays have the leading axis B."""

    flown: Executed
    budget: Budget
    blocked: np.ndarray  # (B,) bool: the shield's face met the ball before the inner box
    contact: np.ndarray  # (B,) [s], time of contact between ball and shield; NaN without contact
    contact_pos: np.ndarray  # (B, 3) [m], ball's centre at the contact; NaN without contact
    # (B,) [m], distance from the shield's centre at which the ball crosses the shield's plane.
    miss: np.ndarray
    # (B,) bool, whether the ball touched base or links before the wrist before the contact.
    struck: np.ndarray
    clearance: np.ndarray  # (B,) [m], least clearance up to the contact; negative inside
    nearest: np.ndarray  # (B,) str, link and obstacle at the least clearance
    clearance_after: np.ndarray  # (B,) [m], least clearance after the contact, while the arm brakes
    planned: np.ndarray  # (B,) bool, whether there was a plan
    motions: np.ndarray  # (B,) int, number of motions that the arm started
    # (B,) [m], errors of the ball's position midway between outer and inner box, predicted at the
    # first and at the last planning. NaN if the planner knows the ball's true flight.
    fit_error: np.ndarray
    last_fit_error: np.ndarray

    @property
    def touched(self) -> np.ndarray:
        """Mask (B,) of the B arms that touched an obstacle before the contact with the ball."""
        return self.clearance < -TOUCH

    @property
    def success(self) -> np.ndarray:
        """Mask (B,) of the B balls that were blocked by an arm that touched no obstacle before."""
        return self.blocked & ~self.touched


def throws(suite: str, num: int, seed: int = 0, **options: Any) -> Throws:
    """Draw random throws: "pole" (a pole before the arm), "open" (no pole) or "short" (6 to 8 m).

    `options` are further arguments of `pj.block.draw`. Its `delay` [s] is the time from the first
    sight of a ball until the arm starts.
    """
    cases = draw_throws(num, suite, seed, **options)
    return Throws(index=np.arange(num), cases=jax.tree.map(np.asarray, cases))


def courses_of(cases: BlockCase, plans: BlockPlan) -> Course:
    """Return the courses of arms: joint motion, start time, and braking after the motion.

    A planned motion starts `cases.delay` [s] after the first sight of the ball. An arm without a
    plan stands still. Joints brake with the acceleration limit of the plans.
    """
    coeffs = np.asarray(plans.motion.coeffs)
    solved = np.asarray(is_solved(plans.status))
    still = np.zeros_like(coeffs)
    still[:, :, 0], still[:, :, 1] = cases.angles[:, None], cases.rates[:, None]
    motion = dataclasses.replace(
        plans.motion,
        coeffs=np.where(solved[:, None, None, None], coeffs, still),
        durations=np.where(solved[:, None], plans.motion.durations, 0.0).astype(coeffs.dtype),
    )
    return Course(motion=motion, begin=cases.delay, braking=cases.limits.acceleration)


def follow_plans(cases: BlockCase, plans: BlockPlan) -> BlockFlights:
    """Return B flights in which the arms follow their plans exactly, without a simulation."""
    courses, entry = courses_of(cases, plans), entry_times(cases)
    end = np.max(np.maximum(np.where(np.isfinite(entry), entry, 0.0), plans.contact_time)) + _AFTER
    times = FRAME * np.arange(int(np.ceil(end / FRAME)) + 1)
    follow = jax.jit(jax.vmap(jax.vmap(reference_at, (None, 0)), (0, None)))
    angles = np.asarray(follow(courses, times.astype(courses.begin.dtype)).angles, float)
    none = np.zeros_like(angles[:, 0])
    flown = Executed(times, angles, angles, np.zeros((len(none), 2)), *[none] * 6)
    return score(cases, plans, flown, Budget(*[np.zeros(len(none))] * 6))


def fly_blocks(
    world: World,
    cases: Throws,
    seed: int = 0,
    *,
    drives: Drives = IDEAL,
    planner: Any = None,
    planning_budget: float | None = None,
    plan: BlockPlan | None = None,
    seconds: np.ndarray | None = None,
    decided: Decided | None = None,
) -> BlockFlights:
    """Plan and simulate a batch of B arms that block thrown balls, and score them.

    Args:
        world: a world with an arm.
        cases: the thrown balls.
        seed: random seed of the encoders' noise, >= 0.
        drives: limits and errors of the drives.
        planner: planner of all plans, by default the planner named `online`.
        planning_budget: [s], time for planning. It is the last part of `delay`, the cases' time
            from the first sight of a ball until the arm starts. An arm whose plan takes longer
            starts late by the excess. If it is None, planning takes no time.
        plan: plans of the cases; by default plans are made here.
        seconds: (B,) [s], wall times of the passed plans.
        decided: motions that were planned from observations of the balls; they are used instead of
            `plan`, and must start at the cases' `delay`.

    Raises:
        ValueError: the arm of the cases is not the simulated arm, or the planning budget exceeds
            the delay.
    """
    case = cases.cases
    require_arm(world, case)
    delay = np.asarray(case.delay, float)
    if planning_budget is not None and not 0.0 <= planning_budget <= delay.min() + 1e-6:
        raise ArgumentError(
            "planning_budget", f">= 0 and <= the delay {delay.min():g}", planning_budget
        )
    if decided is not None:
        plan = decided.plans
    if plan is None:
        made: tuple[BlockPlan, np.ndarray] = measure_plans(planner or block_planner(), case)
        plan, seconds = made
    seconds = np.zeros(len(cases)) if seconds is None or planning_budget is None else seconds
    budget = planning_budget or 0.0
    solved = np.asarray(is_solved(plan.status))
    entry = entry_times(case)
    last = np.where(np.isfinite(entry), entry, delay)
    contact = np.where(solved, np.asarray(plan.contact_time, float), last)
    flown = execute(
        world,
        courses_of(case, plan),
        flight_keys(seed, cases.index),
        since=delay,
        until=contact,
        end=float(np.max(np.maximum(contact, last))) + _AFTER,
        late=np.maximum(seconds - budget, 0.0),
        drives=drives,
    )
    move = np.where(solved, np.sum(np.asarray(plan.motion.durations, float), axis=1), 0.0)
    budget = Budget(
        sense=delay - budget,
        plan=seconds,
        wait=np.maximum(budget - seconds, 0.0),
        move=move,
        stand=contact - (delay - budget) - np.maximum(budget, seconds) - move,
        rest=entry - contact,
    )
    flights = score(case, plan, flown, budget)
    if decided is None:
        return flights
    first, last = (np.asarray(decided.fit_errors(place)[0], float) for place in (0, -1))
    return dataclasses.replace(
        flights, motions=np.asarray(decided.motions), fit_error=first, last_fit_error=last
    )


def require_arm(world: World, cases: BlockCase) -> None:
    """Raise `ValueError` unless the simulated arm equals the arm for which plans are made."""
    if not isinstance(world.robot, ShieldArm):
        raise ArgumentError("world", "an arm", verb="hold", shown=f"a {type(world.robot).__name__}")
    own = jax.tree.leaves_with_path(world.robot.arm)
    for (path, value), planned in zip(own, jax.tree.leaves(cases.arm), strict=True):
        name = path[-1].name
        same = np.shape(planned)[1:] == np.shape(value)
        # The field `home` may differ, since each case has its own joint angles at the start.
        if name != "home" and not (same and np.allclose(planned, value, rtol=1e-5, atol=1e-6)):
            raise ArgumentError(name, "the same in plan and simulated arm", shown="")


def referee_leaves(cases: BlockCase) -> dict[str, np.ndarray]:
    """Return the arrays of a batch of cases in float64, by dotted names such as "ball.pos"."""
    return {name: np.asarray(leaf, float) for name, leaf in leaves_by_name(cases).items()}


def entry_times(cases: BlockCase) -> np.ndarray:
    """Return when B balls enter the inner (protected) box, (B,) [s]; infinite for never."""
    with np.errstate(invalid="ignore"):  # NaN for balls that never rise as high as the box
        return entry_time(referee_leaves(cases), 0.0)


def ball_places(case: dict[str, np.ndarray], times: np.ndarray) -> np.ndarray:
    """Return positions (3, B, S) [m] of B balls at S times [s]; `case` has arrays by field name."""
    pos, vel = case["ball.pos"].T[..., None], case["ball.vel"].T[..., None]
    fall = np.multiply.outer(FALL, case["gravity"])[..., None]
    return pos + vel * times - 0.5 * fall * times**2


def score(cases: BlockCase, plans: BlockPlan, flown: Executed, budget: Budget) -> BlockFlights:
    """Score B simulated motions: which balls are blocked, misses, and obstacle clearances.

    A ball is blocked if it reaches the face of the shield from in front, with its centre over the
    face, before the ball's centre enters the inner (protected) box and before the ball touches
    the arm. The miss is the distance of a blocked ball from the shield's centre. For other balls it
    is the distance where the ball crosses the shield's plane, or NaN if no crossing is in time.

    Args:
        cases: the cases of B flights, leaves (B, ...).
        plans: the plans of the cases.
        flown: the simulated motions.
        budget: durations of sensing, planning and motion within the times of flight.
    """
    case, times = referee_leaves(cases), flown.times
    angles = flown.angles.transpose(2, 0, 1)
    turns, places = links_of(case, angles)
    turn, middle = shield_pose(case, turns, places)
    ball = ball_places(case, times)
    height, *beside = rotate_back(turn, ball - middle)
    gap, beside = height - BALL_RADIUS, np.stack(beside)
    entry = entry_times(cases)

    comes = (gap[:, :-1] > 0.0) & (gap[:, 1:] <= 0.0)
    share = np.where(comes, gap[:, :-1] / np.where(comes, gap[:, :-1] - gap[:, 1:], 1.0), 0.0)
    when = times[:-1] + share * FRAME
    there = beside[..., :-1] + share * (beside[..., 1:] - beside[..., :-1])
    miss = np.where(comes & (when < entry[:, None]), np.linalg.norm(there, axis=0), np.inf)
    corners = np.moveaxis(case["arm.shield_corners"], (1, 2), (0, 1))[..., None]  # (K, 2, B, 1)
    over = np.ones(miss.shape, bool)
    for (y, z), (y_next, z_next) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        over &= (there[0] - y) * (z_next - z) <= (there[1] - z) * (y_next - y)
    lanes, first = np.arange(len(entry)), np.where(over, miss, np.inf).argmin(axis=1)
    hit = over[lanes, first] & np.isfinite(miss[lanes, first])
    nearest = miss.argmin(axis=1)
    at = np.where(hit, first, nearest)
    contact = np.where(hit, when[lanes, at], np.inf)
    strikes = _strikes(case, cases.arm.capsule_link, turns, places, ball)
    struck = np.any(strikes & (times < np.minimum(contact, entry)[:, None]), axis=1)
    blocked = hit & ~struck

    touching = ball_places(case, np.where(blocked, contact, 0.0)[:, None])[..., 0].T
    until = np.where(np.isfinite(contact), contact, entry)
    before = times <= until[:, None]
    least, name = _least(case, cases.arm, angles, before)
    planned, unknown = np.asarray(is_solved(plans.status)), np.full(len(entry), np.nan)
    return BlockFlights(
        first_plan=plans,
        flown=flown,
        planning_seconds=float(budget.plan.sum()),
        budget=budget,
        blocked=blocked,
        contact=np.where(blocked, contact, np.nan),
        contact_pos=np.where(blocked[:, None], touching, np.nan),
        miss=np.where(np.isfinite(miss[lanes, at]), miss[lanes, at], np.nan),
        struck=struck,
        clearance=least,
        nearest=name,
        clearance_after=_least(case, cases.arm, angles, ~before)[0],
        planned=planned,
        motions=planned.astype(int),
        fit_error=unknown,
        last_fit_error=unknown,
    )


def _strikes(
    case: dict[str, np.ndarray], links: Sequence[int], turns: list, places: list, ball: np.ndarray
) -> np.ndarray:
    found = np.zeros(ball.shape[1:], bool)
    for k, link in enumerate(links):
        # Base and links before the wrist are tested for contact with the ball: links 1 to 3 of 6.
        # The capsules that model the wrist protrude through the shield's face, unlike real wrists.
        if link > len(turns) - 4:
            continue
        first, second = case["arm.capsule_ends"][:, k].transpose(1, 2, 0)[..., None]
        if link >= 0:
            first, second = (places[link] + rotate(turns[link], end) for end in (first, second))
        apart = from_segment(ball, first, second) - case["arm.capsule_radius"][:, k, None]
        found |= apart < BALL_RADIUS
    return found


def _least(
    case: dict[str, np.ndarray], arm: Arm, angles: np.ndarray, included: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    least, names = [], []
    for begin in range(0, len(included), _LANES):
        some = slice(begin, begin + _LANES)
        own = {name: leaf[some] for name, leaf in case.items()}
        found = clearances(own, arm, angles[:, some], included[some])
        distances = np.stack([distance for distance, _, _ in found.values()])
        which, lanes = distances.argmin(axis=0), np.arange(distances.shape[1])
        parts = np.stack([np.char.add(part, f", {kind}") for kind, (_, _, part) in found.items()])
        least.append(distances[which, lanes])
        names.append(parts[which, lanes])
    return np.where(included.any(axis=1), np.concatenate(least), np.inf), np.concatenate(names)
