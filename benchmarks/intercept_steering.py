"""Search for a car's motion to a moving target with the steering angle as a part of the state.

`benchmarks.intercept_oracle --steering` uses this search. A motion that it finds keeps every limit,
also the limit of the steering rate, and the referee accepts it: speed and curvature are linear in
time between knots that are `STEP` apart, as in a plan. So a motion proves that a case is feasible.
A failure is no proof, since states are merged and discarded. The search shares no code with the
planners. Positions are in the plane of the world frame, in SI units.

A state has x, y, heading, speed and curvature. In each step the acceleration is one of three and
the steering rate is one of five, so a state has 15 successors. Those that exceed a limit or collide
are discarded. Two lattices (`intercept_lattice`), searched backwards from the meeting, guide the
search: only states from which the lattice `MINIMAL` reaches the meeting are continued, and states
from which `STRICT` reaches it are preferred. Of the states in one small cell one is continued. Of
more than `most` states a random subset is continued, spread evenly over larger cells. The search is
repeated with more states and smaller cells until it finds a motion.
"""

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.intercept_departure import is_free
from planner_jax.benchmarks.intercept_lattice import (
    CELL,
    HEADINGS,
    MINIMAL,
    STRICT,
    Lattice,
    Rules,
    Scene,
    shift_bits,
    spread,
)
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan

STEP = 0.125  # [s] Greatest length of a time step.
_PARTS = 8  # Number of parts of a step; obstacles are checked after each part.
# Sizes of a cell, within which states are merged: x [m], y [m], heading [rad], speed [m/s] and
# curvature [1/m].
_CELL = np.array([0.015, 0.015, 0.03, 0.06, 0.25])
_LARGE = np.array([0.1, 0.1, 0.2, 0.3, 10.0])  # Sizes of cells over which states are spread.
# Repeated searches: greatest number of states, and factor on `_CELL`.
EFFORTS = ((4_000, 1.5), (20_000, 1.0), (80_000, 0.6))
_RATES = np.array([-1.0, -0.35, 0.0, 0.35, 1.0])  # Steering rates, relative to their limit.
_PEDALS = np.array([-1.0, 0.0, 1.0])  # Accelerations, relative to their limit.
_PREFERENCE = 4.0  # Number of preferred states that are continued for each other state.
_CANDIDATES = 64  # Greatest number of motions that a search returns.


class Guide:
    """States from which a lattice car meets the target at the end of a scene."""

    def __init__(self, scene: Scene, rules: Rules, widen: bool):
        lattice = Lattice(scene, rules)
        self.scene, self.stride, self.origin = scene, lattice.stride, lattice.origin
        self.count, self.rise = lattice.count, lattice.levels[1]
        self.size = (int(lattice.count[1]) * lattice.stride + 7) // 8 + 1
        num = lattice.layers
        planes = [lattice.goal(num)] * len(lattice.levels)
        self.bits = [self._pack(planes, widen)]
        for layer in range(num - 1, -1, -1):
            planes = self._step_back(lattice, planes, layer)
            self.bits.append(self._pack(planes, widen))
        self.bits.reverse()

    def _step_back(self, lattice: Lattice, planes: list, layer: int) -> list:
        """Return the states from which a time step leads to one of the states `planes`."""

        def move(planes: list, half: int) -> list:
            return [
                [
                    shift_bits(plane & lattice.free(half + 1, h), -by) & lattice.free(half, h)
                    if plane
                    else 0
                    for h, (plane, by) in enumerate(zip(row, shifts, strict=True))
                ]
                for row, shifts in zip(planes, lattice.shifts[half], strict=True)
            ]

        planes = move(planes, 2 * layer + 1)
        planes = [spread(row, turn) for row, turn in zip(planes, lattice.turns[layer], strict=True)]
        planes = [
            [a | b | c for a, b, c in zip(*lattice.neighbours(planes, k), strict=True)]
            for k in range(len(planes))
        ]
        return move(planes, 2 * layer)

    def _pack(self, planes: list, widen: bool) -> np.ndarray:
        """Return the bits (S, HEADINGS, bytes) of a set; `widen` adds all neighbouring cells."""
        if widen:
            planes = [spread(row, 1) for row in planes]
            planes = [[p | p << 1 | p >> 1 for p in row] for row in planes]
            planes = [[p | p << self.stride | p >> self.stride for p in row] for row in planes]
        limit = (1 << 8 * self.size) - 1
        packed = b"".join((p & limit).to_bytes(self.size, "little") for row in planes for p in row)
        return np.frombuffer(packed, np.uint8).reshape(len(planes), HEADINGS, self.size)

    def admits(self, layer: int, states: np.ndarray) -> np.ndarray:
        """Return which of N states (N, 5) after `layer` time steps are in the set, (N,) bool."""
        cell = np.floor((states[:, :2] - self.origin) / CELL + 0.5).astype(int)
        heading = (states[:, 2] - self.scene.start[2]) * HEADINGS / (2.0 * np.pi)
        heading = np.floor(heading + 0.5).astype(int) % HEADINGS
        level = np.floor(states[:, 3] / self.rise + 0.5).astype(int)
        level = np.minimum(level, len(self.bits[layer]) - 1)
        inside = ((cell >= 0) & (cell < self.count)).all(axis=1)
        bit = np.where(inside, cell[:, 1] * self.stride + cell[:, 0], 0)
        return inside & (self.bits[layer][level, heading, bit >> 3] >> (bit & 7) & 1 == 1)


def find_plan(case: InterceptCase, scene: Scene) -> InterceptPlan | None:
    """Return a plan of one case (arrays of NumPy) that the referee accepts, or None.

    The time steps of `scene` are at most `STEP` long, and end at the time of the case.
    """
    guides = Guide(scene, MINIMAL, widen=True), Guide(scene, STRICT, widen=False)
    for most, cell in EFFORTS:
        plans = _plans(case, scene, *find_motions(scene, guides, most, cell))
        if not len(plans.time):
            continue
        cases = pj.take(jax.tree.map(lambda leaf: leaf[None], case), np.zeros(len(plans.time), int))
        good = np.flatnonzero(pj.intercept.judge(cases, plans).success)
        if good.size:
            return pj.take(plans, good[0])
    return None


def _plans(
    case: InterceptCase, scene: Scene, speed: np.ndarray, curvature: np.ndarray
) -> InterceptPlan:
    """Return the plans of M motions, whose speed and curvature are (M, L + 1)."""
    num = len(speed)
    zeros = jnp.zeros(num)
    start, origin, target = (
        jnp.repeat(jnp.asarray(row)[None], num, axis=0)
        for row in (case.start, case.origin, scene.target[-1])
    )
    return InterceptPlan(
        cost=zeros,
        violation=zeros,
        iterations=zeros.astype(int),
        status=zeros.astype(int),
        start=start,
        time=zeros + case.time,
        speed=jnp.asarray(speed),
        curvature=jnp.asarray(curvature),
        origin=origin,
        meeting=target,
    )


def find_motions(
    scene: Scene, guides: tuple[Guide, Guide], most: int, cell: float
) -> tuple[np.ndarray, np.ndarray]:
    """Search once for motions that meet the target at the end of a scene.

    At most `most` states are continued after each of L time steps, and cells in which states are
    merged are `cell` times as large as usual.

    Returns:
        speed: (M, L + 1) [m/s], at the times of M motions.
        curvature: (M, L + 1) [1/m].
    """
    random = np.random.default_rng(0)
    states = np.array([[*scene.start, scene.initial_speed, scene.initial_curvature]])
    states = states[guides[0].admits(0, states)]
    kept, parents = [states], [np.zeros(len(states), int)]
    for layer in range(1, len(scene.target)):
        before, states, parent = states, *_expand(scene, states)
        fits = guides[0].admits(layer, states)
        states, parent = states[fits], parent[fits]
        is_preferred = guides[1].admits(layer, states)
        chosen = _select(random, states, is_preferred, int(1.5 * most), cell)
        chosen = chosen[_is_drive_free(scene, before[parent[chosen]], states[chosen], layer)]
        chosen = chosen[:most]
        states, parent = states[chosen], parent[chosen]
        kept.append(states)
        parents.append(parent)
        if not len(states):
            return np.zeros((0, len(kept))), np.zeros((0, len(kept)))
    ahead = np.stack([np.cos(states[:, 2]), np.sin(states[:, 2])], axis=1)
    miss = np.linalg.norm(states[:, :2] + scene.middle * ahead - scene.target[-1], axis=1)
    turn = states[:, 2] - scene.end_heading
    off = np.abs(np.arctan2(np.sin(turn), np.cos(turn)))
    which = np.flatnonzero((miss <= scene.tolerance) & (off <= scene.heading_tolerance))
    which = which[:_CANDIDATES]
    path = []
    for states, parent in zip(kept[::-1], parents[::-1], strict=True):
        path.append(states[which, 3:])
        which = parent[which]
    found = np.stack(path[::-1], axis=1)
    return found[..., 0], found[..., 1]


def _expand(scene: Scene, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all successors (M, 5) of states (N, 5) within the car's limits, and their parents."""
    parent = np.repeat(np.arange(len(states)), len(_RATES) * len(_PEDALS))
    rates = np.tile(np.repeat(_RATES, len(_PEDALS)), len(states))
    pedals = np.tile(_PEDALS, len(_RATES) * len(states))
    speed, bend = states[parent, 3], states[parent, 4]
    faster = np.clip(speed + scene.dt * scene.acceleration * pedals, 0.0, scene.speed)
    # Let u = wheelbase * curvature. Its rate is at most the steering rate times 1 + u^2, where |u|
    # is least in the step.
    u, by = scene.wheelbase * bend, np.abs(rates) * scene.steering_rate * scene.dt
    side = np.where(rates * u < 0.0, -1.0, 1.0)
    size = np.abs(u)
    root = np.sqrt(np.maximum(1.0 - 4.0 * by * (by - size), 0.0))
    inner = np.where(by < size, (root - 1.0) / (2.0 * np.maximum(by, 1e-12)), size - by)
    inner = np.where(by > 0.0, inner, size)
    sign = np.where(u == 0.0, np.sign(rates), np.sign(u))
    turned = sign * np.where(side > 0.0, size + by * (1.0 + size**2), inner)
    square = np.maximum(faster**2, 1e-9)
    limit = np.minimum(scene.curvature, scene.lateral_acceleration / square)
    bent = np.clip(turned / scene.wheelbase, -limit, limit)
    w = scene.wheelbase * bent
    least = np.where(u * w < 0.0, 0.0, np.minimum(np.abs(u), np.abs(w)))
    fits = np.abs(w - u) <= scene.steering_rate * scene.dt * (1.0 + least**2) * (1.0 + 1e-9)
    # The lateral acceleration v^2 k has an extremum where 2 v' k + v k' = 0.
    rise, slope = faster - speed, 3.0 * (faster - speed) * (bent - bend)
    share = np.where(slope == 0.0, 0.0, -(2.0 * rise * bend + (bent - bend) * speed))
    share = np.clip(share / np.where(slope == 0.0, 1.0, slope), 0.0, 1.0)
    lateral = (speed + share * rise) ** 2 * (bend + share * (bent - bend))
    fits &= np.abs(lateral) <= scene.lateral_acceleration * (1.0 + 1e-6)
    parent = parent[fits]
    ends = np.stack([faster, bent], axis=1)[fits]
    poses = _drive(scene, states[parent], ends)[-1]
    return np.concatenate([poses, ends], axis=1), parent


def _drive(scene: Scene, states: np.ndarray, ends: np.ndarray) -> list[np.ndarray]:
    """Return the poses (N, 3) after each part of a step.

    Speed and curvature change linearly from the values in `states` (N, 5) to `ends` (N, 2).
    """
    x, y, heading, v, k = states.T
    dv, dk, span = ends[:, 0] - v, ends[:, 1] - k, scene.dt
    poses = []
    for part in range(_PARTS):
        middle = (part + 0.5) / _PARTS
        angles = [
            heading + span * u * (v * k + u * (0.5 * (v * dk + dv * k) + u * dv * dk / 3.0))
            for u in (middle, (part + 1.0) / _PARTS)
        ]
        moved = span / _PARTS * (v + middle * dv)
        x, y = x + moved * np.cos(angles[0]), y + moved * np.sin(angles[0])
        poses.append(np.stack([x, y, angles[1]], axis=1))
    return poses


def _is_drive_free(scene: Scene, before: np.ndarray, after: np.ndarray, layer: int) -> np.ndarray:
    """Return which of N motions from states `before` to `after` (N, 5) do not collide."""
    free = np.ones(len(before), bool)
    for part, poses in enumerate(_drive(scene, before, after[:, 3:])):
        time = (layer - 1 + (part + 1) / _PARTS) * scene.dt
        which = np.flatnonzero(free)
        x, y, heading = poses[which].T
        free[which] = is_free(scene, x, y, heading, time)
    return free


def _select(
    random: np.random.Generator,
    states: np.ndarray,
    is_preferred: np.ndarray,
    most: int,
    cell: float,
) -> np.ndarray:
    """Return the indices of at most `most` states, merged in small cells, the best first."""
    order = random.permutation(len(states))
    order = order[np.argsort(~is_preferred[order], kind="stable")]
    order = order[np.unique(_number(states[order], cell * _CELL), return_index=True)[1]]
    if len(order) <= most:
        return random.permutation(order)
    order = random.permutation(order)
    group = _number(states[order], _LARGE) * 2 + is_preferred[order]
    by_group = np.argsort(group, kind="stable")
    group = group[by_group]
    first = np.r_[True, group[1:] != group[:-1]]
    at = np.arange(len(group))
    rank = np.empty(len(group))
    rank[by_group] = at - np.maximum.accumulate(np.where(first, at, 0))
    rank = rank / np.where(is_preferred[order], _PREFERENCE, 1.0)
    return order[np.argsort(rank, kind="stable")[:most]]


def _number(states: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return a number (N,) of the cell of each state (N, 5); cells have the sizes `size` (5,)."""
    cells = np.floor(states / size).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    number = np.zeros(len(states), np.int64)
    for column, base in zip(cells.T, cells.max(axis=0, initial=0) + 1, strict=True):
        number = number * base + column
    return number
