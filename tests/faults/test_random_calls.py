"""No call of a public function, however malformed, raises an error that is not the library's."""

import pytest

from tests.faults.random_calls import call_randomly


@pytest.mark.slow
def test_random_calls_return_or_raise_an_error_of_the_library(own_checks, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcomes, raw = call_randomly(100_000, seed=0)
    assert not raw, raw
    assert outcomes["refused"] > 50_000 and outcomes["returned"] > 1_000


def test_batches_of_no_case_are_refused_by_every_function_that_makes_cases(own_checks):
    import numpy as np

    import planner_jax as pj
    from tests.faults.test_bad_calls import ball_path, turning

    none = np.zeros((0, 3))
    calls = (
        lambda: pj.hit.case(none, none, none),
        lambda: pj.rally.case(none, none, np.zeros((0, 2, 3))),
        lambda: pj.catch.case(ball_path(0), np.zeros((0,))),
        lambda: pj.team.case(ball_path(0), np.zeros((0,)), np.zeros((0, 2, 3))),
        lambda: pj.intercept.case(turning(0), start=none),
        lambda: pj.group.case(turning(0)),
        lambda: pj.block.case(none, none),
        lambda: pj.reach.case(np.zeros((0, 6))),
        lambda: pj.ball.fit(np.zeros(0), none),
        lambda: pj.ball.fit(np.zeros((0, 9)), np.zeros((0, 9, 3))),
    )
    for call in calls:
        with pytest.raises(pj.ArgumentError):
            call()
