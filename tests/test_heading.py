"""Headings of hits and catches: convention, limits, requests, referee, exports."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flown_plans import SOLVED
from jax.test_util import check_grads
from test_air import bounds

import planner_jax as pj
from planner_jax.core.protocol import is_solved
from planner_jax.export.px4 import trajectory_setpoints
from planner_jax.referee import quadrotor as referee
from planner_jax.referee.heading import judge_heading, read_heading
from planner_jax.referee.rotors import judge_rotors
from planner_jax.robot.attitude import setpoint_at
from planner_jax.robot.heading import plan_heading
from planner_jax.robot.rotor_thrusts import rotor_thrusts
from planner_jax.task.hit.plan import HitPlan, Stroke
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate

BALL = ((3.0, 2.0, 2.0), (-4.0, 0.0, 5.0), (3.0, 0.0, 0.0))
U = np.linspace(0.0, 1.0, 101)
float64 = pytest.mark.usefixtures("float64")
planned = jax.jit(plan_heading)
sampled = jax.jit(
    lambda path, times, order: jax.vmap(lambda time: evaluate(path, time, order))(times),
    static_argnums=2,
)


def case_of(heading, rotors=False, **given):
    case = pj.hit.case(*BALL, heading=heading, dtype=jnp.float64, **given)
    limits = bounds()
    limits = dataclasses.replace(
        limits, rotors=limits.rotors.replace(heading=case.heading.start[0]) if rotors else None
    )
    return case.replace(limits=limits)


def plan_of(seed=0, size=1.0):
    """Return a plan of two seconds, at rest at both ends, that bends and climbs between them."""
    rng = np.random.default_rng(seed)
    bump = np.array([0, 0, 0, 0, 70.0, -168, 140, -40, 0]) / 4.0  # derivatives 0 at 0 and 1
    coeffs = bump[:8, None] * size * rng.normal(size=3) / 2.0 ** np.arange(8)[:, None]
    coeffs[:3] += np.array([[-3.0, 0.0, 1.5], [0.0, 0.5, 0.2], [0.3, -0.4, 0.1]]) * size
    zero = np.zeros(())
    stroke = Stroke(np.array(1.6), *(np.zeros(3) for _ in range(4)), zero)
    path = PiecewisePolynomial(coeffs[None], np.array([2.0]))
    return HitPlan(**SOLVED, trajectory=path, gravity=np.array(9.8), stroke=stroke)


def judged(case, plan):
    one = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (case, plan))
    leaves = {"gravity": one[0].gravity, **read_heading(*one, 1)}
    if one[0].limits.rotors is not None:
        leaves |= {f"limits.rotors.{k}": v for k, v in vars(one[0].limits.rotors).items()}
    path = one[1].trajectory
    pieces = referee.pieces_of(path.coeffs, path.durations)
    return leaves, pieces, judge_heading(pieces, leaves, U, 1e-3, 1e-4)


@float64
def test_a_constant_heading_turns_the_attitude_about_body_z_and_nothing_else():
    for angle in (0.7, -2.5):
        plan = plan_of()
        heading = planned(plan, case_of(angle))
        assert (heading.coeffs[:, 0] == angle).all() and not heading.coeffs[:, 1:].any()
        path = plan.trajectory
        bare, turned = (
            jax.jit(setpoint_at)((path, plan.gravity, None, each), np.array(1.1))
            for each in (None, heading)
        )
        w, x, y, z = turned["quat_wxyz"]
        assert 2.0 * np.arctan2(z, w) == pytest.approx(angle, rel=1e-12)
        rate, own = np.asarray(turned["body_rate"]), bare["body_rate"]
        back = np.exp(1j * angle) * (rate[0] + 1j * rate[1])
        np.testing.assert_allclose([back.real, back.imag, rate[2]], own, atol=1e-12)
        assert turned["thrust"] == bare["thrust"]


@float64
@pytest.mark.parametrize("request_", ["velocity", "ball", ([0.0, 0.5, 2.0], [0.3, -1.0, 2.0])])
def test_the_body_rate_is_the_derivative_of_the_quaternion(request_):
    plan = plan_of()
    leaves = plan.trajectory, plan.gravity, None, planned(plan, case_of(request_))
    at = jax.jit(setpoint_at)
    for time in (0.21, 0.83, 1.37):
        before, now, after = (at(leaves, np.array(time + d)) for d in (-1e-5, 0.0, 1e-5))
        change = (after["quat_wxyz"] - before["quat_wxyz"]) / 2e-5
        (w, *v), v_dot = np.asarray(now["quat_wxyz"]), np.asarray(change)
        v = np.array(v)
        rate = 2.0 * (w * v_dot[1:] - v_dot[0] * v - np.cross(v, v_dot[1:]))
        np.testing.assert_allclose(now["body_rate"], rate, atol=1e-6)
    assert np.ptp(leaves[3].coeffs[:, 0]) > 0.2


@float64
def test_a_heading_reaches_its_request_within_the_limits_of_yaw_and_body_rate():
    case, plan = case_of(1.2, start_attitude=(1.0, 0.0, 0.0, 0.0), max_yaw_rate=1.5), plan_of()
    heading = planned(plan, case)
    rates = heading.coeffs[:, 1, 0]
    assert heading.coeffs[0, 0, 0] == 0.0 and rates.max() == pytest.approx(1.5)
    assert evaluate(heading, np.array(2.0))[0] == pytest.approx(1.2, abs=0.02)
    assert np.abs(np.diff(rates)).max() <= 1.5 / 0.25 * 2.0 / 64 * (1.0 + 1e-9)
    _, _, (turns, (squared, _), tests) = judged(case, plan.replace(heading=heading))
    assert turns[0] and not any(failed for failed, *_ in tests.values())
    bare = np.sqrt(judged(case, plan)[2][1][0][0])
    assert np.sqrt(squared[0]) > bare
    tight = case.replace(limits=case.limits.replace(body_rate=np.array(1.05 * bare)))
    slow = plan.replace(heading=planned(plan, tight))
    assert np.sqrt(judged(tight, slow)[2][1][0][0]) <= 1.05 * bare


@float64
def test_rotors_agree_with_the_referee_and_slow_the_yaw_down():
    case, plan = case_of(([0.0, 1.0], [0.4, 3.0]), rotors=True), plan_of(size=0.5)
    heading = planned(plan, case)
    leaves, pieces, _ = judged(case, plan.replace(heading=heading))
    measured, _ = judge_rotors(pieces, leaves, U, 1e-3)
    times = 2.0 * U
    path = plan.trajectory
    flown = [sampled(path, times, order) for order in (2, 3, 4)]
    turn = [sampled(heading, times, order)[:, 0] for order in range(3)]
    rotors = case.limits.rotors
    own = np.array(rotor_thrusts(*flown, plan.gravity, rotors, None, tuple(turn)))
    assert own.max() == pytest.approx(measured["max_rotor_thrust"][0], rel=2e-3)
    assert own.min() == pytest.approx(measured["min_rotor_thrust"][0], rel=2e-3)
    constant = np.array(rotor_thrusts(*flown, plan.gravity, rotors))
    held = tuple(np.zeros_like(x) + (0.4 if k == 0 else 0.0) for k, x in enumerate(turn))
    np.testing.assert_allclose(
        rotor_thrusts(*flown, plan.gravity, rotors, None, held), constant, rtol=1e-12
    )
    tight = rotors.replace(max_thrust=np.array(constant.max() * 1.0001))
    still = planned(plan, case.replace(limits=case.limits.replace(rotors=tight)))
    found = [np.ptp(each.coeffs[:, 0]) for each in (still, heading)]
    assert found[0] <= 0.6 * found[1]


@float64
def test_rotors_keep_their_limits_where_the_recovery_begins():
    """Let the snap, and with it a rotor's thrust, rise steeply up to the end of the first piece."""
    case, plan = case_of(([0.0, 2.0], [0.4, 3.0]), rotors=True), plan_of()
    coeffs, end = np.zeros((2, 16, 3)), 1.1007
    coeffs[0, 15, 0] = 60.0 / 32760.0 / end**11
    first, then = (
        PiecewisePolynomial(coeffs[k : k + 1], np.array([time])) for k, time in ((0, end), (1, 0.9))
    )
    plan = plan.replace(trajectory=first, recovery=then)
    flown = [sampled(first, np.array([end]), order) for order in (2, 3, 4)]
    rotors = case.limits.rotors
    most = np.max(rotor_thrusts(*flown, plan.gravity, rotors))
    tight = rotors.replace(max_thrust=np.array(most * 1.0002))
    heading = planned(plan, case.replace(limits=case.limits.replace(rotors=tight)))
    turn = [evaluate(heading, np.array(end), order) for order in range(3)]
    assert np.max(rotor_thrusts(*flown, plan.gravity, rotors, None, tuple(turn))) <= most * 1.0005


@float64
def test_the_referee_names_headings_that_start_elsewhere_jump_or_turn_too_fast():
    case, plan = case_of(([0.0, 0.5], [0.3, 1.5])), plan_of()
    heading = planned(plan, case)
    faster = dataclasses.replace(case.heading, max_yaw_rate=np.array(0.8))
    jump = heading.coeffs.at[30:, 0].add(1e-3)
    fails = {
        "yaw rate": (case.replace(heading=faster), heading),
        "heading jump": (case, heading.replace(coeffs=jump)),
        "heading start": (case, heading.replace(coeffs=heading.coeffs.at[:, 0].add(0.1))),
        "": (case, heading),
    }
    for name, (given, own) in fails.items():
        tests = judged(given, plan.replace(heading=own))[2][2]
        assert [each for each in tests if tests[each][0][0]] == [name] * bool(name)
    assert judged(case, plan)[2][2]["heading start"][0]  # a plan without heading has heading 0


@float64
def test_gradients_match_differences_and_a_batch_equals_a_loop():
    case, plan = case_of(([0.0, 0.5, 2.0], [0.3, 0.5, 0.9])), plan_of()

    follows = case.replace(heading=dataclasses.replace(case.heading, follows="velocity"))

    def at_end(angles, coeffs, case):
        own = case.replace(heading=dataclasses.replace(case.heading, angles=angles))
        path = plan.trajectory.replace(coeffs=coeffs)
        return evaluate(plan_heading(plan.replace(trajectory=path), own), jnp.array(1.9))[0]

    point = case.heading.angles, plan.trajectory.coeffs
    for given in (case, follows):
        of = jax.jit(functools.partial(at_end, case=given))
        check_grads(of, point, order=1, modes=["rev"], atol=1e-4, rtol=1e-4, eps=1e-6)
    plans = [plan_of(seed) for seed in range(3)]
    together, cases = (
        jax.tree.map(lambda *leaves: np.stack(leaves), *each)
        for each in (plans, [jax.tree.map(np.asarray, follows)] * 3)
    )
    found = jax.jit(jax.vmap(plan_heading))(together, cases)
    for k, each in enumerate(plans):
        np.testing.assert_allclose(found.coeffs[k], planned(each, follows).coeffs, atol=1e-12)


def test_px4_yaw_speed_is_the_derivative_of_the_yaw():
    plan = plan_of()
    with jax.enable_x64(True):
        heading = jax.tree.map(np.asarray, planned(plan, case_of(([0.0, 1.5], [0.0, -2.0]))))
        fields = trajectory_setpoints(plan.replace(heading=heading), 1000.0)
    yaw = np.unwrap(fields["yaw"].astype(float))
    slope = (yaw[2:-1] - yaw[:-3]) / 2e-3
    np.testing.assert_allclose(fields["yawspeed"][1:-2], slope, atol=0.02)
    assert np.ptp(yaw) > 1.5


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"heading": "north"}, "heading must be one of velocity, ball, got 'north'"),
        ({"heading": np.nan}, "heading must be finite"),
        ({"heading": 0.5, "max_yaw_rate": 0.0}, "max_yaw_rate must be > 0, got 0"),
        ({"max_yaw_rate": 1.0}, "max_yaw_rate must be left out without heading"),
        ({"heading": ([0.0, 2.0, 1.0], [0.0, 1.0, 2.0])}, "heading.times must be rising, got 1"),
        ({"heading": ([0.0, 1.0], [0.0, 1.0, 2.0])}, "heading must have the shape"),
    ],
)
def test_bad_requests_are_errors_of_one_line(given, words):
    with pytest.raises(ValueError, match=words) as raised:
        pj.hit.case(*BALL, **given)
    assert "\n" not in str(raised.value)


@pytest.mark.slow
@pytest.mark.parametrize("task", [pj.hit, pj.catch])
@pytest.mark.parametrize("follows", ["velocity", "ball"])
def test_plans_with_headings_succeed(task, follows):
    cases = task.draw(6, seed=3)
    own = jax.tree.map(lambda leaf: jnp.tile(leaf, (6,) + (1,) * leaf.ndim), request_of(follows))
    turned = cases.replace(heading=own)
    planner = task.planner(recovery="brake")
    plans, bare = pj.plan(planner, turned), pj.plan(planner, cases)
    np.testing.assert_array_equal(plans.trajectory.coeffs, bare.trajectory.coeffs)
    solved = is_solved(plans.status)
    verdict = task.judge(turned, plans)
    assert solved.any() and np.array_equal(np.asarray(verdict.success), solved)
    assert np.ptp(np.asarray(plans.heading.coeffs)[..., 0, 0], axis=1).max() > 0.3
    fast = dataclasses.replace(own, max_yaw_rate=own.max_yaw_rate * 0.1)
    rejected = task.judge(turned.replace(heading=fast), plans)
    assert "yaw rate" in list(rejected.failed_limit)


def request_of(follows):
    return jax.tree.map(jnp.float32, pj.hit.case(*BALL, heading=follows).heading)
