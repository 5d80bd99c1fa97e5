"""Dubins's shortest ways lead to the goal, are the least of six words, and known ones are met."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dubins import (
    WORDS,
    DubinsPath,
    dubins,
    dubins_words,
    pose_along,
    sample_dubins,
)

CURVATURE = 2.0
float64 = pytest.mark.usefixtures("float64")


def drawn(num, seed=0):
    """Starts and goals (num, 3) within 4 m, at all headings."""
    rng = np.random.default_rng(seed)
    return rng.uniform([-2.0, -2.0, -np.pi], [2.0, 2.0, np.pi], (2, num, 3))


@jax.jit
def everything(starts, goals):
    """Of each pair: the ends (6, 3) of all words, which exist, their lengths, and the path."""

    def of_pair(start, goal):
        lengths, exists = dubins_words(start, goal, CURVATURE)
        ends = [
            pose_along(DubinsPath(start, jnp.asarray(k), lengths[k], jnp.asarray(CURVATURE)), 1e3)
            for k in range(6)
        ]
        path = dubins(start, goal, CURVATURE)
        return jnp.stack(ends), exists, jnp.sum(lengths, axis=-1), path, sample_dubins(path, 33)

    return jax.vmap(of_pair)(starts, goals)


def misses(ends, goals):
    """Distances of poses, in place [m] and heading [rad]."""
    away = ends - goals
    turned = np.mod(away[..., 2] + np.pi, 2.0 * np.pi) - np.pi
    return np.maximum(np.hypot(away[..., 0], away[..., 1]), np.abs(turned))


@pytest.fixture(scope="module")
def random_pairs():
    with jax.enable_x64(True):
        starts, goals = drawn(512)
        return starts, goals, jax.tree.map(np.asarray, everything(starts, goals))


def test_every_word_that_exists_leads_to_the_goal(random_pairs):
    _, goals, (ends, exists, *_) = random_pairs
    assert misses(ends, goals[:, None])[exists].max() < 1e-12
    assert exists[:, :2].all() and 0.2 < exists[:, 2:].mean(axis=0).min() < 1.0


def test_the_way_is_the_shortest_word_no_shorter_than_the_straight_line(random_pairs):
    starts, goals, (_, exists, lengths, path, _) = random_pairs
    np.testing.assert_allclose(path.length, np.where(exists, lengths, np.inf).min(axis=1))
    assert (path.length >= np.hypot(*(goals - starts)[:, :2].T)).all()
    assert set(path.word) == set(range(6))


def test_samples_are_equally_far_apart_and_turn_no_tighter_than_allowed(random_pairs):
    starts, goals, (*_, path, poses) = random_pairs
    np.testing.assert_allclose(poses[:, 0], starts)
    assert misses(poses[:, -1], goals).max() < 1e-12
    spacing = path.length[:, None] / 32
    steps = np.diff(poses, axis=1)
    assert (np.abs(steps[..., 2]) <= CURVATURE * spacing + 1e-12).all()
    chords = np.hypot(steps[..., 0], steps[..., 1])
    assert (chords <= spacing + 1e-12).all()
    assert (
        chords >= 2.0 / CURVATURE * np.sin(np.minimum(CURVATURE * spacing, np.pi) / 2) - 1e-12
    ).all()


def test_single_precision_misses_the_goal_by_micrometres_and_finds_the_same_lengths(random_pairs):
    starts, goals, (*_, path, _) = random_pairs
    single = everything(np.float32(starts), np.float32(goals))
    found, poses = single[3], np.asarray(single[4])
    assert found.lengths.dtype == np.float32
    np.testing.assert_allclose(found.length, path.length, atol=2e-5)
    assert misses(poses[:, -1], goals).max() < 2e-5


@float64
def test_the_mirrored_pair_has_the_mirrored_word():
    starts, goals = drawn(512, seed=1)
    mirror = np.array([1.0, -1.0, -1.0])
    path, mirrored = everything(starts, goals)[3], everything(starts * mirror, goals * mirror)[3]
    np.testing.assert_allclose(path.lengths, mirrored.lengths, atol=1e-12)
    swapped = [WORDS.index(word.translate(str.maketrans("LR", "RL"))) for word in WORDS]
    np.testing.assert_array_equal(np.array(swapped)[path.word], mirrored.word)


@pytest.mark.parametrize(
    "goal, word, length",
    [
        ((3.0, 0.0, 0.0), None, 3.0),
        ((0.5, 0.5, np.pi / 2), "LSL", np.pi / 4),
        ((0.0, -1.0, np.pi), None, np.pi / 2),
        ((2.0, 1.0, np.pi), "LSL", 2.0 + np.pi / 2),
        ((2.0, 1.0, 0.0), "LSR", None),
        ((0.0, 0.0, np.pi), None, 7.0 * np.pi / 6),
        ((0.0, 0.0, 0.0), None, 0.0),
    ],
)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_known_ways(goal, word, length, dtype):
    """Straight on, a quarter and a half turn, a half turn with a run, a lane, on the spot, none."""
    with jax.enable_x64(dtype == "float64"):
        goals = np.zeros((512, 3), dtype)
        goals[0] = goal
        path = jax.tree.map(lambda leaf: np.asarray(leaf)[0], everything(goals * 0, goals)[3])
    assert word is None or WORDS[path.word] == word
    if length is not None:
        np.testing.assert_allclose(
            path.lengths.sum(), length, atol=2e-3 if dtype == "float32" else 1e-7
        )


@float64
def test_a_goal_moved_on_along_the_last_part_is_that_much_farther_and_gradients_are_finite():
    def last_sense_and_length(goal):
        path = dubins(jnp.zeros(3), goal, CURVATURE)
        return path.length, path.word

    gradient = jax.jit(jax.vmap(jax.grad(last_sense_and_length, has_aux=True)))
    goals = drawn(64, seed=2)[1]
    special = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, np.pi], [0.5, 0.5, np.pi / 2]])
    slope, words = map(np.asarray, gradient(np.concatenate([goals, special])))
    assert np.isfinite(slope).all()
    turn = CURVATURE * np.array([{"L": 1.0, "R": -1.0}[WORDS[word][2]] for word in words[:64]])
    ahead = np.stack([np.cos(goals[:, 2]), np.sin(goals[:, 2]), turn], axis=1)
    np.testing.assert_allclose(np.sum(slope[:64] * ahead, axis=1), 1.0, atol=1e-9)
