"""Tests of cars that drive in reverse, change gears and stop."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.plane.reach import Lattice, Vehicle, grid_of, reach_set

PLANNER = pj.intercept.planner()
# A corridor in which the car cannot turn attempt in one sweep.
CORRIDOR = [
    np.array([[0.0, y], [8.0, y], [8.0, y + 0.1], [0.0, y + 0.1]], np.float32) for y in (3.4, 4.5)
]


def target(x, y=4.0):
    return pj.TurningPath(jnp.array([x, y], jnp.float32), jnp.zeros(2), jnp.array(0.0))


def case_of(x, start=(5.0, 4.0, 0.0), reverse_speed=0.7, **numbers):
    numbers = {"initial_speed": 0.0, "walls": CORRIDOR} | numbers
    return pj.intercept.case(target(x), start=start, reverse_speed=reverse_speed, **numbers)


def solve(case):
    plan = pj.plan(PLANNER, case)
    verdict = pj.intercept.judge(case, plan)
    assert pj.are_solved(plan) and verdict.success, verdict.sentence()
    return np.asarray(plan.speed), plan, verdict


@pytest.mark.slow
def test_a_target_behind_the_car_in_a_corridor_is_met_in_reverse():
    speed, _, verdict = solve(case_of(1.0))
    assert speed.min() >= -0.7 * 1.001 and speed.max() <= 1e-3
    assert verdict.max_speed == pytest.approx(-speed.min(), rel=1e-6)


@pytest.mark.slow
def test_a_car_that_drives_forward_changes_the_gear_and_one_in_reverse_does_so_too():
    speed = solve(case_of(1.0, start=(4.0, 4.0, 0.0), initial_speed=0.5))[0]
    assert speed[0] == 0.5 and speed[-1] < -0.1
    speed = solve(case_of(6.0, start=(4.0, 4.0, 0.0), initial_speed=-0.5))[0]
    assert speed[0] == -0.5 and speed[-1] > 0.1


@pytest.mark.slow
def test_a_stop_is_an_end_speed_of_zero_and_the_end_may_be_bounded_to_reverse():
    stop = dataclasses.replace(case_of(3.0), end_speed=jnp.zeros(2))
    assert abs(solve(stop)[0][-1]) <= 1e-3 * 1.5
    moving = dataclasses.replace(case_of(2.0), end_speed=jnp.array([-0.6, -0.5]))
    assert -0.601 <= solve(moving)[0][-1] <= -0.499


@pytest.mark.slow
def test_the_plan_in_reverse_does_not_depend_on_units():
    case = case_of(1.0)
    scaled = {name: 1000.0 * getattr(case.body, name) for name in vars(case.body)}
    given = vars(case.limits).items()
    limits = {name: 1000.0 * limit for name, limit in given if limit is not None}
    limits |= {"curvature": case.limits.curvature / 1e3, "steering_rate": jnp.array(2.0)}
    small = pj.intercept.case(
        pj.TurningPath(jnp.array([1000.0, 4000.0]), jnp.zeros(2), jnp.array(0.0)),
        start=(5000.0, 4000.0, 0.0),
        initial_speed=0.0,
        walls=[1000.0 * wall for wall in CORRIDOR],
        tolerance=50.0,
        upper=(8000.0, 8000.0),
        **scaled,
        **limits,
    )
    np.testing.assert_allclose(solve(small)[0], 1000.0 * solve(case)[0], atol=1.0)


@pytest.mark.slow
def test_the_referee_rejects_reverse_without_the_gear_or_faster_than_allowed():
    case = case_of(1.0)
    _, plan, _ = solve(case)
    for reverse in (None, jnp.array(0.3)):
        limits = dataclasses.replace(case.limits, reverse_speed=reverse)
        verdict = pj.intercept.judge(dataclasses.replace(case, limits=limits), plan)
        assert not verdict.success and verdict.sentence().startswith("speed: ")


@pytest.mark.parametrize("speed", [-0.8, 1.6])
def test_an_initial_speed_out_of_the_limits_is_an_error_that_names_it(speed):
    with pytest.raises(pj.CaseError, match="^initial_speed must be from -reverse_speed to"):
        case_of(1.0, initial_speed=speed)


def test_cells_in_reverse_mirror_those_ahead():
    lattice = Lattice((64, 64), layers=6, levels=3, headings=8, reverse_levels=2)
    start, size = jnp.array([2.0, 2.0, 0.0]), jnp.array([4.0, 4.0])
    grid = grid_of(lattice, start, jnp.array(4.0), jnp.array(0.5), 0.0 * size, size)
    speeds = 0.5 * jnp.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    vehicle = Vehicle(
        radius=jnp.array(0.0),
        ahead=jnp.zeros(1),
        speeds=speeds,
        turn_rates=jnp.full(5, 0.0),
        acceleration=jnp.array(jnp.inf),
    )
    nobody = case_of(1.0).movers
    field, allowed = jnp.ones((64, 64)), jnp.ones((8, 64, 64), bool)
    reach = jax.jit(reach_set)
    found = reach(grid, field, allowed, nobody, vehicle, jnp.array(0.0), jnp.array(6))
    bits = np.asarray(found.bits)[4, :, :, 0]  # (words, levels, rows), of the first heading
    cells = (bits[..., None] >> np.arange(32, dtype=np.uint32)) & 1
    row = np.moveaxis(cells, 0, 2)[:, int(grid.start[1])].reshape(5, 64)
    middle = int(grid.start[0])
    ahead = [set(np.flatnonzero(row[k]) - middle) for k in range(5)]
    assert ahead[4] == {-cell for cell in ahead[0]} and ahead[3] == {-cell for cell in ahead[1]}
    assert max(ahead[4]) > 3 and 0 in ahead[2]
