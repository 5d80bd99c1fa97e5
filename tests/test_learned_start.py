"""First guesses by a neural network: their benefit, and searches without a network."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.benchmarks.learn_starts import make_untrained, to_bytes
from planner_jax.optimise.shipped import REACH, StartNetwork, load_network
from planner_jax.planning.decided import first_choice


@pytest.mark.parametrize("task", ["hit", "catch"])
def test_the_learnt_guess_costs_a_hundredth_and_little_more_than_the_optimum(task):
    if task == "hit":
        problem, cases = pj.hit.HitProblem(), pj.hit.draw(64, seed=3)
    else:
        problem = pj.catch.CatchProblem()
        cases = first_choice(pj.catch.Greedy(), pj.catch.draw(64, "throws", 3))

    def costs(case, problem):
        context = problem.prepare(case)
        return problem.objective(problem.first_guess(context), context).cost

    learnt, smooth = (
        np.asarray(jax.jit(jax.vmap(lambda case, own=own: costs(case, own)))(cases))
        for own in (problem, dataclasses.replace(problem, learned=False))
    )
    ended = pj.plan(pj.SearchPlanner(problem), cases)
    assert pj.are_solved(ended).all()
    assert np.median(smooth / ended.cost) > 1.5
    assert np.median(learnt / ended.cost) < 1.1
    assert np.all(learnt <= smooth)


def test_late_hits_begin_where_a_few_iterations_find_what_all_guesses_do_not():
    late = pj.hit.to_cases(pj.hit.generate_serves(64, 3), delay=0.7)
    (search,) = [each for each in pj.hit.HitProblem.attempts if each.solver.max_steps == 150]

    def share(learned):
        planner = pj.hit.HitProblem.planner(learned=learned, attempts=(search,))
        return pj.are_solved(pj.plan(planner, late)).mean()

    assert share(True) > share(False) + 0.1


def test_an_untrained_network_adds_nothing_and_far_features_count_as_less_far():
    features = np.random.default_rng(0).normal(size=(100, 3))
    network = make_untrained(features, 2, (5,))
    np.testing.assert_array_equal(network(jnp.asarray(features[0], jnp.float32)), 0.0)
    network = dataclasses.replace(network, weights=(network.weights[0], np.ones((5, 2))))
    mean, deviation = network.mean, network.deviation
    at = [network(jnp.asarray(mean + far * deviation, jnp.float32)) for far in (REACH, 10 * REACH)]
    np.testing.assert_allclose(at[0], at[1], rtol=1e-5)
    assert np.abs(at[0]).max() > 0.0


@pytest.mark.parametrize(
    "task, name", [("hit", "exact-12"), ("hit", "exact-12-supple"), ("catch", "exact-6")]
)
def test_a_shipped_network_is_what_its_archive_holds(task, name, tmp_path):
    network = load_network(f"planner_jax.task.{task}", name)
    (tmp_path / "again.npz").write_bytes(to_bytes(network))
    with np.load(tmp_path / "again.npz", allow_pickle=False) as file:
        assert len(file.files) == 2 + 2 * len(network.weights)
        for k, weight in enumerate(network.weights):
            np.testing.assert_array_equal(file[f"weight{k}"], weight)
    assert isinstance(network, StartNetwork)
    assert all(np.isfinite(each).all() for each in (*network.weights, *network.biases))
