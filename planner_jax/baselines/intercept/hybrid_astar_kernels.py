"""The loops of `hybrid_astar`, compiled by numba, which this module needs.

All code is scalar and runs on the host in float64. A pose is x [m], y [m] and heading [rad] of the
rear axle in the world frame.
"""

import heapq
import math
from typing import NamedTuple

import numpy as np
from numba import njit

from planner_jax.baselines.intercept.dubins_kernels import (
    SENSES,
    TURN,
    in_frame,
    least_length,
    words_to_point,
    words_to_pose,
)

FOUND, NOT_FOUND, BLOCKED = 0, 1, 2
PRIMITIVES = 5  # full and half curvature to the left, straight, and likewise to the right


class Scene(NamedTuple):
    """What is in the way of a body, and where on the map its middle may be."""

    polygons: np.ndarray  # (N, V, 2) [m], convex, counter-clockwise
    present: np.ndarray  # (N,) bool
    lower: np.ndarray  # (2,) [m], corner of the map
    upper: np.ndarray  # (2,) [m], the opposite corner
    middle: float  # [m], how far the body's middle is ahead of the rear axle
    places: np.ndarray  # (D,) [m], likewise of the discs that cover it
    clear: float  # [m], least distance of a disc's middle from a polygon
    corner: np.ndarray  # (2,) [m], of a grid on which the rear axle and all discs are
    shape: tuple[int, int]  # of that grid, in cells


class Goal(NamedTuple):
    """A pose, or a point for the body's middle, where the heading is free."""

    pose: np.ndarray  # (3,), of the rear axle; of a point its x and y
    has_heading: bool


class Rules(NamedTuple):
    """What a search may do, and what it costs."""

    curvature: float  # [1/m], the tightest
    cell: float  # [m], side of a cell
    headings: int  # bins of a turn
    price: float  # what a metre at the tightest curvature costs more than a straight one [m]
    slack: float  # by how much, relative, the heuristic is stretched
    max_expansions: int


class _Field(NamedTuple):
    """Distances at the nodes of a grid, at which a search looks things up."""

    far: np.ndarray  # (X, Y) [m], from the nearest polygon
    corner: np.ndarray  # (2,) [m], of the node (0, 0)
    step: float  # [m], between nodes


class _Primitives(NamedTuple):
    """Arcs of one length, of which every one turns by whole bins."""

    reach: float  # [m], their length
    bins: np.ndarray  # (PRIMITIVES,) int, by which they turn
    moves: np.ndarray  # (PRIMITIVES, M, 2) [m], to each sample, in the frame of their start
    directions: np.ndarray  # (headings, PRIMITIVES, M, 2), cos and sin of the heading there


class _Tree(NamedTuple):
    """Nodes that were reached, one a cell."""

    place: np.ndarray  # (nodes, 3), x [m], y [m], and the cost so far [m]
    bin: np.ndarray  # (nodes,) int32, of heading from that of the start
    parent: np.ndarray  # (nodes,) int32, -1 of the start
    primitive: np.ndarray  # (nodes,) int32, that led here
    node: np.ndarray  # (cells,) int32, n + 1 of the node n in a cell, -n - 1 once it is expanded


@njit(cache=True)
def _distance(x, y, polygon):
    """How far a point is outside of a convex polygon (V, 2), counter-clockwise; negative inside."""
    nearest, highest = np.inf, -np.inf
    before_x, before_y = polygon[-1, 0], polygon[-1, 1]
    for k in range(polygon.shape[0]):
        edge_x, edge_y = polygon[k, 0] - before_x, polygon[k, 1] - before_y
        square = edge_x**2 + edge_y**2
        if square > 1e-12:
            from_x, from_y = x - before_x, y - before_y
            share = min(max((from_x * edge_x + from_y * edge_y) / square, 0.0), 1.0)
            away = (from_x - share * edge_x) ** 2 + (from_y - share * edge_y) ** 2
            nearest = min(nearest, away)
            highest = max(highest, (from_x * edge_y - from_y * edge_x) / math.sqrt(square))
        before_x, before_y = polygon[k, 0], polygon[k, 1]
    return math.sqrt(nearest) if highest > 0.0 else highest


@njit(cache=True)
def distance_field(polygons, present, corner, step, shape, cap):
    """Distance [m] from the nearest polygon at the nodes of a grid, `cap` where it is greater.

    Args:
        polygons: (N, V, 2) [m].
        present: (N,) bool.
        corner: (2,) [m], the node (0, 0).
        step: [m], between nodes.
        shape: how many nodes along x and y.
        cap: [m], > 0.
    """
    field = np.full(shape, cap)
    for k in range(polygons.shape[0]):
        if not present[k]:
            continue
        low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
        for v in range(polygons.shape[1]):
            x = (polygons[k, v, 0] - corner[0]) / step
            y = (polygons[k, v, 1] - corner[1]) / step
            low_x, low_y = min(low_x, x), min(low_y, y)
            high_x, high_y = max(high_x, x), max(high_y, y)
        reach = cap / step
        for i in range(max(int(low_x - reach), 0), min(int(high_x + reach) + 2, shape[0])):
            for j in range(max(int(low_y - reach), 0), min(int(high_y + reach) + 2, shape[1])):
                x, y = corner[0] + i * step, corner[1] + j * step
                field[i, j] = min(field[i, j], _distance(x, y, polygons[k]))
    return field


@njit(cache=True)
def _between_nodes(field, x, y):
    """Bilinear value of a field at a place counted in nodes, held at the grid's edge."""
    x = min(max(x, 0.0), field.shape[0] - 1.000001)
    y = min(max(y, 0.0), field.shape[1] - 1.000001)
    i, j = int(x), int(y)
    u, v = x - i, y - j
    low = (1.0 - v) * field[i, j] + v * field[i, j + 1]
    high = (1.0 - v) * field[i + 1, j] + v * field[i + 1, j + 1]
    return (1.0 - u) * low + u * high


@njit(cache=True)
def _is_free(x, y, cos, sin, scene, field):
    """Whether the body is on the map and clear of polygons, the rear axle at (x, y) [m]."""
    mid_x, mid_y = x + scene.middle * cos, y + scene.middle * sin
    if mid_x < scene.lower[0] or mid_x > scene.upper[0]:
        return False
    if mid_y < scene.lower[1] or mid_y > scene.upper[1]:
        return False
    for k in range(scene.places.shape[0]):
        at_x = (x + scene.places[k] * cos - field.corner[0]) / field.step
        at_y = (y + scene.places[k] * sin - field.corner[1]) / field.step
        if _between_nodes(field.far, at_x, at_y) < scene.clear:
            return False
    return True


@njit(cache=True)
def _free_at(pose, scene, field):
    """Whether a pose is."""
    return _is_free(pose[0], pose[1], math.cos(pose[2]), math.sin(pose[2]), scene, field)


@njit(cache=True)
def _field_around(scene, cell):
    """The field of a scene; two of its steps are a cell."""
    shape = (2 * scene.shape[0] + 1, 2 * scene.shape[1] + 1)
    cap = scene.clear + cell
    far = distance_field(scene.polygons, scene.present, scene.corner, 0.5 * cell, shape, cap)
    return _Field(far, scene.corner, 0.5 * cell)


@njit(cache=True)
def _goal_poses(goal, scene, num):
    """Poses at the goal: the one, or of a free heading so many (num, 3)."""
    back = 0.0 if goal.has_heading else scene.middle
    poses = np.empty((1 if goal.has_heading else num, 3))
    for k in range(poses.shape[0]):
        heading = goal.pose[2] + TURN * k / num
        poses[k, 0] = goal.pose[0] - back * math.cos(heading)
        poses[k, 1] = goal.pose[1] - back * math.sin(heading)
        poses[k, 2] = heading
    return poses


@njit(cache=True)
def _is_blocked(start, goal, scene, field):
    """Whether the body cannot stand at the start, or in no way at the goal."""
    if not _free_at(start, scene, field):
        return True
    poses = _goal_poses(goal, scene, 72)
    for k in range(poses.shape[0]):
        if _free_at(poses[k], scene, field):
            return False
    return True


@njit(cache=True)
def _primitives(start_heading, rules):
    """Arcs longer than a cell's diagonal, sampled at most half a cell apart."""
    width = TURN / rules.headings
    turns = 2
    while turns * width / rules.curvature <= math.sqrt(2.0) * rules.cell:
        turns += 2  # half the curvature turns by half of them
    reach = turns * width / rules.curvature
    num = int(math.ceil(reach / (0.5 * rules.cell)))
    half = turns // 2
    bins = np.array([turns, half, 0, -half, -turns])
    moves = np.zeros((PRIMITIVES, num, 2))
    directions = np.zeros((rules.headings, PRIMITIVES, num, 2))
    for p in range(PRIMITIVES):
        for m in range(num):
            length = reach * (m + 1) / num
            bend = width * bins[p] * (m + 1) / num
            chord = length * _sinc(0.5 * bend)
            moves[p, m, 0] = chord * math.cos(0.5 * bend)
            moves[p, m, 1] = chord * math.sin(0.5 * bend)
            for k in range(rules.headings):
                directions[k, p, m, 0] = math.cos(start_heading + width * k + bend)
                directions[k, p, m, 1] = math.sin(start_heading + width * k + bend)
    return _Primitives(reach, bins, moves, directions)


@njit(cache=True)
def _sinc(x):
    """sin(x) / x."""
    return math.sin(x) / x if abs(x) > 1e-9 else 1.0


@njit(cache=True)
def _is_free_along(pose, parts, senses, curvature, scene, field):
    """Whether a way of three parts [m] from a pose is free all along."""
    x, y, heading = pose[0], pose[1], pose[2]
    for k in range(3):
        if parts[k] > 0.0:
            num = int(math.ceil(parts[k] / field.step))
            bend = senses[k] * curvature * parts[k] / num
            chord = parts[k] / num * _sinc(0.5 * bend)
            for _ in range(num):
                x += chord * math.cos(heading + 0.5 * bend)
                y += chord * math.sin(heading + 0.5 * bend)
                heading += bend
                if not _is_free(x, y, math.cos(heading), math.sin(heading), scene, field):
                    return False
    return True


@njit(cache=True)
def _shot(pose, goal, bound, rules, scene, field, lengths):
    """The cheapest free word to the goal of all that cost less than a bound [m].

    Returns its row of `lengths` [m], -1 if there is none, and its cost [m].
    """
    x, y = in_frame(pose, goal, rules.curvature)
    if goal.has_heading:
        words_to_pose(x, y, goal.pose[2] - pose[2], lengths)
    else:
        words_to_point(x, y, lengths)
    costs = np.empty(6)
    for row in range(6):
        costs[row] = 0.0
        for k in range(3):
            lengths[row, k] /= rules.curvature
            costs[row] += lengths[row, k] * (1.0 + rules.price * abs(SENSES[row, k]))
        if not goal.has_heading:
            lengths[row, 1] -= scene.middle
            costs[row] = costs[row] - scene.middle if lengths[row, 1] >= 0.0 else np.inf
    for _ in range(6):
        row = 0
        for other in range(6):
            row = other if costs[other] < costs[row] else row
        if not costs[row] < bound:
            break
        if _is_free_along(pose, lengths[row], SENSES[row], rules.curvature, scene, field):
            return row, costs[row]
        costs[row] = np.inf
    return -1, np.inf


@njit(cache=True)
def _empty_tree(node_of, max_expansions):
    """A tree without nodes, with room for all that so many expansions can reach."""
    most = min(PRIMITIVES * max_expansions, node_of.size) + 1
    return _Tree(
        np.empty((most, 3)),
        np.empty(most, np.int32),
        np.empty(most, np.int32),
        np.empty(most, np.int32),
        node_of,
    )


@njit(cache=True)
def _cell_of(x, y, heading_bin, field, headings):
    """Number of the cell (x, y, heading), -1 off the grid."""
    i = int((x - field.corner[0]) / (2.0 * field.step))
    j = int((y - field.corner[1]) / (2.0 * field.step))
    num_x, num_y = field.far.shape[0] // 2, field.far.shape[1] // 2
    if x < field.corner[0] or y < field.corner[1] or i >= num_x or j >= num_y:
        return -1
    return (i * num_y + j) * headings + heading_bin


@njit(cache=True)
def _is_free_primitive(tree, node, p, primitives, scene, field):
    """Whether a primitive from a node is free all along."""
    x, y, k = tree.place[node, 0], tree.place[node, 1], tree.bin[node]
    # The heading of a node is that of the straight primitive.
    cos, sin = primitives.directions[k, PRIMITIVES // 2, 0]
    for m in range(primitives.moves.shape[1]):
        ahead, aside = primitives.moves[p, m]
        new_cos, new_sin = primitives.directions[k, p, m]
        new_x, new_y = x + cos * ahead - sin * aside, y + sin * ahead + cos * aside
        if not _is_free(new_x, new_y, new_cos, new_sin, scene, field):
            return False
    return True


@njit(cache=True)
def _way_back(tree, node, primitives, lengths, senses, curvature):
    """Curvatures [1/m] and lengths [m] of primitives to a node and of the three parts after it."""
    count, back = 0, node
    while tree.parent[back] >= 0:
        back = tree.parent[back]
        count += 1
    curvatures, parts = np.empty(count + 3), np.empty(count + 3)
    for m in range(count - 1, -1, -1):
        curvatures[m] = 0.5 * (PRIMITIVES // 2 - tree.primitive[node]) * curvature
        parts[m] = primitives.reach
        node = tree.parent[node]
    for m in range(3):
        curvatures[count + m], parts[count + m] = senses[m] * curvature, lengths[m]
    return curvatures, parts


@njit(cache=True)
def _enter(tree, node, parent, primitive, x, y, cost, heading_bin):
    """Write a node."""
    tree.place[node, 0], tree.place[node, 1], tree.place[node, 2] = x, y, cost
    tree.bin[node], tree.parent[node], tree.primitive[node] = heading_bin, parent, primitive


@njit(cache=True)
def _expand(node, num, best_cost, start, goal, scene, rules, field, primitives, tree, heap):
    """Reach the neighbours of a node; how many of the tree's nodes are then in use."""
    x, y, cost, k = tree.place[node, 0], tree.place[node, 1], tree.place[node, 2], tree.bin[node]
    cos, sin = primitives.directions[k, PRIMITIVES // 2, 0]
    last = primitives.moves.shape[1] - 1
    pose, lengths = np.empty(3), np.empty((6, 3))
    for p in range(PRIMITIVES):
        ahead, aside = primitives.moves[p, last]
        pose[0], pose[1] = x + cos * ahead - sin * aside, y + sin * ahead + cos * aside
        heading_bin = (k + primitives.bins[p]) % rules.headings
        cell = _cell_of(pose[0], pose[1], heading_bin, field, rules.headings)
        if cell < 0 or tree.node[cell] < 0:
            continue
        turning = 0.5 * abs(p - PRIMITIVES // 2)
        new_cost = cost + primitives.reach * (1.0 + rules.price * turning)
        known = tree.node[cell] - 1
        if known >= 0 and tree.place[known, 2] <= new_cost:
            continue
        if new_cost >= best_cost:
            continue
        if not _is_free_primitive(tree, node, p, primitives, scene, field):
            continue
        pose[2] = start[2] + TURN / rules.headings * heading_bin
        rest = max(0.0, least_length(pose, goal, scene.middle, rules.curvature, lengths))
        if known < 0:
            known = num
            num += 1
            tree.node[cell] = num
        _enter(tree, known, node, p, pose[0], pose[1], new_cost, heading_bin)
        heapq.heappush(heap, (new_cost + (1.0 + rules.slack) * rest, known))
    return num


@njit(cache=True)
def search(start, goal, scene, rules, node_of):
    """Hybrid A* from a pose (3,) to a `Goal` in a `Scene` by `Rules`.

    Args:
        start: (3,).
        goal: a `Goal`.
        scene: a `Scene`.
        rules: `Rules`.
        node_of: (cells and headings,) int32, zeros to write to; NumPy gets them from the system
            without touching them.

    Returns:
        Status (FOUND, NOT_FOUND or BLOCKED), curvatures (P,) [1/m] and lengths (P,) [m] of the
        parts of the way, its cost [m], and how many nodes were expanded.
    """
    none = np.zeros(0)
    field = _field_around(scene, rules.cell)
    if _is_blocked(start, goal, scene, field):
        return BLOCKED, none, none, np.inf, 0
    primitives = _primitives(start[2], rules)
    tree = _empty_tree(node_of, rules.max_expansions)
    _enter(tree, 0, -1, 0, start[0], start[1], 0.0, 0)
    tree.node[_cell_of(start[0], start[1], 0, field, rules.headings)] = 1
    num, expansions, wait = 1, 0, 0
    best_cost, best_node, best_row = np.inf, -1, -1
    pose, lengths, best_lengths = np.empty(3), np.empty((6, 3)), np.empty(3)
    heap = [(0.0, 0)]
    while len(heap) > 0 and expansions < rules.max_expansions:
        bound, node = heapq.heappop(heap)
        if best_cost <= bound:
            break
        pose[0], pose[1], cost = tree.place[node, 0], tree.place[node, 1], tree.place[node, 2]
        pose[2] = start[2] + TURN / rules.headings * tree.bin[node]
        cell = _cell_of(pose[0], pose[1], tree.bin[node], field, rules.headings)
        if tree.node[cell] < 0:
            continue
        tree.node[cell] *= -1
        expansions += 1
        wait -= 1
        if wait <= 0:  # shots are the more frequent, the nearer the goal is
            row, rest = _shot(pose, goal, best_cost - cost, rules, scene, field, lengths)
            if row >= 0:
                best_cost, best_node, best_row = cost + rest, node, row
                for k in range(3):
                    best_lengths[k] = lengths[row, k]
            wait = int((bound - cost) / (4.0 * primitives.reach))
        num = _expand(
            node, num, best_cost, start, goal, scene, rules, field, primitives, tree, heap
        )
    if best_node < 0:
        return NOT_FOUND, none, none, np.inf, expansions
    curvatures, parts = _way_back(
        tree, best_node, primitives, best_lengths, SENSES[best_row], rules.curvature
    )
    return FOUND, curvatures, parts, best_cost, expansions
