"""Tests of the planner that warps stored motions of a library until they meet a given ball."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_block_library import setting

import planner_jax as pj
from planner_jax.baselines.block.library import build as building
from planner_jax.baselines.block.library.adapt import AdaptBlock, Effort, adapt_planner
from planner_jax.baselines.block.library.cells import Face, Layout, cell_of, cells_around
from planner_jax.baselines.block.library.file import save_library
from planner_jax.baselines.block.library.planner import LibraryBlock
from planner_jax.baselines.block.library.table import Row, library_of, pack_rows
from planner_jax.core.errors import ArgumentError
from planner_jax.robot.arm_file import irb1600
from planner_jax.task.block.default_planner import OnlineBlock
from planner_jax.task.block.end_poses import contact_terms, end_poses, flight_of
from planner_jax.task.block.motion import joint_terms, profiles
from planner_jax.task.block.scene import paper_scene

ONLINE = OnlineBlock(pieces=6, points=10)
LAYOUT = Layout((Face(0, 1, (3, 2)),), (Face(0, 1, (1, 2)),))
EFFORT = Effort(neighbours=4, points=4, screened=6, samples=8, checks=3)
BALL = ((9.0, 0.5, 0.3), (-8.0, -0.4, 5.4))
GOOD = [0, 6, 7]  # cases of the fixture `planned` that can be planned


def library(pieces=6, has_pole=True):
    case = pj.block.case(*BALL, scene=paper_scene(has_pole=has_pole))
    found = jax.jit(lambda case: end_poses(case, flight_of(case), 10, 6))(case)
    good = np.flatnonzero(np.asarray(found.effort) <= 0.99)
    ends = np.asarray(found.angles)[np.resize(good, LAYOUT.num_pairs)]
    steps = profiles(pieces, True)[0][:, None] * (ends - irb1600().home)[:, None]
    num = (1, LAYOUT.num_pairs)
    vectors = (np.broadcast_to(each, (*num, 3)) for each in np.eye(3))
    row: Any = Row(steps[None], np.full(num, 0.9), *vectors)  # type: ignore[arg-type]
    given = setting(capsule_radius=paper_scene(has_pole=has_pole).capsule_radius)
    return library_of(pack_rows(row), irb1600().home[None], LAYOUT, given)


def planner(has_pole=True):
    stored = LibraryBlock(library(has_pole=has_pole))
    return AdaptBlock(stored, online=ONLINE, efforts=(EFFORT,))


def warp(own, case, effort):
    flight = flight_of(case)
    poses = end_poses(case, flight, effort.points, own.online.pieces)
    return own.warp(case, flight, jnp.asarray(0), poses, effort)


def test_the_cells_around_a_point_are_the_nearest_of_its_face():
    layout, box = Layout((Face(0, 1, (4, 3)), Face(2, 1, (1, 5))), ()), paper_scene().outer
    faces = layout.outer
    at = jax.jit(lambda p: (cells_around(faces, box, tuple(p)), cell_of(faces, box, tuple(p))))
    rng = np.random.default_rng(0)
    middles = np.indices((4, 3)).reshape(2, -1).T
    for point in rng.uniform((1.0, -1.0, 0.0), (1.0, 1.0, 1.85), (20, 3)):
        (cells, away, found), (own, _) = at(point)
        share = (point[1:] - box.lower[1:]) / (box.upper[1:] - box.lower[1:])
        apart = ((share * (4, 3) - 0.5 - middles) ** 2).sum(axis=1)
        assert found and own in cells and len(set(cells.tolist())) == 4
        np.testing.assert_allclose(away, apart[cells], atol=1e-5)
        np.testing.assert_allclose(np.min(away), apart.min(), atol=1e-5)
    (cells, _, found), _ = at(np.array([0.0, 0.3, 1.85]))  # This face has one cell across.
    assert found and set(cells.tolist()) == {12 + 2, 12 + 3}
    assert not at(np.array([0.0, 1.0, 0.9]))[0][2]


@pytest.mark.slow
def test_warped_motions_meet_the_ball_and_open_ones_keep_their_limits():
    own = planner(has_pole=False)
    scene = paper_scene(has_pole=False)
    case = pj.block.case((9.0, 0.45, 0.35), BALL[1], scene=scene)

    @jax.jit
    def evaluate(case):
        flight = flight_of(case)
        warped = warp(own, case, EFFORT)

        def one(point):
            steps, first, duration = ONLINE.decode(case, point)
            share = 1.0 - ONLINE.slack
            excess = joint_terms(case, steps, first, duration, ONLINE.weights, share).excess
            angles = case.angles + jnp.asarray(1.0 / 6.0) * jnp.sum(steps, axis=0)
            return contact_terms(case, flight, angles, point[-1], ONLINE.weights)[2], excess

        return warped, *jax.vmap(one)(warped.points)

    warped, contact, joints = evaluate(case)
    there = np.isfinite(warped.penalty)
    assert there.any() and np.asarray(warped.is_open).any()
    assert (np.asarray(contact)[there] < 0.0).all()
    assert (np.asarray(joints)[np.asarray(warped.is_open)] <= -ONLINE.slack + 1e-5).all()


@pytest.mark.slow
def test_a_stored_motion_for_the_same_ball_is_not_warped():
    own = planner(has_pole=False)
    case = pj.block.case(*BALL, scene=paper_scene(has_pole=False))
    same = dataclasses.replace(EFFORT, points=10)
    warped = jax.jit(lambda case: warp(own, case, same))(case)
    shape = profiles(6, True)[0]
    steps = np.asarray(warped.points[:, :-1]).reshape(-1, 6, 6)
    turned = steps.sum(axis=1, keepdims=True) / shape.sum()
    np.testing.assert_allclose(steps, shape[:, None] * turned, atol=1e-4)
    assert np.min(warped.penalty) < 0.1


@pytest.fixture(scope="module")
def planned():
    own = planner(has_pole=False)
    pos = np.array(BALL[0]) + np.random.default_rng(2).uniform(-0.15, 0.15, (8, 3))
    cases = pj.block.case(pos, np.tile(BALL[1], (8, 1)), scene=paper_scene(has_pole=False))
    cases = jax.tree.map(np.array, cases)
    cases.ball.vel[1, 0] *= -1.0  # The ball flies away from the arm.
    cases.ball.pos[2] = np.nan
    cases.angles[3, 2] += 1e-2  # The arm is not at its home pose.
    cases.limits.velocity[4] *= 0.5  # The limits differ from the library's.
    cases.rates[5, 0] = 0.1  # The arm is not at rest.
    return own, cases, jax.device_get(pj.plan(own, jax.tree.map(jnp.asarray, cases)))


def test_statuses_name_the_reason_and_the_referee_confirms_solved_plans(planned):
    _, cases, plans = planned
    S = pj.Status
    assert plans.status[1] == S.OUT_OF_REACH and plans.status[2] == S.BAD_INPUT
    assert [S(int(s)) for s in plans.status[3:6]] == [S.BLOCKED] * 3
    verdict: Any = pj.block.judge(cases, plans)
    assert pj.are_solved(plans)[GOOD].all() and verdict.success[GOOD].all()


def test_invalid_files_and_cases_are_rejected(tmp_path):
    with pytest.raises(ValueError, match="adapt:FILE, which `planner-jax library build FILE`"):
        pj.block.planner("adapt")
    path = tmp_path / "a.lib"
    save_library(path, library())
    with pytest.raises(ArgumentError, match="^library must have motions of 10 pieces, got 6 in"):
        pj.block.planner(f"adapt:{path}")
    save_library(path, library(pieces=10))
    own = adapt_planner(path)
    own.check(pj.block.draw(2))
    with pytest.raises(ArgumentError, match=r"one of [0-9a-f]{12} for cases of [0-9a-f]{12}$"):
        own.check(pj.block.draw(1, regime="R1"))


@pytest.mark.slow
def test_the_referee_confirms_warped_and_refined_motions(tmp_path):
    path = tmp_path / "a.lib"
    layout = Layout((Face(0, 1, (4, 4)),), (Face(0, 1, (3, 3)),))
    building.build(path, setting(), irb1600().home, layout, progress=False)
    own, cases = adapt_planner(path), pj.block.draw(60, seed=11)
    blocked = []
    for efforts in (own.efforts[:1], own.efforts):
        plans = pj.plan(dataclasses.replace(own, efforts=efforts), cases)
        verdict: Any = pj.block.judge(cases, plans)
        assert not (pj.are_solved(plans) & ~verdict.success).any()
        blocked.append(pj.are_solved(plans))
    assert (blocked[1] | ~blocked[0]).all() and blocked[1].sum() > blocked[0].sum() > 0
