"""Read planning problems of CommonRoad scenarios (XML, 2018b or 2020a) as cases of `intercept`.

World frame of the file, SI units; time 0 is the initial state of the planning problem.

Every obstacle of a file becomes walls or movers: static and environment obstacles, recorded
trajectories, and occupancy sets, also those of phantom obstacles. An obstacle that states neither a
trajectory nor an occupancy set stands at its initial state.
"""

import dataclasses
import os
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError, XMLPullParser

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.path import Path as Area

import planner_jax as pj
from planner_jax.core.errors import PlannerJaxError
from planner_jax.host.files import open_plain
from planner_jax.plane.polygons import convex_parts

MARGIN = 15.0  # [m], distance from the box around start and goal up to which the map is read
INSIDE = 0.98  # scale of goal regions and headings, so that plans end inside despite rounding
SPEED = 13.9  # [m/s], speed limit of maps that state none: 50 km/h
# Traffic signs of 2020a that state a speed limit, in Germany, China, the USA, Spain and Russia.
SPEED_SIGNS = ("274", "274.1", "R2-1", "R301", "3.24")
LARGEST = 1 << 25  # [B], greatest size of a file
MOST_ELEMENTS, MOST_ATTRIBUTES, DEEPEST = 300_000, 50_000, 64  # of a file; depth of its elements
_SQUARE = ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))
LONGEST = 1e4  # [m], greatest distance of two neighbouring points of a lanelet
# The BMW 320i of the CommonRoad vehicle models. Its acceleration may have any direction, up to
# 11.5 m/s^2; each of the two components is limited to 11.5 m/s^2 / sqrt(2).
CAR = {
    "length": 4.508, "width": 1.610, "wheelbase": 2.5789128, "rear_overhang": 0.8312829,
    "acceleration": 8.13, "lateral_acceleration": 8.13,
    "curvature": float(np.tan(1.066)) / 2.5789128, "steering_rate": 0.4,
}  # fmt: skip
AHEAD = 0.5 * CAR["length"] - CAR["rear_overhang"]  # [m], from the rear axle to the body's middle


class ScenarioError(PlannerJaxError, ValueError):
    """Error: a file is no scenario that can be read. The message is one line and names the file."""


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

    The convex parts of a goal lanelet are goals. A goal without a position becomes a square around
    the point that the car reaches straight ahead at its initial speed. The goals of a planning
    problem are sorted: first the goal whose distance from the start is closest to the distance
    driven at the initial speed. The car's speed is limited to the map's greatest speed limit, or to
    1.1 times the initial speed.

    Raises:
        ScenarioError: the file is no scenario, has no planning problem, is larger than 32 MiB or
            300,000 elements, or a part is missing or invalid.
        OSError: the file cannot be read, or is no regular file.
    """
    try:
        found = _read(_parse(path), path.name)
        if not found:
            raise ValueError("must have a planning problem with a goal, got none")
    except (ParseError, ValueError, RecursionError) as error:
        raise ScenarioError(f"{path}: {' '.join(str(error).split())}") from None
    return found


def _parse(path: Path) -> Element:
    """Return the root of an XML file; count its elements and attributes while it is parsed."""
    parser, depth, num = XMLPullParser(("start", "end")), 0, 0
    root: Any = None
    signs = 0  # number of equality signs, which is at least the number of attributes
    with open_plain(path, LARGEST) as file:
        while block := file.read(1 << 16):
            if (signs := signs + block.count(b"=")) > MOST_ATTRIBUTES:
                raise ValueError(f"must have at most {MOST_ATTRIBUTES} attributes")
            parser.feed(block)
            events: Any = parser.read_events()
            for event, element in events:
                is_start = event == "start"
                depth, num = depth + (1 if is_start else -1), num + is_start
                root = element if root is None else root
                if num > MOST_ELEMENTS or depth > DEEPEST:
                    most = f"{MOST_ELEMENTS} elements, nested at most {DEEPEST} deep"
                    raise ValueError(f"must have at most {most}")
    parser.close()
    if root is None or root.tag != "commonRoad":
        raise ValueError("must be a scenario of CommonRoad, with the root commonRoad")
    return root


def _read(root: Element, file: str) -> list[Problem]:
    found = []
    lanes = {each.get("id", ""): _sides(each) for each in root.iterfind("lanelet")}
    step, borders = _float(root.get("timeStepSize")), _borders(list(lanes.values()))
    if step <= 0.0:
        raise ValueError(f"timeStepSize must be > 0, got {step:g}")
    signs = [
        _float(each.findtext("additionalValue"))
        for each in root.iterfind("trafficSign/trafficSignElement")
        if each.findtext("trafficSignID") in SPEED_SIGNS
    ]
    allowed = max([*_numbers(root, "lanelet/speedLimit"), *signs], default=SPEED)
    obstacles = [each for each in root if each.tag.lower().endswith("obstacle")]
    for node in root.iterfind("planningProblem"):
        x, y, heading, begin = _pose(initial := _child(node, "initialState"))
        speed, rate = (_range(initial, name, 0.0)[0] for name in ("velocity", "yawRate"))
        rear = np.array([x - AHEAD * np.cos(heading), y - AHEAD * np.sin(heading), heading])
        problems = []
        for goal, region in _goals(node, lanes, step):
            early, late = (step * (time - begin) for time in _range(goal, "time"))
            low, high = _range(goal, "orientation", -4.0, 4.0, turn=2.0 * np.pi)
            slow, fast = _range(goal, "velocity", 0.0, np.inf)
            middle, ends = region.mean(axis=0), np.vstack([region, [[x, y]]])
            box = ends.min(axis=0) - MARGIN, ends.max(axis=0) + MARGIN
            walls, movers, paths = list(borders), [], []
            for obstacle in obstacles:
                still, moving = _place_obstacle(obstacle, step, begin, late)
                walls += still
                for shape, times, poses in moving:
                    if _is_near(poses[:, :2], *box):
                        movers.append(shape)
                        paths.append((times, poses))
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
            problem = Problem(file, int(node.get("id", "0")), step, arguments)
            problems.append((abs(np.hypot(*(middle - [x, y])) - speed * late), problem))
        found += [problem for _, problem in sorted(problems, key=lambda each: each[0])]
    return found


def _goals(
    node: Element, lanes: dict[str, list[np.ndarray]], step: float
) -> list[tuple[Element, np.ndarray]]:
    """Return the alternative goals of a planning problem, each with a convex region (V, 2) [m]."""
    found = []
    for goal in node.iterfind("goalState"):
        shapes = [_polygon(shape, lanes) for shape in goal.iterfind("position/*")]
        if not shapes:
            x, y, heading, begin = _pose(initial := _child(node, "initialState"))
            late = step * (_range(goal, "time")[1] - begin)
            far = _range(initial, "velocity", 0.0)[0] * late
            square = max(far, 2.0 * CAR["length"]) * np.array(_SQUARE)
            shapes = [_place(square, x + far * np.cos(heading), y + far * np.sin(heading), heading)]
        found += [(goal, part) for shape in shapes for part in convex_parts("goal", shape)]
    return found


def _place_obstacle(
    obstacle: Element, step: float, begin: float, late: float
) -> tuple[list[np.ndarray], list[tuple[np.ndarray, np.ndarray, np.ndarray]]]:
    """Return the walls of an obstacle, and its movers: shapes (V, 2), times (K,), poses (K, 3).

    The times [s] of the movers are from 0 to `late` and one step later.
    """
    shapes = [_polygon(shape) for shape in obstacle.iterfind("shape/*")]
    states = obstacle.findall("initialState") + obstacle.findall("trajectory/state")
    occupied = obstacle.findall("occupancySet/occupancy")
    if not occupied and not (shapes and (states or obstacle.tag == "environmentObstacle")):
        name = f"{obstacle.tag} {obstacle.get('id')}"
        raise ValueError(f"{name} must have a shape and a state, or an occupancySet")
    poses = np.array([_pose(state) for state in states]).reshape(-1, 4)
    # The first state of a trajectory may repeat the initial state.
    times, first = np.unique(step * (poses[:, 3] - begin), return_index=True)
    poses = poses[first, :3]
    poses[:, 2] = np.unwrap(poses[:, 2])
    role = obstacle.findtext("role") or obstacle.tag
    if not occupied and ("static" in role or len(poses) < 2):
        if not len(poses):
            return shapes, []  # an environment obstacle, in the frame of the world
        return [_place(shape, *poses[0]) for shape in shapes], []
    moving = [(shape, times, poses) for shape in shapes if len(poses)]
    for each in occupied:  # a shape stands still from half a step before to half a step after
        ends = step * (np.array(_range(each, "time")) + [-0.5, 0.5] - begin)
        for shape in (_polygon(shape) for shape in each.iterfind("shape/*")):
            middle = shape.mean(axis=0)
            moving.append((shape - middle, ends, np.array([[*middle, 0.0]] * 2)))
    return [], [kept for each in moving if (kept := _keep(*each, step, late))]


def _keep(
    shape: np.ndarray, times: np.ndarray, poses: np.ndarray, step: float, late: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return a mover with its states from time 0 to one step after `late`; None without any."""
    if len(times) == 1:  # a state at one time is valid from half a step before to half a step after
        times, poses = times + step * np.array([-0.5, 0.5]), np.repeat(poses, 2, axis=0)
    if times[-1] <= 0.0 or times[0] >= late + step:
        return None
    begin = max(int(np.searchsorted(times, 0.0, "right")) - 1, 0)
    end = int(np.searchsorted(times, late + step)) + 1
    return shape, times[begin:end], poses[begin:end]


def _is_near(points: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> bool:
    return bool((points.max(axis=0) > lower).all() and (points.min(axis=0) < upper).all())


def _sides(lanelet: Element) -> list[np.ndarray]:
    """Return the left bound of a lanelet, and the right bound in reverse: a clockwise ring."""
    lines = [_points(_child(lanelet, name), ".") for name in ("leftBound", "rightBound")]
    for line in lines:
        if len(line) < 2 or np.abs(np.diff(line, axis=0)).max() > LONGEST:
            rule = f"two or more points that are at most {LONGEST:g} m apart"
            raise ValueError(f"a bound of lanelet {lanelet.get('id')} must have {rule}")
    left, right = map(_thin, lines)
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
    """Return the corners of a shape; a circle becomes a polygon of 16 corners around it.

    `lanes` are the lanelets of the file, by their names; None if the shape must not be a lanelet.
    """
    if lanes is not None and shape.tag == "lanelet":
        if (name := shape.get("ref")) not in lanes:
            raise ValueError(f"a goal must be on a lanelet of the file, got {name}")
        return np.vstack(lanes[name])
    if shape.tag == "polygon":
        return _points(shape, ".")
    if shape.tag not in ("rectangle", "circle"):
        raise ValueError(f"a shape must be a rectangle, circle or polygon, got {shape.tag}")
    names = ("length", "width", "radius", "orientation", "center/x", "center/y")
    length, width, radius, heading, x, y = (_float(shape.findtext(name, "0")) for name in names)
    corners = np.array(_SQUARE) * [length, width]
    if radius:
        angles = np.pi / 8 * np.arange(16)
        corners = radius / np.cos(np.pi / 16) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return _place(corners, x, y, heading)


def _place(corners: np.ndarray, x: float, y: float, heading: float) -> np.ndarray:
    cos, sin = np.cos(heading), np.sin(heading)
    return corners @ [[cos, sin], [-sin, cos]] + [x, y]


def _child(node: Element, name: str) -> Element:
    if (found := node.find(name)) is None:
        raise ValueError(f"{node.tag} {node.get('id', '')} must have {name}")
    return found


def _float(text: str | None) -> float:
    try:
        number = float(text or "")
    except ValueError:
        number = np.nan
    if not np.isfinite(number):
        raise ValueError(f"a number must be finite and decimal, got {text!r:.40}")
    return number


def _numbers(node: Element, path: str) -> list[float]:
    return [_float(each.text) for each in node.iterfind(path)]


def _range(node: Element, name: str, *default: float, turn: float = 0.0) -> tuple[float, float]:
    """Return the ends of an interval; an interval of angles may pass the full `turn` [rad]."""
    values = _numbers(node, f"{name}/*") or default
    if not values:
        raise ValueError(f"{node.tag} must have {name}")
    low, high = values[0], values[-1]
    high += turn * (high < low)
    if high < low:
        raise ValueError(f"{name} of {node.tag} must rise, got {low:g} to {high:g}")
    return low, high


def _pose(state: Element) -> tuple[float, ...]:
    """Return x, y [m], heading [rad], and the time step; means of those that are uncertain."""
    paths = ("position//x", "position//y", "orientation/*", "time/*")
    found = [_numbers(state, path) for path in paths]
    if not all(found):
        raise ValueError(f"{state.tag} must have a position, an orientation and a time")
    return tuple(float(np.mean(each)) for each in found)


def _points(node: Element, name: str) -> np.ndarray:
    axes = [_numbers(node, f"{name}/point/{axis}") for axis in "xy"]
    if len(axes[0]) != len(axes[1]):
        raise ValueError(f"every point of {node.tag} must have x and y")
    return np.stack(axes, axis=1)
