"""The planner of [Yu2023bat] with a variable state at the transition between two sections."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import assert_gradient_matches_differences

import planner_jax as pj
from planner_jax.ball.flight import gravity_vector
from planner_jax.baselines.hit.bat import _COST_UNIT, BatHit
from planner_jax.baselines.hit.common import motion_excess
from planner_jax.baselines.parts.lbfgs_lite import LitePlanner, LiteRule, minimise_lite
from planner_jax.penalties.hinges import smooth_hinge
from planner_jax.trajectory.polynomial import Motion, evaluate

pytestmark = pytest.mark.usefixtures("float64")
# [s], waypoints of one spline of 4 equal pieces, and of two halves of 2 pieces, are the same.
HALVES = (0.6, 0.6)
PAIR = BatHit(sections=2)
RULE = LiteRule(gradient=1e-7, decrease=1e-9)


def states_at(trajectory, times, num):
    """Return the derivatives of orders 0 to `num` - 1 at T times, (T, num, 3)."""
    orders = [jax.vmap(lambda t, d=d: evaluate(trajectory, t, d))(times) for d in range(num)]
    return jnp.stack(orders, axis=1)


def point_of(problem, plan, case):
    """Return the variables of two sections whose waypoints and states are on a plan's motion."""
    end = plan.stroke.time
    switch = problem.stage_times[0] / sum(problem.stage_times) * end
    shares = np.arange(1, problem.num_pieces) / problem.num_pieces
    times = jnp.concatenate([shares * switch, switch + shares * (end - switch)])
    waypoints = states_at(plan.trajectory, times, 1)
    middle, tail = states_at(plan.trajectory, jnp.stack([switch, end]), 4)
    thrust = tail[2] - gravity_vector(case.gravity)
    parts = [waypoints.ravel(), middle.ravel(), jnp.log(end)[None], tail[1, 1:], thrust[::2]]
    return jnp.concatenate(parts) / jnp.asarray(problem.scale)


@functools.partial(jax.jit, static_argnums=0)
def convert(problem, plan, case):
    """Return the variables of two sections on a plan's motion, and their cost."""
    point = point_of(problem, plan, case)
    return point, problem.objective(point, problem.prepare(case)).cost


def one_case(k=0):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[k], pj.hit.draw(8, seed=3, dtype=np.float64))


@functools.partial(jax.jit, static_argnums=0)
def near_guess(problem, case, shift=0.0):
    """Return the first guess plus a shift, its context, plan and cost, and the impact's parts."""
    context = problem.prepare(case)
    point = problem.first_guess(context) + shift
    impact, defect = problem.impact((point * jnp.asarray(problem.scale))[-5:], context)
    parts = problem.transition_state(impact, case), problem._terminal_penalty(impact, defect, case)
    plan, cost = problem.decode(point, context), problem.objective(point, context).cost
    return point, context, plan, cost, *parts


def test_both_sections_have_the_variable_state_at_the_transition():
    shift = np.random.default_rng(0).normal(size=len(PAIR.scale)) * 0.3
    point, _, plan, *_ = near_guess(PAIR, one_case(), shift)
    state = (point * jnp.asarray(PAIR.scale))[18:30].reshape(4, 3)
    coeffs, durations = plan.trajectory.coeffs, plan.trajectory.durations
    factors = np.array([1.0, 1.0, 2.0, 6.0])[:, None]
    np.testing.assert_allclose(factors * coeffs[4, :4], state, rtol=1e-9, atol=1e-9)
    ends = [np.polynomial.Polynomial(axis) for axis in coeffs[3].T]
    ends = [[each.deriv(d)(durations[3]) for each in ends] for d in range(4)]
    np.testing.assert_allclose(ends, state, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(durations, np.repeat([7.0, 5.0], 4) / 48.0 * plan.stroke.time)


def test_the_first_guess_is_the_transition_state_of_the_published_front_end():
    point, *_, state, _ = near_guess(PAIR, one_case(), np.zeros(len(PAIR.scale)))
    natural = point * jnp.asarray(PAIR.scale)
    np.testing.assert_allclose(natural[18:27].reshape(3, 3), state, rtol=1e-12)
    np.testing.assert_array_equal(natural[27:30], 0.0)


def test_the_cost_of_the_first_guess_equals_a_direct_evaluation():
    case = one_case()
    _, _, plan, cost, _, ends = near_guess(PAIR, case, np.zeros(len(PAIR.scale)))
    coeffs, durations = (np.asarray(each) for each in jax.tree.leaves(plan.trajectory))
    energy, penalty = 0.0, 0.0
    roots, weights = np.polynomial.legendre.leggauss(8)
    limits = case.limits
    units = np.array([limits.speed**2, limits.acceleration**2, limits.body_rate**2, 1.0])
    for piece, duration in zip(coeffs, durations, strict=True):
        axes = [np.polynomial.Polynomial(axis) for axis in piece.T]
        snap = [axis.deriv(4)(0.5 * duration * (roots + 1.0)) for axis in axes]
        energy += 0.5 * duration * np.sum(weights * np.square(snap))
        times = np.linspace(0.0, duration, PAIR.nodes + 1)
        pos, vel, acc, jerk = (
            jnp.stack([axis.deriv(d)(times) for axis in axes], axis=-1) for d in range(4)
        )
        excess = motion_excess(Motion(pos[:, 2], vel, acc, jerk), case.gravity, limits)
        hinges = smooth_hinge(jnp.stack(excess) * units[:, None], PAIR.hinge_width).sum(0)
        penalty += PAIR.limit_weight * np.sum(0.5 * (hinges[1:] + hinges[:-1]) * np.diff(times))
    expected = energy + PAIR.time_weight * plan.stroke.time + penalty + ends
    np.testing.assert_allclose(cost * _COST_UNIT, expected, rtol=1e-8)


def test_one_spline_is_a_point_of_two_halves_with_equal_cost_and_gradients_are_right():
    single, halves = BatHit(), BatHit(sections=2, num_pieces=2, stage_times=HALVES)
    case = one_case(1)
    _, context, plan, single_cost, *_ = near_guess(single, case)
    same, cost = convert(halves, plan, case)
    np.testing.assert_allclose(cost, single_cost, rtol=1e-9)
    objective = jax.jit(lambda x: halves.objective(x, context).cost)
    assert_gradient_matches_differences(objective, same)


def optimise(problem, start, case):
    context = problem.prepare(case)
    return minimise_lite(lambda x: _COST_UNIT * problem.objective(x, context).cost, start, RULE)


@pytest.mark.slow
@pytest.mark.parametrize("problem", [PAIR, BatHit(sections=2, num_pieces=2, stage_times=HALVES)])
def test_from_the_optimum_of_one_spline_two_sections_are_not_dearer(problem):
    cases = pj.hit.draw(8, seed=3, dtype=np.float64)
    plans = pj.plan(LitePlanner(BatHit(), _COST_UNIT, RULE), cases)
    starts, _ = jax.vmap(functools.partial(convert, problem))(plans, cases)
    search = jax.jit(jax.vmap(functools.partial(optimise, problem)))
    _, cost, _, _ = search(starts, cases)
    assert (cost / _COST_UNIT <= plans.cost * (1.0 + 1e-6)).all()


def test_a_variable_transition_needs_a_transition():
    with pytest.raises(ValueError, match="sections must be 1 to 2, got 3"):
        BatHit(sections=3)
    with pytest.raises(ValueError, match="sections must be 1 to 1, got 2"):
        BatHit(sections=2, transition=False)
