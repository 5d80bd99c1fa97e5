import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import double

import planner_jax as pj
from planner_jax.benchmarks.compilation import record_programs
from planner_jax.benchmarks.latency import begin_replans
from planner_jax.optimise.levenberg import LevenbergConfig
from planner_jax.robot.car import pose_at
from planner_jax.robot.car_motion import Quadratic, by_unknowns, motion
from planner_jax.task.intercept.problem.motion_problem import MotionProblem
from planner_jax.task.intercept.problem.terms import Weights
from planner_jax.task.intercept.searches import make_field, make_grid
from tests.planners import ONE_SEARCH, with_room
from tests.trees import as_numpy

# Planners in these tests make one search, so that only one program is compiled.
PLANNER = pj.intercept.planner(searches=ONE_SEARCH)
START = np.array([0.8, 4.0, 0.3])
WALL = [[3.9, -0.5], [4.1, -0.5], [4.1, 8.5], [3.9, 8.5]]
BOX = np.array([[-1.0, -0.5], [1.0, -0.5], [1.0, 0.5], [-1.0, 0.5]])
HALF = [[3.9, -0.5], [4.1, -0.5], [4.1, 5.5], [3.9, 5.5]]


@pytest.fixture
def knots():
    rng = np.random.default_rng(0)
    return rng.uniform(0.2, 1.5, 9), rng.uniform(-2.0, 2.0, 9)


def test_the_motion_follows_the_car_s_kinematics(knots, float64):
    times = np.linspace(0.0, 4.0, 5 * (len(knots[0]) - 1) + 1)[1:]
    start, end = jnp.asarray(START), jnp.asarray(4.0)

    @jax.jit
    def both(speed, curvature):
        poses = jax.vmap(lambda t: pose_at(start, end, speed, curvature, t))(times)
        return motion(start, end, speed, curvature, 5), poses

    found, poses = jax.device_get(both(*knots))
    np.testing.assert_allclose(found.pos.reshape(-1, 2), poses[:, :2], atol=2e-5)
    np.testing.assert_allclose(found.heading.ravel(), poses[:, 2], atol=1e-12)
    np.testing.assert_allclose(found.time.ravel(), times, atol=1e-12)
    np.testing.assert_allclose(found.direction[..., 0], np.cos(found.heading), atol=1e-12)


def test_gradient_and_curvature_by_the_unknowns_match_automatic_differentiation(knots, float64):
    speed, curvature = map(jnp.asarray, knots)
    num, samples = len(speed) - 1, 3
    rng = np.random.default_rng(1)
    roots = rng.normal(size=(num, samples, 4, 4)), rng.normal(size=(num, 5, 5))
    squares = [jnp.asarray(root @ root.swapaxes(-1, -2)) for root in roots]
    cost = Quadratic(
        push=jnp.asarray(rng.normal(size=(num, samples, 4))),
        stiffness=squares[0],
        piece_push=jnp.asarray(rng.normal(size=(num, 5))),
        piece_stiffness=squares[1],
    )

    def unpack(point):
        v, c = jnp.append(speed[:1], point[:num]), jnp.append(curvature[:1], point[num:-1])
        return v, c, point[-1]

    def samples_of(point):
        v, c, time = unpack(point)
        found = motion(jnp.asarray(START), time, v, c, samples)
        return jnp.concatenate([found.pos, found.heading[..., None], found.time[..., None]], -1)

    def pieces_of(point):
        v, c, time = unpack(point)
        return jnp.stack([v[:-1], v[1:], c[:-1], c[1:], jnp.full(num, time)], axis=1)

    @jax.jit
    def both(point):
        v, c, time = unpack(point)
        drive = motion(jnp.asarray(START), time, v, c, samples)
        slopes = jax.jacfwd(samples_of)(point), jax.jacfwd(pieces_of)(point)
        return slopes, by_unknowns(drive, cost, True), by_unknowns(drive, cost, False)

    point = jnp.concatenate([speed[1:], curvature[1:], jnp.array([4.0])])
    (of_samples, of_pieces), free, fixed = both(point)
    gradient = np.einsum("ksi,ksin->n", cost.push, of_samples)
    gradient += np.einsum("ki,kin->n", cost.piece_push, of_pieces)
    curvature = np.einsum("ksin,ksij,ksjm->nm", of_samples, cost.stiffness, of_samples)
    curvature += np.einsum("kin,kij,kjm->nm", of_pieces, cost.piece_stiffness, of_pieces)
    np.testing.assert_allclose(free[0], gradient, atol=1e-10)
    np.testing.assert_allclose(free[1], curvature, atol=1e-10)
    np.testing.assert_allclose(fixed[0], gradient[:-1], atol=1e-10)
    np.testing.assert_allclose(fixed[1], curvature[:-1, :-1], atol=1e-10)


def test_a_pose_is_the_integral_of_the_car_s_kinematics(knots, float64):
    num = 40000
    time, knot_times = (np.arange(num) + 0.5) / num * 2.3, np.linspace(0.0, 4.0, 9)
    v, c = (np.interp(time, knot_times, values) for values in knots)
    turn = v * c * 2.3 / num
    heading = START[2] + np.cumsum(turn) - 0.5 * turn
    step = v * 2.3 / num
    expected = START + [np.sum(step * np.cos(heading)), np.sum(step * np.sin(heading)), turn.sum()]
    found = jax.jit(pose_at)(START, 4.0, *knots, 2.3)
    np.testing.assert_allclose(found, expected, atol=1e-7)


# With meet="early" the meeting time is a decision variable, too.
@pytest.mark.parametrize("meet", [pytest.param("given", marks=pytest.mark.slow), "early"])
def test_the_gradient_of_the_cost_matches_finite_differences(knots, float64, meet):
    case = double(pj.take(pj.intercept.draw(1, "hard", 5), 0))
    case = case.replace(end_heading=jnp.array(2.0), heading_tolerance=jnp.array(0.1))
    case = case.replace(limits=case.limits.replace(jerk=jnp.array(0.4)))
    if meet == "early":  # the unknown of a prescribed speed at the end moves to this speed
        case = case.replace(end_speed=jnp.zeros(2), tolerance=jnp.array(0.01))
    problem = MotionProblem(meet, pieces=8)
    grid = jax.jit(lambda case: make_grid(case, ONE_SEARCH[0].lattice, is_time_free=False))(case)
    field = jax.jit(make_field)(case, grid)
    positions = jnp.asarray(np.random.default_rng(3).uniform(1.0, 7.0, (8, 2)))
    given = case, field, Weights(follow=1.0), positions
    model = jax.jit(lambda point: problem.build_model(point, *given))
    speed, curvature = (jnp.asarray(1.2 * each[1:]) for each in knots)
    point = problem.pack(speed, curvature, jnp.array(9.0))
    found = model(point)
    assert found.cost > 1.0 and found.violation > 0.0
    steps = 1e-6 * jnp.eye(point.size)
    slopes = [(model(point + step).cost - model(point - step).cost) / 2e-6 for step in steps]
    scale = np.abs(found.gradient).max()
    np.testing.assert_allclose(2.0 * found.gradient, slopes, rtol=2e-3, atol=2e-3 * scale)


def draw_hard():
    return pj.intercept.draw(12, "hard", 7)


@pytest.fixture(scope="module")
def planned():
    cases = as_numpy(with_room(draw_hard()))
    return cases, pj.plan(PLANNER, cases)


def test_the_referee_confirms_the_planner(planned):
    cases, plans = planned
    verdict = pj.intercept.judge(cases, plans)
    solved = pj.are_solved(plans)
    assert solved.sum() >= 10
    np.testing.assert_array_equal(verdict.success, solved)
    assert verdict.miss[solved].max() <= 0.05
    assert "target" in verdict.sentence(int(np.argmax(solved)))


@pytest.mark.slow
def test_effort_best_also_solves_starts_beside_walls_without_space_for_margins():
    cases = pj.take(pj.intercept.draw(600, "hard", 1), np.array([20, 176, 291, 506]))
    efforts = ("feasible", "best")
    usual, best = (pj.plan(pj.intercept.planner(effort=each), cases) for each in efforts)
    success = pj.intercept.judge(cases, best).success
    assert success.sum() > pj.are_solved(usual).sum() and (success | ~pj.are_solved(best)).all()


def test_a_plan_is_sampled_at_a_rate_up_to_its_end(planned):
    cases, plans = planned
    k = int(np.argmax(pj.are_solved(plans)))
    one = pj.take(plans, k).sample(50.0)
    assert one.time.shape == (501,) and one.pos.shape == (501, 2)
    np.testing.assert_allclose(one.pos[0], cases.start[k, :2], atol=1e-5)
    rate = np.linalg.norm(np.diff(one.pos, axis=0), axis=1) * 50.0
    np.testing.assert_allclose(rate, 0.5 * (one.speed[1:] + one.speed[:-1]), atol=0.02)
    np.testing.assert_allclose(one.yaw_rate, one.speed * one.curvature, atol=1e-5)
    middle = one.pos[-1] + 0.15 * np.array([np.cos(one.heading[-1]), np.sin(one.heading[-1])])
    assert np.linalg.norm(middle - plans.meeting[k]) <= 0.05
    batch = plans.sample(10.0)
    assert batch.pos.shape == (12, 101, 2)


def still(x, y):
    return pj.TurningPath(jnp.array([x, y]), jnp.zeros(2), jnp.array(0.0))


def scene(target, walls=(), **settings):
    return pj.intercept.case(still(*target), walls=walls, **settings)


def stack(cases):
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(x) for x in leaves]), *cases)


NEAR = (6.0, 4.0)
SCENES = {
    "a wall across": (scene((6.0, 4.0), [WALL]), pj.Status.NO_PATH),
    "start in a wall": (scene((6.0, 4.0), [WALL], start=(3.85, 4.0, 0.0)), pj.Status.BLOCKED),
    "goal in a wall": (scene((4.0, 4.0), [WALL]), pj.Status.BLOCKED),
    "off the map": (scene((8.5, 4.0)), pj.Status.BLOCKED),
    "too far for the time": (scene((7.8, 4.0), time=3.0), pj.Status.TOO_FAR),
    "NaN": (dataclasses.replace(scene(NEAR), target=still(np.nan, 4.0)), pj.Status.BAD_INPUT),
    "north": (scene((5.0, 5.0), end_heading=0.5 * np.pi), pj.Status.CONVERGED),
    "west": (scene((5.0, 5.0), end_heading=np.pi), pj.Status.CONVERGED),
    "at rest": (scene((5.0, 5.0), initial_speed=0.0), pj.Status.CONVERGED),
    "faster": (scene((5.0, 5.0), initial_speed=1.3, start=(0.8, 1.0, 1.2)), pj.Status.CONVERGED),
}


@pytest.fixture(scope="module")
def scenes():
    batch = stack([case for case, _ in SCENES.values()])
    return batch, jax.device_get(pj.plan(PLANNER, jax.tree.map(jnp.asarray, batch)))


@pytest.mark.parametrize("name", SCENES)
def test_an_unsolvable_case_has_a_status_and_others_are_solved(scenes, name):
    k, status = list(SCENES).index(name), SCENES[name][1]
    case, plan = pj.take(scenes, k)
    assert plan.status == status
    assert pj.Status(plan.status).message
    verdict = pj.intercept.judge(case, plan)
    assert verdict.success == (status == pj.Status.CONVERGED), verdict.sentence()


def with_absent_last(cases):
    """Return cases in which the absent obstacles, the first ones of `with_room`, come last."""
    groups = {name: getattr(cases, name) for name in ("walls", "movers")}
    return cases.replace(**jax.tree.map(lambda leaf: leaf[:, ::-1], groups))


# Arrays without room for more obstacles need another compiled program.
@pytest.mark.parametrize("is_narrow", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_absent_obstacles_and_repeated_corners_change_no_plan(planned, scenes, is_narrow):
    cases, plans = planned
    same = as_numpy(draw_hard()) if is_narrow else with_absent_last(cases)
    found = pj.plan(PLANNER, same)
    np.testing.assert_array_equal(found.status, plans.status)
    assert np.isclose(found.cost, plans.cost, rtol=1e-3).mean() >= 0.8
    ours, theirs = (pj.intercept.judge(each, plans) for each in (same, cases))
    for name in ("success", "wall_clearance", "mover_clearance"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    batch, expected = scenes
    walls, across = batch.walls, np.array(WALL + WALL[-1:] * 4, np.float32)
    corners = np.where(walls.present[..., None, None], walls.corners, across)
    batch = batch.replace(walls=walls.replace(corners=corners))
    again = pj.plan(PLANNER, jax.tree.map(jnp.asarray, batch))
    np.testing.assert_array_equal(again.status, expected.status)
    np.testing.assert_allclose(again.cost, expected.cost, rtol=1e-5)


def test_other_numbers_of_obstacles_and_corners_compile_nothing(scenes):
    target = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (10, *leaf.shape)), still(7.0, 4.0))

    def plan(num):
        sides = 3 + np.arange(num) % 4
        circles = [2.0 * np.pi * np.arange(each)[:, None] / each for each in sides]
        polygons = [0.2 * np.hstack([np.cos(angle), np.sin(angle)]) for angle in circles]
        walls, movers = ([p + [2.0 + 0.5 * k, y] for k, p in enumerate(polygons)] for y in (2, 6))
        cases = pj.intercept.case(
            target, np.full(10, 10.0), walls=walls, movers=movers, mover_velocities=(0.0, -0.1)
        )
        return pj.intercept.judge(cases, pj.plan(PLANNER, cases))

    assert plan(1).success.all() and plan(5).success.all()  # up to 4, and 5 to 12 movers
    with record_programs() as programs:
        assert all(plan(num).success.all() for num in (3, 4, 6, 9))
    assert not programs


@pytest.fixture(scope="module")
def early():
    batch = stack([scene((5.0, 5.0)), scene((6.0, 4.0), [HALF]), scene((6.0, 4.0), [WALL])])
    search = dataclasses.replace(ONE_SEARCH[0], solver=LevenbergConfig(40))
    return batch, pj.plan(pj.intercept.planner(meet="early", searches=(search,)), batch)


@pytest.mark.slow
def test_an_early_meeting_is_little_later_than_a_straight_drive(early):
    cases, plans = early
    verdict = pj.intercept.judge(cases, plans)
    assert verdict.success[:2].all() and plans.status[2] == pj.Status.NO_PATH
    # Least time: accelerate from 0.5 to 1.5 m/s in 1 s, on 1 m, and then drive at 1.5 m/s.
    distance = np.linalg.norm(plans.meeting - cases.start[:, :2] - [0.15, 0.0], axis=1)
    least = 1.0 + (distance - 0.05 - 1.0) / 1.5
    assert np.all(plans.time[:2] > least[:2])
    assert plans.time[0] < least[0] + 0.6  # it has to turn by 15 degrees
    assert plans.time[0] < plans.time[1] < 10.0
    np.testing.assert_array_equal(plans.cost[:2], plans.time[:2])


@pytest.mark.slow
@pytest.mark.parametrize(
    "numbers",
    [{"end_speed": (0.0, 0.0)}, {"end_speed": (0.0, 0.001)}, {"tolerance": 0.01}, {"time": 4.0}],
    ids=["stop", "nearly a stop", "small tolerance", "little time"],
)
def test_an_early_meeting_does_not_wait_for_the_time_limit(numbers):
    path = pj.TurningPath(jnp.array([6.0, 4.0]), jnp.zeros(2), jnp.array(0.0))
    case = pj.intercept.case(path, **numbers)
    plan = pj.plan(pj.intercept.planner(meet="early"), case)
    verdict = pj.intercept.judge(case, plan)
    assert pj.are_solved(plan) and verdict.success, verdict.sentence()
    # Least time: accelerate from 0.5 to 1.5 m/s in 1 s, on 1 m, and drive at 1.5 m/s. A stop
    # takes 1.5 s, on 1.125 m. The body's middle is 0.15 m ahead of the rear axle.
    distance = 6.0 - 0.8 - 0.15 - numbers.get("tolerance", 0.05) - 1.0
    is_stop = "end_speed" in numbers
    least = 1.0 + (distance - 1.125 * is_stop) / 1.5 + 1.5 * is_stop
    assert least - 5e-3 < float(plan.time) < least + 0.18


@pytest.mark.slow
def test_a_plan_stays_the_same_for_an_unchanged_target(planned):
    cases, plans = planned
    good = np.flatnonzero(pj.are_solved(plans))
    cases, plans = pj.take((cases, plans), good)
    elapsed = 2.0
    target = jax.vmap(lambda path: path.at(elapsed))(cases.target)
    turned = pj.TurningPath(target.pos, target.vel, cases.target.turn_rate)
    again = pj.replan(PLANNER, cases, plans, elapsed)  # by default for the target of the cases
    assert pj.are_solved(again).all()
    np.testing.assert_allclose(again.time, 8.0, atol=1e-5)
    np.testing.assert_allclose(again.meeting, plans.meeting, atol=1e-3)
    before, after = plans.sample(10.0), again.sample(10.0)
    np.testing.assert_allclose(after.pos[:, 0], before.pos[:, 20], atol=1e-4)
    # A plan that is made again at 2 s stays near the part of the first plan after 2 s.
    apart = np.linalg.norm(after.pos - before.pos[:, 20:], axis=-1)
    assert np.median(apart) < 0.1
    movers = cases.movers.replace(centre=cases.movers.centre + elapsed * cases.movers.velocity)
    start = {"start": again.start, "speed": again.speed[:, 0], "curvature": again.curvature[:, 0]}
    moved = cases.replace(target=turned, time=again.time, movers=movers, **start)
    assert pj.intercept.judge(moved, again).success.all()


@pytest.mark.slow
def test_a_wall_that_is_seen_on_the_way_is_avoided():
    straight = pj.TurningPath(jnp.array([6.0, 4.0]), jnp.zeros(2), jnp.array(0.0))
    case = pj.intercept.case(straight, 10.0, walls=[np.array([[0, 0], [1, 0], [0, 1]], float)])
    plan = pj.plan(PLANNER, case)
    walls = pj.obstacles([np.array([[4, 3.7], [4.2, 3.7], [4.2, 4.4], [4, 4.4]], float)])
    again = pj.replan(PLANNER, case, plan, 2.0, walls=walls)
    driven = {"start": again.start, "speed": again.speed[0], "curvature": again.curvature[0]}
    seen = dataclasses.replace(case, walls=walls, time=again.time, **driven)
    assert not pj.intercept.judge(dataclasses.replace(case, walls=walls), plan).success
    assert pj.are_solved(again) and pj.intercept.judge(seen, again).success
    with pytest.raises(TypeError, match="walls must be made by pj.obstacles, got a list"):
        pj.replan(PLANNER, case, plan, 2.0, walls=[np.zeros((3, 2))])


def test_latency_plans_the_remainders_of_solved_plans_again(planned):
    cases, plans = planned
    planner, tasks = begin_replans(PLANNER, cases, 2.0)
    assert planner == PLANNER.replanner()
    assert len(tasks.case.time) == pj.are_solved(plans).sum()
    np.testing.assert_allclose(tasks.case.time, 8.0, atol=1e-5)
    goal = jax.vmap(lambda case: case.target.at(case.time).pos)
    np.testing.assert_allclose(goal(tasks.case), goal(cases)[pj.are_solved(plans)], atol=1e-4)


def problem(length=1.0, time=1.0, shift=(0.0, 0.0), turn=0.0):
    """Return a car's drive past a box, in units that are 1 / `length` m and 1 / `time` s."""
    cos, sin = np.cos(turn), np.sin(turn)
    shift = np.asarray(shift, float)

    def move(points):
        return length * np.asarray(points, float) @ np.array([[cos, sin], [-sin, cos]]) + shift

    speed, acceleration = length / time, length / time**2
    velocity = move([3.0, 0.5]) - move([0.0, 0.0])
    target = pj.TurningPath(move([14.0, 3.0]), velocity / time, np.zeros(()))
    return pj.intercept.case(
        target,
        6.0 * time,
        start=(*move([0.0, 0.0]), turn),
        initial_speed=5.0 * speed,
        walls=[move(BOX + [9.0, 0.5])],
        lower=-np.inf,
        upper=np.inf,
        tolerance=0.3 * length,
        length=4.5 * length,
        width=1.6 * length,
        wheelbase=2.6 * length,
        rear_overhang=0.9 * length,
        speed=12.0 * speed,
        acceleration=4.0 * acceleration,
        lateral_acceleration=4.0 * acceleration,
        curvature=0.18 / length,
        steering_rate=0.6 / time,
    )


# Length and time of the units [1/m, 1/s], position [m] and heading [rad] of the frame.
UNITS = [
    (1.0, 1.0, (0.0, 0.0), 0.0),
    (1000.0, 1.0, (0.0, 0.0), 0.0),
    (1e-3, 1.0 / 3600.0, (0.0, 0.0), 0.0),
    (1.0, 1.0, (5e5, 4.6e6), 0.0),
    (1.0, 1.0, (-30.0, 20.0), 2.2),
    (1000.0, 1.0, (5e8, 1e8), -0.7),
]


@pytest.fixture(scope="module")
def in_units():
    cases = stack([problem(*each) for each in UNITS])
    return cases, pj.plan(PLANNER, cases)


def test_a_problem_in_other_units_far_away_and_rotated_has_the_same_plan(in_units):
    cases, plans = in_units
    usual = pj.take(plans, 0)
    assert usual.status == pj.Status.CONVERGED
    assert pj.intercept.judge(cases, plans).success.all()
    for k, (length, time, _, _) in enumerate(UNITS):
        plan = pj.take(plans, k)
        np.testing.assert_allclose(plan.speed * time / length, usual.speed, rtol=2e-3, atol=2e-3)
        np.testing.assert_allclose(plan.curvature * length, usual.curvature, atol=1e-3)
        np.testing.assert_allclose(plan.cost * time**3 / length**2, usual.cost, rtol=1e-2)


def test_samples_of_a_plan_at_utm_coordinates_are_exact_to_a_millimetre(in_units):
    shift = np.asarray(UNITS[3][2])
    far, here = (pj.take(in_units[1], k).sample(5.0).pos for k in (3, 0))
    assert far.dtype == np.float64
    np.testing.assert_allclose(far[0], shift, atol=1e-9)
    np.testing.assert_allclose(far - shift, here, atol=0.02)


@pytest.mark.slow
def test_the_car_avoids_a_recorded_mover_and_stops_in_a_region_with_a_margin():
    lorry = 0.4 * BOX
    path = ([0.0, 5.0, 10.0], [[3.0, 4.0, 0.0], [4.0, 4.0, 1.5], [5.0, 7.0, 1.6]])
    case = pj.intercept.case(
        pj.TurningPath(np.float32([6.5, 4.0]), np.zeros(2, np.float32), np.float32(0.0)),
        movers=[lorry],
        mover_paths=[path],
        walls=[pj.intercept.Circle(4.5, 2.6, 0.3)],
        region=[[-0.5, -0.3], [0.5, -0.3], [0.5, 0.3], [-0.5, 0.3]],
        tolerance=0.01,
        end_speed=(0.0, 0.05),
        margin=0.1,
    )
    plan = pj.plan(PLANNER, case)
    verdict = pj.intercept.judge(case, plan)
    assert plan.status == pj.Status.CONVERGED and verdict.success, verdict.sentence(())
    assert verdict.mover_clearance >= 0.099 and verdict.wall_clearance >= 0.099
    assert verdict.end_speed <= 0.0501 and verdict.miss <= 0.01


def test_the_status_says_why_there_is_no_plan():
    target = pj.TurningPath(np.float32([6.5, 4.0]), np.zeros(2, np.float32), np.float32(0.0))
    settings = {
        pj.Status.TOO_FAR: {"time": 1.0},
        pj.Status.BLOCKED: {"start": (0.8, 4.0, 0.0), "walls": [0.3 * BOX + [0.9, 4.0]]},
        pj.Status.NO_PATH: {"walls": [[[2, -1], [2.2, -1], [2.2, 9], [2, 9]]]},
    }
    cases = [pj.intercept.case(target, **{"time": 10.0, **each}) for each in settings.values()]
    cases.append(pj.intercept.case(target, 10.0, start=(-1.0, 4.0, 0.0)))
    status = pj.plan(PLANNER, stack(cases)).status
    np.testing.assert_array_equal(status, [*settings, pj.Status.BLOCKED])


def test_bad_input_is_rejected_in_one_line():
    with pytest.raises(ValueError, match="^meet must be given, early or least, got 'soon'$"):
        pj.intercept.planner(meet="soon")
    with pytest.raises(ValueError, match=r"^target must have leaves that begin with .* \(3,\)"):
        scene(NEAR, time=np.ones(3))


@pytest.mark.slow
def test_a_limited_jerk_is_kept():
    slow = {"time": 7.5, "initial_speed": 0.2}
    free, limited = (scene((7.0, 4.0), [HALF], jerk=jerk, **slow) for jerk in (np.inf, 0.8))
    assert free.limits.jerk is None
    plans = [pj.plan(PLANNER, case) for case in (free, limited)]
    verdicts = [pj.intercept.judge(limited, plan) for plan in plans]
    assert [str(each.failed_limit) for each in verdicts] == ["jerk", ""]
    assert verdicts[0].max_jerk > 1.2 and verdicts[1].max_jerk <= 0.8 * 1.001
