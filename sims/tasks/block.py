"""Simulated blocks, in which an arm moves a shield into balls' paths: table, recordings, report."""

import dataclasses
import functools
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from planner_jax.baselines.protocols import BY_ROW
from planner_jax.core.planner import Planner
from planner_jax.referee.arm_clearance import links_of, shield_pose
from planner_jax.robot.arm_scene import Scene
from planner_jax.runs.columns import BOOL, LIST, NUMBER, TEXT, Column, leaves_of
from planner_jax.runs.style import draw
from planner_jax.runs.summary import percent
from planner_jax.runs.table import RateTable
from planner_jax.runs.timing import measure
from planner_jax.sims.block_settings import BlockFly
from planner_jax.sims.execution import FRAME
from planner_jax.sims.model import World
from planner_jax.sims.perception.observation import eye
from planner_jax.sims.perception.receding import Decided, decide
from planner_jax.sims.recording import Recording
from planner_jax.sims.robots.arm.drives import Drives
from planner_jax.sims.robots.arm.robot import ShieldArm
from planner_jax.sims.task import FlightTask
from planner_jax.sims.tasks.block_flights import (
    BLOCK_WORLD,
    FALL,
    TOUCH,
    BlockFlights,
    Throws,
    ball_places,
    fly_blocks,
    referee_leaves,
    throws,
)
from planner_jax.sims.tasks.block_shown import (
    BUDGET,
    budget_figure,
    budget_table,
    ground_of,
    joint_table,
    scenery,
)
from planner_jax.task.block.api import planner as block_planner
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.problem.flight import flight_of
from planner_jax.task.block.spec import SUITES
from planner_jax.task.block.suites import BALL_RADIUS, scene_for

_BOUNCE = 0.5  # restitution of a blocked ball, an assumption that only pictures use
_KEPT = 5  # number of simulated frames from one recorded sample to the next


class BlockFlight(FlightTask):
    """The simulation of blocks, which `sims/run.py` calls to simulate, score and draw a run."""

    settings: BlockFly

    @functools.cached_property
    def scene(self) -> Scene:
        """The obstacles and the protected body."""
        own = self.settings.arm_options()
        return own.get("scene") or scene_for(own.get("arm"), has_pole=SUITES[self.suite].has_pole)

    @functools.cached_property
    def robot(self) -> ShieldArm:
        """The simulated arm."""
        own = self.settings
        height = -ground_of(self.scene)
        return ShieldArm(height, file=own.arm, tip=own.tip, shield=own.shield)

    @functools.cached_property
    def drives(self) -> Drives:
        """The joints' drives, with the torque limits of the arm's file."""
        return self.settings.drives(self.robot.torques)

    THING = "ball"
    THING_RADIUS = BALL_RADIUS
    CONTACT = "blocked"
    SUCCESS = "blocked the ball and touched nothing else before"
    _real = BY_ROW["Natarajan2024", "Section V-B", "real"]
    PUBLISHED = f"[Natarajan2024], {_real.num} throws, {_real.what_counts}: {_real}"
    VIEW = (20.0, -50.0)
    EYE = ((2.6, -2.6, 1.9), (0.3, 0.0, 0.9))
    BOUNDS = ((-1.1, -1.5, 0.0), (2.8, 1.5, 2.6))
    COLUMNS = (
        *leaves_of(
            "verdict",
            ("planned", "", "whether there was a plan", BOOL),
            ("blocked", "", "whether the shield's face met the ball before the inner box", BOOL),
            ("contact_time", "s", "of ball and shield; NaN without contact", NUMBER, "contact"),
            ("miss", "m", "of the ball from the shield's centre, in its plane; NaN if too late"),
            ("struck", "", "whether the ball hit base or links before the wrist", BOOL),
            ("clearance", "m", "least up to the contact; negative inside"),
            ("nearest", "", "link and obstacle at the least clearance", TEXT),
            ("clearance_after", "m", "least after the contact, while the arm brakes"),
            (
                "error_rms",
                "rad",
                "of the joints from their commanded course",
                LIST,
                "flown.error_rms",
            ),
            ("error_worst", "rad", "greatest error of each joint", LIST, "flown.error_worst"),
            ("torque_rms", "N m", "of the drives", LIST, "flown.torque_rms"),
            ("torque_worst", "N m", "of the drives", LIST, "flown.torque_worst"),
            ("saturated", "1", "share of the time at the torque limit", LIST, "flown.saturation"),
            ("motions", "", "number of motions that the arm started", NUMBER),
            ("fit_error", "m", "of the first fit of the ball's flight; NaN if known", NUMBER),
            ("last_fit_error", "m", "of the last fit of the ball's flight; NaN if known", NUMBER),
        ),
        *(
            Column(f"time_{name}", "s", BUDGET[name], NUMBER, lambda b, n=name: _part(b, n))
            for name in BUDGET
        ),
    )

    def world(self) -> World:
        """Return the simulated world with the arm and its drawn surroundings."""
        world = dataclasses.replace(BLOCK_WORLD, robot=self.robot)
        return dataclasses.replace(world, scenery=scenery(self.robot.arm, self.scene))

    def parameters(self) -> dict[str, Any]:
        """Return the parameters of joint drives, encoders and control, for the run's manifest."""
        drives = dataclasses.asdict(self.drives)
        torques = [each if np.isfinite(each) else None for each in drives["torques"]]
        return {
            "drives": drives | {"torques": torques},  # None for a joint without a limit
            "gains": dataclasses.asdict(self.robot.gains),
            "gravity": BLOCK_WORLD.gravity,
            "timestep": BLOCK_WORLD.timestep,
        }

    def cases(self) -> Throws:
        """Draw all throws of the run from its suite (family of random throws) and seed."""
        settings = self.settings
        delay = settings.until_known + settings.until_set
        given = settings.draw_options()
        return throws(self.suite, settings.num, settings.seed, delay=delay, **given)

    def fly(self, cases: Throws, record: bool) -> BlockFlights:
        """Plan and simulate blocks of balls; motions are stored even if `record` is false."""
        settings, planner = self.settings, block_planner(self.settings.planner)
        decided, seconds = None, 0.0
        if settings.perception:
            decided, seconds, _ = measure(lambda: _observe_and_plan(settings, planner, cases.cases))
        flights = fly_blocks(
            dataclasses.replace(BLOCK_WORLD, robot=self.robot),
            cases,
            settings.seed,
            drives=self.drives,
            planner=planner,
            planning_budget=settings.until_set,
            decided=decided,
        )
        return dataclasses.replace(flights, planning_seconds=flights.planning_seconds + seconds)

    def recording(
        self, cases: Throws, flights: BlockFlights, lanes: Sequence[int] | np.ndarray
    ) -> Recording:
        """Return a recording of the flights whose indices in the batch are `lanes`."""
        lanes = np.asarray(lanes)
        some, flown, robot = cases[lanes], flights.flown, self.robot
        kept = np.arange(0, flown.times.size, _KEPT)
        raised = np.array([0.0, 0.0, robot.base_height])
        met, balls = flights.contact[lanes], _balls(some.cases, flights, lanes, -robot.base_height)
        return Recording(
            index=some.index,
            success=flights.success[lanes],
            time=np.tile(flown.times[kept], (len(some), 1)),
            robot=flown.angles[lanes][:, kept],
            wanted=robot.place(flown.wanted[lanes][:, kept]),
            balls=(balls[:, kept] + raised)[:, :, None],
            met=met[:, None],
            contact=(flights.contact_pos[lanes] + raised)[:, None],
            target=np.full((len(some), 3), np.nan),
            expected=np.zeros((len(some), kept.size, 0, 3)),
        )

    @property
    def suite(self) -> str:
        """The name of the suite, the family of random throws, for the report."""
        return str(self.settings.suite)

    @property
    def conditions(self) -> str:
        """Times for sensing and planning, and errors of drives and encoders, for the report."""
        settings = self.settings
        meeting = "wide" if settings.wide else "strict"
        limits = f"Regime {settings.regime}" if settings.arm is None else "Limits of the arm's file"
        scale = f"{100 * settings.torque:g} %" if np.isfinite(self.drives.torques).all() else "free"
        return (
            f"{limits}, {meeting}, {1e3 * settings.until_known:g} ms for sensing "
            f"and {1e3 * settings.until_set:g} ms for planning; torques "
            f"{scale} with a lag of {1e3 * settings.lag:g} ms, plans "
            f"{1e3 * settings.latency:g} ms late, "
            f"encoders {settings.encoders}, {100 * settings.mass_error:g} % error of the masses"
        )

    @property
    def simulated(self) -> str:
        """A description of arm and balls, for the report of a run."""
        settings = self.settings
        if not settings.perception:
            return f"{ShieldArm.WORDS}; balls fall freely and are known exactly"
        noise = (
            f"{100 * settings.noise:g} cm of noise" if settings.noise else "a stereo camera's noise"
        )
        again = f"planned at {settings.rate:g} Hz" if settings.rate else "planned once"
        return (
            f"{ShieldArm.WORDS}; balls fall freely and are observed at {settings.frame_rate:g} Hz "
            f"with {noise}; motions are {again}, as if planning never exceeded its time limit"
        )

    def counts(self, rows: Any) -> dict[str, Any]:
        """Count plans, contacts and blocks, and summarise misses, joint errors and torques."""
        planned, miss = np.asarray(rows["planned"]), np.asarray(rows["miss"])
        blocked = np.asarray(rows["blocked"])
        late = np.asarray(rows["time_plan"]) > self.settings.until_set
        errors = {name: np.asarray(rows[name]) for name in ("fit_error", "last_fit_error")}
        seen = np.isfinite(errors["fit_error"])
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
            "motions": int(np.asarray(rows["motions"]).sum()),
            **{
                f"{name}_median": float(np.median(values[seen])) if seen.any() else None
                for name, values in errors.items()
            },
            "miss_median": float(np.median(miss[blocked])) if blocked.any() else None,
            "miss_worst": float(np.max(miss[blocked])) if blocked.any() else None,
            "error_rms": np.sqrt((lists["error_rms"] ** 2).mean(axis=0)).tolist(),
            "torque_rms": np.sqrt((lists["torque_rms"] ** 2).mean(axis=0)).tolist(),
            "torque_worst": lists["torque_worst"].max(axis=0).tolist(),
            "saturated": lists["saturated"].mean(axis=0).tolist(),
        }

    def findings(self, summary: Mapping[str, Any]) -> list[str]:
        """Return sentences on shares of blocked balls and obstacle contacts, and on torques."""
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
        if summary["fit_error_median"] is not None:
            first, last = (100 * summary[f"{name}fit_error_median"] for name in ("", "last_"))
            lines.append(
                f"Midway between the boxes, the first fit of the flight was {first:.1f} cm off in "
                f"the median, the last fit {last:.1f} cm; arms started "
                f"{summary['motions'] / number:.1f} motions each."
            )
        if self.settings.perception and self.settings.arm is None:
            lines.append(
                "Hard for an arm that observes its balls are the joint limits R2: it starts late, "
                "and misses some half of the balls of the suite short and a third of pole, where "
                "it misses a tenth with R1 (docs/lab/block.md)."
            )
        worst, share = summary["torque_worst"], summary["saturated"]
        lines.append(
            f"Joints 1 to 3 used up to {worst[0]:.0f}, {worst[1]:.0f} and {worst[2]:.0f} N m, and "
            f"were at their limit {100 * share[0]:.1f}, {100 * share[1]:.1f} and "
            f"{100 * share[2]:.1f} % of the time."
        )
        return lines

    def tables(self, rows: Any) -> Sequence[RateTable]:
        """Return two tables: durations of sensing, planning and motion; joint tracking errors."""
        return [budget_table(rows), joint_table(rows)]

    def draw(self, folder: Path, rows: Any) -> Sequence[str]:
        """Draw the times for sensing, planning and motion of up to 32 balls; return file names."""
        draw(folder / "budget.png", budget_figure, (8.0, 5.0), rows)
        return ["budget.png"]


def _observe_and_plan(settings: BlockFly, planner: Planner, cases: BlockCase) -> Decided:
    """Return the motions of arms that observe their balls, not yet cut at the contacts."""
    moments, overhead = [settings.until_known], settings.until_set
    if settings.rate:
        latest = float(np.max(jax.jit(jax.vmap(flight_of))(cases).latest))
        step = 1.0 / settings.rate
        moments += list(np.arange(moments[0] + step, latest - overhead, step))
    # The noise of a ball depends on the ball alone, and not on the other balls.
    balls = np.concatenate([cases.ball.pos, cases.ball.vel], axis=1).astype(np.float32)
    seeds = [zlib.crc32(ball.tobytes(), settings.seed) for ball in balls]
    return decide(
        planner,
        cases,
        eye(rate=settings.frame_rate, std=settings.noise or None),
        moments,
        overhead=overhead,
        seed=np.array(seeds, np.uint32),
        again=settings.rate > 0.0,
    )


def _part(batch: Any, name: str) -> np.ndarray:
    return getattr(batch.verdict.budget, name)


def _balls(cases: BlockCase, flights: BlockFlights, lanes: np.ndarray, ground: float) -> np.ndarray:
    case, flown = referee_leaves(cases), flights.flown
    times, met = flown.times, flights.contact[lanes]
    free = np.moveaxis(ball_places(case, times), 0, 2)
    turns, places = links_of(case, flown.angles[lanes].transpose(2, 0, 1))
    turn, middle = shield_pose(case, turns, places)
    normal = turn[:, 0]
    rows = np.arange(len(lanes))
    at = np.clip(np.searchsorted(times, np.nan_to_num(met)), 1, len(times) - 1)
    shield = ((middle[:, rows, at] - middle[:, rows, at - 1]) / FRAME).T
    facing = normal[:, rows, at].T
    vel = case["ball.vel"] - np.outer(case["gravity"] * np.nan_to_num(met), FALL)
    into = np.sum((vel - shield) * facing, axis=1, keepdims=True)
    away = vel - (1.0 + _BOUNCE) * into * facing
    span = np.maximum(times - met[:, None], 0.0)[..., None]
    fall = 0.5 * case["gravity"][:, None, None] * span**2 * FALL
    back = flights.contact_pos[lanes][:, None] + away[:, None] * span - fall
    path = np.where((times > np.nan_to_num(met, nan=np.inf)[:, None])[..., None], back, free)
    return np.where(path[..., 2:] > ground, path, np.nan)
