"""The loops of `hybrid_astar`, compiled by numba; importing this module requires numba.

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

FOUND, NOT_FOUND, BLOCKED = 0, 1, 2  # status of a search
# Number of arcs from a node: left at full and half curvature, straight, right at half and full.
PRIMITIVES = 5


class Scene(NamedTuple):
    """The obstacles, the map, and the discs that cover the car's body."""

    polygons: np.ndarray  # (N, V, 2) [m], convex, counter-clockwise
    present: np.ndarray  # (N,) bool
    lower: np.ndarray  # (2,) [m], corner of the map
    upper: np.ndarray  # (2,) [m], the opposite corner
    middle: float  # [m], distance of the body's centre ahead of the rear axle
    offsets: np.ndarray  # (D,) [m], distances of the discs' centres ahead of the rear axle
    clear: float  # [m], least distance of a disc's centre from a polygon
    corner: np.ndarray  # (2,) [m], least coordinates of a grid that contains rear axle and discs
    shape: tuple[int, int]  # number of cells of this grid along x and y


class Goal(NamedTuple):
    """The goal of a search: a pose, or a point for the body's centre with a free heading."""

    pose: np.ndarray  # (3,), of the rear axle; x and y of the point if the heading is free
    has_heading: bool


class Rules(NamedTuple):
    """Settings of a search: greatest curvature, grid, costs, and greatest number of nodes."""

    curvature: float  # [1/m], greatest curvature
    cell: float  # [m], side of a square cell of the search grid
    headings: int  # number of heading bins in a full turn
    price: float  # added cost [m] per metre driven at the greatest curvature
    slack: float  # the heuristic is multiplied by 1 + slack
    max_expansions: int  # number of expanded nodes after which the search gives up


class _Field(NamedTuple):
    """Distances from the nearest polygon at the nodes of a grid, computed before a search."""

    far: np.ndarray  # (X, Y) [m], distance of each node
    corner: np.ndarray  # (2,) [m], position of node (0, 0)
    step: float  # [m], distance between neighbouring nodes


class _Primitives(NamedTuple):
    """The arcs that lead from a node to its neighbours, sampled at M points."""

    reach: float  # [m], length of every arc
    bins: np.ndarray  # (PRIMITIVES,) int, heading change of each arc, in heading bins
    moves: np.ndarray  # (PRIMITIVES, M, 2) [m], samples ahead and to the left of the node
    # (headings, PRIMITIVES, M, 2), cos and sin of the samples' headings for each node heading.
    directions: np.ndarray


class _Tree(NamedTuple):
    """The nodes that a search has reached, at most one per cell of position and heading."""

    place: np.ndarray  # (nodes, 3), x [m], y [m], and cost from the start [m]
    bin: np.ndarray  # (nodes,) int32, heading bin relative to the start's heading
    parent: np.ndarray  # (nodes,) int32, index of the previous node; -1 for the start
    primitive: np.ndarray  # (nodes,) int32, index of the arc from the parent
    # (cells,) int32, of each grid cell: 0 if unreached, n + 1 for node n, -n - 1 if n is expanded.
    node: np.ndarray


@njit(cache=True)
def _distance(x, y, polygon):
    """Return the signed distance of a point from a convex counter-clockwise polygon (V, 2)."""
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
    """Return distances [m] from the nearest polygon at the nodes of a grid, at most `cap`.

    Args:
        polygons: (N, V, 2) [m].
        present: (N,) bool.
        corner: (2,) [m], position of node (0, 0).
        step: [m], distance between neighbouring nodes.
        shape: number of nodes along x and y.
        cap: [m], > 0, greatest distance that is computed.
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
def _interpolate(field, x, y):
    """Interpolate a distance field bilinearly at a position in grid steps, clamped to the grid."""
    x = min(max(x, 0.0), field.shape[0] - 1.000001)
    y = min(max(y, 0.0), field.shape[1] - 1.000001)
    i, j = int(x), int(y)
    u, v = x - i, y - j
    low = (1.0 - v) * field[i, j] + v * field[i, j + 1]
    high = (1.0 - v) * field[i + 1, j] + v * field[i + 1, j + 1]
    return (1.0 - u) * low + u * high


@njit(cache=True)
def _is_free(x, y, cos, sin, scene, field):
    """Return whether the body with its rear axle at (x, y) [m] is on the map and collision-free."""
    mid_x, mid_y = x + scene.middle * cos, y + scene.middle * sin
    if mid_x < scene.lower[0] or mid_x > scene.upper[0]:
        return False
    if mid_y < scene.lower[1] or mid_y > scene.upper[1]:
        return False
    for k in range(scene.offsets.shape[0]):
        at_x = (x + scene.offsets[k] * cos - field.corner[0]) / field.step
        at_y = (y + scene.offsets[k] * sin - field.corner[1]) / field.step
        if _interpolate(field.far, at_x, at_y) < scene.clear:
            return False
    return True


@njit(cache=True)
def _is_free_at(pose, scene, field):
    return _is_free(pose[0], pose[1], math.cos(pose[2]), math.sin(pose[2]), scene, field)


@njit(cache=True)
def _compute_field(scene, cell):
    shape = (2 * scene.shape[0] + 1, 2 * scene.shape[1] + 1)
    cap = scene.clear + cell
    far = distance_field(scene.polygons, scene.present, scene.corner, 0.5 * cell, shape, cap)
    return _Field(far, scene.corner, 0.5 * cell)


@njit(cache=True)
def _list_goal_poses(goal, scene, num):
    """Return the goal's pose (1, 3), or poses with `num` headings (num, 3) if it has no heading."""
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
    """Return whether the body collides at the start, or at every pose of the goal."""
    if not _is_free_at(start, scene, field):
        return True
    poses = _list_goal_poses(goal, scene, 72)
    for k in range(poses.shape[0]):
        if _is_free_at(poses[k], scene, field):
            return False
    return True


@njit(cache=True)
def _compute_primitives(start_heading, rules):
    """Compute the arcs that the search tries from a node, long enough to leave a grid cell."""
    width = TURN / rules.headings
    turns = 2
    while turns * width / rules.curvature <= math.sqrt(2.0) * rules.cell:
        turns += 2  # even, since an arc of half the curvature turns by half as many bins
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
    return math.sin(x) / x if abs(x) > 1e-9 else 1.0


@njit(cache=True)
def _is_free_along(pose, parts, senses, curvature, scene, field):
    """Return whether a Dubins path of three arcs or lines from a pose is collision-free."""
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
def _shoot(pose, goal, bound, rules, scene, field, lengths):
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
    """Return the index of the cell that contains (x, y, heading), or -1 outside the grid."""
    i = int((x - field.corner[0]) / (2.0 * field.step))
    j = int((y - field.corner[1]) / (2.0 * field.step))
    num_x, num_y = field.far.shape[0] // 2, field.far.shape[1] // 2
    if x < field.corner[0] or y < field.corner[1] or i >= num_x or j >= num_y:
        return -1
    return (i * num_y + j) * headings + heading_bin


@njit(cache=True)
def _is_free_primitive(tree, node, p, primitives, scene, field):
    x, y, k = tree.place[node, 0], tree.place[node, 1], tree.bin[node]
    # The node's heading is the heading of the first sample on the straight arc.
    cos, sin = primitives.directions[k, PRIMITIVES // 2, 0]
    for m in range(primitives.moves.shape[1]):
        ahead, aside = primitives.moves[p, m]
        new_cos, new_sin = primitives.directions[k, p, m]
        new_x, new_y = x + cos * ahead - sin * aside, y + sin * ahead + cos * aside
        if not _is_free(new_x, new_y, new_cos, new_sin, scene, field):
            return False
    return True


@njit(cache=True)
def _trace_back(tree, node, primitives, lengths, senses, curvature):
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
    tree.place[node, 0], tree.place[node, 1], tree.place[node, 2] = x, y, cost
    tree.bin[node], tree.parent[node], tree.primitive[node] = heading_bin, parent, primitive


@njit(cache=True)
def _expand(node, num, best_cost, start, goal, scene, rules, field, primitives, tree, heap):
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
    """Run Hybrid A*, a search over cells of position and heading, from a pose to a goal.

    Args:
        start: (3,) x, y [m] of the rear axle and heading [rad].
        goal: goal of the path.
        scene: obstacles, map and body.
        rules: settings and limits.
        node_of: (cells * heading bins,) int32 zeros, overwritten with the node that the search
            reached in each cell. They are an argument, since NumPy allocates zeros much faster than
            numba.

    Returns:
        Status (FOUND, NOT_FOUND or BLOCKED), curvatures (P,) [1/m] and lengths (P,) [m] of the P
        parts of the path, its cost [m], and the number of expanded nodes.
    """
    none = np.zeros(0)
    field = _compute_field(scene, rules.cell)
    if _is_blocked(start, goal, scene, field):
        return BLOCKED, none, none, np.inf, 0
    primitives = _compute_primitives(start[2], rules)
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
        if wait <= 0:  # near the goal a direct path is tried more often
            row, rest = _shoot(pose, goal, best_cost - cost, rules, scene, field, lengths)
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
    curvatures, parts = _trace_back(
        tree, best_node, primitives, best_lengths, SENSES[best_row], rules.curvature
    )
    return FOUND, curvatures, parts, best_cost, expansions
