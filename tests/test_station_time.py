"""Search in a graph of time and station (distance along a path), and corridors beside obstacles."""

import itertools

import jax
import numpy as np
import pytest

from planner_jax.baselines.intercept.station_time import (
    Blocked,
    StationTimeGrid,
    StationTimeProblem,
    corridor,
    reference_line,
)

GRID = StationTimeGrid(stations=6, steps=5, jumps=3)
POLYGONS, PARTS = 2, 3
float64 = pytest.mark.usefixtures("float64")


def problem(polygons=(), speed_limit=9.0, initial_speed=0.5, acceleration_limit=9.0):
    unused = (20.0, 21.0, (0.0, 0.0), (1.0, 1.0))
    rows = [*polygons, *[unused] * (POLYGONS - len(polygons))]
    start, end, lower, upper = (np.array(each, float) for each in zip(*rows, strict=True))
    present = np.arange(POLYGONS) < len(polygons)
    return StationTimeProblem(
        **{"end_station": np.array(6.0), "horizon": np.array(10.0)},
        **{"initial_speed": np.array(initial_speed), "initial_acceleration": np.array(0.0)},
        speed_limit=np.broadcast_to(np.asarray(speed_limit, float), PARTS),
        acceleration_limit=np.array(acceleration_limit),
        blocked=Blocked(start=start, end=end, lower=lower, upper=upper, present=present),
    )


def draw_problems(num, seed=0):
    rng = np.random.default_rng(seed)
    problems = []
    for _ in range(num):
        polygons = []
        for _ in range(POLYGONS):
            start, low, rise = rng.uniform(0.5, 7.0), rng.uniform(0.5, 4.5), rng.uniform(-0.4, 0.8)
            end, height = start + rng.uniform(1.0, 2.5), rng.uniform(0.6, 1.5)
            edge = low + np.array([0.0, rise])
            polygons.append((start, end, edge, edge + height))
        problems.append(problem(polygons, (2.0, rng.choice([0.6, 2.0]), 2.0), 0.5, 0.6))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *problems)


coarse = jax.jit(jax.vmap(lambda p: reference_line(p, GRID)))
BATCH = 48


def pad(*problems):
    rows = [*problems, *[problems[-1]] * (BATCH - len(problems))]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *rows)


@pytest.fixture(scope="module")
def lines():
    with jax.enable_x64(True):
        problems = draw_problems(BATCH)
        return problems, jax.tree.map(np.asarray, coarse(problems))


def depth(problems, k, times, station):
    blocked = jax.tree.map(lambda leaf: leaf[k], problems.blocked)
    deepest = np.full(np.shape(times), -np.inf)
    for p in np.flatnonzero(blocked.present):
        share = (times - blocked.start[p]) / (blocked.end[p] - blocked.start[p])
        edges = blocked.lower[p], blocked.upper[p]
        lower, upper = (first + share * (last - first) for first, last in edges)
        inside = np.minimum(station - lower, upper - station)
        deepest = np.maximum(deepest, np.where((share > 0.0) & (share < 1.0), inside, -np.inf))
    return deepest


def best_by_trying(problems, k):
    limits = problems.speed_limit[k]
    times = np.linspace(0.0, 10.0, 10001)
    least = np.inf
    for jumps in itertools.product(range(4), repeat=5):
        if sum(jumps) != 6:
            continue
        place = np.concatenate([[0], np.cumsum(jumps)])
        speed = np.array([0.5, *(0.5 * jump for jump in jumps)])
        change = np.diff(speed) / 2.0
        passed = [limits[a // 2 : (b + 1) // 2] for a, b in itertools.pairwise(place)]
        if any((v > part + 1e-6).any() for v, part in zip(speed[1:], passed, strict=True)):
            continue
        if (np.abs(change) > 0.6).any() or np.sum(change**2) * 2.0 >= least:
            continue
        if depth(problems, k, times, np.interp(times, np.arange(6) * 2.0, place)).max() < 1e-3:
            least = np.sum(change**2) * 2.0
    return least


def test_the_line_is_the_best_of_all_on_the_grid(lines):
    problems, found = lines
    expected = np.array([best_by_trying(problems, k) for k in range(BATCH)])
    assert 0.2 < np.isfinite(expected).mean() < 1.0
    np.testing.assert_array_equal(found.found, np.isfinite(expected))
    np.testing.assert_allclose(found.cost, expected, rtol=1e-9)


@float64
def test_an_empty_graph_has_the_straight_line_and_a_full_one_has_none():
    free = problem(initial_speed=0.6)
    wall = problem([(3.0, 4.0, (-1.0, -1.0), (7.0, 7.0))])
    fast = problem(speed_limit=(9.0, 0.2, 9.0))
    cases = pad(free, wall, fast)
    straight = jax.jit(lambda p: reference_line(p, StationTimeGrid(10, 5, 3)))(free)
    np.testing.assert_allclose(straight.station, np.linspace(0.0, 6.0, 6), atol=1e-12)
    np.testing.assert_allclose(straight.cost, 0.0, atol=1e-12)
    found = coarse(cases)
    assert list(found.found[:3]) == [True, False, False]
    np.testing.assert_allclose(found.station[1], np.linspace(0.0, 6.0, 6), atol=1e-12)


SHARES = np.linspace(0.0, 1.0, 9)


@jax.jit
@jax.vmap
def around(problem, station):
    kinds = {kind: corridor(problem, station, 5, kind) for kind in ("tilted", "edges", "flat")}
    return {kind: (found, found.bounds(SHARES)) for kind, found in kinds.items()}


@pytest.fixture(scope="module")
def corridors(lines):
    problems, found = lines
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, around(problems, found.station))


@pytest.mark.parametrize("kind", ["tilted", "edges", "flat"])
def test_nothing_between_the_lines_of_a_corridor_is_inside_of_a_polygon(lines, corridors, kind):
    problems, found = lines
    fine = np.linspace(0.0, 1.0, 401)
    grid = np.array([np.interp(fine, SHARES, unit) for unit in np.eye(9)])
    lower, upper = (np.clip(bound, 0.0, 6.0) @ grid for bound in corridors[kind][1])
    times = (np.arange(5)[:, None] + fine) * 2.0
    num = 0
    for k in np.flatnonzero(found.found):
        is_open = upper[k] > lower[k]
        for share in (0.0, 0.5, 1.0):
            station = (lower[k] + share * (upper[k] - lower[k]))[is_open]
            assert depth(problems, k, times[is_open], station).max() < 1e-9
        num += is_open.sum()
    assert num > 1000


def test_the_tilted_corridor_holds_the_line_and_is_the_widest(lines, corridors):
    _, found = lines
    station = found.station[:, :-1, None] + np.diff(found.station)[..., None] * np.linspace(0, 1, 9)
    is_inside = {
        kind: ((station >= lower - 1e-9) & (station <= upper + 1e-9)).all(axis=(1, 2))[found.found]
        for kind, (_, (lower, upper)) in corridors.items()
    }
    assert is_inside["tilted"].all()
    assert is_inside["flat"].mean() <= is_inside["edges"].mean() < 1.0


def test_flat_corridors_are_rectangles_and_edges_have_the_slope_of_the_polygon():
    start, slope = 3.0, 0.25
    case = problem([(start, 8.0, (1.0, 1.0 + 5.0 * slope), (2.0, 2.0 + 5.0 * slope))])
    above = np.linspace(0.0, 6.0, 6) + np.array([0.0, 2.0, 2.0, 1.5, 1.0, 0.0])
    with jax.enable_x64(True):
        found = around(pad(case), np.tile(above, (BATCH, 1)))
    kinds = [jax.tree.map(lambda leaf: leaf[0], found[kind][0]) for kind in ("edges", "flat")]
    edges, flat = (np.asarray(kind.lower_rise[:, 0]) for kind in kinds)
    np.testing.assert_allclose(edges, [0.0, *[2.0 * slope] * 3, 0.0], atol=1e-12)
    np.testing.assert_array_equal(flat, 0.0)
    heads = np.asarray(kinds[0].lower[:, 0])
    np.testing.assert_allclose(heads[1:4], 2.0 + slope * (np.array([2.0, 4.0, 6.0]) - start))
    assert (heads[[0, 4]] == -np.inf).all()
    np.testing.assert_allclose(kinds[1].lower[1:4, 0], 2.0 + slope * np.array([1.0, 3.0, 5.0]))
    assert not np.isfinite(kinds[0].upper).any()


def test_pieces_have_the_speed_limit_of_the_parts_they_pass_and_keep_off_slower_ones():
    case = problem(speed_limit=(1.0, 0.4, 0.7))
    station = np.array([0.0, 1.0, 2.0, 2.5, 4.0, 6.0])
    with jax.enable_x64(True):
        found = around(pad(case), np.tile(station, (BATCH, 1)))["tilted"][0]
    np.testing.assert_allclose(found.speed[0], [1.0, 1.0, 0.4, 0.4, 0.7])
    np.testing.assert_allclose(found.ceiling[0], [2.0, 2.0, np.inf, np.inf, np.inf])
    np.testing.assert_allclose(found.floor[0], [*[-np.inf] * 4, 4.0])
