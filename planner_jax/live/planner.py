"""The live loop without its socket: packets in, setpoints out.

There is always a course: the way to rest from where the robot was first seen, and then plans, each
with the way to rest behind it. An answer holds what is due of the course. A plan is searched for in
a thread of its own, for which an answer waits a part of the deadline and no longer.
"""

import concurrent.futures
import contextlib
import dataclasses
import math
import time
from typing import Any

import numpy as np

from planner_jax.core.protocol import is_solved
from planner_jax.live.arrivals import Arrivals
from planner_jax.live.course import (
    Course,
    Due,
    open_ended,
    setpoints,
    state_of,
    to_rest,
    with_rest,
)
from planner_jax.live.export_cache import traced
from planner_jax.live.packets import (
    BALL,
    MOST_SETPOINTS,
    SILENT,
    WIDTH,
    Fault,
    Motion,
    Packet,
    answer,
    read_request,
)
from planner_jax.live.report import Report
from planner_jax.live.sight import Sight
from planner_jax.live.strokes import Stroke
from planner_jax.planning.single_call import call_packed

_IMMINENT = 1e-3  # [s], before the next look, in which nothing is rehearsed any longer
_PATIENCE = 0.2  # share of the deadline that an answer waits for a plan
_ASTRAY = 0.5  # [m], between robot and course, from which on the course begins anew
_JOIN = (0.02, 0.2)  # [m, m/s], by which a plan that comes late may be off the course
_NOTHING = np.zeros((0, WIDTH), np.float32)


@dataclasses.dataclass(frozen=True)
class _Flight:
    """A course, and the plan that it is of, if any. Times by the senders' clock."""

    course: Course
    began: float  # [s]
    plan: Any = None
    contact: float = math.nan  # [s]
    ball: int = -1


@dataclasses.dataclass(frozen=True)
class _Job:
    """A plan that is being searched for."""

    found: concurrent.futures.Future
    due: float  # [s], when it begins
    ball: int


class LivePlanner:
    """Plans for one ball at a time, and answers packets with setpoints.

    Args:
        stroke: what is planned, such as `HitStroke()`.
        rate: of the setpoints in an answer [Hz].
        horizon: K, how many there are.
        deadline: [s], from a packet to its answer.
        noise: [m], standard deviation of a coordinate of a ball that is observed.
        known: [m/s], standard deviation of the ball's velocity from which on is planned.
    """

    def __init__(
        self,
        stroke: Stroke,
        *,
        rate: float = 100.0,
        horizon: int = 10,
        deadline: float = 0.01,
        noise: float = 0.005,
        known: float = 0.3,
    ) -> None:
        if not 1 <= horizon <= MOST_SETPOINTS:
            raise ValueError(f"horizon must be from 1 to {MOST_SETPOINTS}, got {horizon}")
        for name, value in {"rate": rate, "deadline": deadline, "noise": noise}.items():
            if not 0.0 < value < math.inf:
                raise ValueError(f"{name} must be finite and > 0, got {value}")
        self.stroke, self.deadline = stroke, deadline
        self._period, self._num, self._known = 1.0 / rate, horizon, known
        gravity = float(stroke.case.gravity)
        self._sight = Sight(stroke.flight, stroke.drag, gravity, noise)
        self._worker = concurrent.futures.ThreadPoolExecutor(1, "planning")
        self._came = 0.0, 0.0  # when the last two packets of a ball came
        self.report, self._arrivals = Report(deadline), Arrivals()
        self._forget()

    def _forget(self) -> None:
        """Know nothing of robot and ball."""
        self._flight: _Flight | None = None
        self._before: _Flight | None = None  # what is flown on if the flight finds no rest
        self._job: _Job | None = None
        self._done = -1  # number of the last ball that was met
        self._sight.forget()

    def close(self) -> None:
        """End the thread that plans."""
        self._worker.shutdown(cancel_futures=True)
        self.report.end()

    def warm_up(self) -> None:
        """Have all compiled that will be called, and begin the report."""
        ahead = self.stroke.case.head_state[0]
        state = self.stroke.case.head_state
        flight = self._resting(state, 0.0)
        self._due(flight, 0.0)
        for k in range(3):  # towards the robot
            place = tuple(ahead + (4.0 - 0.1 * k, 0.0, 0.1 * k))
            ball, _ = self._sight.see(0, place, 0.01 * k, 0.01 * k)
        assert ball is not None
        plan = self._worker.submit(self.stroke.first, ball, state).result()
        self._worker.submit(self.stroke.again, plan, 0.01, ball).result()
        self._sight.forget()
        self.report.begin()

    def answer(self, data: bytes, sender: object, received: float) -> bytes | None:
        """The answer to a packet, or None where it gets none.

        Args:
            data: of the packet.
            sender: who sent it, hashable.
            received: `time.perf_counter()` when it came [s].
        """
        self._complete()
        report = self.report
        report.counts["packets"] += 1
        packet = read_request(data)
        if isinstance(packet, Fault):
            assert packet in SILENT
            report.faults[packet] += 1
            return None
        fault, set_anew = self._arrivals.fault(packet, sender, received)
        if set_anew:
            report.counts["clocks"] += 1
            self._forget()
        report.stages["read"].add(time.perf_counter() - received)
        # What is due is due now, however old the packet may be.
        due = self._arrivals.newest
        if packet.kind == BALL:
            self._came = received, self._came[0]
        if fault is Fault.NONE:
            use = self._see_ball if packet.kind == BALL else self._see_robot
            fault = use(packet, due, received)
        else:
            self._collect(due)
        if fault is Fault.NONE:
            report.counts["used"] += 1
            report.counts["late"] += self._arrivals.was_late
        else:
            report.faults[fault] += 1
        began = time.perf_counter()
        sent = self._packed(packet, fault, due)
        report.stages["setpoints"].add(time.perf_counter() - began)
        return sent

    def sent(self, data: bytes, received: float, computed: float = math.inf) -> None:
        """Note that the answer to a packet has been sent, and do what could wait for that.

        Args:
            data: the packet.
            received: when it came, by `time.perf_counter()`.
            computed: time [s] that this process has had processors for since then, or more.
        """
        taken = time.perf_counter() - received
        self.report.counts["answered"] += 1
        if taken > self.deadline:
            self.report.counts["missed"] += 1
            self.report.counts["starved"] += computed < self.deadline
        self.report.stages["answer"].add(taken)
        if data[5] == BALL:
            self.report.stages["ball"].add(taken)
        self._complete()

    def rehearse(self) -> bool:
        """Do what the next look at the ball will ask for, and forget it; whether there is a ball.

        What a core has done a moment ago is in its caches: it takes a half to a third of the time
        that it takes once other programs have emptied these.
        """
        flight, due = self._flight, self._arrivals.newest
        if flight is None or self._job is not None or not due < flight.contact:
            return False
        last, before = self._came
        if 0.0 < last + (last - before) - time.perf_counter() < _IMMINENT:
            return False  # lest the next look has to wait
        ball = self._sight.rehearse(due)
        if ball is None or not self._is_worth_planning(flight.ball, due):
            return False
        self._worker.submit(self._again, flight, ball, due).result()
        self._due(flight, due)
        return True

    # The robot.

    def _see_robot(self, packet: Packet, due: float, _: float) -> Fault:
        self._collect(due)
        pos, vel, acc = np.reshape(packet.values, (3, 3))
        if self._flight is not None:
            wanted = state_of(self._flight.course, max(packet.measured - self._flight.began, 0.0))
            away = math.dist(wanted[0], pos)
            self.report.tracking = max(self.report.tracking, away)
            if away <= _ASTRAY:
                return Fault.NONE
            self.report.counts["astray"] += 1
        state = np.stack([pos + vel * (due - packet.measured), vel, acc, 0.0 * pos])
        self._flight = self._resting(state.astype(np.float32), due)
        self._before = self._job = None
        return Fault.NONE

    def _resting(self, state: np.ndarray, began: float) -> _Flight:
        course, keeps = to_rest(state, self.stroke.pieces, self.stroke.case)
        self.report.counts["hard_rests"] += not keeps
        return _Flight(course, began)

    # The ball.

    def _see_ball(self, packet: Packet, due: float, received: float) -> Fault:
        began = time.perf_counter()
        before = self._sight.number
        ball, fault = self._sight.see(packet.ball, packet.values, packet.measured, due)
        self.report.stages["estimate"].add(time.perf_counter() - began)
        self.report.counts["balls"] += self._sight.number != before
        self._collect(due)
        if ball is not None and self._job is None and self._is_worth_planning(packet.ball, due):
            flight: Any = self._flight
            found = self._worker.submit(self._search, ball, flight, packet.ball, due)
            self._job = _Job(found, due, packet.ball)
        if self._job is not None:
            left = _PATIENCE * self.deadline - (time.perf_counter() - received)
            with contextlib.suppress(TimeoutError):
                self._job.found.result(max(left, 0.0))
            self._collect(due)
            self.report.counts["busy"] += self._job is not None
        return fault

    def _is_worth_planning(self, ball: int, due: float) -> bool:
        flight = self._flight
        if flight is None or not self._sight.is_known(self._known):
            return False
        if flight.plan is not None and flight.ball == ball:
            return flight.contact - due >= self.stroke.shortest
        return ball != self._done

    def _search(self, ball: Any, flight: _Flight, number: int, due: float) -> _Flight | None:
        """A flight that begins when it is due, or None; in the thread that plans."""
        began, elapsed = time.perf_counter(), due - flight.began
        stages = self.report.stages
        if flight.plan is not None and flight.ball == number:
            found = self._again(flight, ball, due)
            stages["again"].add(time.perf_counter() - began)
            if is_solved(int(found.plan.status)):
                return found
            self.report.counts["refused"] += 1
            began = time.perf_counter()
        plan = self.stroke.first(ball, state_of(flight.course, elapsed))
        stages["first"].add(time.perf_counter() - began)
        if is_solved(int(plan.status)):
            return self._flight_of(plan, number, due)
        self.report.counts["refused"] += 1
        return None

    def _again(self, flight: _Flight, ball: Any, due: float) -> _Flight:
        """What is flown, planned again, whether it is solved or not; in the thread that plans."""
        plan = self.stroke.again(flight.plan, due - flight.began, ball)
        return self._flight_of(plan, flight.ball, due)

    def _flight_of(self, plan: Any, ball: int, due: float) -> _Flight:
        course = open_ended(plan.trajectory, self.stroke.case)
        return _Flight(course, due, plan, due + self.stroke.contact(plan), ball)

    def _collect(self, due: float) -> None:
        """Fly what the thread has found, if it is ready and can still be joined."""
        flight, job = self._flight, self._job
        if flight is not None and flight.plan is not None and due >= flight.contact:
            self._done = flight.ball
        if job is None or not job.found.done():
            return
        self._job = None
        found: _Flight | None = job.found.result()
        if found is None or flight is None or self._done == job.ball:
            return
        if due > job.due and not self._joins(flight, found, due):
            self.report.counts["unjoined"] += 1
            return
        is_again = flight.plan is not None and flight.ball == job.ball
        self.report.counts["replans" if is_again else "plans"] += 1
        self._before, self._flight = flight, found
        if due + self._num * self._period > found.contact:
            self._complete()

    def _complete(self) -> None:
        """Find the way to rest behind the plan that is flown, or fly on what was flown before.

        This is left until an answer has been sent, or needs it.
        """
        flight, before = self._flight, self._before
        if flight is None or before is None:
            return
        began = time.perf_counter()
        course, keeps = with_rest(flight.plan.trajectory, self.stroke.case)
        self.report.stages["rest"].add(time.perf_counter() - began)
        self.report.counts["endless"] += not keeps
        self._flight = dataclasses.replace(flight, course=course) if keeps else before
        self._before = None

    def _joins(self, flight: _Flight, found: _Flight, due: float) -> bool:
        old, new = (state_of(each.course, due - each.began) for each in (flight, found))
        return all(math.dist(old[k], new[k]) <= _JOIN[k] for k in range(2))

    # The answer.

    def _packed(self, packet: Packet, fault: Fault, due: float) -> bytes:
        flight = self._flight
        if flight is None or not math.isfinite(due):
            times = (packet.sent, self._period, math.nan)
            return answer(packet, fault, Motion.NONE, times, _NOTHING)
        motion = Motion.PLAN if due < flight.contact else Motion.SAFE
        contact = flight.contact if motion is Motion.PLAN else math.nan
        return answer(packet, fault, motion, (due, self._period, contact), self._due(flight, due))

    def _due(self, flight: _Flight, due: float) -> np.ndarray:
        """The setpoints (K, 20) from a time on."""
        elapsed: Any = np.float32(due - flight.began)
        period: Any = np.float32(self._period)
        due_of = Due(flight.course, elapsed, period)
        return call_packed(setpoints, self._num, None, due_of, compiler=traced)
