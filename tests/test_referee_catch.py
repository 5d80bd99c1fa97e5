"""The referee of catches, an independent check of plans, on plans in closed form."""

import math

import numpy as np
import pytest
from numpy.polynomial import Polynomial
from referees import add, assert_same, checks, cut, edit, failure, flight, rows, stack
from scipy.integrate import solve_ivp

from planner_jax.referee.catch import CatchVerdict, referee_catches

GRAVITY, DRAG, NET_HEIGHT, NET_RADIUS = 9.81, 0.5, 0.2, 0.125
START, FIRST, SECOND = (0.0, 0.0, 1.2), (0.6, -0.3, 1.4), (-0.4, 0.2, 1.1)
TIMES = (1.1, 2.4)  # of the two catches
# [s], durations of six trajectory pieces: two up to each catch, and two unused pieces.
DURATIONS = (0.4, 0.7, 0.8, 0.5, 0.0, 0.0)
STEP = Polynomial([0, 0, 0, 0, 35, -84, 70, -20])  # from 0 to 1, at rest up to jerk at both
STEEPEST = 35.0 / 16.0  # slope of STEP, at 1/2


def rest_to_rest(start, end, durations):
    step = STEP(Polynomial([0.0, 1.0 / sum(durations)]))
    return cut([a + (b - a) * step for a, b in zip(start, end, strict=True)], durations)


def hover(place, pieces):
    coeffs = np.zeros((pieces, 8, 3))
    coeffs[:, 0] = place
    return coeffs


def drop(time):
    """Return the fall [m] of a ball with linear drag from rest [Yu2023catch, eq. 9]."""
    return GRAVITY * time / DRAG - GRAVITY * (1.0 - math.exp(-DRAG * time)) / DRAG**2


def above_net(place, time):
    return np.array(place) + [0.0, 0.0, NET_HEIGHT + drop(time)]


def good():
    """Return arrays (1, ...) of a case and a plan by name: target 2 is caught, then target 0."""
    nowhere = np.full(3, np.nan)
    first = rest_to_rest(START, FIRST, DURATIONS[:2])
    second = rest_to_rest(FIRST, SECOND, DURATIONS[2:4])
    leaves = {
        "coeffs": np.concatenate([first, second, hover(SECOND, 2)]),
        "durations": DURATIONS,
        "order": [2, 0, 1],
        "times": [*TIMES, TIMES[1]],
        "present": [True, False, True],
        "horizon": [3.0, np.nan, 1.5],
        "head_state": [START, *np.zeros((3, 3))],
        "gravity": GRAVITY,
        "targets.ball.pos": [above_net(SECOND, TIMES[1]), nowhere, above_net(FIRST, TIMES[0])],
        "targets.ball.vel": [np.zeros(3), nowhere, np.zeros(3)],
        "targets.drag": [np.full(3, DRAG), nowhere, np.full(3, DRAG)],
        "targets.gravity": [GRAVITY, np.nan, GRAVITY],
        **{"net.height": NET_HEIGHT, "net.radius": NET_RADIUS, "net.max_angle": math.pi / 6.0},
        **{"limits.min_thrust": 0.3 * GRAVITY, "limits.max_thrust": 2.5 * GRAVITY},
        **{"limits.speed": 5.0, "limits.body_rate": 5.0, "limits.min_height": 0.25},
    }
    exact = {"order": int, "present": bool}
    return {k: np.array(leaf, exact.get(k, float))[None] for k, leaf in leaves.items()}


def judge(leaves, **options) -> CatchVerdict:
    plans = flight(leaves, optional=False)
    return referee_catches(plans, plans, **options)


assert_good, assert_fails = checks(judge)


def one_target(place=START, *, pos=None, vel=(0.0, 0.0, -3.0), time=1.1, drag=0.0, gravity=0.0):
    pos = np.array(place) + [0.0, 0.0, NET_HEIGHT] if pos is None else np.asarray(pos)
    leaves = good()
    return leaves | {
        **{"coeffs": hover(place, 2)[None], "durations": np.array([[0.4, time - 0.4]])},
        **{"order": np.array([[0]]), "times": np.array([[time]])},
        **{"present": np.array([[True]]), "horizon": np.array([[3.0]])},
        "head_state": np.array([[place, *np.zeros((3, 3))]]),
        "targets.ball.pos": (pos - np.array(vel) * time)[None, None],
        "targets.ball.vel": np.array([[vel]], float),
        "targets.drag": np.full((1, 1, 3), drag),
        "targets.gravity": np.array([[gravity]]),
    }


def test_two_targets_are_caught_in_sequence_and_an_absent_one_is_ignored():
    verdict = assert_good(good())
    assert verdict.failed_limit[0] == "" and np.isnan(verdict.failed_time[0])
    assert verdict.sentence(0).startswith("success: 2 caught, at most ")
    np.testing.assert_array_equal(verdict.caught, [[True, True, False]])
    np.testing.assert_allclose(verdict.catch_times, [[*TIMES, np.nan]])
    np.testing.assert_allclose(verdict.net_distance, [[0.0, 0.0, np.nan]], atol=1e-12)
    np.testing.assert_allclose(verdict.angle, [[0.0, 0.0, np.nan]], atol=1e-12)
    assert verdict.num_caught[0] == 2
    assert verdict.head_error[0] < 1e-12 and verdict.continuity_error[0] < 1e-12


def test_pieces_that_are_not_flown_are_ignored():
    leaves = good()
    leaves["coeffs"][0, 4:] = np.nan
    leaves["times"][0, 2] = np.nan
    assert_same(rows(judge(good())), rows(judge(leaves)))


def test_a_piece_with_a_duration_after_the_last_catch_is_judged_too():
    leaves = good()
    leaves["durations"][0, 4] = 0.2
    assert judge(leaves).success[0]
    leaves["coeffs"][0, 4, 1, 0] = 3.0  # a jump from 0 to 3 m/s
    assert_fails(leaves, "continuity", time=TIMES[1])


def test_without_a_target_there_is_nothing_to_catch():
    leaves = good()
    leaves["present"][:], leaves["durations"][:] = False, 0.0
    leaves["order"][:] = [0, 1, 2]
    # Rounding makes the cosine of the zero angle less than 1.
    leaves["coeffs"][0, 0, 2] = [0.3, 0.2, 0.1]
    verdict = judge(leaves)
    assert verdict.max_body_rate[0] == 0.0
    assert verdict.success[0] and verdict.num_caught[0] == 0
    assert verdict.sentence(0) == "success: there is no target to catch"


def test_peaks_agree_with_the_closed_form():
    verdict = judge(good())
    paths = np.diff([START, FIRST, SECOND], axis=0)
    periods = np.diff([0.0, *TIMES])
    speeds = STEEPEST * np.linalg.norm(paths, axis=1) / periods
    assert verdict.max_speed[0] == pytest.approx(speeds.max(), rel=1e-7)
    assert verdict.min_height[0] == pytest.approx(SECOND[2], rel=1e-7)
    u = np.linspace(0.0, 1.0, 20001)
    rises = (paths / periods[:, None] ** 2)[:, None] * STEP.deriv(2)(u)[:, None]
    thrust = np.linalg.norm(rises + [0.0, 0.0, GRAVITY], axis=2)
    assert verdict.min_thrust[0] == pytest.approx(thrust.min(), rel=1e-7)
    assert verdict.max_thrust[0] == pytest.approx(thrust.max(), rel=1e-7)


@pytest.mark.parametrize(
    "order, wrong",
    [([2, 2, 1], 1), ([2, 1, 0], 2), ([2, 0, 3], 1), ([2, 0, 0], 1), ([2, -1, 1], 1)],
)
def test_an_order_that_misses_a_present_target_fails(order, wrong):
    leaves = good()
    leaves["order"][0] = order
    verdict = assert_fails(leaves, "order", excess=wrong, time=TIMES[1])
    assert verdict.caught[0, 0] and not verdict.caught[0, 2]
    assert verdict.num_caught[0] == (2 if order[1] == 0 else 1)


@pytest.mark.parametrize("late", [-0.02, 0.02])
@pytest.mark.parametrize("place", [0, 1])
def test_a_catch_claimed_at_another_time_fails(place, late):
    leaves = good()
    leaves["times"][0, place] += late
    verdict = assert_fails(leaves, "catch time", excess=0.02, time=TIMES[place])
    np.testing.assert_array_equal(verdict.caught[0], [place == 1, place == 0, False])


def test_a_catch_after_the_targets_own_horizon_fails():
    leaves = good()
    leaves["horizon"][0] = [TIMES[1] + 0.01, 0.0, TIMES[0] - 0.01]
    verdict = assert_fails(leaves, "catch time", excess=0.01, time=TIMES[0])
    np.testing.assert_array_equal(verdict.caught, [[False, True, False]])
    leaves["horizon"][:] = np.inf
    assert judge(leaves).success[0]


@pytest.mark.parametrize("piece, duration", [(1, 0.0), (2, 0.0), (3, -0.3), (4, -0.3)])
def test_a_piece_without_positive_duration_fails(piece, duration):
    leaves = good()
    leaves["durations"][0, piece] = duration
    leaves["times"] = np.cumsum(leaves["durations"], axis=1)[:, 1::2]
    assert_fails(leaves, "catch time", excess=-duration)


@pytest.mark.parametrize(
    "limit, name, field, sign",
    [
        ("speed", "speed", "max_speed", 1),
        ("max_thrust", "thrust high", "max_thrust", 1),
        ("body_rate", "body rate", "max_body_rate", 1),
        ("min_thrust", "thrust low", "min_thrust", -1),
        ("min_height", "ground", "min_height", -1),
    ],
)
def test_a_limit_moved_below_what_is_flown_fails_by_name_and_excess(limit, name, field, sign):
    leaves = good()
    value = getattr(judge(leaves), field)
    leaves[f"limits.{limit}"] = value / (1.0 + 0.25 * sign)
    says = "25.00% above" if sign > 0 else "25.00% below"
    verdict = assert_fails(leaves, name, excess=0.25, says=says)
    assert verdict.num_caught[0] == 2
    leaves[f"limits.{limit}"] = value / (1.0 + 0.0009 * sign)
    assert judge(leaves).success[0]
    assert judge(leaves | {f"limits.{limit}": np.array([sign * np.inf])}).success[0]


def test_a_target_beside_the_hoop_is_missed():
    leaves = good()
    leaves["targets.ball.pos"][0, 2, :2] += [0.12, -0.16]
    verdict = assert_fails(leaves, "net", excess=0.2 / NET_RADIUS - 1.0, time=TIMES[0])
    assert verdict.net_distance[0, 0] == pytest.approx(0.2)
    np.testing.assert_array_equal(verdict.caught, [[False, True, False]])
    assert_fails(leaves, "net", net_test="ball", tolerance=0.05)


@pytest.mark.parametrize("above", [-0.02, 0.02])
def test_a_target_above_or_below_the_hoop_is_not_in_its_plane(above):
    leaves = good()
    leaves["targets.ball.pos"][0, 0, 2] += above
    verdict = assert_fails(leaves, "net plane", excess=0.02, time=TIMES[1])
    assert verdict.net_offset[0, 1] == pytest.approx(above)
    np.testing.assert_array_equal(verdict.caught, [[True, False, False]])
    assert judge(leaves, contact_tolerance=0.021).success[0]
    assert judge(leaves, net_test="ball").success[0]


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.0, 0.6, 0.8), (0.0, 0.0, 1.0)])
def test_the_ball_test_takes_the_distance_in_any_direction(direction):
    hoop = np.array(START) + [0.0, 0.0, NET_HEIGHT]
    protocol = {"net_test": "ball", "tolerance": 0.05}
    inside = one_target(pos=hoop + 1.049 * NET_RADIUS * np.array(direction))
    outside = one_target(pos=hoop + 1.051 * NET_RADIUS * np.array(direction))
    assert judge(inside, **protocol).success[0]
    assert_fails(outside, "net", excess=0.051, **protocol)
    assert not judge(inside, net_test="ball").success[0]


@pytest.mark.parametrize("degrees", [29.0, 45.0, 180.0])
def test_the_angle_is_that_between_the_nets_axis_and_the_targets_way_back(degrees):
    angle = math.radians(degrees)
    leaves = one_target(vel=(2.0 * math.sin(angle), 0.0, -2.0 * math.cos(angle)))
    assert judge(leaves).angle[0, 0] == pytest.approx(angle)
    if degrees < 30.0:
        assert judge(leaves).success[0]
    else:
        verdict = assert_fails(leaves, "angle", excess=degrees / 30.0 - 1.0, time=1.1)
        assert verdict.net_distance[0, 0] < 1e-12 and not verdict.caught.any()


def test_a_target_at_rest_has_no_angle_to_fail():
    verdict = judge(one_target(vel=(0.0, 0.0, 0.0)))
    assert verdict.success[0] and np.isnan(verdict.angle[0, 0])


def test_a_tilted_thrust_tilts_the_net():
    tilt = math.radians(20.0)
    axis = np.array([math.sin(tilt), 0.0, math.cos(tilt)])
    push = GRAVITY * math.tan(tilt)  # constant, along x: thrust along `axis`
    durations, time = np.array([0.3, 0.6]), 0.9
    end = np.array([0.5 * push * time**2, 0.0, 1.2])
    path = [Polynomial([0.0, 0.0, 0.5 * push]), Polynomial([0.0]), Polynomial([1.2])]
    across = np.array([-axis[2], 0.0, axis[0]])
    pos = end + NET_HEIGHT * axis + 0.1 * across - 0.003 * axis
    leaves = one_target(pos=pos, vel=-4.0 * axis, time=time)
    leaves |= {"coeffs": cut(path, durations)[None], "durations": durations[None]}
    leaves["head_state"][0, 2, 0] = push
    verdict = assert_good(leaves)
    assert verdict.angle[0, 0] == pytest.approx(0.0, abs=1e-12)
    assert verdict.net_offset[0, 0] == pytest.approx(-0.003)
    assert verdict.net_distance[0, 0] == pytest.approx(math.hypot(0.1, 0.003))


@pytest.mark.parametrize("drag", [0.0, 1e-9, 1e-3, 0.3, (0.1, 0.6, 4.0), -0.2])
def test_a_ball_with_linear_drag_is_where_integration_puts_it(drag):
    drag, time = np.broadcast_to(drag, 3).astype(float), 1.7
    pos, vel = np.array([1.0, -2.0, 3.0]), np.array([-4.0, 1.0, 6.0])

    def fall(_, state):
        return np.concatenate([state[3:], -drag * state[3:] - [0.0, 0.0, GRAVITY]])

    exact = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-12}
    end = solve_ivp(fall, (0.0, time), np.concatenate([pos, vel]), **exact).y[:, -1]
    leaves = one_target(end[:3] - [0.0, 0.0, NET_HEIGHT], time=time, gravity=GRAVITY)
    leaves["targets.ball.pos"][0, 0], leaves["targets.ball.vel"][0, 0] = pos, vel
    leaves["targets.drag"][0, 0] = drag
    verdict = judge(leaves)
    assert verdict.net_distance[0, 0] < 1e-9
    angle = math.acos(-end[5] / np.linalg.norm(end[3:]))
    assert verdict.angle[0, 0] == pytest.approx(angle, abs=1e-8)


def with_targets(leaves, targets):
    others = {name: leaf for name, leaf in leaves.items() if not name.startswith("targets.")}
    return others | {f"targets.{k}": np.asarray(v, float)[None, None] for k, v in targets.items()}


def test_a_harmonic_target_is_caught_where_it_swings():
    leaves = one_target()
    vel, amplitude = np.array([0.2, 0.0, -1.0]), np.array([0.0, 0.1, 0.4])
    rate, phase = 3.0, 0.7
    swing = rate * 1.1 + phase
    start = np.array(START) + [0.0, 0.0, NET_HEIGHT] - 1.1 * vel - amplitude * math.sin(swing)
    path = {"pos": start, "vel": vel, "amplitude": amplitude, "rate": rate, "phase": phase}
    verdict = judge(with_targets(leaves, path))
    end_vel = vel + amplitude * rate * math.cos(swing)
    assert verdict.net_distance[0, 0] < 1e-12
    assert verdict.angle[0, 0] == pytest.approx(math.acos(-end_vel[2] / np.linalg.norm(end_vel)))


@pytest.mark.parametrize("time", [0.45, 0.999, 1.1, 1.3])
def test_a_table_is_read_by_cubic_convolution(time):
    # Cubic convolution reproduces quadratic functions, so a parabola is interpolated exactly.
    pos, vel = np.array([1.0, 0.3, 2.0]), np.array([-2.0, 0.1, 3.0])
    nodes = (np.arange(30) - 1.0)[:, None] * 0.05
    pull = [0.0, 0.0, -GRAVITY]
    table = {"pos": pos + nodes * vel + 0.5 * nodes**2 * pull, "vel": vel + nodes * pull}
    end = pos + time * vel + 0.5 * time**2 * np.array(pull)
    leaves = one_target(end - [0.0, 0.0, NET_HEIGHT], time=time)
    verdict = judge(with_targets(leaves, table | {"resolution": 0.05}))
    assert verdict.net_distance[0, 0] < 1e-12
    end_vel = vel + time * np.array(pull)
    assert verdict.angle[0, 0] == pytest.approx(math.acos(-end_vel[2] / np.linalg.norm(end_vel)))


def test_a_target_keeps_its_velocity_beyond_its_table():
    nodes = (np.arange(8) - 1.0)[:, None] * 0.1  # to 0.5 s
    way = np.array([0.1, 0.0, -2.0])
    table = {"pos": [3.0, 0.0, 4.0] + nodes * way, "vel": np.tile(way, (8, 1)), "resolution": 0.1}
    leaves = one_target(np.array([3.0, 0.0, 4.0 - NET_HEIGHT]) + 1.1 * way)
    assert judge(with_targets(leaves, table)).success[0]


def test_targets_of_a_users_class_are_followed_by_a_function():
    leaves = good()
    known = judge(leaves)
    plans = flight(leaves, optional=False)
    path, plans.targets = plans.targets, "falling"

    def states(targets, order, times):
        assert targets == "falling" and order.dtype.kind == "i"
        pos = path.ball.pos[np.arange(len(order))[:, None], order].copy()
        for lane, place in np.ndindex(*order.shape):
            pos[lane, place, 2] -= drop(times[lane, place])
        return pos, np.full(pos.shape, [0.0, 0.0, -1.0])

    verdict = referee_catches(plans, plans, target_states=states)
    assert verdict.success[0], verdict.sentence(0)
    np.testing.assert_array_equal(verdict.caught, known.caught)
    with pytest.raises(ValueError, match="targets of class str need target_states"):
        referee_catches(plans, plans)
    with pytest.raises(ValueError, match=r"target_states' pos must be \(1, 3, 3\), got \(3,\)"):
        referee_catches(plans, plans, target_states=lambda *_: (np.zeros(3), np.zeros(3)))


def unequal_lanes():
    only = {"present": [False, False, True], "order": [2, 1, 0], ("durations", (2, 3, 4, 5)): 0.0}
    edits = [{}, {"limits.speed": 1.25}, only, {("head_state", 0): add(0.2)}]
    edits += [{("targets.ball.pos", 2, 0): add(0.5)}, {"order": [0, 2, 1], "horizon": 3.0}]
    return [edit(good(), each) for each in edits]


def test_caught_targets_are_counted_and_none_is_caught_by_a_broken_plan():
    lanes = stack(*unequal_lanes())
    np.testing.assert_array_equal(judge(lanes).num_caught, [2, 2, 1, 2, 1, 0])
    lanes["gravity"][0] = np.nan
    assert not judge(lanes).caught[0].any()
    assert not judge(FAILURES["body rate: free fall"][0]).caught.any()


FALL = Polynomial([9.0, 0.0, -0.5 * GRAVITY])
PERIOD = TIMES[1] / 4  # the two pieces that are not flown do not count
FAILURES = {
    **{
        f"head state: derivative {k}": failure(
            *(edit(good(), {("head_state", k, 1): add(0.1)}), 0.1 * PERIOD**k / math.factorial(k)),
            time=0.0,
        )
        for k in range(4)
    },
    "body rate: free fall": failure(
        one_target(START)
        | {"coeffs": cut([Polynomial([0]), Polynomial([0]), FALL], (0.4, 0.7))[None]}
        | {"head_state": np.array([[[0, 0, 9.0], [0, 0, 0], [0, 0, -GRAVITY], [0, 0, 0]]])}
        | {"limits.speed": np.array([np.inf]), "limits.min_thrust": np.zeros(1)},
        np.inf,
        says="without attitude",
    ),
    "continuity: position": failure(
        edit(good(), {("coeffs", (2, 3, 4, 5), 0, 1): add(0.01)}), 0.01, TIMES[0]
    ),
}
FAILED = ["", "speed", "", "head state", "net", "net"]
ABSURD = ("coeffs", "durations", "times", "targets.drag", "net.height")
WRONG = [
    ({}, {"net_test": "hoop"}, r'net_test must be "plane" or "ball", got \'hoop\''),
    ({"net.radius": np.array(0.1)}, {}, r"net.radius must be \(1,\), got \(\)"),
    ({"present": np.ones(3, bool)}, {}, r"present must be \(1, N\), got \(3,\)"),
    ({"order": np.zeros((1, 2))}, {}, r"order must be \(1, 3\), got \(1, 2\)"),
    ({"coeffs": good()["coeffs"][:, :5]}, {}, r"N \* M pieces for N = 3 targets, got 5"),
    ({"targets.drag": np.ones((1, 3))}, {}, r"targets.drag must be \(1, 3, 3\), got \(1, 3\)"),
]
