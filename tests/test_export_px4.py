"""Tests of plans exported to PX4 in its north-east-down frame, read back by pymavlink."""

import socket
import struct
import threading
import time

import numpy as np
import pytest
from flown_plans import bag, export_plan, matrices, quadrotor, table
from pymavlink import mavutil
from pymavlink.dialects.v20 import common

from planner_jax.core.errors import ArgumentError
from planner_jax.export import frames
from planner_jax.export.api import stream
from planner_jax.export.px4 import trajectory_setpoints
from planner_jax.export.setpoints import setpoints_of

RATE = 50.0


def test_east_is_y_north_is_x_up_is_negative_z_and_the_conversion_is_exact():
    np.testing.assert_array_equal(frames.to_ned(np.eye(3)), [[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    a, b = np.random.default_rng(0).normal(size=(2, 50, 3)).astype(np.float32)
    np.testing.assert_array_equal(frames.to_ned(a), a[:, [1, 0, 2]] * np.float32([1, 1, -1]))
    back = frames.to_ned(frames.to_ned(a))
    assert back.dtype == np.float32 and (back == a).all()
    crossed = np.cross(frames.to_ned(a), frames.to_ned(b))
    np.testing.assert_allclose(crossed, frames.to_ned(np.cross(a, b)), rtol=1e-5, atol=1e-6)


def test_yaw_is_clockwise_from_north():
    pairs = [(0.0, 90.0), (90.0, 0.0), (180.0, -90.0), (45.0, 45.0), (-60.0, 150.0)]
    for one, other in np.radians(pairs + [pair[::-1] for pair in pairs]):
        assert np.cos(frames.to_ned_yaw(one) - other) == pytest.approx(1.0, abs=1e-12)


def test_yaw_and_its_rate_are_those_of_the_nose_seen_from_above():
    found = quadrotor().sample(4000.0)
    yaw, rate = frames.yaw_of(found.quat_wxyz, found.body_rate)
    nose = matrices(found.quat_wxyz)[:, :, 0]
    np.testing.assert_allclose(yaw, np.arctan2(nose[:, 1], nose[:, 0]), atol=1e-6)
    first = slice(1, 700)  # These samples are within the first piece.
    differences = (yaw[2:] - yaw[:-2]) * 2000.0
    assert np.abs(rate[first]).max() > 0.1
    np.testing.assert_allclose(differences[:699], rate[first], atol=0.05)
    turning = np.array([[0.3, 0.2, -0.7]])
    assert frames.yaw_of(np.array([[1.0, 0.0, 0.0, 0.0]]), turning) == (0.0, -0.7)
    up = np.array([[np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0]])
    assert frames.rotate(up, np.array([1.0, 0.0, 0.0]))[0, 2] == pytest.approx(1.0)
    assert frames.yaw_of(up, turning) == (0.0, 0.0)


def test_setpoints_of_px4_are_those_of_the_plan_in_north_east_down():
    plan = quadrotor()
    fields, found = trajectory_setpoints(plan, RATE), setpoints_of(plan, RATE)
    vectors = {"position": found.pos, "velocity": found.vel, "acceleration": found.acc}
    for name, ours in {**vectors, "jerk": found.jerk}.items():
        np.testing.assert_array_equal(fields[name], frames.to_ned(ours))
    np.testing.assert_array_equal(fields["timestamp"], np.round(1e6 * found.time))
    nose = matrices(found.quat_wxyz)[:, :, 0]
    np.testing.assert_allclose(fields["yaw"], np.arctan2(nose[:, 0], nose[:, 1]), atol=1e-5)
    assert all(values.dtype == np.float32 for values in list(fields.values())[1:])


def test_a_table_of_px4_has_the_columns_of_its_message(tmp_path):
    header, rows = table(export_plan(quadrotor(), to="px4", out=tmp_path / "a.csv", rate=RATE))
    fields = trajectory_setpoints(quadrotor(), RATE)
    assert header[:5] == ["timestamp", "position[0]", "position[1]", "position[2]", "velocity[0]"]
    assert header[-2:] == ["yaw", "yawspeed"] and len(header) == 15
    wanted = np.hstack([np.reshape(values, (len(rows), -1)) for values in fields.values()])
    np.testing.assert_array_equal(rows.astype(np.float32), wanted.astype(np.float32))


def test_a_bag_of_px4_has_a_message_a_setpoint(tmp_path):
    path = export_plan(quadrotor(), to="px4", out=tmp_path / "a.mcap", rate=RATE)
    profile, found = bag(path)
    fields = trajectory_setpoints(quadrotor(), RATE)
    assert profile == "ros2" and found[0][0].name == "px4_msgs/msg/TrajectorySetpoint"
    assert found[0][1].topic == "/fmu/in/trajectory_setpoint"
    for name, values in fields.items():
        read = np.array([getattr(message, name) for *_, message in found])
        np.testing.assert_array_equal(read.astype(values.dtype), values, err_msg=name)
    times = [record.log_time for _, _, record, _ in found]
    np.testing.assert_array_equal(times, 1000 * fields["timestamp"])


def assert_are_setpoints(read, fields):
    assert len(read) == len(fields["timestamp"])
    names = ("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate")
    found = [[getattr(message, name) for name in names] for message in read]
    columns = ("position", "velocity", "acceleration", "yaw", "yawspeed")
    expected = np.hstack([fields[name].reshape(len(read), -1) for name in columns])
    np.testing.assert_array_equal(np.array(found, np.float32), expected)
    assert {message.get_type() for message in read} == {"SET_POSITION_TARGET_LOCAL_NED"}
    assert {(m.coordinate_frame, m.type_mask) for m in read} == {(common.MAV_FRAME_LOCAL_NED, 0)}
    stamps = [message.time_boot_ms for message in read]
    np.testing.assert_allclose(stamps, 1e-3 * fields["timestamp"].astype(float), atol=0.51)
    assert [message.get_seq() for message in read] == [k % 256 for k in range(len(read))]


@pytest.mark.parametrize("rate", [RATE, 1000.0])
def test_a_telemetry_log_is_read_by_pymavlink(tmp_path, rate):
    path = export_plan(quadrotor(), to="px4", out=tmp_path / "a.tlog", rate=rate)
    fields = trajectory_setpoints(quadrotor(), rate)
    log = mavutil.mavlink_connection(str(path), dialect="common")
    read = []
    while (message := log.recv_msg()) is not None:
        read.append(message)
    log.close()
    assert_are_setpoints(read, fields)
    stamps = [message._timestamp for message in read]
    np.testing.assert_allclose(stamps, 1e-6 * fields["timestamp"].astype(float), atol=1e-9)
    assert struct.unpack(">Q", path.read_bytes()[:8]) == (0,)


def test_a_stream_arrives_in_real_time_and_is_decoded():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(5.0)
        port = ear.getsockname()[1]
        sent = []
        send = lambda: stream(quadrotor(), recovery=None, to="px4", udp=port, rate=RATE)  # noqa: E731
        sender = threading.Thread(target=lambda: sent.append(send()))
        fields = trajectory_setpoints(quadrotor(), RATE)
        packets, came, began = [], [], time.monotonic()
        sender.start()
        for _ in fields["timestamp"]:
            packets.append(ear.recv(300))
            came.append(time.monotonic())
        sender.join()
    assert sent == [len(packets)]
    decoder = common.MAVLink(None)
    assert_are_setpoints([decoder.parse_buffer(packet)[0] for packet in packets], fields)
    late = np.array(came) - began - 1e-6 * fields["timestamp"].astype(float)
    assert (late >= 0.0).all() and late.min() < 1.0, "none is early, however busy the machine is"


def test_only_px4_is_streamed_to_a_port_on_which_a_program_listens():
    for port in (0, -1, 65536, "14540", True, None):
        with pytest.raises(ArgumentError, match="^udp must be a port from 1 to 65535, got"):
            stream(quadrotor(), recovery=None, to="px4", udp=port)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
    with pytest.raises(ArgumentError, match=f"^udp must be .* listens, got {port}$"):
        stream(quadrotor(), recovery=None, to="px4", udp=port)
    with pytest.raises(ArgumentError, match="^udp must not be given for csv, only for px4, got 9$"):
        stream(quadrotor(), recovery=None, to="csv", udp=9)
