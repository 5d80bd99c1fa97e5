import jax
import jax.numpy as jnp
import numpy as np
import pytest

from planner_jax.ball.target import BallPath
from planner_jax.task.catch.spec import SUITES, TASK
from planner_jax.task.catch.suites import CATCH_HEIGHT, LAUNCH, draw, earliest_throw
from tests.trees import assert_same

NUM = 64
THROWS = ("throws", "hard", "parabola1", "parabola2")
PARALLEL = ("square4", "pentagon5", "hexagon6", "heptagon7")
# Name of a suite -> for each target: half sides [m] of the rectangle where it lands, range of its
# flight time [s], and time [s] from its launch to the start of planning.
RANGES = {
    "throws": [((1.0, 0.4), (1.4, 1.78), 0.3)],
    "hard": [((2.0, 1.5), (1.4, 1.78), 0.5)],
    "parabola1": [((1.0, 0.4), (1.4, 2.0), 0.3)],
    "parabola2": [((1.0, 0.4), (1.4, 1.6), 0.3), ((1.0, 0.4), (1.7, 2.0), 0.0)],
}
# Name of a suite -> greatest horizontal distance [m] of targets from the origin, height range [m].
VOLUMES = {
    "harmonic2": (9.0, (1.0, 3.5)),
    "triangle3": (7.3, (1.5, 2.5)),
    **{name: (11.3, (1.5, 2.5)) for name in PARALLEL},
}

float64 = pytest.mark.usefixtures("float64")


@jax.jit
def states(targets, times):
    return jax.vmap(jax.vmap(lambda path, t: jax.vmap(path.at)(t)))(targets, times)


def until_horizon(cases, num=60):
    return cases.horizon[..., None] * jnp.linspace(0.0, 1.0, num)[None, None]


def draw_doubles(name, num=NUM, seed=3):
    return draw(num, name, seed, dtype=jnp.float64)


def away(pos):
    return np.linalg.norm(np.asarray(pos)[..., :2], axis=-1)


def test_a_suite_depends_on_its_name_and_the_seed_alone():
    np.testing.assert_allclose(draw(1, "throws").targets.ball.vel[0, 0, 1], -0.10602945, rtol=1e-5)
    np.testing.assert_allclose(draw(1, "hexagon6").targets.ball.pos[0, 0, 2], 2.3829162, rtol=1e-5)
    heptagon = draw(1, "heptagon7").targets.ball.pos[0, 0]
    np.testing.assert_allclose(heptagon, [-1.8125371, 7.8405933, 2.0519066], rtol=1e-5)
    assert (draw(1, "throws").targets.ball.vel != draw(1, "hard").targets.ball.vel).all()


@pytest.mark.parametrize("name", SUITES)
def test_shapes_and_setting(name):
    cases, suite = draw(3, name), SUITES[name]
    assert suite.description.endswith(".") and TASK.suites[name] == suite.description
    assert cases.batch_shape == (3,) and cases.num_targets == suite.num_targets
    for leaf in jax.tree.leaves(cases):
        assert leaf.shape[:1] == (3,) and leaf.dtype in (np.float32, np.int32, bool)
    assert cases.present.all()
    np.testing.assert_array_equal(cases.head_state[:, 0], np.tile([0.0, 0.0, 1.0], (3, 1)))
    assert not cases.head_state[:, 1:].any()
    many = np.asarray(draw(NUM, name).horizon)
    assert 0.9 * suite.horizon < many.max() <= suite.horizon * (1.0 + 1e-6)


@float64
def test_the_first_ball_of_the_paper_is_planned_when_it_has_flown_2_m_and_is_above_2_8_m():
    cases = draw_doubles("paper-throws", 500)
    times = jnp.asarray(np.tile(np.arange(-0.01, 1.7, 2e-3), (500, 1, 1)))
    flown = np.asarray(states(cases.targets, times).pos)[:, 0]
    far, height = np.linalg.norm(flown - np.array(LAUNCH), axis=2), flown[..., 2]
    now = 5  # index of time 0
    assert (far[:, now] >= 2.0 - 1e-9).all() and (height[:, now] >= 2.8 - 1e-9).all()
    assert ((far[:, 0] < 2.0) | (height[:, 0] < 2.8)).all(), "10 ms before one rule is not met"
    assert (height.max(axis=1) <= 4.2 + 1e-9).all() and height.max() > 4.1
    down = (height <= 0.0).argmax(axis=1)
    assert (down > 0).all() and times[0, 0][down].max() <= 1.602
    landing = np.abs(flown[np.arange(500), down, :2])
    assert (landing <= [1.02, 0.42]).all() and (landing.max(axis=0) > [0.9, 0.36]).all()
    assert len(np.unique(np.asarray(cases.horizon))) == 500


@float64
def test_targets_swing_by_the_formula_of_the_paper():
    cases, times = draw_doubles("paper-harmonic2"), np.array([0.0, 0.5, 1.7])
    path = cases.targets
    pos = states(path, jnp.asarray(np.tile(times, (NUM, 2, 1)))).pos
    expected = np.asarray(path.pos)[:, :, None] + np.sin(
        np.asarray(path.rate)[..., None, None] * times[:, None]
    ) * np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(pos, expected, atol=1e-12)


@float64
@pytest.mark.parametrize("name", THROWS)
def test_a_throw_leaves_the_machine_lands_in_its_rectangle_and_flies_as_long_as_it_says(name):
    cases = draw_doubles(name)
    for i, (land, (shortest, longest), delay) in enumerate(RANGES[name]):
        ball = jax.tree.map(lambda leaf, i=i: leaf[:, i : i + 1], cases.targets)
        flown = np.arange(0.0, longest, 2e-3)
        pos = np.asarray(states(ball, jnp.asarray(np.tile(flown - delay, (NUM, 1, 1)))).pos)[:, 0]
        np.testing.assert_allclose(pos[:, 0], np.tile(LAUNCH, (NUM, 1)), atol=1e-9)
        down = np.where((pos[..., 2] <= 0.0).any(axis=1), (pos[..., 2] <= 0.0).argmax(axis=1), -1)
        flight = flown[down]
        assert flight.min() >= shortest and flight.max() <= longest
        assert flight.max() - flight.min() > 0.8 * (longest - shortest)
        where = np.abs(pos[np.arange(NUM), down, :2])
        assert (where <= np.array(land) + 0.02).all(), "2 ms of flight are up to 1 cm"
        assert (where.max(axis=0) > 0.8 * np.array(land)).all()
        high = pos[..., 2].max()
        assert high < (4.2 if name in ("throws", "hard") else 5.4)
        assert pos[..., 2].max(axis=1).min() > 2.7


@float64
@pytest.mark.parametrize("name", THROWS)
def test_a_thrown_ball_may_be_caught_until_it_falls_through_the_least_height(name):
    cases = draw_doubles(name)
    ball = states(cases.targets, until_horizon(cases))
    np.testing.assert_allclose(ball.pos[..., -1, 2], CATCH_HEIGHT, atol=1e-9)
    assert (ball.vel[..., -1, 2] < 0.0).all()
    assert (ball.pos[..., :-1, 2] > CATCH_HEIGHT).all()
    drag = 0.5 if name in ("throws", "hard") else 0.0
    assert (cases.targets.drag == drag).all() and (cases.targets.gravity == 9.81).all()


@float64
@pytest.mark.parametrize("name", VOLUMES)
def test_every_target_stays_in_its_volume_and_comes_near_the_quadrotor(name):
    cases, (reach, (low, high)) = draw_doubles(name), VOLUMES[name]
    assert (cases.horizon == SUITES[name].horizon).all()
    ball = states(cases.targets, until_horizon(cases))
    distance, height = away(ball.pos), np.asarray(ball.pos)[..., 2]
    assert distance.max() <= reach
    assert low <= height.min() and height.max() <= high
    assert height.max() - height.min() > 0.8 * (high - low)
    assert distance.min(axis=-1).max() < 2.8
    level = away(ball.vel)
    assert level.min() >= 1.0 - 1e-9 and level.max() <= 1.5 + 1e-9
    sinking = -np.asarray(ball.vel)[..., 2].min()
    assert 2.0 < sinking <= 2.5 if name == "harmonic2" else sinking == 0.0


@float64
def test_swings_are_near_in_time():
    cases = draw_doubles("harmonic2")
    ball = states(cases.targets, until_horizon(cases, 141))
    near = away(ball.pos)[..., 40:101]  # These samples are from 2 to 5 s.
    assert near.min(axis=-1).max() < 1.5 + 0.04
    assert not cases.targets.amplitude[..., :2].any()


@float64
def test_lines_are_a_triangle_at_angles_of_120_degrees_and_polygons_in_parallel():
    for name in ("triangle3", *PARALLEL):
        cases = draw_doubles(name)
        assert isinstance(cases.targets, BallPath)
        assert not (cases.targets.drag.any() or cases.targets.gravity.any())
        num = SUITES[name].num_targets
        ball = states(cases.targets, until_horizon(cases, 61))
        pos, vel = np.asarray(ball.pos), np.asarray(ball.vel)[:, :, 0]
        centre = pos.mean(axis=1, keepdims=True)
        side = np.linalg.norm(pos - np.roll(pos, 1, axis=1), axis=-1)  # (B, N, T)
        np.testing.assert_allclose(side, np.broadcast_to(side[:, :1], side.shape), rtol=1e-9)
        radius = np.linalg.norm(pos - centre, axis=-1)
        np.testing.assert_allclose(side, radius * 2.0 * np.sin(np.pi / num), rtol=1e-9)
        cosine = (vel * np.roll(vel, 1, axis=1)).sum(-1) / (vel**2).sum(-1)
        np.testing.assert_allclose(cosine, -0.5 if name == "triangle3" else 1.0, atol=1e-9)
        if name == "triangle3":
            assert 3.0 <= radius[:, 0, 0].min() and radius[:, 0, 0].max() <= 4.0
            closest = np.broadcast_to(radius.argmin(axis=-1) * 0.1, vel.shape[:2])
            assert 1.6 <= closest.min() and closest.max() <= 3.6
            assert (np.abs(centre[..., :2]) <= 0.5 + 1e-9).all()
        else:
            assert 1.0 <= radius.min() and radius.max() <= 1.5
            middle = np.abs(centre[:, 0, 24:37, :2])  # These samples are from 4 to 6 s.
            assert (middle.max(axis=-1).min(axis=-1) <= 0.5 + 0.08).all()


@float64
@pytest.mark.parametrize(("name", "first", "spread"), [("rush3", 2.35, 0.5), ("rush6", 3.8, 0.6)])
def test_targets_of_a_rush_are_due_one_after_the_other_in_any_order(name, first, spread):
    cases = draw_doubles(name, 512)
    due = np.asarray(cases.horizon)
    in_order, each = np.sort(due, axis=1), np.argsort(due, axis=1)
    middle = first + 0.9 * np.arange(due.shape[1])
    assert (np.abs(in_order - middle) <= 0.5 * spread + 1e-9).all()
    assert np.abs(in_order - middle).max() > 0.45 * spread
    share = np.bincount(each[:, 0]) / len(due)
    np.testing.assert_allclose(share, 1.0 / due.shape[1], atol=0.08)
    start = states(cases.targets, until_horizon(cases))
    assert away(start.pos).max() <= VOLUMES["triangle3" if name == "rush3" else "hexagon6"][0]
    assert not cases.optional


@float64
@pytest.mark.parametrize("name", ["swarm8", "swarm12"])
def test_balls_of_a_swarm_sink_all_around_and_may_be_left(name):
    cases = draw_doubles(name)
    assert cases.optional
    ball = states(cases.targets, until_horizon(cases))
    pos, vel = np.asarray(ball.pos), np.asarray(ball.vel)
    np.testing.assert_allclose(pos[..., -1, 2], CATCH_HEIGHT, atol=1e-9)
    assert 2.0 <= pos[..., 0, 2].min() and pos[..., 0, 2].max() <= 6.0
    assert 5.5 < away(pos[..., 0, :]).max() <= 6.0
    assert 0.4 <= -vel[..., 2].max() and -vel[..., 2].min() <= 2.0
    assert 0.25 < away(vel).max() <= 0.3
    angle = np.arctan2(pos[..., 0, 1], pos[..., 0, 0])
    assert np.histogram(angle, bins=4, range=(-np.pi, np.pi))[0].min() > 0.15 * angle.size


@pytest.mark.parametrize(
    "name", ["hard", "paper-throws", "harmonic2", "paper-harmonic2", "hexagon6"]
)
def test_padding_leaves_the_present_targets_alone(name):
    plain, padded = draw(5, name, 2), draw(5, name, 2, num_targets=8)
    own = SUITES[name].num_targets
    assert padded.num_targets == 8
    np.testing.assert_array_equal(padded.present, np.tile(np.arange(8) < own, (5, 1)))
    place = np.where(np.arange(8) < own, np.arange(8), 0)
    ours, theirs = ((cases.targets, cases.horizon) for cases in (padded, plain))
    assert_same(ours, jax.tree.map(lambda leaf: leaf[:, place], theirs))


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"suite": "throw"}, "suite must be one of throws, paper-throws, .*, swarm12, got 'throw'"),
        ({"num": 0}, "num must be >= 1, got 0"),
        ({"seed": -1}, "seed must be >= 0, got -1"),
        ({"suite": "triangle3", "num_targets": 2}, "num_targets must be >= 3 .*'triangle3', got 2"),
    ],
)
def test_bad_arguments_are_named_in_one_line(options, says):
    with pytest.raises(ValueError, match=rf"\A{says}.*\Z"):
        draw(**{"num": 3, **options})


def test_the_earliest_throw_leaves_less_time_than_any_other_of_its_suite():
    ball, horizon = earliest_throw("throws")
    many = draw(200, "throws", 3)
    assert horizon <= np.min(many.horizon) + 1e-3
    assert ball.vel[2] <= np.min(many.targets.ball.vel[..., 2]) + 1e-3
    assert abs(ball.pos[1]) < 1e-6  # It is aimed at the middle.
    with pytest.raises(ValueError, match="^suite must be one of single throws, got 'hexagon6'$"):
        earliest_throw("hexagon6")
