"""The live planner, which receives packets with observations and answers with setpoints."""

import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.benchmarks import serve_floods
from planner_jax.benchmarks.floods import FLOODS, NUMBER
from planner_jax.benchmarks.serve_soak import distance_off
from planner_jax.cli.main import main
from planner_jax.live import planner as live_planner
from planner_jax.live.course import with_recovery
from planner_jax.live.packets import (
    BALL,
    ROBOT,
    USUAL,
    Fault,
    Motion,
    Reason,
    read_answer,
    request,
)
from planner_jax.live.planner import LivePlanner
from planner_jax.live.server import Server
from planner_jax.live.settings import CatchServe, HitServe
from planner_jax.live.strokes import CATCH_DRAG, CatchStroke, HitStroke

HOME, STEP = np.array([0.0, 0.0, 1.0]), 0.01
PAGE = Path(__file__).parents[1] / "docs" / "live.md"


def positions_of(vel):
    ball = pj.BallState(jnp.array([3.0, 0.1, 1.7]), jnp.asarray(vel, jnp.float32))
    thrown = pj.BallPath(ball, jnp.full(3, CATCH_DRAG), jnp.asarray(9.81))
    return np.asarray(jax.jit(jax.vmap(thrown.at))(STEP * jnp.arange(200)).pos, float)


@pytest.fixture(scope="module")
def path():
    return positions_of([-2.9, 0.0, 4.4])


@pytest.fixture(scope="module")
def warm():
    planner = LivePlanner(CatchStroke(), deadline=30.0)
    planner.warm_up()
    yield planner
    planner.close()


@pytest.fixture
def server(warm):
    server = Server(warm, 0)
    yield server
    server._socket.close()


class Throw:
    """A simulated throw, in which the robot exactly follows the setpoints of the live planner."""

    def __init__(self, planner, path, number, disturb=lambda step, data: [data], home=HOME):
        self.planner, self.path, self.number = planner, path, number
        self.disturb, self.home = disturb, home
        planner._forget()
        self.answers, self.sequence = [], 0
        self.now = time.perf_counter()
        planner._arrivals.__init__()

    def send(self, data):
        answer = self.planner.answer(data, "sender", self.now)
        found = None if answer is None else read_answer(answer)
        if found is not None:
            self.planner.record_sent(data, time.perf_counter())
            if not found.fault or found.fault in USUAL:
                self.answers.append(found)
        return found

    def packet(self, kind, values):
        self.sequence += 1
        return request(kind, self.sequence, self.now, self.now, tuple(values), self.number)

    def fly(self, steps):
        state = np.stack([self.home, 0.0 * HOME, 0.0 * HOME])
        random = np.random.default_rng(0)
        for step in range(steps):
            self.now += STEP
            self.send(self.packet(ROBOT, state.ravel()))
            observed = self.path[step] + random.normal(0.0, 0.003, 3)
            for data in self.disturb(step, self.packet(BALL, observed)):
                self.send(data)
            state = self.answers[-1].setpoints[0, :9].astype(float).reshape(3, 3)
        return self.answers


def balls_of(answers):
    return answers[1::2]


def first_column(answers, name):
    return np.array([answer.column(name)[0] for answer in answers])


def last_plan(answers):
    return [answer for answer in answers if answer.motion is Motion.PLAN][-1]


def test_a_throw_is_caught_along_a_smooth_course_and_nothing_is_compiled(warm, path):
    before = warm.report.compiled
    throw = Throw(warm, path, 1)
    answers = balls_of(throw.fly(180))
    assert warm.report.compiled == before
    motions = [answer.motion for answer in answers]
    first, last = motions.index(Motion.PLAN), 179 - motions[::-1].index(Motion.PLAN)
    assert 2 <= first <= 12 and set(motions[first : last + 1]) == {Motion.PLAN}
    assert set(motions[last + 1 :]) == {Motion.SAFE}  # without another plan
    contact, times = answers[last].contact, np.arange(180) * STEP + answers[0].begin
    ball = np.array([np.interp(contact, times, path[:180, k]) for k in range(3)])
    at = np.argmin(np.abs(times - contact))
    pos, thrust = answers[at].column("pos")[0], answers[at].column("acc")[0] + [0, 0, 9.81]
    net = pos + 0.2 * thrust / np.linalg.norm(thrust)
    # Tolerance [m]: the radius of the net, and the distance of the ball's flight in one STEP.
    assert np.linalg.norm(net - ball) < 0.125 + 0.06
    positions, speeds = first_column(answers, "pos"), first_column(answers, "vel")
    jumps = np.diff(positions, axis=0) - 0.5 * STEP * (speeds[1:] + speeds[:-1])
    assert np.abs(jumps).max() < 0.01
    slowing = np.linalg.norm(speeds[last + 1 :], axis=1)
    assert slowing[-1] < 0.5 * slowing[0]
    throw.now += 3.0
    rest = throw.send(throw.packet(BALL, path[0]))
    assert not rest.column("vel").any() and (rest.column("pos")[:, 2] > 0.2).all()


def test_setpoints_agree_with_each_other(warm, path):
    answer = balls_of(Throw(warm, path, 2).fly(40))[-1]
    pos, vel = answer.column("pos"), answer.column("vel")
    assert answer.motion is Motion.PLAN and pos.shape == (10, 3)
    assert answer.period == pytest.approx(STEP)
    middle = 0.5 * STEP * (vel[1:] + vel[:-1])
    np.testing.assert_allclose(np.diff(pos, axis=0), middle, atol=2e-4)
    np.testing.assert_allclose(np.linalg.norm(answer.column("quat_wxyz"), axis=1), 1.0, atol=1e-5)
    thrust = np.linalg.norm(answer.column("acc") + [0.0, 0.0, 9.81], axis=1)
    np.testing.assert_allclose(answer.column("thrust")[:, 0], thrust, rtol=1e-5)


def test_before_the_robot_is_known_there_are_no_setpoints_and_then_it_comes_to_rest(warm, path):
    throw = Throw(warm, path, 3)
    first = throw.send(throw.packet(BALL, path[0]))
    assert first.motion is Motion.NONE and not len(first.setpoints)
    moving = [*HOME, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    answer = throw.send(throw.packet(ROBOT, moving))
    assert answer.motion is Motion.SAFE
    np.testing.assert_allclose(answer.column("vel")[0], [2.0, 0.0, 0.0], atol=1e-5)
    throw.now += 0.9
    state = throw.answers[-1].column("pos")[-1]
    throw.now += 3.5
    rest = throw.send(throw.packet(BALL, path[0]))
    assert not rest.column("vel").any() and (rest.column("thrust") == np.float32(9.81)).all()
    assert rest.column("pos")[0, 0] > state[0]


def test_bad_packets_are_counted_by_name_without_an_effect(warm, path):
    nan, far = (np.nan, 0.0, 0.0), (3.0, 3.0, 9.0)

    def disturb(step, data):
        throw.sequence += 4
        n, now = throw.sequence - 3, throw.now
        unknown, of_nan = data[:5] + b"\x63" + data[6:], request(BALL, n, now, now, nan, 4)
        before = [b"junk", of_nan, request(BALL, n, 1e300, 1e300, far, 4), unknown]
        after = [data, data[:-3], request(BALL, n, now, now, far, 4)]
        packets = [*([data, bad] for bad in after), *([bad, data] for bad in before)]
        return packets[step % len(packets)]

    clean = balls_of(Throw(warm, path, 4).fly(60))[-1]
    before = warm.report.faults.copy()
    throw = Throw(warm, path, 4, disturb)
    answers = throw.fly(60)
    spoiled = last_plan(answers)
    names = {fault for fault, num in (warm.report.faults - before).items() if num}
    expected = {Fault.DUPLICATE, Fault.CUT, Fault.STRANGE, Fault.NOT_FINITE, Fault.OTHER_CLOCK}
    assert names >= {*expected, Fault.UNKNOWN_KIND}
    assert all(np.isfinite(answer.setpoints).all() for answer in answers)
    contacts = [answer.contact - answer.begin for answer in (spoiled, clean)]
    assert abs(contacts[0] - contacts[1]) < 0.05


def test_floods_from_other_addresses_do_not_change_the_setpoints(warm, path):
    def disturb(step, data):
        for name, flood in FLOODS.items():
            rate = min(flood.rate, 2000) * STEP
            for k in range(int(rate * step), int(rate * (step + 1))):
                sender = (name, k) if flood.is_moving else name
                answer = warm.answer(flood.make(k, throw.now), sender, throw.now)
                refused.append(answer is not None and not len(read_answer(answer).setpoints))
        return [data]

    clean, refused = Throw(warm, path, NUMBER).fly(130), []
    before = warm.report.faults.copy()
    throw = Throw(warm, path, NUMBER, disturb)
    flooded = throw.fly(130)
    assert [answer.motion for answer in flooded] == [answer.motion for answer in clean]
    positions = [first_column(answers, "pos") for answers in (clean, flooded)]
    np.testing.assert_allclose(*positions, rtol=0, atol=2e-3)
    found = warm.report.faults - before
    assert {Fault.OTHER_CLOCK, Fault.OTHER_SENDER, Fault.CROWDED, Fault.NOT_FINITE} <= {*found}
    assert sum(refused) <= 64 < 5000 < len(refused)  # 32 answers in each second


def test_setpoints_are_dated_by_the_answered_request(warm):
    throw = Throw(warm, None, 70)
    throw.send(throw.packet(ROBOT, [*HOME, *[0.0] * 6]))
    throw.now += 0.02
    throw.send(throw.packet(BALL, HOME))
    # Another sender's ball that is measured and sent 15 ms earlier, but arrives later.
    sent = throw.now - 0.015
    late = warm.answer(request(BALL, 1, sent, sent, (1.0, 1.0, 1.0), 71), "other", throw.now)
    assert read_answer(late).begin == sent
    # A sender whose clock is 15 ms ahead gets setpoints for the current time.
    sent = throw.now + 0.015
    early = warm.answer(request(BALL, 2, sent, sent, (1.0, 1.0, 1.0), 71), "other", throw.now)
    assert read_answer(early).begin == pytest.approx(throw.now, abs=1e-6)


def test_throws_are_caught_by_plans_with_recoveries(warm):
    random, before = np.random.default_rng(1), warm.report.counts.copy()
    for number in range(20, 24):
        positions = positions_of(np.array([-2.9, 0.0, 4.4]) + random.normal(0.0, 0.15, 3))
        answers = balls_of(Throw(warm, positions, number).fly(100))
        last = last_plan(answers)
        since = last.contact - answers[0].begin
        ball = [np.interp(since, STEP * np.arange(200), positions[:, k]) for k in range(3)]
        assert distance_off(last, 0.2, 9.81, np.array(ball)) < 0.125
        assert since < 1.0
    assert all(warm.report.counts[name] == before[name] for name in ("endless", "refused"))


def detect(path, random, step, false):
    """Return the detection of a frame; `false` [m] is where false detections stand, or None."""
    if step == 0 or random.uniform() < 0.2:
        return random.uniform([-1, -2, 0], [4, 2, 3]) if false is None else false
    return path[step]


def test_a_ball_is_known_in_spite_of_false_detections(warm, path):
    sight, random, errors = warm._sight, np.random.default_rng(2), []
    for run in range(60):
        sight.forget()
        false = random.uniform([-1, -2, 0], [4, 2, 3]) if run % 2 else None
        error = np.inf
        for step in range(40):
            seen = detect(path, random, step, false) + random.normal(0.0, 0.005, 3)
            ball, _ = sight.see(1, tuple(seen), STEP * step, STEP * step)
            if ball is not None and step > 30:
                error = np.linalg.norm(ball.pos - path[step])
        errors.append(error if sight.is_known(1, 0.3) else np.inf)
    sight.forget()
    assert np.mean(np.array(errors) < 0.02) >= 0.95, np.sort(errors)[-6:]


@pytest.mark.slow
def test_balls_are_caught_in_spite_of_false_detections(warm, path):
    random, met = np.random.default_rng(3), []
    for run in range(60):
        false = random.uniform([-1, -2, 0], [4, 2, 3]) if run % 2 else None
        seen = np.array([detect(path, random, step, false) for step in range(110)])
        answers = balls_of(Throw(warm, seen, 100 + run).fly(100))
        plans = [answer for answer in answers if answer.motion is Motion.PLAN]
        since = plans[-1].contact - answers[0].begin if plans else 0.0
        ball = [np.interp(since, STEP * np.arange(200), path[:, k]) for k in range(3)]
        met.append(bool(plans) and distance_off(plans[-1], 0.2, 9.81, np.array(ball)) < 0.125)
    assert np.mean(met) >= 0.95, met


def test_of_two_balls_in_flight_the_second_waits_until_the_first_is_caught(warm, path):
    def both(step, data):
        values = tuple(path[step] + [0.4, 0.1, 0.3])
        return [data, request(BALL, throw.sequence + 5000, throw.now, throw.now, values, 41)]

    throw = Throw(warm, path, 40, both)
    answers = throw.fly(60)
    plans = [answer for answer in answers if answer.motion is Motion.PLAN]
    assert len(plans) > 60 and np.ptp([answer.contact for answer in plans]) < 0.1


def test_an_answer_without_a_plan_has_the_reason(warm, path):
    throw = Throw(warm, path + [40.0, 40.0, 30.0], 50)
    reasons = [answer.reason for answer in throw.fly(60)]
    assert reasons[0] is Reason.NO_BALL and reasons[3] is Reason.UNCERTAIN
    assert {*reasons[-20:]} <= {Reason.TOO_FAR, Reason.NO_PLAN}
    caught = balls_of(Throw(warm, path, 51).fly(120))
    assert caught[-1].reason is Reason.DONE and last_plan(caught).reason is Reason.NONE


@pytest.mark.parametrize("acc", [-9.81, -30.0])
def test_setpoints_from_free_fall_and_upside_down_have_unit_quaternions(warm, acc):
    throw = Throw(warm, None, 61)
    answer = throw.send(throw.packet(ROBOT, (*HOME, *[0.0] * 5, acc)))
    np.testing.assert_allclose(np.linalg.norm(answer.column("quat_wxyz"), axis=1), 1.0, rtol=1e-5)
    assert answer.motion is Motion.SAFE and np.isfinite(answer.setpoints).all()


@pytest.mark.parametrize(
    "state", [(0, 0, -5, *[0] * 6), (*HOME, 60, 0, 0, 0, 0, 0), (*HOME, 0, 0, 0, 0, 0, -300)]
)
def test_an_absurd_state_of_the_robot_is_not_used(warm, state):
    throw = Throw(warm, None, 60)
    answer = throw.send(throw.packet(ROBOT, state))
    assert answer.fault is Fault.ABSURD and answer.motion is Motion.NONE


def test_a_robot_off_its_course_gets_a_recovery_from_its_position(warm, path):
    throw = Throw(warm, path, 5)
    throw.fly(30)
    before = warm.report.counts["astray"]
    throw.now += STEP
    answer = throw.send(throw.packet(ROBOT, [5.0, 5.0, 2.0, *[0.0] * 6]))
    assert warm.report.counts["astray"] == before + 1
    assert answer.motion is Motion.SAFE
    np.testing.assert_allclose(answer.column("pos")[0], [5.0, 5.0, 2.0], atol=1e-5)


def test_a_plan_without_a_recovery_is_not_flown(warm, path, monkeypatch):
    monkeypatch.setattr(live_planner, "with_recovery", lambda *a: (with_recovery(*a)[0], False))
    before = warm.report.counts["endless"]
    answers = Throw(warm, path, 8).fly(40)
    assert warm.report.counts["endless"] - before > 10 and warm._flight.plan is None
    assert answers[-2].motion is Motion.SAFE  # to a state of the robot
    assert np.linalg.norm(first_column(answers, "pos") - HOME, axis=1).max() < 0.02


@pytest.mark.parametrize("rate", [2.0, 200.0])
def test_setpoints_continue_along_the_recovery_at_any_rate(warm, path, monkeypatch, rate):
    monkeypatch.setattr(warm, "_period", 1.0 / rate)
    answer = balls_of(Throw(warm, path, 9).fly(40))[-1]
    assert answer.motion is Motion.PLAN and answer.period == pytest.approx(1.0 / rate)
    times = answer.begin + answer.period * np.arange(10)
    assert (answer.column("vel")[times > answer.contact + 4.0] == 0.0).all()
    steps = np.linalg.norm(np.diff(answer.column("pos"), axis=0), axis=1)
    assert (steps < 5.0 * answer.period).all()  # the greatest speed


def test_slow_planning_is_answered_from_the_last_plan(warm, path, monkeypatch):
    released = threading.Event()
    throw, again = Throw(warm, path, 6), warm.stroke.again
    throw.fly(20)
    monkeypatch.setattr(warm, "deadline", 0.002)
    monkeypatch.setattr(warm.stroke, "again", lambda *a: (released.wait(), again(*a))[1])
    before = warm.report.counts["busy"]
    throw.now += STEP
    answer = throw.send(throw.packet(BALL, path[20]))
    assert answer.motion is Motion.PLAN and warm.report.counts["busy"] == before + 1
    released.set()
    warm._job.found.result()


def test_the_client_of_the_page_prints_setpoints(warm, server, capsys):
    warm._forget()
    warm._arrivals.__init__()
    server._socket.settimeout(0.05)
    stopped = threading.Event()
    thread = threading.Thread(target=server.run, args=(lambda: not stopped.is_set(),))
    thread.start()
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    script = next(block for block in blocks if "Client(" in block)
    assert script.count("\n") <= 20
    try:
        exec(script.replace("Client()", f"Client({server.port}, timeout=5.0)"), {})
    finally:
        stopped.set()
        thread.join()
    assert "PLAN" in capsys.readouterr().out


def test_a_packet_arrives_when_the_system_receives_it(server):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(b"here", ("127.0.0.1", server.port))
    sent = time.perf_counter()
    time.sleep(0.1)
    data, _, received = server._receive()
    assert data == b"here" and abs(received - sent) < 0.05


def test_foreign_packets_get_one_warning_a_kind_and_no_answer(server, capsys):
    ours = request(BALL, 1, 5.0, 5.0, (0.0, 0.0, 1.0))
    for data in (b"GET / HTTP/1.1", ours[:30], b"", ours[:4] + b"\x02" + ours[5:], b"PJLV", b"x"):
        server._answer(data, ("127.0.0.1", 9), time.perf_counter())
    lines = capsys.readouterr().err.splitlines()
    start = "planner-jax: warning: a packet from 127.0.0.1:9 "
    assert [line.startswith(start) for line in lines] == [True] * 3
    assert "PJLV" in lines[0] and "length" in lines[1] and "version" in lines[2]


def test_a_refused_client_is_printed_once_and_answered_without_setpoints(server, capsys):
    server.planner._forget()
    server.planner._arrivals.__init__()
    now, state = time.perf_counter(), (*HOME, *[0.0] * 6)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as second:
        second.bind(("127.0.0.1", 0))
        for k in range(1, 5):
            server._answer(request(ROBOT, k, 1.0 + k, 1.0 + k, state), ("127.0.0.1", 9), now + k)
            server._answer(
                request(ROBOT, k, 1.5 + k, 1.5 + k, state), second.getsockname(), now + k + 0.5
            )
        second.settimeout(1.0)
        answer = read_answer(second.recv(2048))
    assert answer.fault is Fault.OTHER_SENDER and not len(answer.setpoints)
    (line,) = capsys.readouterr().err.splitlines()
    assert "belongs to another address" in line


@pytest.mark.slow
def test_all_throws_of_the_first_client_are_planned_during_floods(tmp_path, monkeypatch):
    names = ["nan", "numbers", "ports", "lies", "future", "robot", "robot-ahead", "clock"]
    words = ["--floods", ",".join(names), "--throws", "2", "--out", str(tmp_path / "run")]
    monkeypatch.setattr(sys, "argv", ["serve_floods", *words])
    serve_floods.main()
    rows = json.loads((tmp_path / "run" / "rows.json").read_text())
    assert [row["flood"] for row in rows] == ["none", *names]
    for row in rows:
        assert row["planned"] == row["thrown"] == 2 and row["step"] <= 0.05, row


def test_a_robot_is_selected_by_name_and_must_carry_the_tool():
    stroke = CatchServe(robot="x500-net").stroke()
    assert float(stroke.case.net.radius) == pytest.approx(0.2)
    assert CatchServe().stroke().case.net.radius == CatchStroke().case.net.radius
    with pytest.raises(pj.ArgumentError, match="robot must carry a racket"):
        HitServe(robot="x500-net")
    for robot, rule in (("nobody", "one of"), ("gone.yaml", "a file that can be read")):
        with pytest.raises(pj.ArgumentError, match=f"robot must be {rule}"):
            CatchServe(robot=robot)


def test_a_port_in_use_ends_the_command_with_one_line(server, capsys):
    assert main(["serve", "catch", "--port", str(server.port)]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and f"port {server.port}: Address already in use" in error


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_the_report(number):
    words = [sys.executable, "-m", "planner_jax", "serve", "catch", "--port", "0", "--report"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None and "Answering" in process.stdout.readline()
    process.send_signal(number)
    out, err = process.communicate(timeout=30.0)
    assert err.startswith("Compiling the planner.\n")
    assert process.returncode == 128 + number and "0 packets answered" in err
    assert "compiled after the start: 0" in out


@pytest.mark.slow
def test_hits_are_planned_too():
    cases = pj.hit.draw(1)
    of_one = jax.jit(lambda ball: pj.fly(ball, 1.5, 0.0616, 9.8, num_steps=150)[1].pos)
    served = np.asarray(of_one(pj.take(cases.ball, 0)), float)
    home = np.asarray(cases.head_state[0, 0], float)
    planner = LivePlanner(HitStroke(), deadline=30.0)
    planner.warm_up()
    throw = Throw(planner, served, 1, home=home)
    answers = throw.fly(40)
    planner.close()
    assert answers[-1].motion is Motion.PLAN and planner.report.compiled == 0


@pytest.mark.slow
def test_setpoints_follow_the_requested_heading(path):
    planner = LivePlanner(CatchStroke(heading="ball", max_yaw_rate=1.0), deadline=30.0)
    planner.warm_up()
    answers = balls_of(Throw(planner, path, 1).fly(90))
    planner.close()
    assert planner.report.compiled == 0 and last_plan(answers).reason is Reason.NONE
    quat = first_column(answers, "quat_wxyz")
    yaw = 2.0 * np.arctan2(quat[:, 3], quat[:, 0])
    ball = np.arctan2(path[0, 1], path[0, 0])
    assert np.ptp(yaw) > 0.1 * abs(ball) and np.abs(np.diff(yaw)).max() <= 1.02 * STEP
