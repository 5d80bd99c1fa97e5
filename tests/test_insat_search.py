"""Tests of the search of `epase`, `insat` and `pinsat`, and of the optimisation of splines."""

import heapq

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from planner_jax.baselines.block.b_spline import basis, hodograph
from planner_jax.baselines.block.epase import OpenStates, State, find_path, is_independent
from planner_jax.baselines.block.insat import InsatBlock, Terms, _optimise
from planner_jax.baselines.block.library.insat_pairs import find_steps
from planner_jax.core.errors import ArgumentError
from planner_jax.optimise.lbfgs import LbfgsConfig

STEP = np.deg2rad(4.0)  # [rad], the only step of a search over two joints
MOVES = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])


class Maze:
    """A square of two joint angles, `size` by `size` steps, with walls that have one gap each."""

    def __init__(self, size):
        self.size, self.free = size, np.ones((size, size), bool)
        self.start, self.end = np.array([2.0, size // 2]) * STEP, np.array([size - 2.5, 9.0]) * STEP
        for k, column in enumerate(range(8, size - 6, 12)):
            self.free[column : column + 2] = False
            gap = size - 9 if k % 2 else 6
            self.free[column : column + 2, gap : gap + 4] = True

    def is_free(self, angles):
        nodes = np.round(angles / STEP).astype(int)
        within = ((nodes >= 0) & (nodes < self.size)).all(axis=-1)
        x, y = np.moveaxis(np.clip(nodes, 0, self.size - 1), -1, 0)
        return within & self.free[x, y]

    def are_edges_free(self, begins, ends):
        shares = np.linspace(0.0, 1.0, 2 * self.size + 1)[:, None, None]
        return self.is_free(begins + shares * (ends - begins)).all(axis=0)

    def find_shortest(self):
        """Return the least length of steps on the grid and then a straight edge to the end."""
        nodes = np.stack(np.indices(self.free.shape), axis=-1).reshape(-1, 2)
        ends = np.clip(nodes[:, None] + MOVES, 0, self.size - 1) @ [self.size, 1]
        begins, ends = np.repeat(np.arange(len(nodes)), 4), ends.reshape(-1)
        is_open = self.is_free(nodes * STEP)
        keep = is_open[begins] & is_open[ends] & (begins != ends)
        steps = np.full(keep.sum(), STEP), (begins[keep], ends[keep])
        graph = coo_array(steps, (len(nodes), len(nodes))).tocsr()
        start = int(np.round(self.start / STEP) @ [self.size, 1])
        lengths = dijkstra(graph, indices=start) + np.linalg.norm(nodes * STEP - self.end, axis=1)
        lasts = self.are_edges_free(nodes * STEP, np.broadcast_to(self.end, nodes.shape))
        return np.min(lengths[lasts])

    def find_by_astar(self, weight):
        """Return the path of weighted A*, written down plainly, without batches of states."""
        number, closed, lengths = 0, set(), {}
        queue = [(0.0, number, self.start, 0.0, [self.start])]
        while queue:
            _, _, angles, length, path = heapq.heappop(queue)
            node = tuple(np.round(angles / STEP).astype(int))
            if node in closed:
                continue
            closed.add(node)
            if self.are_edges_free(angles[None], self.end[None])[0]:
                return np.stack([*path, self.end])
            for move in MOVES:
                new = angles + STEP * move
                longer = length + np.linalg.norm(new - angles)
                node = tuple(np.round(new / STEP).astype(int))
                is_open = self.are_edges_free(angles[None], new[None])[0]
                if is_open and node not in closed and longer < lengths.get(node, np.inf):
                    lengths[node], number = longer, number + 1
                    cost = longer + weight * np.linalg.norm(new - self.end)
                    heapq.heappush(queue, (cost, number, new, longer, [*path, new]))
        return None


def test_a_state_is_independent_if_no_earlier_state_can_shorten_its_path():
    """Compare states at 0, 1 and 3 rad on a line: g(s) - g(s') <= w h(s', s)."""
    near, middle, far = (State(np.array([x, 0.0]), g) for x, g in ((0, 0.5), (1, 2.0), (3, 2.4)))
    # From `near` to `middle` 2.0 - 0.5 = 1.5 > 1, to `far` 2.4 - 0.5 = 1.9 <= 3.
    assert not is_independent(middle, [near], 1.0)
    assert is_independent(middle, [near], 1.5)
    assert is_independent(far, [near], 1.0)
    assert is_independent(far, [near, middle], 1.0)
    assert not is_independent(middle, [far, near], 1.0)
    assert is_independent(near, [], 1.0)


def test_independent_states_are_popped_together_and_others_stay():
    states = OpenStates(State(np.zeros(2), 0.0), np.array([4.0, 0.0]), 1.0)
    assert len(states.pop(8)) == 1
    for x, g in ((0.0, 0.5), (1.0, 2.0), (3.0, 2.4)):
        states.push(State(np.array([x, 1.0]), g))
    popped = states.pop(8)
    assert [state.length for state in popped] == [2.4, 0.5]
    assert [state.length for state in states.pop(8)] == [2.0]
    assert states.num_expanded == 4 and not states.pop(8)
    # The last state had the greatest cost among the first states of all batches.
    assert states.bound == pytest.approx(2.0 + np.hypot(3.0, 1.0))


@pytest.mark.parametrize(
    ("size", "weight"), [(30, 2.0), *(pytest.param(100, x, marks=pytest.mark.slow) for x in (1, 3))]
)
def test_paths_are_at_most_the_weight_times_as_long_as_the_shortest(size, weight):
    """Search a grid one by one and 16 states at a time; one by one is weighted A*."""
    maze, always = Maze(size), lambda: 1.0
    shortest = maze.find_shortest()
    paths = [
        find_path(State(maze.start, 0.0), maze.end, maze, always, weight, width)  # type: ignore[arg-type]
        for width in (1, 16)
    ]
    np.testing.assert_array_equal(paths[0], maze.find_by_astar(weight))
    for path in paths:
        assert maze.are_edges_free(path[:-1], path[1:]).all()
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        assert shortest * (1 - 1e-9) <= length <= weight * shortest * (1 + 1e-9)


VELOCITY = np.array([5.236, 5.585, 5.934, 11.17, 13.963, 15.708])  # [rad/s]
ACCELERATION = 60.0  # [rad/s^2]


def optimise(ends, weights):
    """Optimise splines from zero to standstill at `ends` (N, 6), for 100 iterations."""
    curves = np.linspace(0.0, 1.0, 65)[:, None] * ends[:, None]
    limits = np.full(6, -9.0), np.full(6, 9.0), VELOCITY, np.full(6, ACCELERATION)
    norms = np.geomspace(16.0, 4096.0, 100)
    terms = Terms(*limits, np.array(0.1), np.array(weights), norms)  # type: ignore[arg-type]
    config = LbfgsConfig(
        max_steps=100, memory=20, patience=100, tolerance=0.0, trial_steps=(1.0, 2.5, 0.3, 0.05)
    )
    found = _optimise(curves, np.array(True), terms, config)
    return np.asarray(found.time[:, -1]), np.asarray(found.length[:, -1])


def minimise_by_slsqp(end, weights):
    """Return the least cost of eq. 4a of a spline of 7 control points, by SLSQP of SciPy."""
    samples = basis(3, 7, np.linspace(0.0, 1.0, 33))
    bounds = ((hodograph(3, 1, 7), VELOCITY, 1), (hodograph(3, 2, 7), ACCELERATION, 2))

    def points_of(x):
        return np.concatenate([np.zeros((2, 6)), x[:-1].reshape(3, 6), [end, end]])

    def cost(x):
        length = np.linalg.norm(np.diff(samples @ points_of(x), axis=0), axis=1).sum()
        return weights[0] * x[-1] + weights[1] * length

    def slack(x):
        parts = [
            (limit * x[-1] ** order + sign * matrix @ points_of(x)) / np.max(limit)
            for matrix, limit, order in bounds
            for sign in (-1, 1)
        ]
        return np.concatenate([part.reshape(-1) for part in parts])

    guess = np.append(np.linspace(0.2, 0.8, 3)[:, None] * end, 1.0)
    found = minimize(
        cost,
        guess,
        method="SLSQP",
        constraints={"type": "ineq", "fun": slack},
        options={"maxiter": 300, "ftol": 1e-9},
    )
    assert found.success
    return found.fun


def test_splines_have_the_least_cost_that_slsqp_finds_and_the_least_time_in_closed_form(float64):
    """The least time of one joint: constant acceleration T^2 a at the outer control points.

    The second derivative has the five control points a T^2 (1, 1, 0, -1, -1), so that the joint
    turns by 11/48 a T^2.
    """
    ends = np.stack([0.6 * np.random.default_rng(0).normal(size=6), 0.2 * np.eye(6)[5]])
    weights = (1.0, 0.1)
    time, length = optimise(ends, weights)
    cost = weights[0] * time + weights[1] * length
    for each, end in zip(cost, ends, strict=True):
        assert each == pytest.approx(minimise_by_slsqp(end, weights), rel=1e-3)
    assert optimise(ends, (1.0, 0.0))[0][1] == pytest.approx(
        np.sqrt(48 * 0.2 / (11 * ACCELERATION)), rel=1e-3
    )


@pytest.mark.parametrize("rests", [True, False])
def test_a_stored_motion_ends_where_its_spline_ends_and_reaches_a_limit(rests):
    points = np.random.default_rng(1).normal(size=(7, 6))
    points[1] = points[0]
    points[-2] = points[-1] if rests else points[-2]
    steps, duration = find_steps(points, 10, VELOCITY, np.full(6, ACCELERATION))
    knots = np.concatenate([np.zeros((1, 6)), steps])
    turned = 0.05 * (knots[1:] + knots[:-1]).sum(axis=0)
    np.testing.assert_allclose(points[0] + turned, points[-1], atol=1e-12)
    assert not rests or np.abs(steps[-1]).max() < 1e-12
    rates, rises = np.abs(steps) / duration, 10 * np.abs(np.diff(knots, axis=0)) / duration**2
    assert max(np.max(rates / VELOCITY), np.max(rises / ACCELERATION)) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"lift": "state"}, "^lift must be one of edge, expansion, got 'state'$"),
        ({"weights": (1.0,)}, r"^weights must be two numbers >= 0, got \[1.0\]$"),
        ({"duration": (0.0, 1.0)}, "^duration must be two numbers >= 0.001"),
        ({"norms": (0.5, 16.0)}, "^norms must be two numbers >= 1"),
        ({"width": 0}, "^width must be >= 1, got 0$"),
    ],
)
def test_settings_of_insat_that_make_no_sense_are_rejected(options, message):
    with pytest.raises(ArgumentError, match=message):
        InsatBlock(**options)
