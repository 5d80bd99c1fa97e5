import re
import sys
import types
from pathlib import Path

import jax
import numpy as np
import pytest
from flown_plans import PLANS, arm, bag, car, export_plan, matrices, pieces, quadrotor, table

import planner_jax as pj
from planner_jax.core.errors import ArgumentError
from planner_jax.core.missing_extra import MissingExtra, install_line
from planner_jax.export import csv_rows, ros2
from planner_jax.export.api import stream
from planner_jax.export.crazyflie import poly4d
from planner_jax.export.setpoints import MOST, robot_of, setpoints_of

RATE = 50.0
DATA = Path(__file__).parent / "data"


def xyz(vector):
    return [vector.x, vector.y, vector.z]


@pytest.mark.parametrize("robot", PLANS)
def test_a_table_has_units_every_number_bit_for_bit_and_100_rows_a_second(tmp_path, robot):
    plan = PLANS[robot]
    header, rows = table(export_plan(plan, to="csv", out=tmp_path / "a.csv", rate=RATE))
    found = setpoints_of(plan, RATE)
    blocks = [np.asarray(leaf).reshape(len(rows), -1) for leaf in vars(found).values()]
    np.testing.assert_array_equal(rows[:, 0], found.time)
    np.testing.assert_array_equal(rows[:, 1:].astype(np.float32), np.hstack(blocks[1:]))
    assert len(header) == rows.shape[1] and all(name.endswith("]") for name in header)
    assert header[0] == "time [s]"
    last = {"quadrotor": "thrust [m/s^2]", "car": "yaw_rate [rad/s]", "arm": "ddq6 [rad/s^2]"}
    assert header[-1] == last[robot]
    _, rows = table(export_plan(plan, to="csv", out=tmp_path / "b.csv"))
    np.testing.assert_allclose(np.diff(rows[:, 0]), 0.01, rtol=1e-5)


@pytest.mark.parametrize("robot", PLANS)
def test_a_bag_holds_one_trajectory_as_rosbag2_has_them(tmp_path, robot):
    path = export_plan(PLANS[robot], to="ros2", out=tmp_path / "a.mcap", rate=RATE)
    profile, [(schema, channel, record, message)] = bag(path)
    kind = "JointTrajectory" if robot == "arm" else "MultiDOFJointTrajectory"
    assert (profile, schema.encoding, channel.message_encoding) == ("ros2", "ros2msg", "cdr")
    assert schema.name == f"trajectory_msgs/msg/{kind}" and record.log_time == 0
    found = setpoints_of(PLANS[robot], RATE)
    stamps = [point.time_from_start for point in message.points]
    np.testing.assert_allclose([t.sec + 1e-9 * t.nanosec for t in stamps], found.time, atol=1e-9)
    assert message.header.frame_id == "world"


def test_a_quadrotor_in_a_bag_is_as_it_is_sampled_and_turns_in_the_world(tmp_path):
    plan = quadrotor()
    path = export_plan(plan, to="ros2", out=tmp_path / "a.mcap", rate=RATE)
    points, found = bag(path)[1][0][3].points, setpoints_of(plan, RATE)
    turns = [p.transforms[0].rotation for p in points]
    for name, read, expected in [
        ("position", [xyz(p.transforms[0].translation) for p in points], found.pos),
        ("velocity", [xyz(p.velocities[0].linear) for p in points], found.vel),
        ("acceleration", [xyz(p.accelerations[0].linear) for p in points], found.acc),
        ("attitude", [[turn.w, *xyz(turn)] for turn in turns], found.quat_wxyz),
    ]:
        np.testing.assert_array_equal(read, expected, err_msg=name)
    spin = np.einsum("kij,kj->ki", matrices(found.quat_wxyz), found.body_rate)
    assert np.abs(spin - found.body_rate).max() > 0.01
    np.testing.assert_allclose([xyz(p.velocities[0].angular) for p in points], spin, atol=1e-6)


def test_a_car_in_a_bag_moves_in_the_plane_along_its_heading(tmp_path):
    path = export_plan(car(), to="ros2", out=tmp_path / "a.mcap", rate=1000.0)
    points, found = bag(path)[1][0][3].points, setpoints_of(car(), 1000.0)
    places = np.array([xyz(p.transforms[0].translation) for p in points])
    velocity = np.array([xyz(p.velocities[0].linear) for p in points])
    acceleration = np.array([xyz(p.accelerations[0].linear) for p in points])
    np.testing.assert_array_equal(places[:, :2], found.pos)
    assert not places[:, 2].any() and not velocity[:, 2].any()
    moved = (places[2:] - places[:-2]) * 500.0
    np.testing.assert_allclose(moved, velocity[1:-1], atol=3e-3)
    inner = np.array([not np.isclose(t % 0.1, [0.0, 0.1], atol=2e-3).any() for t in found.time])
    gained = ((velocity[2:] - velocity[:-2]) * 500.0)[inner[1:-1]]
    np.testing.assert_allclose(gained, acceleration[inner][: len(gained)], atol=3e-2)
    turned = matrices([[q.w, q.x, q.y, q.z] for q in (p.transforms[0].rotation for p in points)])
    np.testing.assert_allclose(turned[:, 0, 0], np.cos(found.heading), atol=1e-6)
    np.testing.assert_allclose(turned[:, 1, 0], np.sin(found.heading), atol=1e-6)
    np.testing.assert_array_equal([p.velocities[0].angular.z for p in points], found.yaw_rate)


def test_an_arm_in_a_bag_has_its_six_joints_as_they_are_sampled(tmp_path):
    path = export_plan(arm(), to="ros2", out=tmp_path / "a.mcap", rate=RATE)
    message, found = bag(path)[1][0][3], setpoints_of(arm(), RATE)
    assert message.joint_names == [f"joint_{k}" for k in range(1, 7)]
    points = message.points
    np.testing.assert_array_equal([p.positions for p in points], found.angles)
    np.testing.assert_array_equal([p.velocities for p in points], found.rates)
    np.testing.assert_array_equal([p.accelerations for p in points], found.accelerations)
    assert not any(p.effort for p in points)


@pytest.mark.filterwarnings("ignore:the plan ends at")
@pytest.mark.parametrize("robot", ["car", "arm"])
def test_where_ros_is_installed_a_plan_is_an_object_of_its_classes(monkeypatch, robot):
    with pytest.raises(MissingExtra, match="^trajectory_message needs trajectory_msgs of ROS 2"):
        ros2.trajectory_message(arm())
    for kind, definition in ros2.TYPES.items():
        package, name = kind.split("/")
        slots = [line.split()[1] for line in definition.splitlines()]
        for module in (package, f"{package}.msg"):
            if module not in sys.modules:
                monkeypatch.setitem(sys.modules, module, types.ModuleType(module))
        setattr(sys.modules[f"{package}.msg"], name, type(name, (), {"__slots__": slots}))
    made = ros2.trajectory_message(PLANS[robot], RATE)
    kind, plain = ros2.trajectory(PLANS[robot], RATE)
    assert type(made).__name__ == kind.split("/")[1]
    assert len(made.points) == len(plain["points"]) and made.joint_names == plain["joint_names"]
    time = made.points[-1].time_from_start
    assert type(time).__name__ == "Duration"
    assert time.nanosec == plain["points"][-1]["time_from_start"]["nanosec"]


@pytest.mark.parametrize("powers", [6, 8])
def test_the_table_for_a_crazyflie_and_its_packed_pieces_are_the_same(tmp_path, powers):
    plan = quadrotor(num=5, powers=powers)
    header, rows = table(export_plan(plan, to="crazyflie", out=tmp_path / "a.csv"))
    rows = rows.astype(np.float32)
    assert header[:3] == ["duration", "x^0", "x^1"] and header[9] == "y^0" and len(header) == 33
    np.testing.assert_array_equal(rows, poly4d(plan))
    path = export_plan(plan, to="crazyflie", out=tmp_path / "a.bin")
    packed = np.fromfile(path, "<f4").reshape(5, 33)  # the duration comes last
    np.testing.assert_array_equal(packed, np.roll(rows, -1, axis=1))


def exact_quadrotor():
    """Return a plan of two pieces whose coefficients are exact in float32, with a heading."""
    first, powers = (np.arange(24.0).reshape(3, 8) - 11.0) / 8.0, np.arange(8)
    then = first[:, ::-1].copy()
    then[:, 0] = first @ 0.5**powers
    then[:, 1] = first @ (powers * 0.5 ** np.maximum(powers - 1, 0))
    coeffs = np.swapaxes([first, then], 1, 2).astype(np.float32)
    durations = np.array([0.5, 1.25], np.float32)
    path = pj.PiecewisePolynomial(coeffs=coeffs, durations=durations)
    turn = np.array([[[0.25], [0.5]]], np.float32)
    heading = pj.PiecewisePolynomial(coeffs=turn, durations=np.array([1.75], np.float32))
    return quadrotor().replace(trajectory=path, heading=heading)


def test_the_bytes_for_a_crazyflie_are_those_of_its_own_library(tmp_path):
    lines = (DATA / "crazyflie.hex").read_text().splitlines()
    stored = bytes.fromhex("".join(line for line in lines if not line.startswith("#")))
    path = export_plan(exact_quadrotor(), to="crazyflie", out=tmp_path / "a.bin")
    found, expected = (
        np.frombuffer(each, "<f4").reshape(2, 33) for each in (path.read_bytes(), stored)
    )
    np.testing.assert_array_equal(found[:, [*range(24), 32]], expected[:, [*range(24), 32]])
    np.testing.assert_allclose(found[:, 24:32], expected[:, 24:32], atol=1e-6)  # a fit of the yaw


def test_pieces_are_the_trajectory_itself_without_those_that_take_no_time():
    plan = quadrotor(num=3)
    rows = poly4d(plan).astype(float)
    starts = np.cumsum(rows[:, 0]) - rows[:, 0]
    for start, row in zip(starts, rows, strict=True):
        coeffs = row[1:].reshape(4, 8).T
        position = np.polynomial.polynomial.polyval(0.5 * row[0], coeffs)
        expected = pj.evaluate(plan.trajectory, start + 0.5 * row[0])
        np.testing.assert_allclose(position, [*expected, 0.0], rtol=1e-5, atol=1e-6)
    assert not rows[:, 25:].any(), "yaw"
    path = plan.trajectory
    coeffs, durations = (np.insert(each, 1, 0.0, axis=0) for each in (path.coeffs, path.durations))
    still = path.replace(coeffs=coeffs, durations=durations)
    np.testing.assert_array_equal(poly4d(plan.replace(trajectory=still)), poly4d(plan))


def test_a_higher_degree_and_more_pieces_than_fit_are_refused():
    assert len(poly4d(quadrotor(num=31))) == 31
    with pytest.raises(ArgumentError, match="^plan must have at most 31 pieces, .* got 32$"):
        poly4d(quadrotor(num=32))
    with pytest.raises(ArgumentError, match="^plan must be of degree 7 or less .*, got 9$"):
        poly4d(quadrotor(powers=10))
    high = quadrotor(powers=10)
    nought = high.trajectory.coeffs * (np.arange(10)[:, None] < 8)
    assert poly4d(high.replace(trajectory=high.trajectory.replace(coeffs=nought))).shape == (2, 33)
    large = high.trajectory.replace(
        coeffs=1e300 * (np.arange(8) == 0)[:, None] * np.ones((2, 8, 3))
    )
    with pytest.raises(ArgumentError, match="^plan must have numbers that float32 holds"):
        poly4d(high.replace(trajectory=large))


def export_file(tmp_path, plan=None, name="a.csv", **how):
    return export_plan(plan or quadrotor(), out=tmp_path / name, **{"to": "csv", **how})


BATCH = jax.tree.map(lambda leaf: np.stack([leaf] * 3), quadrotor())
PATH = quadrotor().trajectory
SHORTER = PATH.replace(durations=np.ones(3))
LOST = PATH.replace(coeffs=np.full_like(PATH.coeffs, np.nan))
STILL = jax.tree.map(np.zeros_like, PATH)


@pytest.mark.parametrize("to", ["csv", "crazyflie"])
@pytest.mark.parametrize(
    ("plan", "rule"),
    [
        *(
            (quadrotor().replace(status=np.int32(each)), f"be solved, got the status {each.name}: ")
            for each in (pj.Status.INFEASIBLE, pj.Status.NON_FINITE, pj.Status.NO_PATH)
        ),
        (BATCH, r"be one, as pj.take\(plans, k\) gives, got"),
        (PATH, "be the plan of a robot .* got a PiecewisePoly"),
        (quadrotor().replace(trajectory=LOST), "be finite, got"),
        (quadrotor().replace(trajectory=SHORTER), r"have trajectory.durations of the shape \(2\)"),
        (quadrotor().replace(trajectory=STILL), "take some time, got 0 s$"),
    ],
)
def test_only_a_solved_finite_and_whole_plan_that_takes_time_is_exported(tmp_path, plan, rule, to):
    with pytest.raises(ArgumentError, match=f"^plan must {rule}"):
        export_file(tmp_path, plan, to=to)
    assert not list(tmp_path.iterdir())


def recovered():
    """Return a plan of a quadrotor with a recovery, cut from one continuous trajectory."""
    path = pieces(3, 8, 3)
    first, last = pj.take(path, slice(2)), pj.take(path, slice(2, 3))
    return quadrotor().replace(trajectory=first, recovery=last)


def edited(plan, field, change):
    """Return a plan with one changed array, which a dotted name selects."""
    *outer, name = field.split(".")
    inner = getattr(plan, outer[0]) if outer else plan
    new = inner.replace(**{name: change(np.asarray(getattr(inner, name)))})
    return plan.replace(**{outer[0]: new}) if outer else new


def negate(array):
    return -array


def double(array):
    return 2.0 * array


@pytest.mark.parametrize(
    ("plan", "field", "change", "rule"),
    [
        (recovered(), "gravity", negate, r"have gravity from 0.1 to 100 m/s\^2, got -9.81"),
        (recovered(), "gravity", lambda g: 1e-4 * g, "have gravity from 0.1 to 100"),
        (recovered(), "gravity", lambda g: np.float32(np.nan), "have gravity from 0.1 to 100"),
        (
            recovered(),
            "recovery.coeffs",
            negate,
            r"be continuous to 0.001, got a jump of .* in pos",
        ),
        (recovered(), "recovery.durations", negate, "be of durations >= 0, got -0.22 s"),
        (recovered(), "trajectory.durations", negate, "take some time, got -0.19 s"),
        (recovered(), "trajectory.durations", double, "be continuous to 0.001"),
        (recovered(), "trajectory.coeffs", np.int32, "have floating-point numbers in trajectory"),
        (
            recovered(),
            "recovery.durations",
            np.int32,
            "have floating-point numbers in recovery.dur",
        ),
        (recovered(), "gravity", np.int32, "have floating-point numbers in gravity, got int32"),
        (car(), "time", negate, "take some time, got -0.4 s"),
        (car(), "speed", np.int32, "have floating-point numbers in speed"),
        (arm(), "motion.durations", negate, "take some time|be of durations"),
        (arm(), "motion.durations", double, "be continuous to 0.001, got a jump"),
        (arm(), "motion.coeffs", np.int64, "have floating-point numbers in motion.coeffs"),
    ],
)
def test_a_plan_that_was_edited_to_be_impossible_is_not_exported(plan, field, change, rule):
    assert robot_of(plan).plan is type(plan)
    with pytest.raises(ArgumentError, match=f"^plan must {rule}"):
        robot_of(edited(plan, field, change))


def test_a_jump_of_the_velocity_alone_is_named():
    coeffs = recovered().recovery.coeffs.copy()
    coeffs[0, 1, 2] += 0.002
    broken = recovered().replace(recovery=recovered().recovery.replace(coeffs=coeffs))
    with pytest.raises(ArgumentError, match="a jump of 0.002 in velocities between two pieces$"):
        robot_of(broken)


@pytest.mark.parametrize("rate", [0.0, -5.0, np.nan, np.inf, 1.0, 1e7, "fast", [100.0], True])
def test_an_absurd_rate_is_refused(tmp_path, rate):
    is_number = not np.ndim(rate) and not isinstance(rate, str | bool)
    rule = r"from 2.439 to 2.439e\+05" if is_number else "a number"
    with pytest.raises(ArgumentError, match=f"^rate must be {rule}"):
        export_file(tmp_path, rate=rate)
    assert not list(tmp_path.iterdir())


def test_the_bounds_of_a_rate_are_two_setpoints_and_very_many():
    end = 0.41
    assert len(setpoints_of(quadrotor(), 1.0 / end).time) == 2
    assert len(setpoints_of(quadrotor(), (MOST - 2) / end).time) <= MOST
    with pytest.raises(ArgumentError, match="^rate must be at most 1000 for MAVLink, got 1001$"):
        stream(quadrotor(), recovery=None, to="px4", udp=9, rate=1001)


@pytest.mark.parametrize(("robot", "to"), [("car", "px4"), ("arm", "px4"), ("arm", "crazyflie")])
def test_a_format_that_cannot_carry_the_robot_says_so(tmp_path, robot, to):
    says = f"^to must be a format for plans of the {robot}, got '{to}', which is for quadrotor$"
    with pytest.raises(ArgumentError, match=says):
        export_file(tmp_path, PLANS[robot], to=to)


def test_a_file_is_new_whole_and_has_an_ending_of_its_format(tmp_path):
    path = export_file(tmp_path)
    before = path.read_bytes()
    for name, says in [
        ("a.csv", "out must be a new file, got"),
        ("a.txt", "out must end in .csv for csv, got"),
        ("no/a.csv", "out must be in a folder that can be written, got"),
        ("a.csv/b.csv", "out must be in a folder that can be written, got"),
    ]:
        with pytest.raises(ArgumentError, match=f"^{says}"):
            export_file(tmp_path, name=name)
    with pytest.raises(ArgumentError, match="^out must end in .tlog or .mcap or .csv for px4, got"):
        export_file(tmp_path, to="px4", name="b.bin")
    with pytest.raises(ArgumentError, match="^rate must not be given for crazyflie, which has"):
        export_file(tmp_path, to="crazyflie", name="b.csv", rate=100.0)
    assert [each.name for each in tmp_path.iterdir()] == ["a.csv"] and path.read_bytes() == before


def test_what_fails_while_it_is_written_leaves_nothing(tmp_path, monkeypatch):
    def fails(plan, rate, file):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(csv_rows, "write", fails)
    with pytest.raises(OSError, match="No space left on device") as caught:
        export_file(tmp_path)
    assert caught.value.filename == str(tmp_path / "a.csv")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("package", "module", "name", "to"),
    [
        ("mcap_ros2", "mcap_files", "a.mcap", "ros2"),
        ("mcap_ros2", "mcap_files", "a.mcap", "px4"),
        ("pymavlink", "mavlink", "a.tlog", "px4"),
    ],
)
def test_a_missing_package_is_named(tmp_path, monkeypatch, package, module, name, to):
    for each in [each for each in sys.modules if each.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, each)
    monkeypatch.delitem(sys.modules, f"planner_jax.export.{module}", raising=False)
    monkeypatch.setitem(sys.modules, package, None)
    says = rf"^export to \.\w+ needs {package}.*: {re.escape(install_line('export'))}$"
    with pytest.raises(MissingExtra, match=says):
        export_file(tmp_path, to=to, name=name)
    assert not list(tmp_path.iterdir())


def test_the_yaw_of_a_crazyflie_is_the_heading_of_the_plan():
    durations = np.full(6, 0.1, np.float32)
    rates = np.array([0.0, 0.5, 1.0, 0.2, -0.4, -0.1, 0.0])
    angles = np.append(0.3, 0.3 + np.cumsum(0.05 * (rates[1:] + rates[:-1])))
    coeffs = np.stack([angles[:-1], rates[:-1], np.diff(rates) / 0.2], axis=1)[..., None]
    heading = pj.PiecewisePolynomial(coeffs=coeffs.astype(np.float32), durations=durations)
    rows = poly4d(quadrotor(num=2).replace(heading=heading)).astype(float)
    starts = np.cumsum(rows[:, 0]) - rows[:, 0]
    for start, row in zip(starts, rows, strict=True):
        for share in (0.0, 0.3, 0.7, 1.0):
            yaw = np.polynomial.polynomial.polyval(share * row[0], row[25:])
            time = np.float32(min(start + share * row[0], 0.6))
            assert yaw == pytest.approx(pj.evaluate(heading, time)[0].item(), abs=5e-3)
