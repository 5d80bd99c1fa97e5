"""Piecewise polynomials of least energy (MINCO), compared with a dense quadratic program."""

import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import assert_gradient_matches_differences

from planner_jax.trajectory import proportional_minco as minco
from planner_jax.trajectory.polynomial import evaluate, snap_energy

NODES = 5  # sampling intervals of each piece
PIECE_DURATION = np.array(0.45)  # mean

pytestmark = pytest.mark.usefixtures("float64")
every_order = pytest.mark.parametrize("order", (2, 3, 4))
every_size = pytest.mark.parametrize(
    ("order", "pieces"), [(4, 1), (4, 2), (4, 5), (4, 8), (2, 1), (2, 3), (3, 1), (3, 3)]
)


def durations_of(pieces):
    shares = 1.0 + 0.7 * np.sin(3.0 * np.arange(pieces))
    return PIECE_DURATION * shares / shares.mean()


def maps_of(order, pieces, velocities=False):
    return minco.proportional_minco(order, tuple(durations_of(pieces)), velocities)


@functools.partial(jax.jit, static_argnums=(0, 1))
def solve_for(order, pieces, rows, offsets, duration):
    args = maps_of(order, pieces), rows, offsets, duration
    return (
        minco.proportional_trajectory(*args),
        minco.sample_motion(args[0], NODES, jnp.concatenate(args[1:3]), args[3]),
        minco.trajectory_energy(*args),
    )


trajectory_of = jax.jit(minco.proportional_trajectory, static_argnums=0)


def interpolate(head, tail, waypoints, durations):
    maps = minco.proportional_minco(len(head), tuple(np.asarray(durations, np.float64).tolist()))
    rows = np.asarray(rows_of(head, tail, durations.mean()), head.dtype)
    offsets = (maps.offsets @ np.concatenate([rows, waypoints])).astype(head.dtype)
    return trajectory_of(maps, rows, offsets, durations.mean())


def draw_problem(order, pieces, seed=0, dtype=np.float64):
    rng = np.random.default_rng((seed, order, pieces))
    head, tail = rng.normal(size=(2, order, 3))
    waypoints = rng.normal(size=(pieces - 1, 3))
    durations = rng.uniform(0.3, 1.2, size=pieces)
    return tuple(x.astype(dtype) for x in (head, tail, waypoints, durations))


def rows_of(head, tail, duration=PIECE_DURATION):
    powers = duration ** np.arange(len(head))[:, None]
    return np.concatenate([head * powers, tail * powers])


def draw_rows(order, pieces):
    head, tail, offsets, _ = draw_problem(order, pieces, seed=1)
    return rows_of(head, tail), 0.3 * offsets


def solve_drawn(order, pieces, dtype=np.float64):
    args = (x.astype(dtype) for x in (*draw_rows(order, pieces), PIECE_DURATION))
    return solve_for(order, pieces, *args)


def derivative_row(time, derivative, size):
    powers = [time ** max(k - derivative, 0) for k in range(size)]
    return np.array([math.perm(k, derivative) * power for k, power in enumerate(powers)])


def energy_form(order, durations):
    size = 2 * order
    form = np.zeros((len(durations) * size,) * 2)
    for piece, duration in enumerate(durations):
        for i, j in itertools.product(range(order, size), repeat=2):
            power = i + j - size + 1
            factors = math.perm(i, order) * math.perm(j, order)
            form[piece * size + i, piece * size + j] = factors * duration**power / power
    return form


def dense_solution(head, tail, waypoints, durations):
    order, pieces = len(head), len(durations)
    size = 2 * order
    rows, values = [], []

    def demand(value, *terms):
        row = np.zeros(pieces * size)
        for piece, time, derivative, sign in terms:
            row[piece * size : (piece + 1) * size] += sign * derivative_row(time, derivative, size)
        rows.append(row)
        values.append(value)

    for d in range(order):
        demand(head[d], (0, 0.0, d, 1.0))
        demand(tail[d], (pieces - 1, durations[-1], d, 1.0))
    for i, waypoint in enumerate(waypoints):
        demand(waypoint, (i, durations[i], 0, 1.0))
        for d in range(order):
            demand(np.zeros(3), (i, durations[i], d, 1.0), (i + 1, 0.0, d, -1.0))
    form, rows = energy_form(order, durations), np.array(rows)
    system = np.block([[form, rows.T], [rows, np.zeros((len(rows),) * 2)]])
    right = np.concatenate([np.zeros((len(form), 3)), values])
    scale = 1.0 / np.sqrt(np.abs(system).max(axis=1))
    for _ in range(3):
        scale /= np.sqrt(np.abs(scale[:, None] * system * scale).max(axis=1))
    solution = np.linalg.solve(scale[:, None] * system * scale, scale[:, None] * right)
    return (scale[:, None] * solution)[: len(form)].reshape(pieces, -1, 3)


def ends(coeffs, durations, derivative):
    size = coeffs.shape[1]
    start = np.einsum("k,mki->mi", derivative_row(0.0, derivative, size), coeffs)
    rows = np.array([derivative_row(t, derivative, size) for t in durations])
    return start, np.einsum("mk,mki->mi", rows, coeffs)


def energy(coeffs, durations):
    flat = np.asarray(coeffs).reshape(-1, 3)
    return np.sum(flat * (energy_form(coeffs.shape[1] // 2, np.asarray(durations)) @ flat))


@every_size
def test_the_trajectory_solves_the_dense_quadratic_program_and_its_pieces_join(order, pieces):
    head, tail, waypoints, durations = problem = draw_problem(order, pieces)
    trajectory = interpolate(*problem)
    coeffs, expected = np.asarray(trajectory.coeffs), dense_solution(*problem)
    assert coeffs.shape == (pieces, 2 * order, 3)
    np.testing.assert_allclose(trajectory.durations, durations, rtol=1e-14)
    np.testing.assert_allclose(coeffs, expected, atol=1e-9 * np.abs(expected).max())
    for derivative in range(2 * order - 1):
        start, end = ends(coeffs, durations, derivative)
        np.testing.assert_allclose(end[:-1], start[1:], atol=1e-10 * np.abs(coeffs).max())
        if derivative < order:
            np.testing.assert_allclose(start[0], head[derivative], atol=1e-11)
            np.testing.assert_allclose(end[-1], tail[derivative], atol=1e-9)
        if derivative == 0:
            np.testing.assert_allclose(end[:-1], waypoints, atol=1e-11)


def test_a_trajectory_in_float32_is_right_to_a_tenth_of_a_millimetre():
    single = interpolate(*draw_problem(4, 6, dtype=np.float32))
    assert single.coeffs.dtype == np.float32
    double = interpolate(*(x.astype(np.float64) for x in draw_problem(4, 6, dtype=np.float32)))
    times = double.durations[:, None] * np.linspace(0.0, 1.0, 9)[None]
    powers = np.asarray(times)[:, :, None] ** np.arange(8)
    positions = [powers @ np.asarray(x.coeffs, np.float64) for x in (single, double)]
    np.testing.assert_allclose(*positions, atol=1e-4)


@pytest.mark.parametrize(("order", "pieces"), [(2, 2), (4, 1), (4, 4)])
def test_the_gradient_in_boundary_offsets_and_duration_matches_finite_differences(order, pieces):
    def weigh_energy_and_coefficients(point):
        *args, weight = point
        path = minco.proportional_trajectory(maps_of(order, pieces), *args)
        weights = weight * jnp.cos(jnp.arange(path.coeffs.size, dtype=weight.dtype))
        return snap_energy(path, order) + weights @ path.coeffs.ravel()

    point = *draw_rows(order, pieces), PIECE_DURATION, 1.0
    assert_gradient_matches_differences(weigh_energy_and_coefficients, point, rtol=1e-6)


def test_boundary_rows_are_derivatives_in_the_mean_time_of_a_piece():
    head, tail, _, _ = draw_problem(4, 1)
    rows = jax.jit(minco.boundary_rows)(head, tail, PIECE_DURATION)
    np.testing.assert_allclose(rows, rows_of(head, tail), rtol=1e-14)


@pytest.mark.parametrize(("order", "pieces"), [(4, 1), (4, 2), (4, 5), (3, 3), (2, 3)])
def test_the_energy_formula_is_the_energy_of_the_trajectory(order, pieces):
    trajectory, _, formula = solve_drawn(order, pieces)
    np.testing.assert_allclose(formula, energy(trajectory.coeffs, trajectory.durations), rtol=1e-9)


@pytest.mark.parametrize("proportions", [(1.0,) * 12, (0.2, 0.5) + (1.0,) * 10, (1.0, 30.0)])
@every_order
def test_the_least_energy_is_the_same_in_a_frame_in_uniform_motion_far_away(order, proportions):
    form = minco.proportional_minco(order, proportions).boundary_energy
    rows, _ = draw_rows(order, 3)
    moving = rows.copy()
    moving[[0, order]] += [[10.0], [10.0 + 3.0 * len(proportions)]]  # metres, at 3 m a piece
    moving[[1, order + 1]] += 3.0
    at_rest, far_away = (np.einsum("bi,bc,ci->", x, form, x) for x in (rows, moving))
    np.testing.assert_allclose(far_away, at_rest, rtol=1e-9)


@every_order
def test_zero_offsets_have_the_least_energy_over_all_waypoints(order):
    rows, offsets = draw_rows(order, 3)
    smooth, _, least = solve_for(order, 3, rows, np.zeros_like(offsets), PIECE_DURATION)
    powers = PIECE_DURATION ** np.arange(order)[:, None]
    whole = [3.0 * PIECE_DURATION]
    single = dense_solution(rows[:order] / powers, rows[order:] / powers, np.zeros((0, 3)), whole)
    np.testing.assert_allclose(smooth.coeffs[0], single[0], atol=1e-8 * np.abs(single).max())
    np.testing.assert_allclose(least, energy(single, whole), rtol=1e-9)
    raised = maps_of(order, 3).offset_energy * np.sum(offsets**2)
    raised = raised / PIECE_DURATION ** (2 * order - 1)
    for sign in (1.0, -1.0):
        _, _, more = solve_for(order, 3, rows, sign * offsets, PIECE_DURATION)
        np.testing.assert_allclose(more - least, raised, rtol=1e-6)


@every_size
def test_smoothest_velocities_as_variables_change_nothing(order, pieces):
    usual, supple = maps_of(order, pieces), maps_of(order, pieces, True)
    known = 2 * order + pieces - 1
    size = np.abs(usual.coefficients).max()
    ours = supple.coefficients[..., :known]
    np.testing.assert_allclose(ours, usual.coefficients, atol=1e-9 * size)
    assert supple.coefficients.shape[-1] == known + pieces - 1
    assert supple.offset_energy == pytest.approx(usual.offset_energy, rel=1e-9)
    np.testing.assert_allclose(supple.waypoints[: pieces - 1, known:], 0.0, atol=1e-9)


@every_size
@pytest.mark.parametrize("velocities", [False, True])
def test_waypoints_and_offsets_invert_each_other_and_offsets_cost_their_square(
    order, pieces, velocities
):
    maps, (rows, _) = maps_of(order, pieces, velocities), draw_rows(order, pieces)
    offsets = np.random.default_rng(5).normal(size=(len(maps.offsets), 3))
    columns = np.concatenate([rows, offsets])
    back = maps.offsets @ np.concatenate([rows, maps.waypoints @ columns])
    np.testing.assert_allclose(back, offsets, atol=1e-8)
    energies = energy(maps.coefficients @ columns, maps.proportions)
    least = np.einsum("bi,bc,ci->", rows, maps.boundary_energy, rows)
    np.testing.assert_allclose(energies, least + maps.offset_energy * np.sum(offsets**2), rtol=1e-8)


@every_size
def test_velocities_as_variables_hold_at_the_waypoints_and_pieces_join(order, pieces):
    maps = maps_of(order, pieces, True)
    columns = np.random.default_rng(6).normal(size=(maps.coefficients.shape[-1], 3))
    coeffs, waypoints = maps.coefficients @ columns, maps.waypoints @ columns
    for derivative in range(2 * order - 2):  # one fewer than without velocities
        after, before = ends(coeffs, maps.proportions, derivative)
        after, before = after[1:], before[:-1]
        size = np.abs(before).max(initial=1.0)
        np.testing.assert_allclose(before, after, atol=1e-7 * size)
        if derivative < 2:
            own = waypoints[derivative * (pieces - 1) :][: pieces - 1]
            np.testing.assert_allclose(after, own, atol=1e-9 * size)


@pytest.mark.parametrize("pieces", [2, 3, 8])
def test_a_unit_of_offsets_moves_the_waypoints_by_at_most_a_unit(pieces):
    moves = maps_of(4, pieces).waypoints[:, 8:]
    assert np.linalg.norm(moves, 2) == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize(("order", "pieces"), [(3, 3), (4, 1)])
def test_samples_are_the_values_of_the_trajectory(order, pieces):
    trajectory, motion, _ = solve_drawn(order, pieces)
    knots = np.concatenate([[0.0], np.cumsum(durations_of(pieces))])
    times = np.interp(np.arange(pieces * NODES + 1) / NODES, np.arange(pieces + 1), knots)

    def evaluate_all(time):
        return [evaluate(trajectory, time, derivative) for derivative in range(4)]

    pos, *others = jax.jit(jax.vmap(evaluate_all))(times)
    assert motion.height.shape == times.shape
    np.testing.assert_allclose(motion.height, pos[:, 2], atol=1e-10)
    for samples, values in zip((motion.vel, motion.acc, motion.jerk), others, strict=True):
        np.testing.assert_allclose(samples, values, atol=1e-10 * np.abs(values).max())


def test_samples_and_energy_in_float32_are_right_to_a_millionth():
    single, double = (solve_drawn(4, 5, dtype) for dtype in (np.float32, np.float64))
    for leaf, exact in zip(*(jax.tree.leaves(x[1:]) for x in (single, double)), strict=True):
        assert leaf.dtype == np.float32
        np.testing.assert_allclose(leaf, exact, atol=1e-6 * np.abs(exact).max())


@pytest.mark.parametrize("proportions", [(), (1.0, 0.0), (1.0, -2.0)])
def test_pieces_without_a_duration_are_rejected(proportions):
    with pytest.raises(ValueError, match=r"^proportions must be some numbers > 0, got \("):
        minco.proportional_minco(4, proportions)


def test_maps_are_built_once_and_depend_only_on_ratios():
    assert minco.proportional_minco(4, (1.0,) * 3) is minco.proportional_minco(4, (1.0, 1.0, 1.0))
    one, other = minco.proportional_minco(4, (0.2, 0.4)), minco.proportional_minco(4, (1.0, 2.0))
    np.testing.assert_allclose(one.coefficients, other.coefficients, rtol=1e-12)
    np.testing.assert_allclose(one.proportions, [2.0 / 3.0, 4.0 / 3.0])
