"""Read planning problems of CommonRoad scenarios (XML, 2018b or 2020a) as cases of `intercept`.

World frame of the file, SI units; time 0 is the initial state of the planning problem.
"""

import dataclasses
import os
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, parse

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.path import Path as Area

import planner_jax as pj
from planner_jax.plane.polygons import convex_parts

MARGIN = 15.0  # [m], distance from the box around start and goal up to which the map is read
INSIDE = 0.98  # scale of goal regions and headings, so that plans end inside despite rounding
SPEED = 13.9  # [m/s], speed limit of maps that state none: 50 km/h
# The BMW 320i of the CommonRoad vehicle models. Its acceleration may have any direction, up to
# 11.5 m/s^2; each of the two components is limited to 11.5 m/s^2 / sqrt(2).
CAR = {
    "length": 4.508, "width": 1.610, "wheelbase": 2.5789128, "rear_overhang": 0.8312829,
    "acceleration": 8.13, "lateral_acceleration": 8.13,
    "curvature": float(np.tan(1.066)) / 2.5789128, "steering_rate": 0.4,
}  # fmt: skip
AHEAD = 0.5 * CAR["length"] - CAR["rear_overhang"]  # [m], from the rear axle to the body's middle


@dataclasses.dataclass(frozen=True)
class Problem:
    """A planning problem with one of its alternative goals."""

    file: str
    number: int
    step: float  # [s], time step of the scenario
    arguments: dict[str, Any]  # of `pj.intercept.case`

    def case(self) -> Any:
        """Make the case, whose target stands in the middle of the goal region."""
        return pj.intercept.case(**self.arguments)


def draw(num: int, seed: int, first: int) -> Any:
    """Draw the first problems of files in the folder COMMONROAD, an environment variable."""
    files = sorted(Path(os.environ["COMMONROAD"]).glob("*.xml"))
    order = np.random.default_rng(seed).permutation(len(files))
    drawn = [read(files[order[k % len(files)]])[0] for k in range(first, first + num)]
    for given in (problem.arguments for problem in drawn):
        far = [*given["upper"] + 1e3, 0.0]  # every case of a batch needs a mover with a path
        given["movers"].append(np.eye(3, 2))
        given["mover_paths"].append(([0.0, given["time"]], [far, far]))
    return jax.tree.map(_stack, *[problem.case() for problem in drawn])


def _stack(*leaves: Any) -> Any:
    """Stack arrays of several cases. The last entries of shorter arrays are repeated."""
    shape = np.max([np.shape(leaf) for leaf in leaves], axis=0)
    pads = [[(0, int(n)) for n in shape - np.shape(leaf)] for leaf in leaves]
    pairs = zip(leaves, pads, strict=True)
    return jnp.stack([jnp.pad(leaf, pad, "edge") if pad else leaf for leaf, pad in pairs])


def read(path: Path) -> list[Problem]:
    """Read the planning problems of a scenario, with one entry for each alternative goal.

    The convex parts of a goal lanelet are goals. The goals of a planning problem are sorted: first
    the goal whose distance from the start is closest to the distance driven at the initial speed.
    The car's speed is limited to the map's greatest speed limit, or to 1.1 times the initial speed.
    """
    root, found = parse(path).getroot(), []
    lanes = {each.attrib["id"]: _sides(each) for each in root.iterfind("lanelet")}
    step, borders = float(root.attrib["timeStepSize"]), _borders(list(lanes.values()))
    allowed = max(_numbers(root, "lanelet/speedLimit"), default=SPEED)
    for node in root.iterfind("planningProblem"):
        x, y, heading, begin = _pose(initial := node.findall("initialState")[0])
        speed, rate = (_range(initial, name, 0.0)[0] for name in ("velocity", "yawRate"))
        rear = np.array([x - AHEAD * np.cos(heading), y - AHEAD * np.sin(heading), heading])
        goals = [
            (goal, region)
            for goal in node.iterfind("goalState")
            for shape in goal.iterfind("position/*")
            for region in convex_parts("goal", _polygon(shape, lanes))
        ]
        problems = []
        for goal, region in goals:
            early, late = (step * (time - begin) for time in _range(goal, "time"))
            low, high = _range(goal, "orientation", -4.0, 4.0)  # by default all headings
            slow, fast = _range(goal, "velocity", 0.0, np.inf)
            middle, ends = region.mean(axis=0), np.vstack([region, [[x, y]]])
            box = ends.min(axis=0) - MARGIN, ends.max(axis=0) + MARGIN
            walls, movers, paths = list(borders), [], []
            for obstacle in (each for each in root if each.tag.lower().endswith("obstacle")):
                states = obstacle.findall("initialState") + obstacle.findall("trajectory/state")
                poses = np.array([_pose(state) for state in states])
                times, poses[:, 2] = step * (poses[:, 3] - begin), np.unwrap(poses[:, 2])
                kept = (times >= 0.0) & (times <= late + step)
                shapes = [_polygon(shape) for shape in obstacle.iterfind("shape/*")]
                if "static" in (obstacle.findtext("role") or obstacle.tag):
                    walls += [_place(shape, *poses[0, :3]) for shape in shapes]
                elif kept.sum() > 1 and _is_near(poses[kept, :2], *box):
                    movers += shapes
                    paths += [(times[kept], poses[kept, :3])] * len(shapes)
            arguments = {
                "target": pj.TurningPath(*map(jnp.asarray, (middle, np.zeros(2), 0.0))),
                "start": rear, "initial_speed": speed, "initial_curvature": rate / max(speed, 1.0),
                "time": late, "earliest": early, "region": INSIDE * (region - middle),
                "tolerance": 0.01, "margin": 0.05, "end_heading": 0.5 * (low + high),
                "heading_tolerance": min(0.5 * INSIDE * (high - low), np.pi),
                "end_speed": (slow, fast), "speed": max(allowed, 1.1 * speed, slow + 1.0),
                "walls": [wall for wall in walls if _is_near(wall, *box)], "movers": movers,
                "mover_paths": paths, "lower": box[0], "upper": box[1], **CAR,
            }  # fmt: skip
            problem = Problem(path.name, int(node.attrib["id"]), step, arguments)
            problems.append((abs(np.hypot(*(middle - [x, y])) - speed * late), problem))
        found += [problem for _, problem in sorted(problems, key=lambda each: each[0])]
    return found


def _is_near(points: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> bool:
    return bool((points.max(axis=0) > lower).all() and (points.min(axis=0) < upper).all())


def _sides(lanelet: Element) -> list[np.ndarray]:
    """Return the left bound of a lanelet, and the right bound in reverse: a clockwise ring."""
    left, right = (_thin(_points(lanelet, name)) for name in ("leftBound", "rightBound"))
    return [left, right[::-1]]


def _borders(lanes: list[list[np.ndarray]]) -> list[np.ndarray]:
    """Return walls, 0.1 m thick, outside of the sides of the union of all lanelets.

    A side is divided into pieces of up to 0.2 m. A piece is a border if the point 0.1 m outside of
    it lies in no lanelet. The ends of lanelets are open.
    """
    walls, areas = [], [Area(np.vstack(sides)) for sides in lanes]
    for a, b in (edge for sides in lanes for side in sides for edge in pairwise(side)):
        length = max(float(np.hypot(*(b - a))), 1e-9)
        out = np.array([a[1] - b[1], b[0] - a[0]]) * 0.1 / length
        marks = np.linspace(a, b, int(np.ceil(length / 0.2)) + 1)
        probes = 0.5 * (marks[1:] + marks[:-1]) + out
        is_border = ~np.any([area.contains_points(probes) for area in areas], axis=0)
        ends = marks[np.flatnonzero(np.diff(np.concatenate([[0], is_border, [0]])))]
        walls += [np.array([p, q, q + out, p + out]) for p, q in ends.reshape(-1, 2, 2)]
    return walls


def _thin(line: np.ndarray) -> np.ndarray:
    """Leave out points of a line that lie within 0.03 m of the line without them."""
    chord = line[-1] - line[0]
    away = np.abs((line - line[0]) @ [-chord[1], chord[0]]) / max(np.hypot(*chord), 1e-9)
    k = int(away.argmax())
    halves = [_thin(line[: k + 1])[:-1], _thin(line[k:])] if away[k] > 0.03 else [line[[0, -1]]]
    return np.vstack(halves)


def _polygon(shape: Element, lanes: dict[str, list[np.ndarray]] | None = None) -> np.ndarray:
    """Return the corners of a shape; a circle becomes a polygon of 16 corners around it."""
    if lanes and shape.tag == "lanelet":
        return np.vstack(lanes[shape.attrib["ref"]])
    if shape.tag == "polygon":
        return _points(shape, ".")
    names = ("length", "width", "radius", "orientation", "center/x", "center/y")
    length, width, radius, heading, x, y = (float(shape.findtext(name, "0")) for name in names)
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * [length, width]
    if radius:
        angles = np.pi / 8 * np.arange(16)
        corners = radius / np.cos(np.pi / 16) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return _place(corners, x, y, heading)


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
