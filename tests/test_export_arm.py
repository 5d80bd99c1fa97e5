"""Exports of arms: goals that ROS 2's joint_trajectory_controller accepts, and URScript."""

import dataclasses
import functools
import re

import jax
import numpy as np
import pytest
from flown_plans import SOLVED, arm, bag, pieces, table
from test_block import BRISK

import planner_jax as pj
from planner_jax.core.errors import ArgumentError
from planner_jax.export import ros2
from planner_jax.export.api import bring_to_rest
from planner_jax.export.setpoints import joints_of, setpoints_of
from planner_jax.recovery.after_plan import is_rested
from planner_jax.robot.arm import ArmPlan

RATES = (50.0, 100.0, 237.0)


def rejection(message, joints):
    """Return why joint_trajectory_controller rejects the fields of a message, or "".

    The function `validate_trajectory_msg` of the package ros2_controllers has these rules, with the
    controller's default parameters. Names must also be unique, as the parameter `joints` needs.
    """
    names, points = message["joint_names"], message["points"]
    if not names or not points:
        return "empty"
    if len(set(names)) < len(names) or set(names) != set(joints):
        return "joint names"
    if any(abs(rate) > np.finfo(np.float32).eps for rate in points[-1]["velocities"]):
        return "velocity of the last point"
    if any(message["header"]["stamp"].values()):
        return "start in the past"
    times = [p["time_from_start"]["sec"] * 10**9 + p["time_from_start"]["nanosec"] for p in points]
    if not all(a < b for a, b in zip(times, times[1:], strict=False)):
        return "times do not rise"
    fields = ("positions", "velocities", "accelerations")
    if any(len(point[field]) != len(names) for point in points for field in fields):
        return "sizes"
    return "effort" if any(point["effort"] for point in points) else ""


@functools.cache
def blocks(regime):
    """Return pairs (case, plan) of the solved blocks among six with the regime's limits."""
    cases = jax.tree.map(np.asarray, pj.block.draw(6, "open", seed=1, regime=regime))
    every = [pj.take(cases, k) for k in range(6)]
    pairs = [(case, pj.plan(BRISK, case)) for case in every]
    solved = [pair for pair in pairs if pj.are_solved(pair[1])]
    assert len(solved) >= 4
    return solved


@pytest.mark.parametrize("regime", ["R1", "R2", "R3"])
def test_the_default_controller_accepts_every_solved_block(regime):
    accepted = 0
    for case, plan in blocks(regime):
        assert is_rested(plan) == (regime != "R1" or not np.any(plan.motion.coeffs[-1, 1:]))
        whole = bring_to_rest(plan, "brake", case)
        joints = joints_of(whole, case=case)
        end = np.sum(np.asarray(whole.motion.durations))
        for rate in RATES:
            kind, message = ros2.trajectory(whole, rate, joints)
            assert kind == ros2.ARM and not rejection(message, case.arm.joint_names)
            last = message["points"][-1]
            assert not any(last["velocities"]) and not any(last["accelerations"])
            time = last["time_from_start"]
            assert time["sec"] + 1e-9 * time["nanosec"] == pytest.approx(float(end), abs=2e-9)
            accepted += 1
    assert accepted == len(RATES) * len(blocks(regime))


def test_a_block_at_speed_is_rejected_unless_it_is_followed_by_its_recovery(tmp_path):
    case, plan = next(pair for pair in blocks("R1") if not is_rested(pair[1]))
    with pytest.warns(UserWarning, match="^the plan ends at .* joint_trajectory_controller reject"):
        _, message = ros2.trajectory(plan, 100.0)
    assert rejection(message, message["joint_names"]) == "velocity of the last point"
    path = pj.export(plan, to="ros2", out=tmp_path / "a.mcap", case=case)
    points, moves = bag(path)[1][0][3].points, message["points"]
    assert len(points) > len(moves) and not any(points[-1].velocities)
    same = len(moves) - 1
    np.testing.assert_allclose(
        [point.positions for point in points[:same]], [p["positions"] for p in moves[:same]]
    )
    rates = np.array([point.velocities for point in points[same:]])
    assert (np.abs(rates) <= np.abs(rates[0]) + 1e-5).all()


@pytest.mark.parametrize("rate", [30.0, 60.5, 100.0, 999.0])
def test_the_last_setpoint_is_at_the_exact_end_and_no_interval_is_short(rate):
    plan = arm()
    end = float(plan.motion.durations.sum())
    found, sampled = setpoints_of(plan, rate), plan.sample(rate)
    steps = np.diff(found.time) * rate
    assert found.time[-1] == pytest.approx(end, rel=1e-12)
    np.testing.assert_allclose(steps[:-1], 1.0, rtol=1e-6)
    assert 0.499 <= steps[-1] <= 1.501
    num = len(found.time) - 1
    for name, values in vars(found).items():
        np.testing.assert_array_equal(values[:num], vars(sampled)[name][:num], err_msg=name)
    exact = pj.evaluate(plan.motion, end)
    np.testing.assert_allclose(found.angles[-1], exact, rtol=1e-6)
    assert np.abs(found.rates[-1]).max() > 1.0  # the motion does not end at standstill


def test_a_table_names_the_joints_and_their_limits(tmp_path):
    case, plan = blocks("R2")[0]
    path = pj.export(plan, to="csv", out=tmp_path / "a.csv", case=case)
    header, *lines = path.read_text().splitlines()
    assert header.startswith("time [s],q1 [rad],") and header.endswith(",ddq6 [rad/s^2]")
    comments = [line for line in lines if line.startswith("#")]
    assert lines[:6] == comments
    for k, line in enumerate(comments):
        words = [case.arm.lower[k], case.arm.upper[k], case.limits.velocity[k]]
        words += [case.limits.acceleration[k]]
        assert line.startswith(f"# q{k + 1}: {case.arm.joint_names[k]}, from ")
        numbers = re.findall(r"-?\d+\.?\d*", line.partition(", from ")[2].replace("s^2", ""))
        np.testing.assert_allclose(np.array(numbers, float), words, rtol=1e-5)
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    np.testing.assert_array_equal(rows, table(path)[1])


def test_names_of_joints_are_those_of_the_case_or_as_requested():
    case, plan = blocks("R2")[0]
    own = dataclasses.replace(case.arm, joint_names=tuple("uvwxyz"))
    case = dataclasses.replace(case, arm=own)
    assert joints_of(plan, case=case).names == tuple("uvwxyz")
    assert joints_of(plan).names == tuple(f"joint_{k}" for k in range(1, 7))
    with pytest.raises(
        ArgumentError, match="^joint_names must be 6 different names, got .'abcdef'"
    ):
        joints_of(plan, "abcdef")
    assert joints_of(plan, list("abcdef"), case).names == tuple("abcdef")


@pytest.mark.parametrize("num", [5, 7])
def test_a_program_in_urscript_needs_six_joints_and_a_message_any_number(tmp_path, num):
    plan = ArmPlan(**SOLVED, motion=pieces(2, 4, num))
    export = functools.partial(pj.export, plan, recovery=None)
    says = f"^plan must be of an arm with 6 joints for URScript, got {num} joints$"
    with pytest.raises(ArgumentError, match=says):
        export(to="urscript", out=tmp_path / "a.script")
    with pytest.warns(UserWarning, match="^the plan ends at"):
        path = export(to="ros2", out=tmp_path / "a.mcap")
    assert bag(path)[1][0][3].joint_names == [f"joint_{k}" for k in range(1, num + 1)]
    header, rows = table(export(to="csv", out=tmp_path / "a.csv"))
    assert len(header) == rows.shape[1] == 1 + 3 * num and header[-1] == f"ddq{num} [rad/s^2]"


def test_a_program_in_urscript_moves_to_the_start_and_then_through_all_setpoints(tmp_path):
    case, plan = blocks("R2")[0]
    path = pj.export(plan, to="urscript", out=tmp_path / "a.script", rate=125.0, case=case)
    lines, points = path.read_text().splitlines(), setpoints_of(plan, 125.0)
    assert lines[0] == "def planned_motion():" and lines[-2:] == ["  stopj(2.0)", "end"]
    pose = lambda line: np.array(line.partition("[")[2].partition("]")[0].split(","), float)  # noqa: E731
    (start,) = (pose(line) for line in lines if line.startswith("  movej("))
    steps = [line for line in lines if line.startswith("  servoj(")]
    np.testing.assert_allclose([start, *map(pose, steps)], points.angles, rtol=1e-6, atol=1e-7)
    times = [float(line.partition("], 0, 0, ")[2].partition(",")[0]) for line in steps]
    np.testing.assert_allclose(np.cumsum(times), points.time[1:], rtol=1e-5)
    assert sum(line.startswith("  # q") for line in lines) == 6
