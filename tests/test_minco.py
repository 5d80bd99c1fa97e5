"""MINCO with durations in fixed proportion against a dense quadratic program."""

import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import assert_gradient_matches_differences

from planner_jax.trajectory.polynomial import derivative_factors, evaluate, snap_energy
from planner_jax.trajectory.proportional_minco import (
    boundary_rows,
    equal_pieces,
    proportional_minco,
    proportional_trajectory,
    sample_motion,
    trajectory_energy,
)

ORDERS = (2, 3, 4)
SIZES = [(4, 1), (4, 2), (4, 5), (4, 8), (2, 1), (2, 3), (3, 1), (3, 3)]
FEW_SIZES = [(4, 1), (4, 2), (4, 5), (3, 3), (2, 3)]
NODES = 5  # intervals a piece of the samples
PIECE_DURATION = np.array(0.45)  # on average

float64 = pytest.mark.usefixtures("float64")
every_order = pytest.mark.parametrize("order", ORDERS)
every_size = pytest.mark.parametrize(("order", "pieces"), SIZES)
few_sizes = pytest.mark.parametrize(("order", "pieces"), FEW_SIZES)


def durations_of(pieces):
    """In fixed proportion, none like the next, 0.45 s on average."""
    shares = 1.0 + 0.7 * np.sin(3.0 * np.arange(pieces))
    return PIECE_DURATION * shares / shares.mean()


def maps_of(order, pieces, velocities=False):
    return proportional_minco(order, tuple(durations_of(pieces)), velocities)


@functools.partial(jax.jit, static_argnums=(0, 1))
def proportional_one(order, pieces, rows, offsets, duration):
    """Trajectory, samples and energy."""
    args = maps_of(order, pieces), rows, offsets, duration
    return (
        proportional_trajectory(*args),
        sample_motion(args[0], NODES, jnp.concatenate(args[1:3]), args[3]),
        trajectory_energy(*args),
    )


def minco_one(head, tail, waypoints, durations):
    """The trajectory of given ends, waypoints and durations."""
    maps = proportional_minco(len(head), tuple(np.asarray(durations, np.float64).tolist()))
    rows = np.asarray(rows_of(head, tail, durations.mean()), head.dtype)
    offsets = (maps.offsets @ np.concatenate([rows, waypoints])).astype(head.dtype)
    return trajectory_of(maps, rows, offsets, durations.mean())


trajectory_of = jax.jit(proportional_trajectory, static_argnums=0)


def problem(order, pieces, seed=0, dtype=np.float64):
    """Ends, waypoints about a metre apart, and unequal durations."""
    rng = np.random.default_rng((seed, order, pieces))
    head, tail = rng.normal(size=(2, order, 3))
    waypoints = rng.normal(size=(pieces - 1, 3))
    durations = rng.uniform(0.3, 1.2, size=pieces)
    return tuple(x.astype(dtype) for x in (head, tail, waypoints, durations))


def derivative_row(time, derivative, size):
    """Derivatives of 1, t, t^2, ... at a time."""
    return np.array(
        [
            math.perm(k, derivative) * time ** (k - derivative) if k >= derivative else 0.0
            for k in range(size)
        ]
    )


def energy_form(order, durations):
    """The integral of |p^(s)|^2 as a quadratic form in all coefficients."""
    size = 2 * order
    form = np.zeros((len(durations) * size,) * 2)
    for piece, duration in enumerate(durations):
        for i, j in itertools.product(range(order, size), repeat=2):
            power = i + j - size + 1
            factors = math.perm(i, order) * math.perm(j, order)
            form[piece * size + i, piece * size + j] = factors * duration**power / power
    return form


def constraints(head, tail, waypoints, durations):
    """Rows A and values b of A c = b: ends, waypoints, and derivatives up to s - 1 that join."""
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
    return np.array(rows), np.array(values)


def dense_solution(head, tail, waypoints, durations):
    """Coefficients (M, 2s, 3) from the Karush-Kuhn-Tucker system of the quadratic program."""
    form = energy_form(len(head), durations)
    rows, values = constraints(head, tail, waypoints, durations)
    system = np.block([[form, rows.T], [rows, np.zeros((len(rows),) * 2)]])
    right = np.concatenate([np.zeros((len(form), 3)), values])
    # The equations are of very different size, so each is divided by its largest number.
    scale = 1.0 / np.sqrt(np.abs(system).max(axis=1))
    for _ in range(3):
        scale /= np.sqrt(np.abs(scale[:, None] * system * scale).max(axis=1))
    solution = scale[:, None] * np.linalg.solve(
        scale[:, None] * system * scale, scale[:, None] * right
    )
    return solution[: len(form)].reshape(len(durations), -1, 3)


def ends(coeffs, durations, derivative):
    """A derivative at the start and at the end of every piece, (M, 3) each."""
    size = coeffs.shape[1]
    start = np.einsum("k,mki->mi", derivative_row(0.0, derivative, size), coeffs)
    rows = np.array([derivative_row(t, derivative, size) for t in durations])
    return start, np.einsum("mk,mki->mi", rows, coeffs)


def energy(coeffs, form):
    flat = coeffs.reshape(len(form), 3)
    return np.sum(flat * (form @ flat))


# The trajectory


@float64
@every_size
def test_the_trajectory_is_the_solution_of_the_dense_quadratic_program(order, pieces):
    given = problem(order, pieces)
    trajectory = minco_one(*given)
    expected = dense_solution(*given)
    assert trajectory.coeffs.shape == (pieces, 2 * order, 3)
    np.testing.assert_allclose(trajectory.durations, given[-1], rtol=1e-14)
    np.testing.assert_allclose(trajectory.coeffs, expected, atol=1e-9 * np.abs(expected).max())


@float64
@every_size
def test_pieces_join_in_all_derivatives_up_to_2s_minus_2_and_pass_the_waypoints(order, pieces):
    head, tail, waypoints, durations = problem(order, pieces)
    coeffs = np.asarray(minco_one(head, tail, waypoints, durations).coeffs)
    for derivative in range(2 * order - 1):
        start, end = ends(coeffs, durations, derivative)
        np.testing.assert_allclose(end[:-1], start[1:], atol=1e-10 * np.abs(coeffs).max())
        if derivative < order:
            np.testing.assert_allclose(start[0], head[derivative], atol=1e-11)
            np.testing.assert_allclose(end[-1], tail[derivative], atol=1e-9)
        if derivative == 0:
            np.testing.assert_allclose(end[:-1], waypoints, atol=1e-11)


@float64
@every_order
def test_every_admissible_change_raises_the_energy(order):
    """Changes keep ends, waypoints and joints, so the first order of the energy vanishes."""
    given = problem(order, 3)
    coeffs = np.asarray(minco_one(*given).coeffs)
    form = energy_form(order, given[-1])
    rows, _ = constraints(*given)
    _, sizes, basis = np.linalg.svd(rows)
    admissible = basis[np.sum(sizes > 1e-12 * sizes[0]) :]
    assert len(admissible) == 2 * (order - 1)
    rng = np.random.default_rng(0)
    least = energy(coeffs, form)
    for _ in range(5):
        change = (admissible.T @ rng.normal(size=(len(admissible), 3))).reshape(coeffs.shape)
        raised = energy(change, form)
        assert raised > 0.0
        for size in (1.0, -1.0):
            np.testing.assert_allclose(
                energy(coeffs + size * change, form), least + raised, rtol=1e-9
            )


@float64
@every_order
def test_a_polynomial_of_degree_s_minus_1_costs_nothing_and_is_found_again(order):
    durations = problem(order, 3)[-1]
    coeffs = np.random.default_rng(1).normal(size=(order, 3))
    at = lambda time, d=0: derivative_row(time, d, order) @ coeffs  # noqa: E731
    times = np.concatenate([[0.0], np.cumsum(durations)])
    head, tail = (np.array([at(t, d) for d in range(order)]) for t in times[[0, -1]])
    waypoints = np.array([at(t) for t in times[1:-1]])
    trajectory = minco_one(head, tail, waypoints, durations)
    np.testing.assert_allclose(trajectory.coeffs[0, :order], coeffs, atol=1e-9)
    np.testing.assert_allclose(trajectory.coeffs[:, order:], 0.0, atol=1e-8)


@float64
@every_order
def test_stretched_time_divides_the_derivatives_by_its_powers(order):
    head, tail, waypoints, durations = problem(order, 3)
    powers = 2.5 ** np.arange(order)[:, None]
    slow = minco_one(head / powers, tail / powers, waypoints, 2.5 * durations)
    expected = minco_one(head, tail, waypoints, durations).coeffs
    expected = np.asarray(expected) / 2.5 ** np.arange(2 * order)[:, None]
    np.testing.assert_allclose(slow.coeffs, expected, atol=1e-11 * np.abs(expected).max())


def test_a_trajectory_in_float32_is_right_to_a_tenth_of_a_millimetre(float64):
    """Of waypoints a metre apart, six pieces and the durations 0.3 s to 1.2 s."""
    single = minco_one(*problem(4, 6, dtype=np.float32))
    assert single.coeffs.dtype == np.float32
    double = minco_one(*(x.astype(np.float64) for x in problem(4, 6, dtype=np.float32)))
    durations = double.durations[:, None] * np.linspace(0.0, 1.0, 9)
    powers = np.asarray(durations)[:, :, None] ** np.arange(8)
    positions = [
        np.einsum("mtk,mki->mti", powers, np.asarray(x.coeffs, np.float64))
        for x in (single, double)
    ]
    np.testing.assert_allclose(*positions, atol=1e-4)


# The maps


def energy_and_coefficients(maps, point):
    """The energy, and a sum in which every coefficient counts."""
    rows, offsets, duration, weight = point
    trajectory = proportional_trajectory(maps, rows, offsets, duration)
    weights = weight * jnp.cos(jnp.arange(trajectory.coeffs.size, dtype=weight.dtype))
    return snap_energy(trajectory, maps.order) + weights @ trajectory.coeffs.ravel()


@float64
@pytest.mark.parametrize(("order", "pieces"), [(2, 2), (4, 1), (4, 4)])
def test_the_gradient_in_boundary_offsets_and_duration_matches_finite_differences(order, pieces):
    point = *proportional_problem(order, pieces), PIECE_DURATION, 1.0
    function = functools.partial(energy_and_coefficients, maps_of(order, pieces))
    assert_gradient_matches_differences(function, point, rtol=1e-6)


@float64
def test_the_energy_gradient_in_a_waypoint_is_twice_the_jump_of_the_derivative_2s_minus_1():
    """By parts; other derivatives at the joint adapt, so that they do not count."""
    maps, (rows, offsets) = maps_of(4, 4), proportional_problem(4, 4)
    args = maps, rows, offsets, PIECE_DURATION
    by_offsets = jax.jit(jax.grad(trajectory_energy, argnums=2), static_argnums=0)(*args)
    gradient = maps.offsets[:, 8:].T @ by_offsets
    coeffs = np.asarray(trajectory_of(*args).coeffs)
    start, end = ends(coeffs, durations_of(4), 7)
    np.testing.assert_allclose(gradient, 2.0 * (start[1:] - end[:-1]), rtol=1e-8)


def rows_of(head, tail, duration=PIECE_DURATION):
    """The boundary in the unit time of a piece."""
    powers = duration ** np.arange(len(head))[:, None]
    return np.concatenate([head * powers, tail * powers])


def proportional_problem(order, pieces):
    """Boundary rows and offsets."""
    head, tail, offsets, _ = problem(order, pieces, seed=1)
    return rows_of(head, tail), 0.3 * offsets


def solve_proportional(order, pieces, dtype=np.float64):
    args = (x.astype(dtype) for x in (*proportional_problem(order, pieces), PIECE_DURATION))
    return proportional_one(order, pieces, *args)


@float64
def test_boundary_rows_are_derivatives_in_the_average_time_of_a_piece():
    head, tail, _, _ = problem(4, 1)
    rows = jax.jit(boundary_rows)(head, tail, PIECE_DURATION)
    np.testing.assert_allclose(rows, rows_of(head, tail), rtol=1e-14)


@float64
@few_sizes
def test_the_energy_formula_is_the_energy_of_the_trajectory(order, pieces):
    trajectory, _, formula = solve_proportional(order, pieces)
    form = energy_form(order, np.asarray(trajectory.durations))
    np.testing.assert_allclose(formula, energy(np.asarray(trajectory.coeffs), form), rtol=1e-9)


@pytest.mark.parametrize("proportions", [(1.0,) * 12, (0.2, 0.5) + (1.0,) * 10, (1.0, 30.0)])
@every_order
def test_the_least_energy_is_that_of_a_frame_in_uniform_motion_far_away(order, proportions):
    form = proportional_minco(order, proportions).boundary_energy
    rows, _ = proportional_problem(order, 3)
    moving = rows.copy()
    moving[[0, order]] += [[10.0], [10.0 + 3.0 * len(proportions)]]  # metres, at 3 m a piece
    moving[[1, order + 1]] += 3.0
    at_rest, far_away = (np.einsum("bi,bc,ci->", x, form, x) for x in (rows, moving))
    np.testing.assert_allclose(far_away, at_rest, rtol=1e-9)


@every_size
def test_waypoints_and_offsets_are_found_from_each_other(order, pieces):
    maps = maps_of(order, pieces)
    rows, offsets = proportional_problem(order, pieces)
    waypoints = maps.waypoints @ np.concatenate([rows, offsets])
    back = maps.offsets @ np.concatenate([rows, waypoints])
    np.testing.assert_allclose(back, offsets, atol=1e-9)


@float64
@every_order
def test_no_offsets_are_the_least_energy_over_all_waypoints(order):
    """That is the one polynomial of degree 2s - 1 which joins the ends in the whole time."""
    rows, offsets = proportional_problem(order, 3)
    smooth, _, least = proportional_one(order, 3, rows, np.zeros_like(offsets), PIECE_DURATION)
    powers = PIECE_DURATION ** np.arange(order)[:, None]
    whole = [3.0 * PIECE_DURATION]
    joined = dense_solution(rows[:order] / powers, rows[order:] / powers, np.zeros((0, 3)), whole)
    np.testing.assert_allclose(smooth.coeffs[0], joined[0], atol=1e-8 * np.abs(joined).max())
    np.testing.assert_allclose(least, energy(joined, energy_form(order, whole)), rtol=1e-9)
    raised = maps_of(order, 3).offset_energy * np.sum(offsets**2)
    raised = raised / PIECE_DURATION ** (2 * order - 1)
    for sign in (1.0, -1.0):
        _, _, more = proportional_one(order, 3, rows, sign * offsets, PIECE_DURATION)
        np.testing.assert_allclose(more - least, raised, rtol=1e-6)


@every_size
def test_velocities_as_variables_change_nothing_while_they_are_the_smoothest(order, pieces):
    usual, supple = maps_of(order, pieces), maps_of(order, pieces, True)
    known = 2 * order + pieces - 1
    scale = np.abs(usual.coefficients).max()
    np.testing.assert_allclose(
        supple.coefficients[..., :known], usual.coefficients, atol=1e-9 * scale
    )
    assert supple.coefficients.shape[-1] == known + pieces - 1
    assert supple.offset_energy == pytest.approx(usual.offset_energy, rel=1e-9)
    moved = supple.waypoints[: pieces - 1, known:]
    np.testing.assert_allclose(moved, 0.0, atol=1e-9)


@every_size
def test_velocities_as_variables_cost_a_multiple_of_their_offsets_square(order, pieces):
    maps = maps_of(order, pieces, True)
    rows, _ = proportional_problem(order, pieces)
    offsets = np.random.default_rng(5).normal(size=(2 * (pieces - 1), 3))
    columns = np.concatenate([rows, offsets])
    coeffs = np.einsum("mkc,ci->mki", maps.coefficients, columns)
    form = energy_form(order, maps.proportions)
    found = energy(coeffs, form)
    least = np.einsum("bi,bc,ci->", rows, maps.boundary_energy, rows)
    np.testing.assert_allclose(found, least + maps.offset_energy * np.sum(offsets**2), rtol=1e-8)
    back = maps.offsets @ np.concatenate([rows, maps.waypoints @ columns])
    np.testing.assert_allclose(back, offsets, atol=1e-8)


@every_size
def test_velocities_as_variables_are_those_at_the_waypoints_and_pieces_join(order, pieces):
    maps = maps_of(order, pieces, True)
    columns = np.random.default_rng(6).normal(size=(maps.coefficients.shape[-1], 3))
    coeffs = np.einsum("mkc,ci->mki", maps.coefficients, columns)
    places = maps.waypoints @ columns
    for derivative in range(2 * order - 2):  # one fewer than with places alone
        factors = derivative_factors(2 * order - 1, derivative)
        powers = np.maximum(np.arange(2 * order) - derivative, 0)
        ends = np.einsum("mk,mki->mi", factors * maps.proportions[:, None] ** powers, coeffs)[:-1]
        begins = factors[derivative] * coeffs[1:, derivative]
        size = np.abs(ends).max(initial=1.0)
        np.testing.assert_allclose(ends, begins, atol=1e-7 * size)
        if derivative < 2:
            own = places[derivative * (pieces - 1) :][: pieces - 1]
            np.testing.assert_allclose(begins, own, atol=1e-9 * size)


@pytest.mark.parametrize("pieces", [2, 3, 8])
def test_a_unit_of_offsets_moves_the_waypoints_by_a_unit_at_most(pieces):
    moves = maps_of(4, pieces).waypoints[:, 8:]
    assert np.linalg.norm(moves, 2) == pytest.approx(1.0, rel=1e-9)


@float64
@pytest.mark.parametrize(("order", "pieces"), [(3, 3), (4, 1)])
def test_samples_are_the_values_of_the_trajectory(order, pieces):
    trajectory, motion, _ = solve_proportional(order, pieces)
    ends = np.concatenate([[0.0], np.cumsum(durations_of(pieces))])
    times = np.interp(np.arange(pieces * NODES + 1) / NODES, np.arange(pieces + 1), ends)

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, None))
    def evaluate_all(time, trajectory):
        return tuple(evaluate(trajectory, time, derivative) for derivative in range(4))

    pos, vel, acc, jerk = evaluate_all(times, trajectory)
    assert motion.height.shape == times.shape
    np.testing.assert_allclose(motion.height, pos[:, 2], atol=1e-10)
    for samples, values in ((motion.vel, vel), (motion.acc, acc), (motion.jerk, jerk)):
        size = np.abs(np.asarray(values)).max()
        np.testing.assert_allclose(samples, values, atol=1e-10 * size)


@float64
def test_proportional_batch_equals_loop():
    rows, offsets = proportional_problem(4, 5)
    many = [(rows, offsets, 0.45), (3.0 * rows, -offsets, 0.2), (rows[::-1], 0.0 * offsets, 1.0)]
    together = jax.jit(jax.vmap(functools.partial(proportional_one, 4, 5)))(
        *(np.stack(x) for x in zip(*many, strict=True))
    )
    for k, (rows, offsets, duration) in enumerate(many):
        alone = proportional_one(4, 5, rows, offsets, np.array(duration))
        for many_leaf, leaf in zip(*map(jax.tree.leaves, (together, alone)), strict=True):
            size = np.abs(np.asarray(leaf)).max()
            np.testing.assert_allclose(np.asarray(many_leaf)[k], leaf, atol=1e-12 * size)


def test_samples_and_energy_in_float32_are_right_to_a_millionth(float64):
    """Of the largest value of each kind."""
    single, double = (solve_proportional(4, 5, dtype) for dtype in (np.float32, np.float64))
    for leaf, exact in zip(*(jax.tree.leaves(x[1:]) for x in (single, double)), strict=True):
        assert leaf.dtype == np.float32
        size = np.abs(np.asarray(exact)).max()
        np.testing.assert_allclose(leaf, exact, atol=1e-6 * size)


@pytest.mark.parametrize("proportions", [(), (1.0, 0.0), (1.0, -2.0)])
def test_pieces_without_a_duration_are_refused(proportions):
    with pytest.raises(ValueError, match=r"^proportions must be some numbers > 0, got \("):
        proportional_minco(4, proportions)


def test_maps_are_built_once_and_know_only_ratios():
    assert proportional_minco(4, equal_pieces(3)) is proportional_minco(4, (1.0, 1.0, 1.0))
    one, other = proportional_minco(4, (0.2, 0.4)), proportional_minco(4, (1.0, 2.0))
    np.testing.assert_allclose(one.coefficients, other.coefficients, rtol=1e-12)
    np.testing.assert_allclose(one.proportions, [2.0 / 3.0, 4.0 / 3.0])
