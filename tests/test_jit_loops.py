"""Cases and plans inside the user's own `jit`, `vmap`, `scan` and `grad`: traced arguments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from trees import as_numpy

import planner_jax as pj
from planner_jax.core.protocol import Status
from planner_jax.core.rules import is_sound
from planner_jax.optimise.settings import Attempt, LbfgsConfig

BALL, VELOCITY = np.float32([4.0, 0.5, 2.0]), np.float32([-7.0, 0.0, 6.0])
TARGET, PLACES = np.float32([3.0, 0.0, 0.0]), np.float32([[0.0, 0.0, 1.6]] * 2)
NUM = 3
POSITIONS = BALL + np.linspace(0.0, 0.2, NUM, dtype=np.float32)[:, None]
FEW = (Attempt(1, LbfgsConfig(max_steps=20)),)
FLIGHT = {  # arguments of all three builders
    "start": np.float32([0.3, -0.2, 1.0]),
    "start_velocity": np.float32([0.1, 0.2, 0.3]),
    "start_attitude": np.float32([0.9, 0.1, 0.0, 0.3]),
    "gravity": np.float32(9.7),
    "speed": np.float32(5.5),
    "max_thrust": np.float32(30.0),
    "body_rate": np.float32(6.0),
    "rotor_drag": np.float32([0.1, 0.2]),
    "wind": np.float32([1.0, 0.0, 0.5]),
    "heading": np.float32(0.4),
    "max_yaw_rate": np.float32(1.5),
    "extras": (pj.KeepOut(np.float32([0.0, 2.0, 1.0]), np.float32(0.3)),),
}
RACKET = {"drag": np.float32(0.03), "restitution": np.float32(0.8), "max_apex": np.float32(5.0)}
NET = {"present": np.array([True]), "net_radius": np.float32(0.2), "max_angle": np.float32(0.6)}
BOX = {"place_range": np.float32([0.4, 0.4, 0.2]), "home": np.float32([0.0, 0.0, 1.0])}
GIVEN = {
    "hit": FLIGHT | RACKET | {"spin": np.float32([1.0, 20.0, 3.0])},
    "catch": FLIGHT | NET,
    "rally": FLIGHT | RACKET | BOX,
}


def path_of(pos, vel=VELOCITY):
    shape = pos.shape[:-1]
    pos, vel = (jnp.broadcast_to(jnp.asarray(each), pos.shape)[..., None, :] for each in (pos, vel))
    zeros = jnp.zeros((*shape, 1, 3), pos.dtype)
    return pj.BallPath(pj.BallState(pos, vel), zeros, jnp.full((*shape, 1), 9.81, pos.dtype))


def make(task, pos, vel=VELOCITY, **given):
    """Return a case of a task, or a batch, for balls at positions `pos` (..., 3)."""
    full = jnp.broadcast_to(jnp.asarray(vel), pos.shape) if len(np.shape(pos)) else vel
    if task == "catch":
        return pj.catch.case(path_of(pos, vel), np.full((*pos.shape[:-1], 1), 1.2), **given)
    if task == "rally":
        return pj.rally.case(pos, full, PLACES, **given)
    return pj.hit.case(pos, full, jnp.broadcast_to(TARGET, pos.shape), **given)


def assert_alike(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert ours.dtype == theirs.dtype
        np.testing.assert_allclose(ours, theirs, rtol=2e-6, atol=2e-6)


tasks = pytest.mark.parametrize("task", ["hit", "catch", "rally"])


@tasks
def test_every_argument_may_be_traced(task):
    given = GIVEN[task]
    found = jax.jit(lambda pos, vel, given: make(task, pos, vel, **given))(BALL, VELOCITY, given)
    assert_alike(found, make(task, BALL, **given))


@tasks
def test_the_structure_of_a_traced_case_is_known_before_its_values(task):
    expected = make(task, BALL, **GIVEN[task])
    found = jax.eval_shape(lambda pos: make(task, pos, **GIVEN[task]), BALL)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    shapes = [[np.shape(x) for x in jax.tree.leaves(each)] for each in (found, expected)]
    assert shapes[0] == shapes[1]
    starts = jax.jit(lambda start: make(task, BALL, start=start))
    for start in ([0.0, 0.0, 1.0], [700.0, 0.0, 1.0]):
        assert starts(np.float32(start)).origin is None
    far = jax.jit(lambda start: is_sound(make(task, BALL, start=start)))
    assert not far(np.float32([2e4, 0.0, 1.0]))  # float32 rounds it by 2 mm


@tasks
def test_vmap_over_positions_is_the_batch(task):
    given = GIVEN[task]
    found = jax.vmap(lambda pos: make(task, pos, **given))(POSITIONS)
    assert_alike(found, make(task, POSITIONS, **given))


@tasks
def test_leaves_have_derivatives_by_arguments(task):
    def height(pos, start):
        case = make(task, pos, start=start)
        ball = case.targets.ball if task == "catch" else case.ball
        return ball.pos[..., 2].sum() + 2.0 * case.head_state[0, 1]

    slopes = jax.grad(height, (0, 1))(BALL, FLIGHT["start"])
    np.testing.assert_array_equal(slopes[0], [0.0, 0.0, 1.0])
    np.testing.assert_array_equal(slopes[1], [0.0, 2.0, 0.0])


@tasks
def test_origins_may_be_traced(task):
    away = np.float32([700.0, -300.0])
    start, ball = (x + np.float32([*away, 0.0]) for x in (FLIGHT["start"], BALL))
    given = {"place_range": np.zeros(3)} if task == "rally" else {}

    def at(origin, ball):
        if task == "hit":
            return pj.hit.case(ball, VELOCITY, ball, start=start, origin=origin)
        if task == "catch":
            return pj.catch.case(path_of(ball), [1.2], start=start, origin=origin)
        places = PLACES + jnp.append(origin, 0.0)[None]
        return pj.rally.case(ball, VELOCITY, places, start=start, origin=origin, **given)

    assert_alike(jax.jit(at)(away, ball), at(away, ball))
    sound = jax.jit(lambda origin, ball: is_sound(at(origin, ball)))
    assert sound(away, ball)
    assert not sound(away, ball + np.float32([2e5, 0.0, 0.0]))  # float32 rounds it by 10 mm


BAD = {
    "hit": {
        "drag": -1.0,
        "speed": -1.0,
        "start": [0.0, 0.0, 0.01],
        "start_attitude": [0.0] * 4,
        "spin": [1e5, 0.0, 0.0],
        "wind": [200.0, 0.0, 0.0],
        "heading": np.nan,
    },
    "catch": {"net_radius": 0.0, "start": [np.nan, 0.0, 1.0], "min_thrust": 90.0},
    "rally": {"min_contact": 1.9, "place_range": [0.1, 0.1, 5.0], "restitution": 2.0},
}


@pytest.mark.parametrize(("task", "name"), [(task, name) for task in BAD for name in BAD[task]])
def test_a_traced_case_with_a_bad_value_is_bad_input(task, name):
    usual = {"rotor_drag": 0.5, "max_thrust": 30.0} if name == "wind" else {}
    sound = jax.jit(lambda value: is_sound(make(task, BALL, **{name: value}, **usual)))
    with pytest.raises(pj.CaseError if name != "spin" else ValueError):
        make(task, BALL, **{name: BAD[task][name]}, **usual)
    assert not sound(np.float32(BAD[task][name]))


def test_a_ball_below_the_ground_is_bad_input():
    sound = jax.jit(lambda pos: is_sound(make("hit", pos)))
    assert sound(BALL) and not sound(-BALL)


def test_lists_may_hold_traced_numbers():
    found = jax.jit(lambda x: pj.hit.case([x, 0.5, 2.0], VELOCITY, TARGET))(BALL[0])
    assert_alike(found, make("hit", BALL))


ERRORS = {
    "ball_pos must have a shape that ends with (3,), got (2,)": lambda x: pj.hit.case(x[:2], x, x),
    "drag must have the shape (), got (3,)": lambda x: make("hit", BALL, drag=x),
    "drag must be numbers, got": lambda x: make("hit", BALL, drag=x.astype(complex)),
    "speed must be numbers, got": lambda x: make("hit", BALL, speed=[x, "fast"]),
    "restitution must be numbers, got": lambda x: make("hit", BALL, restitution=[x, x[:2]]),
    "gravity must be numbers, got": lambda x: make("hit", BALL, gravity=jax.random.key(0)),
    "spin must have the shape (3,), got ()": lambda x: make("hit", BALL, spin=x[0]),
    "origin must have the shape (2,), got (3,)": lambda x: make("hit", BALL, origin=x),
    "heading must have the shape (3,), got (2,)": lambda x: make("hit", BALL, heading=(x, x[:2])),
    "start_attitude must be left out beside start_acceleration, got both": lambda x: make(
        "hit", BALL, start_attitude=np.ones(4), start_acceleration=x
    ),
    "horizon must have an entry for each target": lambda x: pj.catch.case(path_of(x), x[0]),
    "targets must have leaves that begin with the shape (3,)": lambda x: pj.catch.case(
        path_of(x), x
    ),
    "present must be True or False of each target": lambda x: make("catch", BALL, present=x[:1]),
    "start must have the shape (3,), got (2,)": lambda x: make("catch", BALL, start=x[:2]),
    "places must have the shape (K, 3) with K >= 1": lambda x: pj.rally.case(BALL, VELOCITY, x),
    "spin must be left out for rallies": lambda x: make("rally", BALL, spin=x),
}


@pytest.mark.parametrize("words", ERRORS)
def test_wrong_shapes_and_kinds_raise_while_a_function_is_traced(words):
    with pytest.raises(ValueError) as caught:
        jax.eval_shape(ERRORS[words], BALL)
    assert str(caught.value).startswith(words) and "\n" not in str(caught.value)


@tasks
@pytest.mark.slow
def test_a_scan_plans_and_plans_again(task):
    decide = {"decide": "greedy"} if task == "catch" else {}
    planner = pj.task_named(task).planner("exact", attempts=FEW, **decide)

    def step(pos, elapsed):
        case, moved = make(task, pos), pos + elapsed * VELOCITY
        plan = pj.solve(planner, case)
        ball = pj.BallState(moved, jnp.asarray(VELOCITY))
        news = {"targets": path_of(moved)} if task == "catch" else {"ball": ball}
        later = pj.replan(planner, case, plan, elapsed, **news)
        return pos + 0.01, (plan.status, later.status, later.trajectory.coeffs)

    scan = jax.jit(lambda pos, times: jax.lax.scan(step, pos, times)[1])
    times = np.full(NUM, 0.02, np.float32)
    first, later, coeffs = scan(BALL, times)
    assert first.shape == later.shape == (NUM,) and np.isfinite(coeffs).all()
    assert not (np.append(first, later) == Status.BAD_INPUT).any()
    first, later, _ = scan(BALL, -times)
    assert (first != Status.BAD_INPUT).all() and (later == Status.BAD_INPUT).all()
    first, later, _ = scan(BALL * np.float32(np.nan), times)
    assert (first == Status.BAD_INPUT).all() and (later == Status.BAD_INPUT).all()


@tasks
@pytest.mark.slow
def test_vmap_plans_every_lane(task):
    planners = {
        "hit": pj.hit.planner("juggle"),
        "catch": pj.catch.planner("exact", decide="greedy", attempts=FEW),
        "rally": pj.rally.planner("exact", attempts=FEW),
    }
    planner = planners[task]
    bad = POSITIONS.copy()
    bad[1] = np.nan
    program = jax.jit(jax.vmap(lambda pos: pj.solve(planner, make(task, pos))))
    status = np.asarray(program(bad).status)
    assert status[1] == Status.BAD_INPUT and (status[[0, 2]] != Status.BAD_INPUT).all()
    plans = as_numpy(program(POSITIONS))
    verdict = getattr(pj, task).judge(as_numpy(make(task, POSITIONS)), plans)
    assert verdict.success[pj.are_solved(plans)].all()
