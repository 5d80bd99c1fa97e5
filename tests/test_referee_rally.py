"""The referee of rallies: closed forms, and the name and number of each failure."""

import numpy as np
import pytest
from rallies import bounces

import planner_jax as pj


def test_bounces_without_loss_on_a_racket_at_rest_are_accepted():
    case, plan = bounces(hits=4, drop=1.2)
    verdict = pj.rally.judge(case, plan)
    assert verdict.success[0] and verdict.failed_hit[0] == 0
    np.testing.assert_allclose(verdict.apex, 2.7, atol=1e-6)
    assert verdict.contact_error.max() < 1e-6 and verdict.place_error.max() < 1e-6
    assert verdict.sentence(0).startswith("success: 4 hits within")


def test_a_lossy_racket_at_rest_fails_after_the_hit_whose_apex_is_too_low():
    # The ball rises to 1.5 + 1.2 e^2 after the first hit; with e = 0.9 to 2.47, less than 2.6.
    case, plan = bounces(hits=1, restitution=0.9, min_apex=2.6)
    verdict = pj.rally.judge(case, plan)
    assert verdict.sentence(0).startswith("apex low: after hit 1:")
    assert verdict.failed_excess[0] == pytest.approx(1.0 - (1.5 + 1.2 * 0.81) / 2.6, rel=1e-5)
    # The second contact is planned for a ball that returns later: it has fallen past the racket.
    case, plan = bounces(hits=2, restitution=0.9, min_apex=1.0, max_contact=2.4)
    late = pj.rally.judge(case, plan)
    assert late.failed_limit[0] == "contact" and late.failed_hit[0] == 2


@pytest.mark.parametrize(
    ("changes", "limit", "hit"),
    [
        ({"min_contact": 1.51, "offset": 0.02, "place_range": (0.1, 0.1, 0.0)}, "contact low", 1),
        ({"max_contact": 1.49, "offset": -0.02, "place_range": (0.1, 0.1, 0.0)}, "contact high", 1),
        ({"min_apex": 2.8}, "apex low", 1),
        ({"max_apex": 2.6}, "apex high", 1),
    ],
)
def test_limits_of_the_contacts_and_of_the_flights_are_named(changes, limit, hit):
    case, plan = bounces(**changes)
    verdict = pj.rally.judge(case, plan)
    assert verdict.failed_limit[0] == limit and verdict.failed_hit[0] == hit
    assert f"hit {hit}" in verdict.sentence(0)


def test_a_ball_beside_its_box_or_its_planned_place_is_named_with_its_distance():
    case, plan = bounces()
    places = np.array(plan.places)
    places[0, 1, 0] += 0.03
    verdict = pj.rally.judge(case, plan.replace(places=places))
    assert verdict.failed_limit[0] == "planned place" and verdict.failed_hit[0] == 2
    assert verdict.failed_excess[0] == pytest.approx(0.03, abs=1e-6)
    boxes = np.array(case.places)
    boxes[0, 0, 1] = 0.2
    verdict = pj.rally.judge(case.replace(places=boxes), plan)
    assert verdict.failed_limit[0] == "place" and verdict.failed_hit[0] == 1
    assert verdict.failed_excess[0] == pytest.approx(0.1, abs=1e-6)


def test_the_racket_must_meet_the_ball_at_the_planned_times():
    case, plan = bounces()
    strokes = plan.strokes
    for change, limit in ((1e-3, "contact time"), (-0.01, "contact time")):
        time = np.array(strokes.time)
        time[0, 1] += change
        moved = plan.replace(strokes=strokes.replace(time=time))
        verdict = pj.rally.judge(case, moved)
        assert verdict.failed_limit[0] == limit and verdict.failed_hit[0] == 2
    time = np.array(strokes.time)
    time[0, 0] += 2e-3  # the ball has fallen by a further 1 cm
    verdict = pj.rally.judge(case, plan.replace(strokes=strokes.replace(time=time)))
    assert verdict.failed_limit[0] == "contact" and verdict.failed_hit[0] == 1
    coeffs = np.array(plan.trajectory.coeffs)
    coeffs[..., 0, 0] += 0.02
    moved = plan.replace(trajectory=plan.trajectory.replace(coeffs=coeffs))
    head = np.array(case.head_state)
    head[:, 0, 0] += 0.02
    verdict = pj.rally.judge(case.replace(head_state=head), moved)
    assert verdict.failed_limit[0] == "contact"
    assert verdict.failed_excess[0] == pytest.approx(0.02, abs=1e-6)
