"""Tests of extras, which are limits and costs along the trajectory that a user adds to a case."""

import dataclasses
import functools
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import planner_jax as pj
from planner_jax.cost.extras import for_batch, greatest_extras
from planner_jax.trajectory.polynomial import PiecewisePolynomial, states_at
from planner_jax.trajectory.proportional_minco import boundary_rows
from tests.derivatives import assert_gradient_matches_differences

FREE = pj.hit.HitProblem(learned=False)
CATCH = pj.catch.planner("exact", decide="given")
HIT = pj.SearchPlanner(FREE, FREE.attempts[1:2])  # One attempt needs one program.
NUM, AT, FAR = 4, np.zeros(3), np.full((4, 3), 50.0)
TRACES = []
# Values with which the five limits and costs that `having` adds to cases have no effect.
PLAIN: dict[str, Any] = {"centre": FAR, "radius": 1.0, "disliked": FAR, "weight": 0.0}
PLAIN |= {"acceleration": 99.0, "low": FAR, "size": 1.0, "point": -FAR, "normal": (0.0, 0.0, 1.0)}


@struct.dataclass
class Gentle:
    """A limit on the horizontal acceleration, which records whether its inputs are NumPy arrays."""

    acceleration: Any  # () [m/s^2], greatest horizontal acceleration

    def excess(self, pos, vel, acc):
        TRACES.append(isinstance(pos, np.ndarray))
        return (acc[..., :2] ** 2).sum(-1) / self.acceleration**2 - 1.0


def having(cases, **changes):
    given = SimpleNamespace(**PLAIN | changes)

    def array(value, *shape):
        return np.broadcast_to(np.asarray(value, np.float32), (NUM, *shape))

    zones = (
        pj.KeepOut(array(given.centre, 3), array(given.radius)),
        pj.Dislike(array(given.disliked, 3), array(0.4), array(given.weight)),
        Gentle(array(given.acceleration)),
        pj.KeepOutBox(array(given.low, 3), array(given.low + given.size, 3)),
        pj.Plane(array(given.point, 3), array(given.normal, 3)),
    )
    return cases.replace(extras=zones)


def way(plans, k, num=200):
    path = pj.take(plans.trajectory, k)
    many = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], num, axis=0), path)
    return states_at(many, np.linspace(0.0, path.durations.sum(), num))[:, 0]


def straight(path, vel):
    coeffs = np.zeros_like(path.coeffs[:1])
    starts = np.cumsum(path.durations[:1], axis=1) - path.durations[:1]
    coeffs[:, :, 0], coeffs[:, :, 1] = starts[..., None] * vel, vel
    return PiecewisePolynomial(coeffs, path.durations[:1])


def places(plans):
    found = []
    for k in range(NUM):
        flown = way(plans, k)
        distance = np.linalg.norm(flown - flown[0], axis=1)
        found.append(flown[np.argmax(distance > 0.5 * distance[-1])])
    return np.array(found)


@pytest.fixture(scope="module")
def hits():
    return jax.tree.map(np.asarray, pj.hit.draw(NUM, seed=11))


@pytest.fixture(scope="module")
def free(hits):
    return pj.plan(pj.hit.planner(), hits)  # compiled by test_exact


@pytest.fixture(scope="module")
def middle(free):
    return places(free)


@pytest.fixture(scope="module")
def blocked(hits, middle):
    centre = middle + np.array([0.0, 0.03, 0.0])
    return having(hits, centre=centre, radius=np.array([0.2, 0.25, 0.15, 0.2]))


@pytest.fixture(scope="module")
def around(blocked):
    return pj.plan(HIT, blocked)


def test_excess_and_cost_have_their_closed_forms():
    pos = np.array([[0.5, 0.0, 0.0], [0.0, 3.0, 4.0], [0.0, 0.0, 2.25]])
    vel = np.array([[3.0, 0.0, 4.0], [0.0, 5.0, 0.0], [0.0, 0.0, 5.0]])
    found = pj.KeepOut(AT, 2.0).excess(pos, vel, vel)
    np.testing.assert_allclose(found, [0.75, -1.5, -0.125], atol=1e-9)
    # The positions are half a metre outside the box, half way between face and middle, and on a
    # face. The excess is the depth divided by half the shortest side, which is 4 m long.
    box = pj.KeepOutBox(np.array([-2.0, -2.0, 0.0]), np.array([2.0, 3.0, 4.0]))
    where = np.array([[0.0, 3.5, 2.0], [1.0, 0.5, 2.0], [0.0, 0.5, 0.0]])
    np.testing.assert_allclose(box.excess(where, vel, vel), [-0.25, 0.5, 0.0], atol=1e-12)
    wall = pj.Plane(np.array([0.0, 2.0, 7.0]), np.array([0.0, -3.0, 0.0]))
    np.testing.assert_allclose(wall.excess(pos, vel, vel), [-2.0, 1.0, -2.0], atol=1e-12)
    found = pj.Geofence(np.array([-1.0, -1.0, 0.0]), np.full(3, 3.5)).excess(pos, vel, vel)
    np.testing.assert_allclose(found, [0.0, 0.5, -1.0], atol=1e-12)
    # The speed limit is 2.5 m/s inside the zone (first position), absent beyond 1.25 radii (second
    # position), and 5 m/s halfway between (third position).
    found = pj.SpeedZone(AT, 2.0, 2.5).excess(pos, vel, vel)
    np.testing.assert_allclose(found, [1.0, -1.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(pj.Dislike(AT, 1.0, 2.0).cost(pos, vel, vel), [1.125, 0.0, 0.0])


@pytest.mark.parametrize(
    "extra",
    [
        pj.KeepOut(AT, 2.0),
        pj.Geofence(AT - 1.0, AT + 0.5),
        pj.KeepOutBox(AT - 1.0, AT + np.array([0.5, 2.0, 0.9])),
        pj.Plane(AT + 0.1, np.array([1.0, -2.0, 0.5])),
        pj.SpeedZone(AT, 0.8, 2.0),
        pj.Dislike(AT, 2.0, 1.0),
    ],
    ids=lambda extra: type(extra).__name__,
)
def test_gradients_match_differences(extra, float64):
    pos = np.array([[0.5, 0.1, 0.0], [0.3, 0.7, 0.4]])
    method = getattr(extra, "excess", None) or extra.cost
    name = method.__name__

    def value(point):
        extra, pos, vel = point
        return jnp.sum(jnp.sin(getattr(extra, name)(pos, vel, vel)))

    assert_gradient_matches_differences(value, (extra, pos, 2.0 * pos + 1.0), step=1e-6, rtol=1e-6)
    at_centre = jax.grad(lambda pos: jnp.sum(getattr(extra, name)(pos, pos, pos)))(jnp.zeros(3))
    assert np.isfinite(at_centre).all()


def test_a_case_gives_its_extras_the_shape_of_the_batch():
    pos, vel, target = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    one = pj.Geofence((-1, -1, 0), (1, 1, 2))  # One fence is for all three cases.
    many = pj.KeepOut(np.ones((3, 3)), np.ones(3))
    cases = pj.hit.case(pos, vel, target, extras=(one, many))
    assert [leaf.shape for leaf in jax.tree.leaves(cases.extras)] == [(3, 3), (3, 3), (3, 3), (3,)]
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(cases.extras))
    with pytest.raises(ValueError, match="for one case, or have the axes"):
        pj.hit.case(pos, vel, target, extras=(pj.KeepOut(np.ones(3), np.ones(2)),))
    with pytest.raises(ValueError, match="for one case, got a KeepOut"):
        for_batch((many,), (), jnp.float32)


@pytest.mark.slow
def test_plans_avoid_obstacles_and_the_referee_rejects_plans_through_them(
    hits, free, blocked, around
):
    assert pj.are_solved(free).all() and pj.hit.judge(hits, free).success.all()
    verdict = pj.hit.judge(blocked, free)
    assert (verdict.failed_limit == "extra").all() and (verdict.worst_extra == 0).all()
    assert verdict.failed_excess.min() > 0.7
    assert "beyond extras[0] of the case at " in verdict.sentence(0)
    assert pj.are_solved(around).all()
    verdict = pj.hit.judge(blocked, around)
    assert verdict.success.all(), [verdict.sentence(k) for k in range(4)]


def fly_straight(hits, free, vel):
    one = slice(0, 1)
    limits = dataclasses.replace(hits.limits, min_height=hits.limits.min_height - 9.0)
    head = np.zeros((1, 4, 3), np.float32)
    head[0, 1] = vel
    case = pj.take(hits.replace(limits=limits), one).replace(head_state=head)
    return case, pj.take(free, one).replace(trajectory=straight(free.trajectory, head[0, 1]))


def test_the_referee_finds_the_depth_its_time_and_the_extra(hits, free):
    """Fly straight through two forbidden spheres; the referee must report the deeper one."""
    case, plan = fly_straight(hits, free, (2.0, 0.0, 0.0))
    zones = (
        pj.KeepOut(np.array([[0.3, 0.4, 0.0]]), np.array([0.5])),
        pj.Dislike(np.zeros((1, 3)), np.ones(1), np.ones(1)),
        pj.KeepOut(np.array([[1.0, 0.3, 0.0]]), np.array([0.5])),
    )
    verdict = pj.hit.judge(case.replace(extras=zones), plan)
    assert verdict.failed_limit[0] == "extra" and verdict.worst_extra[0] == 2
    np.testing.assert_allclose(verdict.failed_excess, 0.4, atol=1e-3)
    np.testing.assert_allclose(verdict.failed_time, 0.5, atol=5e-3)
    broken = (*zones[:2], pj.KeepOut(np.full((1, 3), np.nan), np.array([0.5])))
    assert pj.hit.judge(case.replace(extras=broken), plan).failed_limit[0] == "not finite"


def test_the_peak_of_a_path_past_an_edge_is_found_between_samples(hits, free):
    """Fly straight at 2.8 m/s through the edge of a box, 2 mm deep, between two samples."""
    case, plan = fly_straight(hits, free, (2.0, 2.0, 0.0))
    head, span = case.head_state, plan.trajectory.durations.sum(axis=1)
    maps, still = FREE.maps, np.zeros((FREE.num_pieces - 1, 3))
    tail = np.stack([head[0, 1] * span, head[0, 1], *np.zeros((2, 3))])
    rows = boundary_rows(head[0], tail, span[0] / FREE.num_pieces)
    columns = jnp.concatenate([rows, jnp.asarray(still, rows.dtype)])
    seen = jax.jit(functools.partial(greatest_extras, maps, columns, span[0] / FREE.num_pieces))
    for place in (0.9, 0.9012, 0.9024, 0.9036):
        low = np.array([[place, -0.1, -0.5]])
        high = np.array([[1.9, place + 0.004, 0.5]])
        verdict = pj.hit.judge(case.replace(extras=(pj.KeepOutBox(low, high),)), plan)
        depth = 0.002 / (0.5 * (high - low).min())
        assert verdict.failed_limit[0] == "extra"
        np.testing.assert_allclose(verdict.failed_excess, depth, rtol=1e-2)
        np.testing.assert_allclose(verdict.failed_time, 0.5 * (place + 0.002), atol=1e-3)
        (found,) = seen((pj.KeepOutBox(jnp.asarray(low[0]), jnp.asarray(high[0])),))
        np.testing.assert_allclose(found, depth, rtol=1e-2)


def test_lanes_of_a_batch_are_those_planned_alone(blocked, around):
    for k in (0, 2):
        alone = pj.plan(HIT, pj.take(blocked, slice(k, k + 1)))
        ours, theirs = alone.trajectory.coeffs[0], around.trajectory.coeffs[k]
        np.testing.assert_allclose(ours[:, 0], theirs[:, 0], atol=2e-3)


def test_another_value_compiles_nothing_anew(hits, around):
    traced = TRACES.count(False)
    assert traced
    pj.plan(HIT, having(hits, radius=0.3, acceleration=30.0))
    assert TRACES.count(False) == traced


# `HIT` makes one attempt, which need not find a path around the boxes.
@pytest.mark.parametrize(
    ("planner", "lanes"),
    [
        (HIT, slice(2, None)),
        pytest.param(pj.SearchPlanner(FREE), slice(None), marks=pytest.mark.slow),
    ],
    ids=["planes", "boxes and planes"],
)
def test_boxes_and_planes_are_planned_around_and_judged(hits, free, middle, planner, lanes):
    """Put boxes near the middles of two trajectories, and planes across two others."""
    sides = np.array([0.5, 0.4, 0.6])
    reach = sides * [0.5, 1.0, 0.5] - [0.0, 0.03, 0.0]
    low = np.where(np.arange(NUM)[:, None] < 2, middle - reach, FAR)
    first, last = (np.array([way(free, k)[place] for k in range(NUM)]) for place in (0, -1))
    across = np.cross(last - first, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    # Each plane is parallel to the line from start to end, and forbids the trajectory's side of it.
    side = np.sign(((middle - first) * across).sum(1, keepdims=True))
    depth = np.abs(((middle - first) * across).sum(1, keepdims=True))
    point = np.where(np.arange(NUM)[:, None] < 2, -FAR, first + 0.5 * depth * side * across)
    normal = np.where(np.arange(NUM)[:, None] < 2, [0.0, 0.0, 1.0], -2.0 * side * across)
    cases = having(hits, low=low, size=sides, point=point, normal=normal)
    verdict = pj.hit.judge(cases, free)
    assert (verdict.failed_limit == "extra").all() and list(verdict.worst_extra) == [3, 3, 4, 4]
    verdict = pj.hit.judge(cases, pj.plan(planner, cases))
    assert verdict.success[lanes].all(), [verdict.sentence(k) for k in range(NUM)]


def test_the_referee_accepts_all_solved_plans_past_boxes(hits, middle):
    random, num_solved = np.random.default_rng(2), 0
    for _ in range(16):  # On some processors only 8 of the first 32 cases are solved.
        half = random.uniform(0.1, 0.3, (NUM, 3))
        low = middle + random.normal(0.0, 0.08, (NUM, 3)) - half
        cases = having(hits, low=low, size=2.0 * half)
        plans = pj.plan(HIT, cases)
        verdict, solved = pj.hit.judge(cases, plans), pj.are_solved(plans)
        num_solved += solved.sum()
        assert verdict.success[solved].all(), [verdict.sentence(k) for k in range(NUM)]
        broken = verdict.failed_limit == "extra"
        excess = np.where(broken, verdict.failed_excess, plans.violation)
        np.testing.assert_allclose(plans.violation, excess, atol=1e-3)
    assert num_solved > 8


def test_a_negative_size_and_a_zero_normal_raise(hits):
    for changed, words in (
        (dict(size=np.array([1.0, -1.0, 1.0])), r"extras.3.low must be < extras.3.high|low must"),
        (dict(normal=(0.0, 0.0, 0.0)), "extras.4.normal must be other than zero, got 0 in lane 0"),
    ):
        with pytest.raises(pj.CaseError, match=words):
            pj.require_sound(having(hits, **changed))


def test_a_users_class_is_planned_and_judged(hits, free):
    samples = pj.take(free, 0).sample(200.0)
    taken = np.linalg.norm(samples.acc[:, :2], axis=1).max()
    gentle = having(hits, acceleration=np.r_[0.8 * taken, [99.0] * (NUM - 1)])
    verdict = pj.hit.judge(gentle, free)
    assert list(verdict.failed_limit) == ["extra", "", "", ""] and verdict.worst_extra[0] == 2
    verdict = pj.hit.judge(gentle, pj.plan(HIT, gentle))
    assert verdict.success.all(), verdict.sentence(0)
    assert TRACES.count(True)  # The referee passes NumPy arrays.


def test_a_cost_moves_the_trajectory(hits, free, middle):
    moved = pj.plan(HIT, having(hits, disliked=middle, weight=0.05))
    assert pj.hit.judge(hits, moved).success.all()
    away = lambda plans, k: np.linalg.norm(way(plans, k) - middle[k], axis=1).min()  # noqa: E731
    assert all(away(moved, k) > away(free, k) + 0.05 for k in range(NUM))


@pytest.mark.slow
def test_catches_stay_inside_a_fence():
    cases = jax.tree.map(np.asarray, pj.catch.draw(NUM, "throws", seed=3))
    free = pj.plan(CATCH, cases)
    assert pj.catch.judge(cases, free).success.all()
    low, high = -FAR, FAR.copy()
    for k in range(NUM):
        first, last = way(free, k)[[0, -1]]
        axis = np.abs(last - first).argmax()
        reach = 0.85 * abs(last - first)[axis]
        low[k, axis], high[k, axis] = first[axis] - reach, first[axis] + reach
    fenced = cases.replace(extras=for_batch((pj.Geofence(low, high),), (NUM,), np.float32))
    verdict = pj.catch.judge(fenced, free)
    assert (verdict.failed_limit == "extra").all() and (verdict.worst_extra == 0).all()
    kept = pj.plan(CATCH, fenced)
    verdict = pj.catch.judge(fenced, kept)
    assert pj.are_solved(kept).all() and verdict.success.all(), verdict.failed_limit


@pytest.mark.slow
def test_the_gradient_by_a_radius_matches_differences_of_plans(hits, float64):
    solver = pj.LbfgsConfig(max_steps=2000, tolerance=1e-13, patience=40)
    long = HIT.with_solver(solver)
    double = lambda cases: jax.tree.map(lambda leaf: np.asarray(leaf, float), cases)  # noqa: E731
    centre = places(pj.plan(long, double(having(hits)))) + np.array([0.0, 0.05, 0.0])
    cases = double(having(hits, centre=centre, radius=0.15))
    found = pj.gradient(HIT, cases, of="cost", by="extras.0.radius", steps=0, solver=solver)

    def costs(change):
        zone = cases.extras[0].replace(radius=cases.extras[0].radius + change)
        return pj.plan(long, cases.replace(extras=(zone, *cases.extras[1:]))).cost

    slopes = (costs(1e-4) - costs(-1e-4)) / 2e-4
    assert slopes.min() > 1e-8  # Every sphere obstructs its plan.
    np.testing.assert_allclose(found.by["extras.0.radius"], slopes, rtol=1e-3)


def test_an_unknown_name_in_the_extras_is_named(blocked):
    with pytest.raises(ValueError, match=r"'extras.5.radius': tuple has 0, 1, 2, 3, 4"):
        pj.gradient(HIT, blocked, of="cost", by="extras.5.radius")
