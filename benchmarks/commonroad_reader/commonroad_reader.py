"""Read planning problems of CommonRoad scenarios (XML, 2018b or 2020a) as cases of `intercept`.

World frame of the file, SI units; time 0 is the initial state of the planning problem.
"""

import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, parse

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.path import Path as Area

import planner_jax as pj
from planner_jax.plane.polygons import convex_parts
from planner_jax.plane.target import TurningPath

MARGIN = 15.0  # [m], distance from the box around start and goal up to which the map is read
INSIDE = 0.98  # scale of goal regions and headings, so that plans end inside despite rounding
# The BMW 320i of the CommonRoad vehicle models. Its acceleration may have any direction, up to
# 11.5 m/s^2; each of the two components is limited to 11.5 m/s^2 / sqrt(2).
CAR = {
    "length": 4.508, "width": 1.610, "wheelbase": 2.5789128, "rear_overhang": 0.8312829,
    "acceleration": 8.13, "lateral_acceleration": 8.13,
    "curvature": float(np.tan(1.066)) / 2.5789128, "steering_rate": 0.4,
}  # fmt: skip
SPEED = 13.9  # [m/s], speed limit of maps that state none: 50 km/h
AHEAD = 0.5 * CAR["length"] - CAR["rear_overhang"]  # [m], from the rear axle to the body's middle


@dataclasses.dataclass(frozen=True)
class Problem:
    """A planning problem with one of its alternative goals."""

    file: str
    number: int
    step: float  # [s], time step of the scenario
    middle: np.ndarray  # (2,) [m], of the goal region
    arguments: dict[str, Any]  # further arguments of `pj.intercept.case`

    def case(self) -> Any:
        """Make the case, whose target stands still in the middle of the goal region."""
        still = TurningPath(*map(jnp.asarray, (self.middle, np.zeros(2), 0.0)))
        return pj.intercept.case(still, **self.arguments)

    def row(self, plan: Any) -> dict[str, Any]:
        """Return a plan's states at the scenario's time steps, for `commonroad_judge.py`.

        A state is x, y of the body's middle [m], heading [rad], speed [m/s], steering angle [rad].
        """
        at = plan.sample(1.0 / self.step)
        pos = at.pos + AHEAD * np.stack([np.cos(at.heading), np.sin(at.heading)], axis=1)
        steering = np.arctan(CAR["wheelbase"] * at.curvature)
        states = np.column_stack([pos, at.heading, at.speed, steering]).tolist()
        return {"file": self.file, "problem": self.number, "states": states}


def draw(num: int, seed: int, first: int) -> Any:
    """Draw cases from the folder in the environment variable COMMONROAD, in an order by the seed.

    A case is the first problem of a file. Obstacles 1 km away are added, so that all cases of the
    batch have arrays of equal shapes.
    """
    files = sorted(Path(os.environ["COMMONROAD"]).glob("*.xml"))
    order = np.random.default_rng(seed).permutation(len(files))
    drawn = [read(files[order[k % len(files)]])[0] for k in range(first, first + num)]
    given = [problem.arguments for problem in drawn]
    tables = [path[0] for each in given for path in each["mover_paths"]]
    longest = max(map(len, tables), default=2)
    walls, movers = (max(len(each[name]) for each in given) + 1 for name in ("walls", "movers"))
    for each in given:
        far, times = each["upper"] + 1e3, np.linspace(0.0, each["time"], longest)
        still = (times, np.tile([*far, 0.0], (longest, 1)))
        each["walls"] += [far + _circle(1.0)] * (walls - len(each["walls"]))
        each["movers"] += [_circle(1.0)] * (movers - len(each["movers"]))
        each["mover_paths"] += [still] * (movers - len(each["mover_paths"]))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *[each.case() for each in drawn])


def read(path: Path) -> list[Problem]:
    """Read the planning problems of a scenario, with one entry for each alternative goal.

    The convex parts of a goal lanelet are goals. The goals of a planning problem are sorted: first
    the goal whose distance from the start is closest to the distance driven at the initial speed.
    The car's speed is limited to the map's greatest speed limit, or to 1.1 times the initial speed.
    """
    root, found = parse(path).getroot(), []
    step, borders = float(root.attrib["timeStepSize"]), list(_borders(root))
    allowed = max(_numbers(root, "lanelet/speedLimit"), default=SPEED)
    for node in root.iterfind("planningProblem"):
        x, y, heading, begin = _pose(initial := node.findall("initialState")[0])
        speed, rate = (_range(initial, name, 0.0)[0] for name in ("velocity", "yawRate"))
        rear = np.array([x - AHEAD * np.cos(heading), y - AHEAD * np.sin(heading), heading])
        goals = []
        for goal, region in _goals(root, node):
            early, late = (step * (time - begin) for time in _range(goal, "time"))
            low, high = _range(goal, "orientation", -4.0, 4.0)  # by default all headings
            middle, ends = region.mean(axis=0), np.vstack([region, [[x, y]]])
            lower, upper = ends.min(axis=0) - MARGIN, ends.max(axis=0) + MARGIN
            walls, movers, paths = list(borders), [], []
            for obstacle in (each for each in root if each.tag.lower().endswith("obstacle")):
                states = obstacle.findall("initialState") + obstacle.findall("trajectory/state")
                poses = np.array([_pose(state) for state in states])
                times, poses[:, 2] = step * (poses[:, 3] - begin), np.unwrap(poses[:, 2])
                kept = (times >= 0.0) & (times <= late + step)
                for shape in map(_polygon, obstacle.iterfind("shape/*")):
                    if "static" in (obstacle.findtext("role") or obstacle.tag):
                        walls.append(_place(shape, *poses[0, :3]))
                    elif kept.sum() > 1 and _is_near(poses[kept, :2], lower, upper):
                        movers.append(shape)
                        paths.append((times[kept], poses[kept, :3]))
            arguments = {
                "start": rear, "initial_speed": speed, "initial_curvature": rate / max(speed, 1.0),
                "time": late, "earliest": early, "region": INSIDE * (region - middle),
                "tolerance": 0.01, "margin": 0.05, "end_heading": 0.5 * (low + high),
                "heading_tolerance": min(0.5 * INSIDE * (high - low), np.pi),
                "end_speed": _range(goal, "velocity", 0.0, np.inf),
                "speed": max(allowed, 1.1 * speed, _range(goal, "velocity", 0.0)[0] + 1.0),
                "walls": [wall for wall in walls if _is_near(wall, lower, upper)],
                "movers": movers, "mover_paths": paths, "lower": lower, "upper": upper, **CAR,
            }  # fmt: skip
            mismatch = abs(np.hypot(*(middle - [x, y])) - speed * late)
            problem = Problem(path.name, int(node.attrib["id"]), step, middle, arguments)
            goals.append((mismatch, len(goals), problem))
        found += [problem for *_, problem in sorted(goals)]
    return found


def _is_near(points: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> bool:
    return bool((points.max(axis=0) > lower).all() and (points.min(axis=0) < upper).all())


def _goals(root: Element, node: Element) -> Iterator[tuple[Element, np.ndarray]]:
    for goal in node.iterfind("goalState"):
        for shape in goal.iterfind("position/*"):
            area = shape
            if shape.tag == "lanelet":
                area = root.findall(f"lanelet[@id='{shape.attrib['ref']}']")[0]
            corners = _polygon(shape) if area is shape else np.vstack(_bounds(area))
            yield from ((goal, part) for part in convex_parts("goal", corners))


def _bounds(lanelet: Element) -> list[np.ndarray]:
    """Return the left bound of a lanelet, and the right bound in reverse: a clockwise ring."""
    left, right = (_thin(_points(lanelet, name)) for name in ("leftBound", "rightBound"))
    return [left, right[::-1]]


def _borders(root: Element) -> Iterator[np.ndarray]:
    """Yield walls, 0.1 m thick, outside of the borders of the union of all lanelets.

    An edge of a lanelet is divided into pieces of up to 0.2 m. A piece is a border if the point
    0.1 m outside of it lies in no lanelet. Gaps between lanelets below 0.1 m are thus no borders.
    Ends of lanelets without a successor or predecessor are open.
    """
    rings = []
    for lanelet in root.iterfind("lanelet"):
        ring = np.vstack(bounds := _bounds(lanelet))
        ends = {len(bounds[0]) - 1: "successor", len(ring) - 1: "predecessor"}
        opened = [k for k, name in ends.items() if lanelet.find(name) is None]
        edges = np.stack([ring, np.roll(ring, -1, axis=0)], axis=1)
        rings.append((Area(ring), np.delete(edges, opened, axis=0)))
    for a, b in (edge for _, edges in rings for edge in edges if (edge[0] != edge[1]).any()):
        length = float(np.hypot(*(b - a)))
        out = np.array([a[1] - b[1], b[0] - a[0]]) * 0.1 / length
        marks = np.linspace(a, b, int(np.ceil(length / 0.2)) + 1)
        probes = 0.5 * (marks[1:] + marks[:-1]) + out
        is_border = ~np.any([area.contains_points(probes) for area, _ in rings], axis=0)
        ends = np.flatnonzero(np.diff(np.concatenate([[0], is_border, [0]])))
        for p, q in zip(marks[ends[::2]], marks[ends[1::2]], strict=True):
            yield np.array([p, q, q + out, p + out])


def _thin(line: np.ndarray) -> np.ndarray:
    """Leave out points of a line that lie within 0.03 m of the line without them."""
    chord = line[-1] - line[0]
    away = np.abs((line - line[0]) @ [-chord[1], chord[0]]) / max(np.hypot(*chord), 1e-9)
    if away.max() <= 0.03:
        return line[[0, -1]]
    k = int(away.argmax())
    return np.vstack([_thin(line[: k + 1])[:-1], _thin(line[k:])])


def _polygon(shape: Element) -> np.ndarray:
    if shape.tag == "polygon":
        return _points(shape, ".")
    names = ("length", "width", "radius", "orientation", "center/x", "center/y")
    length, width, radius, heading, x, y = (float(shape.findtext(name, "0")) for name in names)
    corners = _circle(radius)
    if shape.tag == "rectangle":
        corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * [length, width]
    return _place(corners, x, y, heading)


def _circle(radius: float) -> np.ndarray:
    """Return a polygon of 16 corners around a circle; `INSIDE` times it lies in the circle."""
    angles = np.pi / 8 * np.arange(16)
    return radius / np.cos(np.pi / 16) * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _place(corners: np.ndarray, x: float, y: float, heading: float) -> np.ndarray:
    cos, sin = np.cos(heading), np.sin(heading)
    return corners @ [[cos, sin], [-sin, cos]] + [x, y]


def _numbers(node: Element, path: str) -> list[float]:
    return [float(each.text or 0) for each in node.iterfind(path)]


def _range(node: Element, name: str, *default: float) -> tuple[float, float]:
    values = _numbers(node, f"{name}/*") or default
    return values[0], values[-1]


def _pose(state: Element) -> tuple[float, ...]:
    """Return x, y [m], heading [rad], and the time step; means of those that are uncertain."""
    paths = ("position//x", "position//y", "orientation/*", "time/*")
    return tuple(float(np.mean(_numbers(state, path))) for path in paths)


def _points(node: Element, name: str) -> np.ndarray:
    return np.stack([_numbers(node, f"{name}/point/{axis}") for axis in "xy"], axis=1)
