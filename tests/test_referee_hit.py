"""The referee of hits, an independent check of plans, on plans in closed form."""

import math

import numpy as np
import pytest
from numpy.polynomial import Polynomial
from referees import add, assert_same, checks, cut, edit, failure, flight, rows, stack
from scipy.integrate import solve_ivp

from planner_jax.host.machine import usable_cores
from planner_jax.referee import judging, workers
from planner_jax.referee.hit import HitVerdict, referee_hits

GRAVITY, DRAG, RESTITUTION, RACKET_HEIGHT = 9.8, 0.0616, 0.7, 0.06
IMPACT_TIME, NUM_PIECES = 1.2, 3
TIME = Polynomial([0.0, 1.0])
CONTACT = np.array([-2.0, 0.3, 1.8])
BALL_VEL = np.array([-5.0, -0.4, -5.5])


def fall(_, state, drag=DRAG):
    vel = state[3:]
    return np.concatenate([vel, -drag * np.linalg.norm(vel) * vel - [0.0, 0.0, GRAVITY]])


def fly(pos, vel, span, **options):
    exact = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-12}
    return solve_ivp(fall, (0.0, span), np.concatenate([pos, vel]), **exact, **options)


def join_states(head, tail, duration):
    powers = [Polynomial(row) for row in np.eye(8)]
    rows = [[p.deriv(n)(t) for p in powers] for t in (0.0, duration) for n in range(4)]
    return list(map(Polynomial, np.linalg.solve(np.array(rows), np.concatenate([head, tail])).T))


def volley(
    *, target=(3.0, 0.0, 0.0), flight_time=1.5, ball_vel=BALL_VEL, pieces=NUM_PIECES, air=None
):
    """Return arrays (1, ...) of a case and a plan by name, computed backwards from the impact."""
    target = np.array(target)
    after = (target - CONTACT) / flight_time + [0.0, 0.0, 0.5 * GRAVITY * flight_time]
    change = after - BALL_VEL
    normal = change / np.linalg.norm(change)
    normal_speed = (RESTITUTION * BALL_VEL + after) @ normal / (1.0 + RESTITUTION)
    head, tail = np.zeros((2, 4, 3))
    head[0] = [-3.0, 0.0, 1.5]
    tail[0] = CONTACT - RACKET_HEIGHT * normal
    tail[1] = normal_speed * normal
    tail[2] = 1.1 * GRAVITY * normal - [0.0, 0.0, GRAVITY]
    if air is not None:
        tail[2] -= air["limits.air.drag"] * (tail[1] - air["limits.air.wind"])
    back = fly(CONTACT, np.asarray(ball_vel), -IMPACT_TIME).y[:, -1]
    durations = IMPACT_TIME * np.arange(2, pieces + 2) / np.arange(2, pieces + 2).sum()
    leaves = {
        "coeffs": cut(join_states(head, tail, IMPACT_TIME), durations),
        "durations": durations,
        **{"stroke.time": IMPACT_TIME, "ball.pos": back[:3], "ball.vel": back[3:]},
        **{"head_state": head, "target": target, "drag": DRAG, "gravity": GRAVITY},
        **{"restitution": RESTITUTION, "racket_height": RACKET_HEIGHT},
        **{"limits.speed": 5.0, "limits.acceleration": 15.0},
        **{"limits.body_rate": 8.0, "limits.min_height": 0.25},
        "hit_limits.hitting_speed": [4.0, 3.0, 4.0],
        **{"hit_limits.min_apex": 2.2, "hit_limits.max_apex": 6.2},
        **(air or {}),
    }
    return {name: np.asarray(leaf, float)[None] for name, leaf in leaves.items()}


def judge(leaves, **options) -> HitVerdict:
    plans = flight(leaves, racket_radius=None, lift=None)
    return referee_hits(plans, plans, **options)


assert_good, assert_fails = checks(judge)


def dense(leaves, order, num=20001):
    ends = np.cumsum(leaves["durations"][0])
    times = np.linspace(0.0, ends[-1], num)
    piece = np.minimum(np.searchsorted(ends, times, side="right"), len(ends) - 1)
    local = times - (ends - leaves["durations"][0])[piece]
    derived = np.polynomial.polynomial.polyder(leaves["coeffs"][0, piece], order, axis=1)
    return times, (derived * local[:, None, None] ** np.arange(derived.shape[1])[:, None]).sum(1)


def hopf_rotations(acc):
    """Return the rotation matrices (n, 3, 3) of the Hopf fibration at zero heading."""
    thrust = acc + [0.0, 0.0, GRAVITY]
    z = thrust / np.linalg.norm(thrust, axis=1, keepdims=True)
    a, b, c = z.T
    first = np.stack([1.0 - a * a / (1.0 + c), -a * b / (1.0 + c), -a], axis=1)
    second = np.stack([-a * b / (1.0 + c), 1.0 - b * b / (1.0 + c), -b], axis=1)
    return np.stack([first, second, z], axis=2)


def body_rates(leaves):
    """Return times and body rates [rad/s], by central differences of the attitude."""
    times, acc = dense(leaves, 2)
    attitude = hopf_rotations(acc)
    change = (attitude[2:] - attitude[:-2]) / (times[2:] - times[:-2])[:, None, None]
    skew = np.swapaxes(attitude[1:-1], 1, 2) @ change
    rates = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    return times[1:-1], np.linalg.norm(rates, axis=1)


def test_a_volley_in_wind_succeeds_only_if_the_referee_knows_the_wind():
    names = {"drag": 0.4, "thrust_drag": 0.8, "wind": np.array([2.0, -2.0, 0.5])}
    leaves = volley(air={f"limits.air.{name}": value for name, value in names.items()})
    leaves["limits.acceleration"] += 10.0
    assert assert_good(leaves).contact_error[0] < 1e-7
    still = {name: leaf for name, leaf in leaves.items() if "air" not in name}
    assert judge(still).contact_error[0] > 1e-3


def test_a_volley_solved_backwards_succeeds():
    verdict = assert_good(volley())
    assert verdict.failed_limit[0] == "" and np.isnan(verdict.failed_time[0])
    assert verdict.head_error[0] < 1e-12 and verdict.continuity_error[0] < 1e-12
    assert verdict.contact_error[0] < 1e-7 and verdict.landing_error[0] < 1e-6
    assert verdict.sentence(0).startswith("success: the ball lands")


def test_measured_quantities_agree_with_dense_sampling():
    leaves = volley()
    verdict = judge(leaves)
    size = [np.linalg.norm(dense(leaves, order)[1], axis=1) for order in range(4)]
    thrust = np.linalg.norm(dense(leaves, 2)[1] + [0.0, 0.0, GRAVITY], axis=1)
    assert verdict.max_speed[0] == pytest.approx(size[1].max(), rel=1e-7)
    assert verdict.max_acceleration[0] == pytest.approx(size[2].max(), rel=1e-7)
    assert verdict.min_height[0] == pytest.approx(dense(leaves, 0)[1][:, 2].min(), rel=1e-7)
    assert verdict.min_thrust[0] == pytest.approx(thrust.min(), rel=1e-7)
    assert verdict.max_thrust[0] == pytest.approx(thrust.max(), rel=1e-7)
    np.testing.assert_allclose(verdict.hitting_velocity[0], dense(leaves, 1)[1][-1], rtol=1e-12)
    np.testing.assert_allclose(verdict.landing_point[0], leaves["target"][0], atol=1e-7)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("speed", lambda leaves: dense(leaves, 1)),
        ("acceleration", lambda leaves: dense(leaves, 2)),
        ("body rate", lambda leaves: body_rates(leaves)),
    ],
)
def test_a_lowered_limit_fails_by_name_time_and_excess(name, values):
    leaves = volley()
    times, sizes = values(leaves)
    sizes = sizes if sizes.ndim == 1 else np.linalg.norm(sizes, axis=1)
    leaves["limits." + name.replace(" ", "_")] = sizes.max(keepdims=True) / 1.25
    found = {"excess": 0.25, "rel": 4e-5, "time": times[sizes.argmax()], "apart": 1e-3}
    verdict = assert_fails(leaves, name, **found, says=": 25.00% above its limit at ")
    if name == "body rate":
        assert verdict.max_body_rate[0] == pytest.approx(sizes.max(), rel=1e-5)


def tilts(leaves):
    times, acc = dense(leaves, 2)
    return times, np.arccos(hopf_rotations(acc)[:, 2, 2])


def test_a_tilt_limit_fails_by_name_where_the_tilt_is_greatest():
    leaves = volley()
    assert np.isnan(judge(leaves).max_tilt[0])  # neither a limit nor a recovery
    times, angles = tilts(leaves)
    leaves["limits.max_tilt"] = 2.0 * np.arcsin(np.sin(0.5 * angles.max(keepdims=True)) / 1.25)
    found = {"excess": 0.25, "rel": 4e-5, "time": times[angles.argmax()], "apart": 1e-3}
    verdict = assert_fails(leaves, "tilt", **found)
    assert verdict.max_tilt[0] == pytest.approx(angles.max(), rel=1e-6)
    assert_good(leaves | {"limits.max_tilt": angles.max(keepdims=True)})


def test_ground_fails_where_the_trajectory_is_lowest():
    leaves = volley()
    times, pos = dense(leaves, 0)
    edit(leaves, {"limits.min_height": pos[:, 2].min() * 1.25})
    lowest = {"time": times[pos[:, 2].argmin()], "apart": 1e-3}
    assert_fails(leaves, "ground", excess=0.2, **lowest, says="20.00% below the least height")


@pytest.mark.parametrize("bound, factor", [("min", 1.1), ("max", 0.9)])
def test_apex_fails_when_the_ball_is_highest(bound, factor):
    leaves = volley(flight_time=1.5)
    rise = (-CONTACT[2]) / 1.5 + 0.5 * GRAVITY * 1.5  # vertical speed after the impact
    apex = CONTACT[2] + rise**2 / (2.0 * GRAVITY)
    leaves[f"hit_limits.{bound}_apex"] = np.array([apex * factor])
    found = {"excess": abs(1.0 - factor) / factor, "rel": 1e-5, "apart": 1e-6}
    name = "apex low" if bound == "min" else "apex high"
    verdict = assert_fails(leaves, name, **found, time=IMPACT_TIME + rise / GRAVITY)
    assert verdict.apex[0] == pytest.approx(apex, rel=1e-7)


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_a_jump_between_pieces_is_seen_in_every_derivative(order):
    leaves = volley()
    leaves["coeffs"][0, 1:, order, 2] += 0.1 / math.factorial(order)  # from piece 1 on
    first_joint = leaves["durations"][0, 0] if order == 0 else None
    verdict = assert_fails(leaves, "continuity", time=first_joint, says="jumps by")
    moved = 0.1 * (IMPACT_TIME / NUM_PIECES) ** order / math.factorial(order)
    assert verdict.failed_excess[0] >= moved * (1 - 1e-6)


def test_a_ball_that_runs_away_from_the_racket_is_on_the_wrong_face():
    verdict = assert_fails(volley(ball_vel=(12.0, 0.0, -5.0)), "wrong face")
    assert verdict.contact_error[0] < 1e-3 and verdict.failed_excess[0] > 0.0


def test_limits_are_met_to_a_relative_thousandth():
    leaves = volley()
    fastest = judge(leaves).max_speed
    assert judge(leaves | {"limits.speed": fastest / 1.0009}).success[0]
    assert not judge(leaves | {"limits.speed": fastest / 1.0011}).success[0]
    assert not judge(leaves | {"limits.speed": fastest / 1.0009}, tolerance=0.0).success[0]


def test_a_peak_between_samples_is_found_on_the_polynomial():
    lowest = 20.0 * 200.5 / 400.0  # half-way between two of the 401 samples of 20 s
    path = cut([Polynomial([0.0])] * 2 + [0.25 + (TIME - lowest) ** 2], [20.0])
    leaves = volley() | {"coeffs": path[None], "durations": np.array([[20.0]])}
    assert judge(leaves).min_height[0] == pytest.approx(0.25, abs=1e-5)


@pytest.mark.parametrize("centre", [0.30321, 0.6004, 0.8999])
def test_a_narrow_peak_of_the_body_rate_is_found_where_the_thrust_nearly_vanishes(centre):
    # The thrust per unit mass is (5 t, 0.3, 40 (t - centre)^2 + 0.5). It is short near `centre`, so
    # the attitude turns fast there.
    leaves = volley()
    rise = (40.0 * (TIME - centre) ** 2 + 0.5 - GRAVITY).integ(2) + 1.5
    path = cut([(5.0 * TIME).integ(2), Polynomial([0.3]).integ(2), rise], [IMPACT_TIME])
    leaves |= {"coeffs": path[None], "durations": np.array([[IMPACT_TIME]])}
    _, rates = body_rates(leaves)
    assert judge(leaves).max_body_rate[0] == pytest.approx(rates.max(), rel=1e-4)


def test_a_thrust_that_changes_sign_between_samples_turns_the_quadrotor_over():
    # The vertical thrust per unit mass is 1 - 4 t, the horizontal thrust nearly zero. The body rate
    # is therefore zero at all samples, and huge between the two samples near t = 1/4.
    leaves = volley()
    rise = (1.0 - 4.0 * TIME - GRAVITY).integ(2) + 3.0
    path = cut([Polynomial([2e-9]).integ(2), Polynomial([0.0]), rise], [0.33])
    leaves |= {"coeffs": path[None], "durations": np.array([[0.33]])}
    verdict = judge(leaves)
    assert verdict.min_thrust[0] < 1e-3
    assert verdict.max_body_rate[0] > 100.0


def test_drag_after_the_impact_shortens_the_return_as_integrated():
    leaves = volley()

    def height(_, state):
        return state[2]

    height.terminal, height.direction = True, -1.0
    vel = (leaves["target"][0] - CONTACT) / 1.5 + [0.0, 0.0, 0.5 * GRAVITY * 1.5]
    path = fly(CONTACT, vel, 5.0, events=height, dense_output=True)
    found = {"time": IMPACT_TIME + path.t[-1], "apart": 1e-7}
    verdict = assert_fails(leaves, "landing", **found, drag_after_impact=True)
    np.testing.assert_allclose(verdict.landing_point[0], path.y[:3, -1], atol=1e-6)
    assert verdict.landing_point[0, 0] < leaves["target"][0, 0] - 0.3
    heights = path.sol(np.linspace(0.0, path.t[-1], 100001))[2]
    assert verdict.apex[0] == pytest.approx(heights.max(), abs=1e-7)
    aimed = leaves | {"target": path.y[None, :3, -1]}
    assert judge(aimed, drag_after_impact=True).success[0]
    assert not judge(aimed).success[0]


@pytest.mark.parametrize("drag_after_impact", [False, True])
def test_a_ball_that_never_reaches_the_target_height_does_not_land(drag_after_impact):
    leaves = volley()
    leaves["target"][0, 2] = 9.0
    says = "never comes down to the target's height"
    verdict = assert_fails(leaves, "landing", says=says, drag_after_impact=drag_after_impact)
    assert np.isinf(verdict.landing_error[0]) and np.isnan(verdict.landing_point[0]).all()


def unequal_lanes():
    fast, moved = edit(volley(), {"limits.speed": 1.25}), volley(target=(3.0, -1.0, 0.0))
    away = edit(volley(flight_time=1.4), {("head_state", 0): add(0.2)})
    beside = edit(moved, {("target", 0): add(0.5)})
    return [volley(), fast, volley(flight_time=1.6), away, beside, volley(target=(3.5, 1, 0))]


IMPACT_VEL = np.abs(dense(volley(), 1)[1][-1])
MOVED = [0.1 * (IMPACT_TIME / NUM_PIECES) ** k / math.factorial(k) for k in range(4)]


def spoil(edits, *found, **options):
    return failure(edit(volley(), edits), *found, **options)


good = volley
FAILURES = {
    **{
        f"hitting speed {axis}": spoil(
            {("hit_limits.hitting_speed", k): IMPACT_VEL[k] / 1.1}, 0.1, IMPACT_TIME
        )
        for k, axis in enumerate("xyz")
    },
    **{
        f"head state: derivative {k}": spoil({("head_state", k, 1): add(0.1)}, MOVED[k], 0.0)
        for k in range(4)
    },
    "body rate: free fall": failure(
        volley()
        | {"coeffs": cut([0.0 * TIME, 0.0 * TIME, 3.0 - 0.5 * GRAVITY * TIME**2], [0.3])[None]}
        | {"head_state": np.array([[[0, 0, 3.0], [0, 0, 0], [0, 0, -GRAVITY], [0, 0, 0]]])}
        | {"durations": np.array([[0.3]]), "stroke.time": np.array([0.3])},
        np.inf,
        says="without attitude",
    ),
    "landing: target moved by 20 mm": spoil(
        {("target", (0, 1)): add([0.012, -0.016])},
        *(0.02, IMPACT_TIME + 1.5, {"landing_tolerance": 0.021}),
        **{"rel": 1e-5, "apart": 2e-6, "says": "lands 0.02 m from the target at 2.700 s"},
    ),
    "contact: ball beside the racket": spoil(
        {("ball.pos", 1): add(0.006)}, 0.006, None, {"contact_tolerance": 0.007}, rel=1e-5
    ),
    "contact: ends late": spoil({("durations", -1): add(0.01), "stroke.time": add(0.01)}),
    "contact time: claimed early": spoil({"stroke.time": add(-0.02)}, 0.02, IMPACT_TIME),
    "contact time: claimed late": spoil({"stroke.time": add(0.02)}, 0.02, IMPACT_TIME),
    **{
        f"contact time: a piece of {span} s": spoil(
            {("durations", 1): span, "stroke.time": 2.0 / 3.0 * IMPACT_TIME + span}
        )
        for span in (0.0, -0.3)
    },
    "contact time: ball has landed": spoil(
        {("ball.pos", 2): add(-0.01 - CONTACT[2])}, 0.01 / -BALL_VEL[2], rel=1e-5
    ),
}
OPTIONS = ({}, {"drag_after_impact": True})
FAILED = ["", "speed", "", "head state", "landing", ""]
ABSURD = ("coeffs", "durations", "ball.vel", "drag", "head_state")
WRONG = [
    ({"target": np.zeros(3)}, {}, r"target must be \(1, 3\), got \(3,\)"),
    ({"coeffs": np.zeros((3, 8, 3))}, {}, r"coeffs must be \(B, M, D \+ 1, 3\), got \(3, 8, 3\)"),
]


def test_many_lanes_on_several_threads_are_judged_as_a_few():
    broken = volley()
    broken["coeffs"] = np.full_like(broken["coeffs"], 1e300)
    few = stack(*unequal_lanes(), broken)
    many = {name: np.concatenate([leaf] * 400) for name, leaf in few.items()}
    repeated = {name: np.concatenate([leaf] * 400) for name, leaf in rows(judge(few)).items()}
    assert_same(repeated, rows(judge(many)))


def test_an_infinite_limit_is_no_limit():
    names = "limits.speed", "limits.acceleration", "limits.body_rate", "hit_limits.max_apex"
    limits = dict.fromkeys((*names, "hit_limits.hitting_speed"), np.inf)
    assert_good(edit(volley(), limits | {"limits.min_height": -np.inf}))


@pytest.mark.parametrize(
    ("radius", "off", "passes"),
    [(None, 0.03, True), (0.11, 0.03, True), (0.11, 0.095, True), (0.11, 0.105, False)],
)
def test_a_racket_is_met_within_its_radius_less_a_margin(radius, off, passes):
    """Check that contacts within a tenth of the radius from the rim fail at any tolerance."""
    leaves = volley()
    after = leaves["target"][0] - CONTACT
    aside = np.array([-after[1], after[0], 0.0]) / np.hypot(*after[:2])
    edit(leaves, {"ball.pos": add(off * aside), "target": add(off * aside)})
    if radius is not None:
        leaves["racket_radius"] = np.array([radius])
    verdict = judge(leaves, contact_tolerance=0.2)
    assert verdict.contact_error[0] == pytest.approx(off, rel=1e-3)
    assert verdict.failed_limit[0] == ("" if passes else "contact")
    assert judge(leaves).failed_limit[0] == "contact"  # 5 mm by default


def test_a_small_racket_tightens_the_usual_tolerance():
    leaves = edit(volley(), {("ball.pos", 2): add(0.003)})
    assert judge(leaves).success[0]
    leaves["racket_radius"] = np.array([0.003])
    assert judge(leaves).failed_limit[0] == "contact"


def test_processes_judge_as_threads_do(monkeypatch):
    lanes = np.arange(600)
    case = {"durations": lanes[:, None].astype(np.float32), "value": lanes.astype(np.float32)}
    in_threads = judging.judge_in_chunks(_halve, case, 256)
    monkeypatch.setenv("NPROC", "2")
    monkeypatch.setattr(judging, "_MANY_CORES", 1)
    monkeypatch.setattr(judging, "_MANY_LANES", 1)
    in_processes = judging.judge_in_chunks(_halve, case, 256)
    assert workers._start_workers.cache_info().currsize == 1
    np.testing.assert_array_equal(in_processes["half"], in_threads["half"])
    with pytest.raises(ValueError, match="refused"):
        workers.map_in_processes(_refuse, [1, 2])


@pytest.mark.parametrize(("setting", "num"), [("3", 3), ("0", 1), ("", None), ("many", None)])
def test_nproc_sets_the_number_of_cores(monkeypatch, setting, num):
    monkeypatch.setenv("NPROC", setting)
    assert judging.cores() == (num or usable_cores())
    monkeypatch.delenv("NPROC")
    assert judging.cores() == usable_cores()


def _halve(case):
    return {"half": 0.5 * case["value"]}


def _refuse(_):
    raise ValueError("refused")
