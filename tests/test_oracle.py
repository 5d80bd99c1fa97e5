"""The benchmark `hit_oracle`: its trajectories are hits, and hopeless serves are detected."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj

pytest.importorskip("casadi")
from planner_jax.benchmarks.hit_oracle import search


def serve(limit_scale):
    with jax.enable_x64(True):
        batch = pj.hit.draw(1, seed=5, limit_scale=limit_scale, dtype=jnp.float64)
        return pj.take(jax.tree.map(np.asarray, batch), 0)


def test_an_easy_serve_is_proven_feasible_by_a_trajectory_that_the_referee_passes():
    easy = serve(1.0)
    finding = search.find_hit(easy, search.starting_points(2, 0))
    assert finding.verdict == "feasible"
    assert search.passes_referee(easy, finding.coeffs, finding.durations)
    assert finding.durations.sum() == pytest.approx(finding.impact_time)


def test_a_hopeless_serve_is_infeasible():
    finding = search.find_hit(serve(0.2), search.starting_points(4, 0))
    assert finding.verdict == "infeasible"
    assert finding.least_excess > 0.1
    assert finding.coeffs is None
