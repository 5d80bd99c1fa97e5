"""Blocks in closed loop: an arm with a shield carries out plans against thrown balls (paper 004).

The ball's flight is known once it has been seen for a while; then a plan is made, by a clock on the
wall, and the arm sets out when the time that plans are allowed is over, or later if its plan is
not there by then. Its torques are limited, and nothing else but them moves it. What is counted is
what the simulated arm does, in float64 and by the referee's geometry: balls fall along their
parabola, so that they need no simulation. Times count from the moment at which the ball is first
seen; places are in the robot's base frame, those of recordings in the world, the floor at height 0.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from planner_jax.plan_files import named_leaves
from planner_jax.protocol import is_solved
from planner_jax.referee.arm_clearance import clearances, links_of, shield_middle
from planner_jax.referee.block import times_inside
from planner_jax.referee.solids import from_segment, turned, turned_back
from planner_jax.sims.execution import FRAME, TIMESTEP, Executed, execute
from planner_jax.sims.launch import flight_keys
from planner_jax.sims.model import World
from planner_jax.sims.recording import Recording
from planner_jax.sims.robots.arm.control import Course
from planner_jax.sims.robots.arm.drives import IDEAL, Drives
from planner_jax.sims.robots.arm.robot import ShieldArm
from planner_jax.sims.settings import BlockFly
from planner_jax.sims.task import FlightCases, Flights, FlightTask
from planner_jax.sims.tasks.block_shown import (
    BUDGET,
    budget_figure,
    budget_table,
    joint_table,
    scenery,
)
from planner_jax.sweep.columns import BOOL, LIST, NUMBER, TEXT, Column, leaves_of
from planner_jax.sweep.figures.style import draw
from planner_jax.sweep.summary import percent
from planner_jax.sweep.table import RateTable
from planner_jax.sweep.timing import timed_plans
from planner_jax.task.block.card import SUITES
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan
from planner_jax.task.block.scene import FLOOR
from planner_jax.task.block.suites import BALL_RADIUS, GRAVITY
from planner_jax.task.block.words import draw as draw_throws
from planner_jax.task.block.words import planner as block_planner

BLOCK_ARM = ShieldArm(base_height=-FLOOR)
BLOCK_WORLD = World(BLOCK_ARM, GRAVITY, num_balls=0, timestep=TIMESTEP)
TOUCH = 1e-3  # [m] inside of something that is a contact, as the referee has it
_AFTER = 0.3  # [s], that an arm is simulated after its contact: in it, joints brake
_LANES = 64  # whose clearances are worked out at once
_BOUNCE = 0.5  # restitution of a blocked ball, in pictures alone: an assumption
_KEPT = 5  # frames from one that is recorded to the next
_FALL = np.array([0.0, 0.0, 1.0])


@dataclasses.dataclass(frozen=True)
class Throws(FlightCases):
    """B thrown balls, NumPy leaves."""

    cases: BlockCase  # the delay is the time for sensing and planning


@dataclasses.dataclass(frozen=True)
class Budget:
    """Where the time until the contact goes, (B,) [s] each: eq. (1) of paper 004.

    The ball is blocked if the time of its flight is at least that of the others; what is planned
    after the time that it is allowed makes the arm late.
    """

    sense: np.ndarray  # until the ball's flight is known
    plan: np.ndarray  # by the clock
    wait: np.ndarray  # after the plan, until the arm starts
    move: np.ndarray  # of the plan's motion
    stand: np.ndarray  # after the motion, up to the planned contact; negative if it is too late
    rest: np.ndarray  # from the planned contact until the ball gets into the inner box

    @property
    def flight(self) -> np.ndarray:
        """Until the ball gets into the inner box, (B,) [s]."""
        return np.sum([getattr(self, field.name) for field in dataclasses.fields(self)], axis=0)


@dataclasses.dataclass(frozen=True)
class BlockFlights(Flights):
    """What came of a batch of blocks; leaves with a leading axis B."""

    flown: Executed
    budget: Budget
    blocked: np.ndarray  # (B,) bool: on the face of the shield before it was in the inner box
    contact: np.ndarray  # (B,) [s], of the ball with the shield; NaN without one
    contact_pos: np.ndarray  # (B, 3) [m], of the ball's centre then; NaN likewise
    miss: np.ndarray  # (B,) [m], of the ball from the shield's middle where it is in its plane
    struck: np.ndarray  # (B,) bool, whether the ball touched base or links 1 to 3 before
    clearance: np.ndarray  # (B,) [m], least up to the contact; negative inside
    nearest: np.ndarray  # (B,) str, what came so near
    clearance_after: np.ndarray  # (B,) [m], least from then on, while the arm brakes
    planned: np.ndarray  # (B,) bool, whether there was a plan

    @property
    def touched(self) -> np.ndarray:
        """Which arms ran into something before the contact, (B,) bool."""
        return self.clearance < -TOUCH

    @property
    def success(self) -> np.ndarray:
        """Which balls were blocked by an arm that touched nothing, (B,) bool."""
        return self.blocked & ~self.touched


def throws(
    suite: str,
    num: int,
    seed: int = 0,
    *,
    regime: str = "R2",
    wide: bool = False,
    delay: float = 0.0,
) -> Throws:
    """Throws of a suite; see `pj.block.draw`."""
    cases = draw_throws(num, suite, seed, regime=regime, wide=wide, delay=delay)
    return Throws(index=np.arange(num), cases=jax.tree.map(np.asarray, cases))


def courses_of(cases: BlockCase, plans: BlockPlan) -> Course:
    """What arms follow: their plans from the delay on; without a plan they stay where they are.

    Joints brake as hard as plans may speed them up.
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


def fly_blocks(
    world: World,
    cases: Throws,
    seed: int = 0,
    *,
    drives: Drives = IDEAL,
    planner: Any = None,
    allowed: float | None = None,
    plan: BlockPlan | None = None,
    seconds: np.ndarray | None = None,
) -> BlockFlights:
    """Plan and carry out a batch of blocks.

    Args:
        world: with an arm.
        cases: what is thrown.
        seed: of the noise of encoders, >= 0.
        drives: of the arm.
        planner: of all plans, by default `online`.
        allowed: [s], the end of the delay, that plans may take; a plan that takes longer is
            carried out as much later. None: planning takes no time.
        plan: of each case, instead of one made here.
        seconds: (B,) [s], that these took.

    Raises:
        ValueError: the arm of the cases is not the one that is simulated, or plans are allowed
            more than the delay.
    """
    case = cases.cases
    require_arm(world, case)
    delay = np.asarray(case.delay, float)
    if allowed is not None and not 0.0 <= allowed <= delay.min() + 1e-6:
        raise ValueError(f"allowed must be >= 0 and <= the delay {delay.min():g}, got {allowed:g}")
    if plan is None:
        made: tuple[BlockPlan, np.ndarray] = timed_plans(planner or block_planner(), case)
        plan, seconds = made
    seconds = np.zeros(len(cases)) if seconds is None or allowed is None else seconds
    allowed = allowed or 0.0
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
        late=np.maximum(seconds - allowed, 0.0),
        drives=drives,
    )
    move = np.where(solved, np.sum(np.asarray(plan.motion.durations, float), axis=1), 0.0)
    budget = Budget(
        sense=delay - allowed,
        plan=seconds,
        wait=np.maximum(allowed - seconds, 0.0),
        move=move,
        stand=contact - (delay - allowed) - np.maximum(allowed, seconds) - move,
        rest=entry - contact,
    )
    return scored(case, plan, flown, budget)


def require_arm(world: World, cases: BlockCase) -> None:
    """Raise `ValueError` unless the simulated arm is the one that is planned for."""
    if not isinstance(world.robot, ShieldArm):
        raise ValueError(f"world must hold an arm, got a {type(world.robot).__name__}")
    own = jax.tree.leaves_with_path(world.robot.arm)
    for (path, value), planned in zip(own, jax.tree.leaves(cases.arm), strict=True):
        name = path[-1].name
        same = np.shape(planned)[1:] == np.shape(value)
        # Each case says itself where its arm begins.
        if name != "home" and not (same and np.allclose(planned, value, rtol=1e-5, atol=1e-6)):
            raise ValueError(f"{name} must be the same in plan and simulated arm")


def referee_leaves(cases: BlockCase) -> dict[str, np.ndarray]:
    """All leaves of cases (B, ...) in float64 by their dotted names, as the referee has them."""
    return {name: np.asarray(leaf, float) for name, leaf in named_leaves(cases).items()}


def entry_times(cases: BlockCase) -> np.ndarray:
    """When balls get into the inner box, (B,) [s]; infinite if never."""
    with np.errstate(invalid="ignore"):  # of balls that never rise so high
        begin, end = times_inside(referee_leaves(cases), "inner", 0.0)
    return np.where(end >= 0.0, np.maximum(begin, 0.0), np.inf).min(axis=0)


def ball_places(case: dict[str, np.ndarray], times: np.ndarray) -> np.ndarray:
    """Places (3, B, S) [m] of balls at times (S,) or (B, S) [s]."""
    pos, vel = case["ball.pos"].T[..., None], case["ball.vel"].T[..., None]
    fall = np.multiply.outer(_FALL, case["gravity"])[..., None]
    return pos + vel * times - 0.5 * fall * times**2


def scored(cases: BlockCase, plans: BlockPlan, flown: Executed, budget: Budget) -> BlockFlights:
    """What arms did, held against the balls and all that they must not touch, in float64.

    A ball is blocked when it comes down on the face of the shield, from in front and with its
    centre over the face, before its centre is in the inner box and before it touches the arm. Miss
    is how far from the middle it is there, or where it passes the shield's plane otherwise; it is
    NaN where it does not come to it in time.

    Args:
        cases: leaves (B, ...).
        plans: of them.
        flown: the motions.
        budget: the times.
    """
    case, times = referee_leaves(cases), flown.times
    angles = flown.angles.transpose(2, 0, 1)
    turns, places = links_of(case, angles)
    middle, turn = shield_middle(case, turns, places), turns[5]
    ball = ball_places(case, times)
    height, *beside = turned_back(turn, ball - middle)
    gap, beside = height - BALL_RADIUS, np.stack(beside)
    entry = entry_times(cases)

    comes = (gap[:, :-1] > 0.0) & (gap[:, 1:] <= 0.0)
    share = np.where(comes, gap[:, :-1] / np.where(comes, gap[:, :-1] - gap[:, 1:], 1.0), 0.0)
    when = times[:-1] + share * FRAME
    there = beside[..., :-1] + share * (beside[..., 1:] - beside[..., :-1])
    miss = np.where(comes & (when < entry[:, None]), np.linalg.norm(there, axis=0), np.inf)
    over = np.abs(there).max(axis=0) <= case["arm.shield_half"][:, None]
    lanes, first = np.arange(len(entry)), np.where(over, miss, np.inf).argmin(axis=1)
    hit = over[lanes, first] & np.isfinite(miss[lanes, first])
    nearest = miss.argmin(axis=1)
    at = np.where(hit, first, nearest)
    contact = np.where(hit, when[lanes, at], np.inf)
    links = cases.arm.capsule_link
    strikes = _strikes(case, links, turns, places, ball)
    struck = np.any(strikes & (times < np.minimum(contact, entry)[:, None]), axis=1)
    blocked = hit & ~struck

    touching = ball_places(case, np.where(blocked, contact, 0.0)[:, None])[..., 0].T
    until = np.where(np.isfinite(contact), contact, entry)
    before = times <= until[:, None]
    least, name = _least(case, links, angles, before)
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
        clearance_after=_least(case, links, angles, ~before)[0],
        planned=np.asarray(is_solved(plans.status)),
    )


def _strikes(
    case: dict[str, np.ndarray], links: Sequence[int], turns: list, places: list, ball: np.ndarray
) -> np.ndarray:
    """Which balls touch the base or links 1 to 3 at which frame, (B, S) bool.

    The capsules of the wrist behind the shield bulge out of its face, where the links do not.
    """
    found = np.zeros(ball.shape[1:], bool)
    for k, link in enumerate(links):
        if link > 2:
            continue
        first, second = case["arm.capsule_ends"][:, k].transpose(1, 2, 0)[..., None]
        if link >= 0:
            first, second = (places[link] + turned(turns[link], end) for end in (first, second))
        apart = from_segment(ball, first, second) - case["arm.capsule_radius"][:, k, None]
        found |= apart < BALL_RADIUS
    return found


def _least(
    case: dict[str, np.ndarray], links: Sequence[int], angles: np.ndarray, looked: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Least clearance (B,) [m] of arms at the frames that are looked at, and what comes so near.

    It is infinite where no frame is looked at.
    """
    least, names = [], []
    for begin in range(0, len(looked), _LANES):
        some = slice(begin, begin + _LANES)
        own = {name: leaf[some] for name, leaf in case.items()}
        found = clearances(own, links, angles[:, some], looked[some])
        distances = np.stack([distance for distance, _, _ in found.values()])
        which, lanes = distances.argmin(axis=0), np.arange(distances.shape[1])
        parts = np.stack([np.char.add(part, f", {kind}") for kind, (_, _, part) in found.items()])
        least.append(distances[which, lanes])
        names.append(parts[which, lanes])
    return np.where(looked.any(axis=1), np.concatenate(least), np.inf), np.concatenate(names)


class BlockFlight(FlightTask):
    """Blocks as a run of flights knows them; the settings are `BlockFly`."""

    settings: BlockFly

    THING = "ball"
    THING_RADIUS = BALL_RADIUS
    CONTACT = "blocked"
    SUCCESS = "blocked the ball and touched nothing else before"
    PUBLISHED = "paper 004: 78 % of 50 throws from 6 to 8 m, on hardware"
    VIEW = (20.0, -50.0)
    EYE = ((2.6, -2.6, 1.9), (0.3, 0.0, 0.9))
    BOUNDS = ((-1.1, -1.5, 0.0), (2.8, 1.5, 2.6))
    COLUMNS = (
        *leaves_of(
            "verdict",
            ("planned", "", "whether there was a plan", BOOL),
            ("blocked", "", "on the shield's face before it was in the inner box", BOOL),
            ("contact_time", "s", "of the ball with the shield; NaN without", NUMBER, "contact"),
            ("miss", "m", "of the ball from the shield's middle in its plane; NaN if too late"),
            ("struck", "", "whether the ball touched base or links 1 to 3 before", BOOL),
            ("clearance", "m", "least up to the contact; negative inside"),
            ("nearest", "", "what came so near, and to what", TEXT),
            ("clearance_after", "m", "least from then on, while the arm brakes"),
            (
                "error_rms",
                "rad",
                "of the six joints from what they were told",
                LIST,
                "flown.error_rms",
            ),
            ("error_worst", "rad", "the same at worst", LIST, "flown.error_worst"),
            ("torque_rms", "N m", "of the six drives", LIST, "flown.torque_rms"),
            ("torque_worst", "N m", "of the six drives", LIST, "flown.torque_worst"),
            ("saturated", "1", "share of the time at the torque limit", LIST, "flown.saturation"),
        ),
        *(
            Column(f"time_{name}", "s", BUDGET[name], NUMBER, lambda b, n=name: _part(b, n))
            for name in BUDGET
        ),
    )

    def world(self) -> World:
        """The arm, and what stands around it."""
        return dataclasses.replace(
            BLOCK_WORLD, scenery=scenery(BLOCK_ARM.arm, SUITES[self.suite].has_pole)
        )

    def parameters(self) -> dict[str, Any]:
        """Drives, encoders and control."""
        robot = BLOCK_ARM
        return {
            "drives": dataclasses.asdict(self.settings.drives),
            "gains": dataclasses.asdict(robot.gains),
            "gravity": BLOCK_WORLD.gravity,
            "timestep": BLOCK_WORLD.timestep,
        }

    def cases(self) -> Throws:
        """All throws of the run."""
        settings = self.settings
        return throws(
            settings.suite,
            settings.num,
            settings.seed,
            regime=settings.regime,
            wide=settings.wide,
            delay=settings.sense + settings.allowed,
        )

    def fly(self, cases: Throws, record: bool) -> BlockFlights:
        """Blocks of some balls; they are recorded in any case."""
        settings = self.settings
        return fly_blocks(
            BLOCK_WORLD,
            cases,
            settings.seed,
            drives=settings.drives,
            planner=block_planner(settings.planner),
            allowed=settings.allowed,
        )

    def recording(
        self, cases: Throws, flights: BlockFlights, lanes: Sequence[int] | np.ndarray
    ) -> Recording:
        """The recording of some of the flights; see `FlightTask`."""
        lanes = np.asarray(lanes)
        some, flown, robot = cases[lanes], flights.flown, BLOCK_ARM
        kept = np.arange(0, flown.times.size, _KEPT)
        raised = np.array([0.0, 0.0, -FLOOR])
        met = flights.contact[lanes]
        return Recording(
            index=some.index,
            success=flights.success[lanes],
            time=np.tile(flown.times[kept], (len(some), 1)),
            robot=flown.angles[lanes][:, kept],
            wanted=robot.place(flown.wanted[lanes][:, kept]),
            balls=(_balls(some.cases, flights, lanes)[:, kept] + raised)[:, :, None],
            met=met[:, None],
            contact=(flights.contact_pos[lanes] + raised)[:, None],
            target=np.full((len(some), 3), np.nan),
            expected=np.zeros((len(some), kept.size, 0, 3)),
        )

    @property
    def suite(self) -> str:
        """The suite of throws."""
        return self.settings.suite

    @property
    def conditions(self) -> str:
        """Times, drives and encoders."""
        settings = self.settings
        meeting = "wide" if settings.wide else "strict"
        return (
            f"Regime {settings.regime}, {meeting}, {1e3 * settings.sense:g} ms for sensing and "
            f"{1e3 * settings.allowed:g} ms for planning; torques {100 * settings.torque:g} % with "
            f"a lag of {1e3 * settings.lag:g} ms, plans {1e3 * settings.latency:g} ms late, "
            f"encoders {settings.encoders}, masses believed {100 * settings.mass_error:g} % wrong"
        )

    @property
    def simulated(self) -> str:
        """The arm; the ball falls."""
        return f"{BLOCK_ARM.WORDS}; balls fall freely, as if they had been seen exactly"

    def counts(self, rows: Any) -> dict[str, Any]:
        """Plans, contacts, misses, torques and times."""
        planned, miss = np.asarray(rows["planned"]), np.asarray(rows["miss"])
        blocked = np.asarray(rows["blocked"])
        late = np.asarray(rows["time_plan"]) > self.settings.allowed
        lists = {
            name: np.stack(rows[name].to_numpy(zero_copy_only=False))
            for name in ("error_rms", "torque_rms", "torque_worst", "saturated")
        }
        return {
            "planned": int(planned.sum()),
            "blocked": int(blocked.sum()),
            "touched": int((np.asarray(rows["clearance"]) < -TOUCH).sum()),
            "touched_after": int((np.asarray(rows["clearance_after"]) < -TOUCH).sum()),
            "plans_late": int(late.sum()),
            "miss_median": float(np.median(miss[blocked])) if blocked.any() else None,
            "miss_worst": float(np.max(miss[blocked])) if blocked.any() else None,
            "error_rms": np.sqrt((lists["error_rms"] ** 2).mean(axis=0)).tolist(),
            "torque_rms": np.sqrt((lists["torque_rms"] ** 2).mean(axis=0)).tolist(),
            "torque_worst": lists["torque_worst"].max(axis=0).tolist(),
            "saturated": lists["saturated"].mean(axis=0).tolist(),
        }

    def findings(self, summary: Mapping[str, Any]) -> list[str]:
        """Plans and blocks; contacts; torques."""
        number = summary["num"]
        planned, blocked, touched, after, late = (
            percent(summary[name], number)
            for name in ("planned", "blocked", "touched", "touched_after", "plans_late")
        )
        lines = [
            f"There was a plan for {planned} % of the balls, {late} % of the plans took longer "
            f"than allowed; {blocked} % of the balls were blocked. {touched} % of the arms touched "
            f"something before the contact, {after} % after it, when they braked."
        ]
        if summary["miss_median"] is not None:
            lines.append(
                f"Blocked balls were {100 * summary['miss_median']:.2f} cm from the shield's "
                f"middle in the median, {100 * summary['miss_worst']:.1f} cm at worst."
            )
        worst, share = summary["torque_worst"], summary["saturated"]
        lines.append(
            f"Joints 1 to 3 took up to {worst[0]:.0f}, {worst[1]:.0f} and {worst[2]:.0f} N m, and "
            f"were at their limit {100 * share[0]:.1f}, {100 * share[1]:.1f} and "
            f"{100 * share[2]:.1f} % of the time."
        )
        return lines

    def tables(self, rows: Any) -> Sequence[RateTable]:
        """Where the time of flight goes, and what the joints did."""
        return [budget_table(rows), joint_table(rows)]

    def draw(self, folder: Path, rows: Any) -> Sequence[str]:
        """The time budget of the first balls."""
        draw(folder / "budget.png", budget_figure, (8.0, 5.0), rows)
        return ["budget.png"]


def _part(batch: Any, name: str) -> np.ndarray:
    return getattr(batch.verdict.budget, name)


def _balls(cases: BlockCase, flights: BlockFlights, lanes: np.ndarray) -> np.ndarray:
    """Places (F, S, 3) [m] of balls as they are drawn: on their way, and off the shield."""
    case, flown = referee_leaves(cases), flights.flown
    times, met = flown.times, flights.contact[lanes]
    free = np.moveaxis(ball_places(case, times), 0, 2)
    turns, places = links_of(case, flown.angles[lanes].transpose(2, 0, 1))
    middle, normal = shield_middle(case, turns, places), turns[5][:, 0]
    rows = np.arange(len(lanes))
    at = np.clip(np.searchsorted(times, np.nan_to_num(met)), 1, len(times) - 1)
    shield = ((middle[:, rows, at] - middle[:, rows, at - 1]) / FRAME).T
    facing = normal[:, rows, at].T
    vel = case["ball.vel"] - np.outer(case["gravity"] * np.nan_to_num(met), _FALL)
    into = np.sum((vel - shield) * facing, axis=1, keepdims=True)
    away = vel - (1.0 + _BOUNCE) * into * facing
    span = np.maximum(times - met[:, None], 0.0)[..., None]
    fall = 0.5 * case["gravity"][:, None, None] * span**2 * _FALL
    back = flights.contact_pos[lanes][:, None] + away[:, None] * span - fall
    path = np.where((times > np.nan_to_num(met, nan=np.inf)[:, None])[..., None], back, free)
    return np.where(path[..., 2:] > FLOOR, path, np.nan)
