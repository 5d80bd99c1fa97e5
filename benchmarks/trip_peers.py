"""Compare drives to a standing goal among walls with published planners of paths.

    python -m benchmarks.trip_peers [--barn FOLDER] [--maps FOLDER] [--num 20] [--seed 0]
        [--repeats 3] [--out DIR]

A trip is an interception whose target stands. The robot has the size of a Clearpath Jackal, drives
like a car with the library's default limits and the Jackal's speed limit, keeps 5 cm from every
wall, and stands at start and goal. There are two sets of trips:

* one trip in every file `*.world` of the folder --barn: the cylinders of the benchmark BARN
  [Perille2020], from the start that the benchmark states to its goal 10 m ahead;
* --num random trips on every map of the folder --maps, which has ROS maps (YAML files and images).
  Without the option two maps are generated from the seed: rooms with furniture, and the aisles of a
  warehouse. Start and goal are joined by a path of cells for a disc of the body's width. The robot
  starts in the direction of this path.

This library plans path and speed at once, and every limit holds: `given` has twice the time of a
straight drive of the length of the path of cells, and `early` drives as fast as possible. The
peers plan a path only: OMPL's RRT-Connect with Dubins curves, shortened until that gains nothing
(the extra `arm-peers`), this library's Hybrid A* (the extra `baselines`), and the Hybrid A* of
fastsim-navigation (the extra `peers`; worlds alone, as it needs a heading at the goal). The path is
then driven as fast as the limits of speed and acceleration allow. This favours the peers: the
curvature of their paths jumps, and the limits of steering rate and lateral acceleration are
ignored. A second time also keeps the limit of the lateral acceleration.

The referee decides about success. It judges the clearance of a peer's path, from poses at most 1 cm
apart. RRT-Connect is random: "median" rows have the median over --repeats searches of each trip,
and "best of" rows the best search, with the planning time of all.
"""

import dataclasses
import functools
import importlib.metadata
import importlib.util
import os
import re
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

import planner_jax as pj
from planner_jax.baselines.intercept.hybrid_astar import HybridAstar, hybrid_astar
from planner_jax.benchmarks.path_peers import CELL, INSTALL, PAD, is_installed, run_searches
from planner_jax.benchmarks.run import Bench, argument_parser, at_least, begin
from planner_jax.plane.obstacles import distances
from planner_jax.referee.clearance import clearances, edges, separation
from planner_jax.referee.intercept import CONTACT_SHARE
from planner_jax.runs.table import rate_cells

# Body and greatest speed of a Clearpath Jackal, by its data sheet; the middle is its centre.
JACKAL: dict[str, Any] = {
    "length": 0.508,
    "width": 0.43,
    "wheelbase": 0.262,
    "rear_overhang": 0.123,
    "speed": 2.0,
}
MARGIN = 0.05  # [m], least distance from walls
RADIUS = 0.075  # [m], of the cylinders of BARN
BARN_START, BARN_GOAL = (-2.25, 3.0, 0.5 * np.pi), (-2.25, 13.0)  # of the robot's middle
BARN_LOWER, BARN_UPPER = (-4.6, 1.0), (0.1, 14.0)  # [m], the map
_FINE = 0.01  # [m], distance of the poses at which a path is judged and timed
_SECONDS = 5.0  # [s], time limit of one search of OMPL
_CELLS = 0.05  # [m], cell of the generated maps
OMPL = "ompl not installed: pip install 'planner-jax[arm-peers]' for RRT-Connect"
NUMBA = "numba not installed: pip install 'planner-jax[baselines]' for Hybrid A*"


def body_of(case: Any) -> tuple[float, float, float]:
    """Return the coordinates of the body's rear and front end, and half its width [m].

    The coordinates are along the car, and zero at the rear axle.
    """
    behind = -float(case.body.rear_overhang)
    return behind, behind + float(case.body.length), 0.5 * float(case.body.width)


def measure_cells(case: Any) -> tuple[np.ndarray, np.ndarray]:
    """Compute the distances [m] of square cells of the side `CELL` from the walls of one case.

    Returns:
        corner: (2,) [m], the lower corner of the grid, `PAD` beyond the case's map.
        distance: (Y, X) [m], of the cells' centres, negative in a wall.
    """
    corner = case.lower.astype(float) - PAD
    size = np.ceil((case.upper + PAD - corner) / CELL - 1e-6).astype(int)
    x, y = (corner[k] + CELL * (np.arange(size[k]) + 0.5) for k in range(2))
    east, north = (jnp.asarray(each, jnp.float32).reshape(1, -1) for each in np.meshgrid(x, y))
    far = distances(case.walls.vertices(np.float32(0.0)), case.walls.present, east, north)[0]
    far = np.asarray(far) - case.walls.radius[:, None]
    return corner, far.min(axis=0).reshape(size[::-1])


@dataclasses.dataclass(frozen=True)
class Drive:
    """Result of one planner on one trip."""

    success: bool
    time: float = np.inf  # [s], of the drive; infinite without success
    lateral: float = np.inf  # [s], of the drive if the lateral acceleration is limited, too
    seconds: float = np.nan  # [s], of planning


class Trip:
    """A trip among walls: its case, and the distances of cells from the walls."""

    def __init__(self, case: Any, cells: tuple[np.ndarray, np.ndarray] | None = None):
        """Prepare a trip; `cells` are the results of `measure_cells` if they are known."""
        self.case = case = jax.tree.map(np.asarray, case)
        self.goal = np.asarray(case.target.pos, float)
        self.cells = self.corner, self.distance = cells or measure_cells(case)
        behind, ahead, half = body_of(case)
        self.half, self.middle = np.array([0.5 * (ahead - behind), half]), 0.5 * (behind + ahead)
        self.walls = jax.tree.map(lambda leaf: leaf[case.walls.present], case.walls)
        self.corners = np.asarray(self.walls.vertices(0.0), float)
        self.normals = edges(self.corners)[0]
        self.around = np.linalg.norm(self.walls.corners, axis=2).max(1) + self.walls.radius

    def middles(self, poses: np.ndarray) -> np.ndarray:
        """Return the poses (N, 3) of the body's middle for poses of the rear axle."""
        ahead = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
        return np.concatenate([poses[:, :2] + self.middle * ahead, poses[:, 2:]], axis=1)

    def is_free(self, x: float, y: float, heading: float) -> bool:
        """Return whether the body keeps its margin at one pose of the rear axle."""
        x, y = x + self.middle * np.cos(heading), y + self.middle * np.sin(heading)
        if not (self.case.lower <= (x, y)).all() or not (self.case.upper >= (x, y)).all():
            return False
        column, row = ((np.array([x, y]) - self.corner) / CELL).astype(int)
        # The distance at the middle of the cell differs by at most half the cell's diagonal.
        distance, off = self.distance[row, column], np.sqrt(0.5) * CELL
        if distance > np.hypot(*self.half) + MARGIN + off:
            return True
        if distance < self.half[1] + MARGIN - off:
            return False
        apart = np.hypot(*(self.walls.centre - (x, y)).T) - self.around
        near = np.flatnonzero(apart < np.hypot(*self.half) + MARGIN)
        pose = np.broadcast_to((x, y, heading), (len(near), 3))
        half = np.broadcast_to(self.half, (len(near), 2))
        gaps = separation(self.corners[near], self.normals[near], pose, half)
        return bool((gaps >= MARGIN + self.walls.radius[near]).all())

    def judge_path(self, poses: np.ndarray, seconds: float) -> Drive:
        """Return whether a path of poses (N, 3) of the rear axle succeeds, and its drive time.

        The path must start at the case's start, end at the goal, bend within the limit, and keep
        the margin on the whole, as the referee measures it.
        """
        case, steps = self.case, np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
        turn = np.diff(poses[:, 2])
        turn -= 2.0 * np.pi * np.round(turn / (2.0 * np.pi))
        # The chord of an arc is shorter than the arc.
        steps /= np.sinc(0.5 * turn / np.pi)
        kept = steps > 1e-6
        fine, where = refine(poses, steps)
        middle = self.middles(fine)
        leaves = {name: getattr(self.walls, name) for name in ("centre", "velocity", "corners")}
        leaves |= {name: getattr(self.walls, name) for name in ("present", "radius", "growth")}
        group = {name: np.asarray(leaf)[None] for name, leaf in leaves.items()}
        times = np.zeros((1, len(fine)))
        gap = clearances(group, self.half[None], times, middle[None])[0][0]
        contact = CONTACT_SHARE * float(case.body.length)
        off = np.linalg.norm(fine[0, :2] - case.start[:2])
        miss = np.linalg.norm(middle[-1, :2] - self.goal)
        inside = (middle[:, :2] >= case.lower - contact).all()
        inside &= (middle[:, :2] <= case.upper + contact).all()
        limits = case.limits
        bends = np.where(kept, np.abs(turn) / np.maximum(steps, 1e-6), 0.0)
        is_smooth = (steps * (bends - 1.01 * limits.curvature)).max() < 1e-3
        success = inside and gap >= MARGIN - contact and off < 1e-3 and is_smooth
        if not success or miss > case.tolerance:
            return Drive(False, seconds=seconds)
        length, speed = np.diff(where), np.full(len(fine) - 1, float(limits.speed))
        bend = np.repeat(bends, np.maximum(np.ceil(steps / _FINE).astype(int), 1))
        slow = np.sqrt(limits.lateral_acceleration / np.maximum(bend, 1e-9))
        drive = functools.partial(time_path, length, acceleration=float(limits.acceleration))
        return Drive(True, drive(speed), drive(np.minimum(speed, slow)), seconds)


def refine(poses: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return poses (M, 3) at most `_FINE` apart between poses (N, 3), and their stations (M,) [m].

    `steps` (N - 1,) [m] are the lengths between the poses.
    """
    num = np.maximum(np.ceil(steps / _FINE).astype(int), 1)
    place = np.concatenate([k + np.arange(n) / n for k, n in enumerate(num)] + [[len(num)]])
    poses = np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])])
    index = np.arange(len(poses))
    fine = np.stack([np.interp(place, index, column) for column in poses.T], axis=1)
    return fine, np.interp(place, index, np.append(0.0, np.cumsum(steps)))


def time_path(length: np.ndarray, speed: np.ndarray, acceleration: float) -> float:
    """Return the least time [s] to drive a path of N pieces from standstill to standstill.

    Args:
        length: (N,) [m], of the pieces.
        speed: (N,) [m/s], greatest speed on each piece.
        acceleration: [m/s^2], greatest magnitude of the acceleration along the path.
    """
    square = np.append(np.minimum(np.append(np.inf, speed), np.append(speed, np.inf)) ** 2, 0.0)
    square = square[:-1]
    square[[0, -1]] = 0.0
    for k in range(len(length)):
        square[k + 1] = min(square[k + 1], square[k] + 2.0 * acceleration * length[k])
    for k in range(len(length) - 1, -1, -1):
        square[k] = min(square[k], square[k + 1] + 2.0 * acceleration * length[k])
    ends = np.sqrt(square)
    return float((2.0 * length / np.maximum(ends[1:] + ends[:-1], 1e-12)).sum())


def path_of_cells(trip: Trip) -> np.ndarray:
    """Return the shortest path of cells (N, 2) [m] for a disc of the body's width; N = 0: none."""
    free = trip.distance > trip.half[1] + MARGIN
    number = np.arange(free.size).reshape(free.shape)
    links = []
    for row, column in ((0, 1), (1, 0), (1, 1), (1, -1)):
        rows, left = free.shape[0] - row, max(-column, 0)
        right = free.shape[1] - max(column, 0)
        from_ = np.s_[:rows, left:right]
        to = np.s_[row:, left + column : right + column]
        open_ = free[from_] & free[to]
        pairs = number[from_][open_], number[to][open_]
        links.append((*pairs, np.full(open_.sum(), CELL * np.hypot(row, column))))
    begin_, end, length = (np.concatenate(each) for each in zip(*links, strict=True))
    graph = coo_matrix((length, (begin_, end)), shape=(free.size, free.size)).tocsr()
    middle = trip.middles(np.asarray(trip.case.start, float)[None])[0, :2]
    first, last = (
        number[tuple(((point - trip.corner) / CELL).astype(int)[::-1])]
        for point in (middle, trip.goal)
    )
    far, before = dijkstra(graph, directed=False, indices=first, return_predecessors=True)
    if not np.isfinite(far[last]):
        return np.zeros((0, 2))
    cells = [last]
    while cells[-1] != first:
        cells.append(before[cells[-1]])
    rows, columns = np.divmod(np.array(cells[::-1]), free.shape[1])
    return trip.corner + CELL * (np.stack([columns, rows], axis=1) + 0.5)


def make_trip(
    walls: Sequence[Any], middle: Any, goal: Any, lower: Any, upper: Any, cells: Any = None
) -> Trip:
    """Make a trip of a robot whose middle is at the pose `middle` (3,) to the goal (2,) [m].

    The case has twice the time of a straight drive of the length of the shortest path of cells.
    """
    ahead = np.array([np.cos(middle[2]), np.sin(middle[2])])
    offset = 0.5 * JACKAL["length"] - JACKAL["rear_overhang"]
    case = pj.intercept.case(
        pj.TurningPath(jnp.asarray(goal, jnp.float32), jnp.zeros(2), jnp.zeros(())),
        start=[*(np.asarray(middle[:2]) - offset * ahead), middle[2]],
        initial_speed=0.0,
        end_speed=(0.0, 0.02),
        walls=walls,
        margin=MARGIN,
        lower=lower,
        upper=upper,
        **JACKAL,
    )
    trip = Trip(case, cells)
    steps = np.diff(path_of_cells(trip), axis=0)
    speed, acceleration = float(case.limits.speed), float(case.limits.acceleration)
    straight = np.hypot(*steps.T).sum() / speed + speed / acceleration
    trip.case = dataclasses.replace(trip.case, time=np.float32(2.0 * straight))
    return trip


def read_barn(file: Path) -> Trip:
    """Make the trip of one world of BARN, a file of Gazebo with cylinders."""
    models = file.read_text().split("<state")[0]
    pattern = r"<model name='unit_cylinder[^']*'>.*?<pose[^>]*>([^<]*)</pose>"
    poses = [found.split()[:2] for found in re.findall(pattern, models, re.DOTALL)]
    walls = [pj.intercept.Circle(float(x), float(y), RADIUS) for x, y in poses]
    return make_trip(walls, BARN_START, BARN_GOAL, BARN_LOWER, BARN_UPPER)


def draw_rooms(random: np.random.Generator) -> np.ndarray:
    """Return the cells (H, W) bool of a flat of 18 m x 12 m: six rooms, and furniture.

    Every wall between two rooms has a door of 1.2 m. The furniture are boxes of 0.4 to 1.2 m, with
    at least 0.9 m to walls and other boxes.
    """
    cells = np.zeros((240, 360), bool)
    cells[:3] = cells[-3:] = cells[:, :3] = cells[:, -3:] = True
    cells[120:123] = cells[:, 120:123] = cells[:, 240:243] = True
    for left in (0, 120, 240):
        door = left + random.integers(15, 80)
        cells[120:123, door : door + 24] = False
    for left in (120, 240):
        for low in (0, 120):
            door = low + random.integers(15, 80)
            cells[door : door + 24, left : left + 3] = False
    for _ in range(200):
        height, width = random.integers(8, 24, 2)
        row, column = random.integers(18, 222 - height), random.integers(18, 342 - width)
        if not cells[row - 18 : row + height + 18, column - 18 : column + width + 18].any():
            cells[row : row + height, column : column + width] = True
    return cells


def draw_warehouse(random: np.random.Generator) -> np.ndarray:
    """Return the cells (H, W) bool of a hall of 24 m x 14 m: racks, aisles of 2 m, and pallets.

    A pallet of 0.8 m stands before each rack and leaves 1.2 m of the aisle.
    """
    cells = np.zeros((280, 480), bool)
    cells[:3] = cells[-3:] = cells[:, :3] = cells[:, -3:] = True
    for low in (50, 110, 170, 230):
        for left in (50, 190, 330):
            cells[low : low + 20, left : left + 100] = True
            pallet = left + random.integers(0, 84)
            cells[low + 20 : low + 36, pallet : pallet + 16] = True
    return cells


def write_maps(folder: Path, seed: int) -> None:
    """Write the two generated maps to a folder, as a YAML file and a PGM image each."""
    folder.mkdir(parents=True)
    for name, draw in (("rooms", draw_rooms), ("warehouse", draw_warehouse)):
        cells = draw(np.random.default_rng(seed))
        header = f"P5 {cells.shape[1]} {cells.shape[0]} 255\n".encode()
        pixels = np.where(cells[::-1], 0, 254).astype(np.uint8)
        (folder / f"{name}.pgm").write_bytes(header + pixels.tobytes())
        (folder / f"{name}.yaml").write_text(
            f"image: {name}.pgm\nresolution: {_CELLS}\norigin: [0, 0, 0]\nnegate: 0\n"
            "occupied_thresh: 0.65\nfree_thresh: 0.25\n"
        )


def draw_trips(file: Path, num: int, seed: int) -> list[Trip]:
    """Draw random trips on a ROS map, with at least 4 m between start and goal."""
    grid = pj.intercept.read_map(file)
    walls, lower, upper = grid.walls(), grid.lower, grid.upper
    random, trips = np.random.default_rng(seed), []
    around = 0.5 * np.hypot(JACKAL["length"], JACKAL["width"]) + 2.0 * MARGIN
    middle = [*(0.5 * (lower + upper)), 0.0]
    corner, distance = cells = make_trip(walls, middle, lower, lower, upper).cells
    while len(trips) < num:
        points = random.uniform(lower, upper, (2, 2))
        columns, rows = ((points - corner) / CELL).astype(int).T
        if np.hypot(*(points[1] - points[0])) < 4.0 or distance[rows, columns].min() < around:
            continue
        trip = make_trip(walls, [*points[0], 0.0], points[1], lower, upper, cells)
        path = path_of_cells(trip)
        if len(path):
            ahead = np.arctan2(*(path[10] - path[0])[::-1])
            trips.append(make_trip(walls, [*points[0], ahead], points[1], lower, upper, cells))
    return trips


def pad_walls(trips: list[Trip]) -> list[Any]:
    """Return the trips' cases with equal numbers of walls, so that they share compiled programs."""
    most = max(len(trip.case.walls.present) for trip in trips)

    def pad(leaf: np.ndarray) -> np.ndarray:
        return np.pad(leaf, [(0, most - len(leaf)), *[(0, 0)] * (leaf.ndim - 1)])

    padded = [dataclasses.replace(t.case, walls=jax.tree.map(pad, t.case.walls)) for t in trips]
    return [jax.tree.map(jnp.asarray, case) for case in padded]


def plan_trips(trips: list[Trip], meet: str) -> tuple[list[list[Drive]], float]:
    """Plan trips one after another by this library; also return the first call's time [s]."""
    planner, drives = pj.intercept.planner(meet=meet), []
    cases = pad_walls(trips)
    began = time.perf_counter()
    jax.block_until_ready(pj.plan(planner, cases[0]))
    first = time.perf_counter() - began
    for case in cases:
        began = time.perf_counter()
        plan = jax.block_until_ready(pj.plan(planner, case))
        seconds = time.perf_counter() - began
        verdict = pj.intercept.judge(case, plan)
        took = float(verdict.meeting_time) if verdict.success else np.inf
        drives.append([Drive(bool(verdict.success), took, took, seconds)])
    return drives, first


def search_astar(trip: Trip) -> list[Drive]:
    """Search a path by this library's Hybrid A*, with the margin and the radius of the walls."""
    case = trip.case
    radius = float(case.walls.radius.max())
    began = time.perf_counter()
    path = hybrid_astar(
        *(case.start, trip.goal, case.walls),
        curvature=float(case.limits.curvature),
        body=body_of(case),
        lower=case.lower,
        upper=case.upper,
        settings=HybridAstar(margin=MARGIN + radius + 0.01, poses=2049),
    )
    seconds = time.perf_counter() - began
    return [trip.judge_path(path.poses, seconds) if path.found else Drive(False, seconds=seconds)]


def describe_search(
    case: Any, meeting: np.ndarray, heading: float, margin: float
) -> dict[str, Any]:
    """Return a path problem of `run_searches`; the body is enlarged by `margin` [m] on all sides.

    `heading` [rad] is prescribed at the meeting point (2,) [m] of the body's middle.
    """
    (behind, ahead, half), (corner, distance) = body_of(case), measure_cells(case)
    direction = np.array([np.cos(heading), np.sin(heading)])
    rear, front, side = behind - margin, ahead + margin, half + margin
    return {
        "start": case.start.tolist(),
        "goal": [*(meeting - 0.5 * (behind + ahead) * direction), heading],
        "distance": distance.tolist(),
        "corner": corner.tolist(),
        "curvature": float(case.limits.curvature),
        "body": [[rear, -side], [front, -side], [front, side], [rear, side]],
    }


def search_fastsim(trips: list[Trip]) -> list[list[Drive]]:
    """Search paths by fastsim-navigation, in a process of its own, to the heading of the start."""
    searches = [describe_search(t.case, t.goal, float(t.case.start[2]), MARGIN) for t in trips]
    with tempfile.TemporaryDirectory() as folder:
        found = run_searches(searches, Path(folder))
    return [
        [
            trip.judge_path(np.array(each["poses"]), each["ms"] / 1e3)
            if each["found"]
            else Drive(False)
        ]
        for trip, each in zip(trips, found, strict=True)
    ]


def search_ompl(trip: Trip, repeats: int) -> list[Drive]:
    """Search paths of Dubins curves by OMPL's RRT-Connect, and shorten each path.

    The goal is a set of 16 headings. The shortening is repeated until it gains less than 0.1 %.
    """
    ob, og = (importlib.import_module(f"ompl.{name}") for name in ("base", "geometric"))
    case, space = trip.case, None
    space = ob.DubinsStateSpace(1.0 / float(case.limits.curvature))
    bounds = ob.RealVectorBounds(2)
    for k in range(2):
        bounds.setLow(k, float(case.lower[k]) - trip.middle)
        bounds.setHigh(k, float(case.upper[k]) + trip.middle)
    space.setBounds(bounds)
    information = ob.SpaceInformation(space)
    information.setStateValidityChecker(lambda s: trip.is_free(s.getX(), s.getY(), s.getYaw()))
    information.setStateValidityCheckingResolution(0.02 / space.getMaximumExtent())
    information.setup()

    def state_of(pose: Sequence[float]) -> Any:
        state = space.allocState()
        state.setX(float(pose[0]))
        state.setY(float(pose[1]))
        state.setYaw(np.arctan2(np.sin(yaw := float(pose[2])), np.cos(yaw)))
        return state

    headings = np.arange(16) * np.pi / 8.0
    ahead = np.stack([np.cos(headings), np.sin(headings)], axis=1)
    ends = np.column_stack([trip.goal - trip.middle * ahead, headings])
    drives = []
    for _ in range(repeats):
        goal = ob.GoalStates(information)
        for pose in ends:
            if trip.is_free(*pose):
                goal.addState(state_of(pose))
        problem = ob.ProblemDefinition(information)
        problem.addStartState(state_of(case.start))
        problem.setGoal(goal)
        planner = og.RRTConnect(information)
        planner.setProblemDefinition(problem)
        planner.setup()
        began = time.perf_counter()
        if not planner.solve(_SECONDS) or not problem.hasExactSolution():
            drives.append(Drive(False, seconds=time.perf_counter() - began))
            continue
        path, length = problem.getSolutionPath(), np.inf
        while path.length() < 0.999 * length:
            length = path.length()
            og.PathSimplifier(information, goal).simplifyMax(path)
        seconds = time.perf_counter() - began
        path.interpolate(max(int(path.length() / _FINE), 2))
        states = path.getStates()
        poses = np.array([(s.getX(), s.getY(), s.getYaw()) for s in states])
        drives.append(trip.judge_path(poses, seconds))
    return drives


def select_drives(
    drives: list[list[Drive]],
    rank: Callable[[np.ndarray], float] = np.min,
    total: Callable[[np.ndarray], float] = np.min,
) -> dict[str, np.ndarray]:
    """Return arrays (T,) of the trips' times, from the repeats of each trip.

    A trip's time is `rank` of the times of its repeats, with infinity for failures. Its planning
    time is `total` of the planning times.
    """
    return {
        name: np.array([of(np.array([getattr(d, name) for d in each])) for each in drives])
        for name, of in (("time", rank), ("lateral", rank), ("seconds", total))
    }


def compare(bench: Bench, name: str, trips: list[Trip], repeats: int, *, is_world: bool) -> None:
    """Plan all trips of a set by all planners; print a row for each planner."""
    rows, first = {}, {}
    for meet in ("given", "early"):
        drives, first[meet] = plan_trips(trips, meet)
        rows[meet] = select_drives(drives)
    if importlib.util.find_spec("ompl") is not None:
        drives = [search_ompl(trip, repeats) for trip in trips]
        rows["RRT-Connect, median"] = select_drives(drives, np.median, np.median)
        rows[f"RRT-Connect, best of {repeats}"] = select_drives(drives, np.min, np.sum)
    if importlib.util.find_spec("numba") is not None:
        search_astar(trips[0])
        rows["Hybrid A*"] = select_drives([search_astar(trip) for trip in trips])
    if is_world and is_installed():
        rows["fastsim-navigation"] = select_drives(search_fastsim(trips))
    for planner, found in rows.items():
        solved = np.isfinite(found["time"])
        cells = rate_cells(int(solved.sum()), len(trips))
        both = solved & np.isfinite(rows["early"]["time"])
        for rule in ("time", "lateral"):
            shorter = 1.0 - rows["early"]["time"][both] / found[rule][both]
            gained = f"{100 * np.median(shorter):.1f} %" if both.any() else "-"
            cells += [f"{np.median(found[rule]):.2f}", gained, f"{(shorter < 0.0).sum()}"]
        seconds = np.nanmedian(found["seconds"]) if solved.any() else np.nan
        compiled = f"{first[planner]:.1f}" if planner in first else "-"
        cells += [f"{both.sum()}", f"{1e3 * seconds:.0f}", compiled]
        bench.say(f"| {name} | {planner} | {' | '.join(cells)} |")
        bench.row(set=name, planner=planner, **found, first_call=first.get(planner))
    bench.count(np.isfinite(rows["early"]["time"]))


def versions() -> str:
    """Return the versions of the packages whose planners are compared, and of JAX."""
    found = []
    for package in ("planner-jax", "jax", "ompl", "numba", "fastsim-navigation"):
        try:
            found.append(f"{package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:
            found.append(f"{package} absent")
    return ", ".join(found)


def main() -> None:
    parser = argument_parser("trip_peers", __doc__, num=20, seed=0)
    parser.add_argument("--barn", type=Path, help="folder of BARN's files *.world")
    parser.add_argument("--maps", type=Path, help="folder of ROS maps; default: generated maps")
    parser.add_argument("--repeats", type=at_least(1), default=3, help="searches of RRT-Connect")
    options = parser.parse_args()
    with begin(parser, options) as bench:
        if importlib.util.find_spec("ompl") is not None:
            util = importlib.import_module("ompl.util")
            util.setLogLevel(util.LOG_ERROR)
            util.RNG.setSeed(options.seed + 1)
        folder = options.maps
        if folder is None:
            write_maps(folder := bench.path / "maps", options.seed)
        worlds = sorted(options.barn.glob("*.world")) if options.barn else []
        absent = [] if worlds else ["no world of BARN: pass its folder by --barn"]
        absent += [] if is_installed() else [INSTALL]
        for package, line in (("ompl", OMPL), ("numba", NUMBA)):
            absent += [] if importlib.util.find_spec(package) else [line]
        bench.say(
            *absent,
            f"{versions()}; {os.cpu_count()} cores, load average {os.getloadavg()[0]:.1f}",
            "",
            "| trips | planner | number | success [%] | 95 % interval | drive, median [s] | "
            "`early` is shorter by | longer drives | drive, lateral limit, median [s] | `early` is "
            "shorter by | longer drives | compared | planning [ms] | first call [s] |",
            "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
        )
        if worlds:
            trips = [read_barn(file) for file in worlds]
            compare(bench, "BARN", trips, options.repeats, is_world=True)
        for file in sorted(folder.glob("*.yaml")):
            trips = draw_trips(file, options.num, options.seed)
            compare(bench, file.stem, trips, options.repeats, is_world=False)


if __name__ == "__main__":
    main()
