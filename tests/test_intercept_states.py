"""The last search of interceptions starts from motions with a limited steering rate."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.task.intercept.searches import SEARCHES

PLANNER = pj.intercept.planner("spacetime")


def names_of(searches):
    return [bool(search.states) for search in searches]


def test_states_are_searched_last_and_only_by_cars_without_a_reverse_gear():
    target = pj.TurningPath(jnp.array([4.0, 4.0]), jnp.zeros(2), jnp.array(0.0))
    forward, both = (pj.intercept.case(target, reverse_speed=speed) for speed in (0.0, 0.5))
    assert names_of(PLANNER.attempts_for(forward)) == [False] * 4 + [True]
    assert not any(names_of(PLANNER.attempts_for(both)))


@pytest.mark.slow
@pytest.mark.parametrize("meet", ["given", "early"])
def test_motions_with_a_limited_steering_rate_solve_cases_that_paths_of_cells_do_not(meet):
    # The car must drive a circle first, since the space ahead is closed at first.
    cases = pj.intercept.draw(1, "maze", 977, first=67)
    searches = SEARCHES[meet]
    cells = dataclasses.replace(PLANNER, meet=meet, searches=searches[:-2])
    states = dataclasses.replace(PLANNER, meet=meet, searches=searches[-1:])
    solved = [pj.intercept.judge(cases, pj.plan(each, cases)).success for each in (cells, states)]
    assert np.array(solved).tolist() == [[False], [True]]
