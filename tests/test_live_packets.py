"""Packets between a live planning server and its client: format, order, and rejected packets."""

import dataclasses
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from planner_jax.live import packets
from planner_jax.live.arrivals import Arrivals
from planner_jax.live.packets import Fault, Packet
from planner_jax.live.report import Latencies

BALL_SEEN = packets.request(packets.BALL, 7, 5.0, 4.99, (1.0, 2.0, 3.0), 4)


def test_a_request_comes_back_as_it_was_packed():
    packet = Packet(packets.BALL, 4, 7, 5.0, 4.99, (1.0, 2.0, 3.0))
    assert packets.read_request(BALL_SEEN) == packet
    state = tuple(map(float, range(9)))
    sent = packets.request(packets.ROBOT, 1, 2.0, 2.0, state)
    assert packets.read_request(sent) == Packet(packets.ROBOT, 0, 1, 2.0, 2.0, state)


def test_the_layout_is_that_of_the_documentation():
    head = struct.unpack("<4sBBHId", BALL_SEEN[:20])
    assert head == (b"PJLV", 1, packets.BALL, 4, 7, 5.0)
    assert struct.unpack("<d3d", BALL_SEEN[20:]) == (4.99, 1.0, 2.0, 3.0)


def test_an_answer_comes_back_as_it_was_packed():
    packet = packets.read_request(BALL_SEEN)
    rows = np.arange(2 * packets.WIDTH, dtype=np.float32).reshape(2, packets.WIDTH)
    assert isinstance(packet, Packet)
    state = Fault.OUTLIER, packets.Motion.PLAN, packets.Reason.DONE, (5.0, 0.01, 5.5)
    found = packets.read_answer(packets.answer(packet, *state, rows))
    assert found is not None
    assert (found.sequence, found.sent, found.motion) == (7, 5.0, packets.Motion.PLAN)
    assert (found.fault, found.begin, found.period, found.contact) == (11, 5.0, 0.01, 5.5)
    np.testing.assert_array_equal(found.setpoints, rows)
    np.testing.assert_array_equal(found.column("quat_wxyz"), rows[:, 12:16])


@pytest.mark.parametrize(
    ("data", "fault"),
    [
        (b"", Fault.STRANGE),
        (b"GET / HTTP/1.1", Fault.STRANGE),
        (b"PJLV", Fault.CUT),
        (BALL_SEEN[:-1], Fault.CUT),
        (BALL_SEEN + b"\0", Fault.CUT),
        (BALL_SEEN[:4] + b"\2" + BALL_SEEN[5:], Fault.OTHER_VERSION),
        (BALL_SEEN[:5] + b"\x63" + BALL_SEEN[6:], Fault.UNKNOWN_KIND),
    ],
)
def test_an_unreadable_packet_has_a_fault(data, fault):
    assert packets.read_request(data) is fault


@pytest.mark.parametrize(
    ("sent", "measured", "values", "fault"),
    [
        (5.0, 5.0, (np.nan, 0.0, 0.0), Fault.NOT_FINITE),
        (np.inf, 5.0, (0.0, 0.0, 0.0), Fault.NOT_FINITE),
        (5.0, np.nan, (0.0, 0.0, 0.0), Fault.NOT_FINITE),
        (5.0, 5.0, (1e9, 0.0, 0.0), Fault.ABSURD),
        (5.0, 6.0, (0.0, 0.0, 0.0), Fault.ABSURD),  # measured after it was sent
        (5.0, 1.0, (0.0, 0.0, 0.0), Fault.ABSURD),  # seconds ago
    ],
)
def test_an_invalid_number_is_a_fault(sent, measured, values, fault):
    packet = packets.read_request(packets.request(packets.BALL, 1, sent, measured, values))
    assert isinstance(packet, Packet) and packet.fault is fault


@given(st.binary(max_size=120))
def test_no_bytes_crash_it(data):
    for prefix in (b"", b"PJLV", b"PJLV\1\1", BALL_SEEN[:20]):
        found = packets.read_request(prefix + data)
        assert isinstance(found, Fault | Packet)
        packets.read_answer(prefix + data)


def packet(sequence, sent, ball=0):
    return Packet(packets.BALL, ball, sequence, sent, sent, (0.0, 0.0, 0.0))


def faults(marks):
    arrivals = Arrivals()
    found = [arrivals.check(packet(n, sent), "a", now)[0] for n, sent, now in marks]
    return found, arrivals


def test_packets_in_order_count_and_others_do_not():
    marks = [(1, 1.0, 9.0), (3, 1.02, 9.02), (2, 1.01, 9.03), (3, 1.02, 9.03), (4, 1.03, 9.04)]
    found, _ = faults(marks)
    assert found == [0, 0, Fault.OUT_OF_ORDER, Fault.DUPLICATE, 0]
    # The packet numbers of a sender may restart at 1, if its clock continues.
    found, _ = faults([(900, 1.0, 9.0), (1, 1.5, 9.5), (2, 1.6, 9.6)])
    assert found == [0, 0, 0]


def test_a_late_packet_is_known_by_its_time():
    arrivals = Arrivals()
    arrivals.check(packet(1, 1.0), "a", 9.0)
    arrivals.check(packet(2, 1.1), "a", 9.15)
    assert arrivals.was_late
    arrivals.check(packet(3, 1.2), "a", 9.201)
    assert not arrivals.was_late


def test_another_clock_is_accepted_after_a_second_without_a_used_packet():
    arrivals = Arrivals()
    assert arrivals.check(packet(1, 1.0), "a", 9.0) == (Fault.NONE, False)
    assert arrivals.check(packet(2, 1e300), "b", 9.0) == (Fault.OTHER_CLOCK, False)
    assert arrivals.check(packet(2, 1.01), "a", 9.01) == (Fault.NONE, False)
    found = [arrivals.check(packet(n, 500.0 + n), "a", 9.2 + 0.2 * n) for n in range(6)]
    assert found[:5] == [(Fault.OTHER_CLOCK, False)] * 5
    assert found[5] == (Fault.NONE, True)
    assert arrivals.check(packet(6, 505.2), "a", 10.4) == (Fault.NONE, False)


def test_the_number_of_senders_in_memory_is_bounded():
    arrivals = Arrivals()
    found = [
        arrivals.check(packet(1, 1.0 + 1e-3 * k, ball=k), k, 9.0 + 1e-3 * k)[0] for k in range(500)
    ]
    assert len(arrivals._senders) <= 32 and set(found[32:]) == {Fault.CROWDED}
    # The places of senders that were silent for a second are free again.
    assert arrivals.check(packet(1, 2.1, ball=1), "late", 10.1)[0] is Fault.NONE


def test_a_packet_cannot_come_from_the_future():
    arrivals = Arrivals()
    arrivals.check(packet(1, 1.0), "a", 9.0)
    for k, ahead in enumerate((0.99, 0.5, 0.03)):
        early = arrivals.check(packet(1, 1.01 + ahead, ball=1), f"other {k}", 9.01)
        assert early == (Fault.OTHER_CLOCK, False)
    # A single wrong time stamp of the clock's owner has no effect on its next packets.
    assert arrivals.check(packet(2, 1.92), "a", 9.02)[0] is Fault.OTHER_CLOCK
    assert arrivals.check(packet(3, 1.03), "a", 9.03)[0] is Fault.NONE
    assert arrivals.ahead == 0.0
    assert arrivals.check(packet(1, 1.05, ball=1), "b", 9.04)[0] is Fault.NONE
    assert arrivals.ahead == pytest.approx(0.01)


@pytest.mark.parametrize("step", [0.3, 0.03])
def test_the_owner_of_the_clock_may_set_it_forward_with_two_packets(step):
    arrivals = Arrivals()
    arrivals.check(packet(1, 1.0), "a", 9.0)
    marks = [(n, 1.0 + 0.01 * n + step, 9.0 + 0.01 * n) for n in range(2, 5)]
    found = [arrivals.check(packet(n, sent), "a", now) for n, sent, now in marks]
    assert found == [(Fault.OTHER_CLOCK, False), (Fault.NONE, False), (Fault.NONE, False)]
    assert arrivals.ahead == 0.0


def test_ball_robot_and_clock_belong_to_the_sender_that_came_first():
    arrivals = Arrivals()
    robot = Packet(packets.ROBOT, 0, 1, 1.0, 1.0, (0.0,) * 9)
    assert arrivals.check(packet(1, 1.0), "a", 9.0)[0] is Fault.NONE
    assert arrivals.check(robot, "b", 9.0)[0] is Fault.NONE  # number 0, but not the ball
    for k in range(1, 300):  # "a" observes a ball, "b" the robot, and "c" lies about both
        sent, now = 1.0 + 0.01 * k, 9.0 + 0.01 * k
        state = dataclasses.replace(robot, sent=sent, sequence=k + 1)
        assert arrivals.check(packet(k + 1, sent), "a", now)[0] is Fault.NONE
        assert arrivals.check(state, "b", now)[0] is Fault.NONE
        assert arrivals.check(packet(k, sent), "c", now)[0] is Fault.OTHER_SENDER
        assert arrivals.check(state, "c", now)[0] is Fault.OTHER_SENDER
        assert arrivals.check(packet(k, 500.0 + sent), "d", now)[0] is Fault.OTHER_CLOCK
    # The clock passes on to "b" when "a" is silent, and the ball is free.
    for k in range(300, 410):
        sent, now = 1.0 + 0.01 * k, 9.0 + 0.01 * k
        state = dataclasses.replace(robot, sent=sent, sequence=k + 1)
        assert arrivals.check(state, "b", now)[0] is Fault.NONE
        assert arrivals.check(packet(k, 500.0 + sent), "d", now)[0] is Fault.OTHER_CLOCK
    assert arrivals.check(packet(1, 5.1), "c", 13.1)[0] is Fault.NONE


def test_a_ball_belongs_to_its_sender_while_the_sender_sends_anything():
    arrivals = Arrivals()
    arrivals.check(packet(1, 1.0, ball=7), "a", 9.0)
    for k in range(1, 60):
        assert arrivals.check(packet(k + 1, 1.0 + 0.1 * k), "a", 9.0 + 0.1 * k)[0] is Fault.NONE
    assert arrivals.check(packet(1, 7.0, ball=7), "b", 15.0)[0] is Fault.OTHER_SENDER


def test_the_packets_and_balls_of_a_sender_are_limited():
    arrivals = Arrivals()
    times = 1e-4 * np.arange(1, 20001)  # 10,000 packets a second
    arrivals.check(packet(0, 1.0, ball=99), "a", 9.0)
    found = [arrivals.check(packet(k, 1.0 + t), "b", 9.0 + t)[0] for k, t in enumerate(times)]
    assert 1990 <= found.count(Fault.NONE) <= 2060 and found.count(Fault.TOO_FAST) > 17900
    found = [
        arrivals.check(packet(k, 1.5 + 0.001 * k, ball=100 + k), "c", 9.5 + 0.001 * k)[0]
        for k in range(1, 900)
    ]
    assert found.count(Fault.NONE) == 16 and set(found[16:]) == {Fault.CROWDED}


def test_a_refused_packet_is_answered_once_a_second():
    arrivals = Arrivals()
    times = 0.001 * np.arange(2500)
    assert sum(arrivals.begin_refusal("a", t) for t in times) == 3
    assert sum(arrivals.begin_refusal(k, 9.0 + 0.9e-3 * k) for k in range(1000)) == 32


def test_quantiles_of_times_are_right_to_a_per_cent():
    times, taken = Latencies(), np.random.default_rng(0).lognormal(-7.0, 1.0, 2000)
    for each in taken:
        times.add(each)
    for share in (0.5, 0.99):
        assert times.quantile(share) == pytest.approx(np.quantile(taken, share), rel=0.02)
    assert times.longest == taken.max() and np.isnan(Latencies().quantile(0.5))
