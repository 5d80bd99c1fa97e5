"""Simulated interceptions, in which a car meets a moving target: table, recordings, report."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.runs.columns import NUMBER, Column, leaves_of
from planner_jax.runs.summary import percent
from planner_jax.sims.drive import DriveLoop
from planner_jax.sims.model import World
from planner_jax.sims.recording import Recording
from planner_jax.sims.robots.car.robot import Car
from planner_jax.sims.robots.car.vehicle import Tyres, Vehicle
from planner_jax.sims.scenery import Prism
from planner_jax.sims.settings import InterceptFly
from planner_jax.sims.task import FlightTask
from planner_jax.sims.tasks.intercept import (
    CAR_WORLD,
    SUCCESS,
    TOUCH,
    Driven,
    InterceptFlights,
    Meetings,
    fly_intercepts,
    meetings,
)
from planner_jax.task.intercept.api import draw, positions
from planner_jax.task.intercept.api import planner as intercept_planner
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.searches import (
    SEARCHES,
    Reachability,
    make_field,
    make_grid,
    search_reach,
)

NEAR, FAR = 0.05, 0.5  # [m], two more distances from the target within which drives are counted
_KEPT = 2  # number of simulated frames from one recorded sample to the next
_WALL, _MOVER = "#8C959F", "#D9A441"  # colours of walls and moving obstacles in pictures
_WALL_HEIGHT, _MOVER_HEIGHT, _TARGET_HEIGHT = 0.25, 0.2, 0.08  # [m], heights in pictures


class InterceptFlight(FlightTask):
    """The simulation of interceptions, which `sims/run.py` calls to simulate, score, draw a run."""

    settings: InterceptFly

    THING = "target"
    THING_RADIUS = 0.06
    CONTACT = "met"
    SUCCESS = f"met the target within {SUCCESS:g} m and touched nothing"
    PUBLISHED = "[Qu2022] shows single drives, without rates"
    HAS_REACH = True
    VIEW = (58.0, -90.0)
    EYE = ((4.0, -5.0, 9.0), (4.0, 3.8, 0.0))
    COLUMNS = (
        *leaves_of(
            "verdict",
            ("miss", "m", "from the body's centre to the true target"),
            ("wall_clearance", "m", "least; negative inside"),
            ("mover_clearance", "m", "least; negative inside"),
        ),
        Column(
            "meeting_time", "s", "end of the last plan", NUMBER, lambda b: _get_drives(b).meeting
        ),
        Column("drive_saturated", "1", "share", NUMBER, lambda b: _get_drives(b).saturation[:, 0]),
        Column(
            "steering_saturated", "1", "share", NUMBER, lambda b: _get_drives(b).saturation[:, 1]
        ),
        Column("num_plans", "", "that were driven", NUMBER, lambda b: _get_drives(b).plans),
    )

    def world(self) -> World:
        """Return the simulated ground with the car; obstacles differ from drive to drive."""
        tyres = Tyres() if self.settings.slip else None
        return dataclasses.replace(CAR_WORLD, robot=Car(Vehicle(tyres=tyres)))

    def loop(self) -> DriveLoop:
        """Return the settings of the closed loop: the world and its sensing."""
        return DriveLoop(self.world(), self.settings.sensing)

    def parameters(self) -> dict[str, Any]:
        """Return the settings of the closed loop as plain values for the run's manifest."""
        return dataclasses.asdict(self.loop())

    def cases(self) -> Meetings:
        """Draw all interceptions of the run from its suite (family of random cases) and seed."""
        settings = self.settings
        sensing = settings.sensing
        return meetings(
            settings.suite,
            settings.num,
            settings.seed,
            noise=sensing.target_std,
            observation_rate=sensing.observation_rate,
        )

    def fly(self, cases: Meetings, record: bool) -> InterceptFlights:
        """Plan and simulate interceptions; motions are stored even if `record` is false."""
        settings = self.settings
        return fly_intercepts(
            self.loop(),
            cases,
            settings.seed,
            replan=settings.rate,
            planner=intercept_planner(settings.planner),
            known_target=settings.known_target,
            predict_movers=settings.predict_movers,
        )

    def recording(
        self, cases: Meetings, flights: InterceptFlights, lanes: Sequence[int] | np.ndarray
    ) -> Recording:
        """Return a recording of the drives whose indices in the batch are `lanes`."""
        some, flown = cases[np.asarray(lanes)], flights.flown
        kept = np.arange(0, flown.times.size, _KEPT)
        times = np.tile(flown.times[kept], (len(some), 1))
        seen = [positions(some.cases.target, at) for at in times.T.astype(np.float32)]
        met = np.where(flights.miss <= SUCCESS, flown.meeting, np.nan)[lanes]
        where = np.where(np.isfinite(met)[:, None], flights.target[lanes], np.nan)
        return Recording(
            index=some.index,
            success=flights.success[lanes],
            time=times,
            robot=flown.poses[lanes][:, kept],
            wanted=_add_height(flown.wanted[lanes][:, kept], 0.0),
            balls=_add_height(np.stack(seen, axis=1), _TARGET_HEIGHT)[:, :, None],
            met=met[:, None],
            contact=_add_height(where, _TARGET_HEIGHT)[:, None],
            target=np.full((len(some), 3), np.nan),
            expected=_add_height(flown.paths[lanes][:, kept], _TARGET_HEIGHT),
        )

    @property
    def suite(self) -> str:
        """The name of the suite, the family of random interceptions, for the report."""
        return self.settings.suite

    @property
    def conditions(self) -> str:
        """Noise, latency, prediction and tyres, as the beginning of a sentence of the report."""
        settings = self.settings
        of = (
            "known"
            if settings.known_target
            else f"predicted from observations at {settings.observation_rate:g} Hz"
        )
        movers = "predicted" if settings.predict_movers else "known"
        tyres = "slipping tyres" if settings.slip else "tyres without slip"
        return (
            f"Noise {settings.noise}, latency {1e3 * settings.latency:g} ms, the target {of}, "
            f"movers {movers}, {tyres}"
        )

    @property
    def simulated(self) -> str:
        """A description of the car and its sensing, for the report of a run."""
        return f"{self.world().robot.WORDS}; poses and observations with noise and latency"

    def surroundings(self, index: int) -> Sequence[Prism]:
        """Return the walls and moving obstacles of one drive as prisms for drawing."""
        case = self._case(index)
        found = []
        for group, height, colour in (
            (case.walls, _WALL_HEIGHT, _WALL),
            (case.movers, _MOVER_HEIGHT, _MOVER),
        ):
            for k in np.flatnonzero(group.present):
                corners = np.asarray(group.centre[k] + group.corners[k], float)
                own = corners[np.any(corners != np.roll(corners, 1, axis=0), axis=1)]
                x, y = np.asarray(group.velocity[k], float)
                found.append(Prism(own, height, colour, (float(x), float(y))))
        return found

    def reachable(self, index: int) -> Sequence[tuple[float, np.ndarray]]:
        """Return times [s], each with the points (P, 2) [m] where the car could be at that time."""
        return reach_layers(jax.tree.map(jnp.asarray, self._case(index)))

    def _case(self, index: int) -> InterceptCase:
        settings = self.settings
        one = draw(1, settings.suite, settings.seed, first=index)
        return jax.tree.map(lambda leaf: np.asarray(leaf)[0], one)

    def counts(self, rows: Any) -> dict[str, Any]:
        """Count met targets and obstacle contacts, and average times of saturated actuators."""
        miss = np.asarray(rows["miss"])
        wall, mover = (np.asarray(rows[f"{name}_clearance"]) < -TOUCH for name in ("wall", "mover"))
        return {
            "within_0.05_m": int((miss <= NEAR).sum()),
            "within_0.3_m": int((miss <= SUCCESS).sum()),
            "within_0.5_m": int((miss <= FAR).sum()),
            "miss_median": float(np.median(miss)),
            "touched_wall": int(wall.sum()),
            "touched_mover": int(mover.sum()),
            "drive_saturated": float(np.mean(rows["drive_saturated"])),
            "steering_saturated": float(np.mean(rows["steering_saturated"])),
        }

    def findings(self, summary: Mapping[str, Any]) -> list[str]:
        """Return sentences on shares of met targets, obstacle contacts and saturated actuators."""
        number = summary["num"]
        near, success, far = (
            percent(summary[f"within_{width:g}_m"], number) for width in (NEAR, SUCCESS, FAR)
        )
        walls, movers = (percent(summary[f"touched_{one}"], number) for one in ("wall", "mover"))
        drive, steering = (100.0 * summary[f"{one}_saturated"] for one in ("drive", "steering"))
        return [
            f"Whatever they touched, {near} % came within {NEAR:g} m of the true target, "
            f"{success} % within {SUCCESS:g} m, {far} % within {FAR:g} m; "
            f"{walls} % touched a wall, {movers} % a mover.",
            f"Drive saturated {drive:.2f} % of the time, steering {steering:.2f} %.",
        ]


def _get_drives(batch: Any) -> Driven:
    return batch.verdict.flown


def _add_height(points: np.ndarray, height: float) -> np.ndarray:
    high = np.where(np.isfinite(points[..., :1]), height, np.nan)
    return np.concatenate([points, high], axis=-1)


def reach_layers(case: InterceptCase) -> list[tuple[float, np.ndarray]]:
    """Return pairs of a time [s] and grid points (P, 2) [m] where the car could be at that time.

    The car starts as in `case`, keeps its limits and avoids the obstacles.
    """
    search = SEARCHES["given"][0]

    def search_cells(case: InterceptCase) -> Reachability:
        # The reach set is computed in SI units, since the cells are drawn in the world frame.
        grid = make_grid(case, search.lattice, is_time_free=False)
        return search_reach(case, search, grid, make_field(case, grid), is_time_free=False)

    found = jax.device_get(jax.jit(search_cells)(case))
    grid, words = found.grid, np.bitwise_or.reduce(found.reach.bits, axis=(2, 3))
    layers = []
    for number in range(int(grid.num) + 1):
        bits = np.unpackbits(
            words[number].transpose(1, 0).copy().view(np.uint8), axis=1, bitorder="little"
        ).astype(bool)  # (cells, cells), rows are y
        y, x = np.nonzero(bits)
        points = grid.corner + grid.cell * np.stack([x, y], axis=1)
        layers.append((float((number + 0.5) * grid.step), points))
    return layers
