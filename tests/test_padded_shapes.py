"""Shapes of cases that planners pad, so that many cases share few compiled programs."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.ball.prediction import PathTable
from planner_jax.core.planner import Planner
from planner_jax.core.shapes import next_size, resize
from planner_jax.optimise.levenberg import LevenbergConfig
from planner_jax.plane.obstacle_sizes import fit_obstacles
from planner_jax.plane.obstacles import Obstacles, distances, place
from planner_jax.plane.reach import Lattice
from planner_jax.plane.target import LaterPath, TurningPath
from planner_jax.robot.arm_clearance import least_clearances
from planner_jax.robot.arm_file import irb1600
from planner_jax.robot.scene_sizes import fit_scene
from planner_jax.task.intercept.problem.clearance import least_gap
from planner_jax.task.intercept.problem.shapes import fit_case
from planner_jax.task.intercept.searches import Search
from planner_jax.task.reach.default_planner import Search as ReachSearch
from tests.trees import as_numpy

INTERCEPT = pj.intercept.planner(searches=(Search(2, LevenbergConfig(10), lattice=Lattice()),))
REACH = pj.reach.planner(searches=(ReachSearch(),))
AHEAD = TurningPath(*(np.asarray(x, np.float32) for x in ((4.0, 4.0), (0.1, 0.0), 0.0)))
NUMBERS = (1, 2, 4, 5, 16, 17, 40, 64)


def squares(num, corners=4):
    """Return `num` small polygons along the edge y = 0 of the map, with so many corners each."""
    angles = 2.0 * np.pi * np.arange(corners) / corners
    ring = 0.05 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return [ring + (0.1 + 0.1 * k, 0.1) for k in range(num)]


def group(num, corners=4):
    """Return obstacles in arrays without padding, as `pj.obstacles` would pad them."""
    rings = np.array(squares(num, corners), np.float32).reshape(num, corners, 2)
    centre = rings.mean(axis=1)
    none = np.zeros(num, np.float32)
    still = np.zeros((num, 2), np.float32)
    return Obstacles(centre, rings - centre[:, None], still, np.ones(num, bool), none, none)


def drive(walls=1, movers=1, **options):
    options = {"target": AHEAD, "time": 6.0} | options
    return as_numpy(pj.intercept.case(walls=group(walls), movers=group(movers), **options))


def table(num):
    """Return a target's path of `num` nodes at 0.2 s, on a curve."""
    times = 0.2 * (np.arange(num) - 1.0)
    pos = np.stack([4.0 + np.sin(times), 4.0 + 0.1 * times**2], axis=1)
    vel = np.stack([np.cos(times), 0.2 * times], axis=1)
    return PathTable(*(np.asarray(x, np.float32) for x in (pos, vel, 0.2)))


def layout(case):
    return jax.tree.structure(case), tuple((x.shape, x.dtype) for x in jax.tree.leaves(case))


def scene_of(boxes=1, spheres=0, cylinders=0):
    return pj.reach.make_scene(
        boxes=[
            ((-1.5, 0.05 * k, 2.5), (0.1, 0.02, 0.1), (1.0, 0.0, 0.0, 0.0)) for k in range(boxes)
        ],
        spheres=[((-1.5, 0.05 * k, 2.0), 0.02) for k in range(spheres)],
        cylinders=[
            ([(-1.5, 0.05 * k, 0.0), (-1.5, 0.05 * k, 1.0)], 0.02) for k in range(cylinders)
        ],
    )


def reach(scene, goals=1):
    home = irb1600().home
    turned = [np.add(home, (0.3 + 0.005 * k, *[0.0] * 5)) for k in range(goals)]
    return as_numpy(pj.reach.case(goals=np.array(turned), scene=scene))


def test_the_next_size_is_the_first_that_suffices_or_the_number_itself():
    assert [next_size(n, (4, 16, 64)) for n in (0, 4, 5, 64, 65)] == [4, 4, 16, 64, 65]


def test_an_axis_is_cut_off_or_padded_in_arrays_of_both_kinds():
    rows = np.arange(6.0, dtype=np.float32).reshape(2, 3)
    for leaf in (rows, jnp.asarray(rows)):
        assert type(resize(leaf, -1, 5)) is type(jnp.asarray(leaf) if leaf is not rows else rows)
        np.testing.assert_array_equal(resize(leaf, -1, 2), rows[:, :2])
        np.testing.assert_array_equal(resize(leaf, -2, 3, None), rows[[0, 1, 1]])
        np.testing.assert_array_equal(resize(leaf, -1, 4, 7.0)[:, 3], [7.0, 7.0])
        assert resize(leaf, -1, 3) is leaf and resize(leaf, -1, 4).dtype == np.float32


def test_1_to_64_walls_and_movers_and_nodes_of_a_target_have_three_shapes():
    cases = [drive(walls, movers) for walls in NUMBERS for movers in NUMBERS]
    assert len({layout(fit_case(case)) for case in cases}) == 3
    cases = [drive(target=table(nodes)) for nodes in range(5, 65)]
    assert len({layout(fit_case(case)) for case in cases}) == 1
    many = fit_case(drive(65, 70, target=table(80)))
    sizes = many.walls.present.size, many.movers.present.size, len(many.target.pos)
    assert sizes == (65, 70, 80)


def test_options_of_an_interception_that_are_numbers_have_one_shape():
    options = [{}, {"jerk": 3.0}, {"mover_growth": 0.1}, {"end_heading": 0.3}]
    options += [{"region": 0.1 * np.array(ring)} for ring in (squares(1, 3)[0], squares(1, 8)[0])]
    shape = {"walls": squares(2), "movers": squares(2), "time": 6.0}
    cases = [as_numpy(pj.intercept.case(AHEAD, **shape, **each)) for each in options]
    assert len({layout(fit_case(case)) for case in cases}) == 1
    paths = [([0.0, 1.0], np.zeros((2, 3))), (np.arange(40.0), np.zeros((40, 3)))]
    cases = [as_numpy(pj.intercept.case(AHEAD, **shape, mover_paths=[p, None])) for p in paths]
    assert len({layout(fit_case(case)) for case in cases}) == 1


def test_a_case_of_fitting_shapes_is_padded_to_itself():
    once = fit_case(drive(3, 2, target=table(9)))
    twice = fit_case(once)
    chex.assert_trees_all_equal(once, twice, strict=True)


def test_a_batch_and_its_arrays_on_a_device_are_padded_as_its_cases():
    cases = as_numpy(pj.intercept.draw(3, "easy", 1))
    for batch in (cases, jax.tree.map(jnp.asarray, cases)):
        padded = INTERCEPT.fit_shapes(batch)
        chex.assert_trees_all_equal(pj.take(padded, 1), fit_case(pj.take(cases, 1)))
        kinds = {isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(padded)}
        assert kinds == {batch is cases}


@pytest.mark.parametrize("corners", [3, 6, 7, 20])
def test_padded_obstacles_are_as_far_as_before(corners):
    turning = ([0.0, 2.0], np.array([[1.0, 1.0, 0.0], [2.0, 1.0, 1.0]]))
    polygons = [turning_ring - 1.0 for turning_ring in squares(2, corners)]
    moving = as_numpy(pj.obstacles(polygons, paths=[turning, None]))
    for before in (group(3, corners), moving):
        after = fit_obstacles(before, 16, ())
        assert after.present.shape == (16,) and after.present.sum() == before.present.sum()
        points = np.random.default_rng(1).uniform(0.0, 3.0, (2, 1, 50)).astype(np.float32)
        least = []
        for each in (before, after):
            placed = place(jax.tree.map(jnp.asarray, each), jnp.linspace(0.0, 2.0, 50))
            far, _ = distances(each.corners, placed.present, *placed.enter(*points))
            least.append(jnp.min(far - placed.radius, axis=0))
        np.testing.assert_allclose(least[0], least[1], rtol=1e-6)


def test_the_least_gap_to_chunks_of_walls_is_the_gap_to_the_nearest_wall():
    case = drive(3, 2)
    pos, heading = jnp.asarray([[0.5, 0.5], [2.0, 0.3]]), jnp.asarray([0.1, 2.0])
    least = [
        least_gap(each, pos, heading, jnp.asarray([0.0, 1.0]))
        for each in (case, dataclasses.replace(case, walls=fit_obstacles(case.walls, 64, ())))
    ]
    assert least[0] == least[1]


def test_a_padded_table_is_the_same_path_before_within_and_after_its_times():
    short = table(9)
    case = dataclasses.replace(drive(target=short), target=LaterPath(short, np.float32(0.1)))
    path = fit_case(case).target.path
    assert len(path.pos) == 64 and path.count == 9
    for time in (-0.3, 0.0, 0.55, 1.19, 1.2, 1.3, 5.0):
        chex.assert_trees_all_close(path.at(time), short.at(time), rtol=1e-6)


def test_1_to_64_bodies_of_a_kind_or_goals_have_three_shapes():
    planner = pj.reach.planner()
    for kind in ("boxes", "spheres", "cylinders"):
        cases = [reach(scene_of(**{"boxes": 0, kind: num})) for num in NUMBERS]
        assert len({layout(planner.fit_shapes(case)) for case in cases}) == 3
    cases = [reach(scene_of(), goals) for goals in NUMBERS]
    assert len({layout(planner.fit_shapes(case)) for case in cases}) == 3
    balls = (3.0, 0.1, 0.4), (-8.0, 0.0, 3.0)
    cases = [as_numpy(pj.block.case(*balls, scene=scene_of(num))) for num in NUMBERS]
    assert len({layout(pj.block.planner().fit_shapes(case)) for case in cases}) == 3
    more = planner.fit_shapes(reach(scene_of(65), 65))
    assert len(more.scene.box_half) == len(more.goals) == 65


def test_bodies_that_are_added_to_a_scene_are_far_from_the_arm(tmp_path):
    arm, cube = irb1600(), np.array(np.meshgrid(*[(-0.1, 0.1)] * 3)).reshape(3, 8).T
    mesh = (cube, 1.0, (0.9, 0.1, 0.5), (1.0, 0.0, 0.0, 0.0))
    scene = pj.reach.make_scene(meshes=[mesh], boxes=[((0.9, 0.0, 1.6), (0.2,) * 3, (1, 0, 0, 0))])
    scene = dataclasses.replace(
        scene,
        **vars(scene_of(0, 2, 2))
        | {name: getattr(scene, name) for name in ("meshes", "box_middle", "box_turn", "box_half")},
    )
    padded = fit_scene(scene, ())
    assert padded.meshes is None and len(padded.box_half) == 8 == len(padded.cylinder_radius)
    angles = arm.home + np.random.default_rng(2).uniform(-0.5, 0.5, (5, 6)).astype(np.float32)
    least = [least_clearances(arm, each, angles) for each in (scene, padded)]
    np.testing.assert_allclose(*least, atol=1e-6)


def test_the_index_of_a_goal_counts_the_goals_of_the_caller():
    case = reach(scene_of(), goals=3)
    beyond = dataclasses.replace(case, goals=case.goals + np.float32(50.0))
    assert pj.plan(REACH, case).goal < 3
    assert pj.plan(REACH, beyond).status == pj.Status.OUT_OF_REACH


@pytest.mark.slow
def test_a_session_of_1_to_64_walls_movers_and_nodes_compiles_three_programs(monkeypatch):
    counted = chex.assert_max_traces(type(INTERCEPT).solve, n=3)
    monkeypatch.setattr(type(INTERCEPT), "solve", counted)
    for walls, movers, nodes in ((1, 1, 5), (16, 4, 64), (17, 5, 9), (3, 12, 20), (64, 64, 30)):
        case = drive(walls, movers, target=table(nodes))
        assert pj.plan(INTERCEPT, case).status != pj.Status.BAD_INPUT
    chex.clear_trace_counter()


@pytest.mark.slow
def test_a_session_of_1_to_64_bodies_and_goals_compiles_three_programs(monkeypatch):
    monkeypatch.setattr(type(REACH), "solve", chex.assert_max_traces(type(REACH).solve, n=3))
    for bodies, goals in ((1, 1), (2, 8), (8, 5), (9, 17), (64, 64)):
        case = reach(scene_of(bodies), goals)
        assert pj.reach.judge(case, pj.plan(REACH, case)).success
    chex.clear_trace_counter()


@pytest.mark.slow
@pytest.mark.parametrize("suite", ["easy", "medium", "hard", "maze", "rush", "gale", "storm"])
def test_padded_interceptions_have_the_plans_of_the_cases(suite, monkeypatch):
    assert_equal_plans(INTERCEPT, pj.intercept.draw(4, suite, 1), monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("suite", ["pole", "open", "short"])
def test_padded_blocks_have_the_plans_of_the_cases(suite, monkeypatch):
    assert_equal_plans(pj.block.planner(), pj.block.draw(4, suite, 1), monkeypatch)


@pytest.mark.slow
def test_padded_reaches_have_the_plans_of_the_cases(monkeypatch):
    assert_equal_plans(pj.reach.planner(), pj.reach.draw(4, "pillar", 1), monkeypatch)
    some = [as_numpy(reach(scene_of(5, 3, 2), goals)) for goals in (1, 3)]
    for case in some:
        one = jax.tree.map(lambda leaf: leaf[None], case)
        assert_equal_plans(REACH, one, monkeypatch)


def assert_equal_plans(planner, cases, monkeypatch):
    """Assert that single plans of a batch have the status and cost of plans without padding."""
    cases = as_numpy(cases)
    each = [pj.take(cases, k) for k in range(cases.batch_shape[0])]
    padded = [pj.plan(planner, case) for case in each]
    with monkeypatch.context() as patch:
        patch.setattr(type(planner), "fit_shapes", Planner.fit_shapes)
        plain = [pj.plan(planner, case) for case in each]
    for ours, theirs in zip(padded, plain, strict=True):
        chex.assert_trees_all_equal_shapes(ours, theirs)
        assert ours.status == theirs.status
        np.testing.assert_allclose(ours.cost, theirs.cost, rtol=1e-4)
        np.testing.assert_allclose(ours.violation, theirs.violation, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_a_case_of_65_walls_and_traced_cases_are_planned():
    case = drive(65, 2)
    plan = pj.plan(INTERCEPT, case)
    assert pj.intercept.judge(case, plan).success
    few = drive(3, 2)
    within = jax.jit(lambda case: pj.solve(INTERCEPT, case))(few)
    np.testing.assert_allclose(within.cost, pj.plan(INTERCEPT, few).cost, rtol=1e-4)
