"""Live planning without the socket: a packet with a measurement in, a packet with setpoints out.

The robot always follows a course, a trajectory that ends at standstill. An answer has the next
setpoints of the course. Planning runs in a separate thread; an answer waits for the thread only for
a fraction of the deadline.
"""

import concurrent.futures
import contextlib
import dataclasses
import math
import time
from collections.abc import Callable, Hashable
from typing import Generic

import numpy as np

from planner_jax.ball.flight import BallState
from planner_jax.core.choices import require
from planner_jax.core.protocol import Status, is_solved
from planner_jax.live import packets
from planner_jax.live.arrivals import Arrivals
from planner_jax.live.course import hold_heading, recovery_from, state_of, with_recovery
from planner_jax.live.flights import (
    Flight,
    flight_of,
    heading_at,
    is_absurd,
    joins,
    sample_setpoints,
)
from planner_jax.live.packets import (
    BALL,
    MOST_SETPOINTS,
    SILENT,
    USUAL,
    WIDTH,
    Fault,
    Motion,
    Packet,
    Reason,
)
from planner_jax.live.report import Report
from planner_jax.live.sight import Sight
from planner_jax.live.strokes import CaseT, PlanT, Stroke

_PATIENCE = 0.2  # fraction of the deadline for which an answer waits for a new plan
_ASTRAY = 0.5  # [m], distance from the planned position above which the robot is stopped
_KNOWN = 0.3  # [m/s], standard deviation of a ball's velocity below which planning starts
_FORGOTTEN = 1.0  # [s], after which the number of a ball that was hit or caught is another ball
_NOTHING = np.zeros((0, WIDTH), np.float32)


@dataclasses.dataclass(frozen=True)
class _Job(Generic[PlanT]):
    """A search for a plan, which runs in the planning thread."""

    found: concurrent.futures.Future[Flight[PlanT] | None]
    start: float  # [s], time at which the plan starts, by the senders' clock
    ball: int  # number of the ball that the plan meets


class LivePlanner(Generic[CaseT, PlanT]):
    """Plans for one ball after another, and answers packets with setpoints.

    Several balls may fly together. While the robot flies to one of them, the others wait.

    Args:
        stroke: the task to hit or to catch balls, such as `HitStroke()`.
        rate: [Hz], rate of the setpoints in an answer.
        horizon: number K of setpoints in an answer.
        deadline: [s], longest time from the arrival of a packet to its answer.
        noise: [m], standard deviation of an observed coordinate of a ball.
    """

    def __init__(
        self,
        stroke: Stroke[CaseT, PlanT],
        *,
        rate: float = 100.0,
        horizon: int = 10,
        deadline: float = 0.01,
        noise: float = 0.005,
    ) -> None:
        fits = 1 <= horizon <= MOST_SETPOINTS
        require(fits, "horizon", f"from 1 to {MOST_SETPOINTS}", horizon)
        for name, value in {"rate": rate, "deadline": deadline, "noise": noise}.items():
            require(0.0 < value < math.inf, name, "finite and > 0", value)
        self.stroke, self.deadline = stroke, deadline
        self._period, self._num = 1.0 / rate, horizon
        self._gravity, self._limits = stroke.case.gravity, stroke.case.limits
        self._sight = Sight(stroke.flight, stroke.drag, float(self._gravity), noise)
        self._worker = concurrent.futures.ThreadPoolExecutor(1, "planning")
        self.report, self._arrivals = Report(deadline), Arrivals()
        self.fault = Fault.NONE  # why the last packet is not used
        self._forget()

    def _forget(self) -> None:
        self._flight: Flight[PlanT] | None = None
        # Trajectory before the current plan. The robot returns to it if no trajectory from the
        # end of the plan to standstill keeps the limits.
        self._before: Flight[PlanT] | None = None
        self._job: _Job[PlanT] | None = None
        # For each ball that the robot has hit or caught, the time [s] of its last observation.
        self._done: dict[int, float] = {}
        self._met: Flight[PlanT] | None = None  # the flight that has hit or caught its ball
        self._reason = Reason.NO_BALL
        self._sight.forget()

    def close(self) -> None:
        """End the planning thread."""
        self._worker.shutdown(cancel_futures=True)
        self.report.end()

    def warm_up(self, say: Callable[[str], object] = lambda line: None) -> None:
        """Compile all programs by planning for an invented ball; then count later compilations.

        `say` receives a line of text after every part.
        """
        state = np.asarray(self.stroke.case.head_state)
        sample_setpoints(self._recover(state, 0.0), 0.0, self._period, self._num)
        say("Compiled recoveries and setpoints, part 1 of 3.")
        ball = None
        for k in range(3):  # three observations of a ball that flies towards the robot
            pos = tuple(state[0] + (4.0 - 0.1 * k, 0.0, 0.1 * k))
            ball, _ = self._sight.see(0, pos, 0.01 * k, 0.01 * k)
        assert ball is not None
        plan = self._worker.submit(
            self.stroke.first, ball, state, heading_at(self.stroke, None, 0.0)
        ).result()
        say("Compiled the estimate of a ball and plans from scratch, part 2 of 3.")
        self._worker.submit(self.stroke.again, plan, 0.01, ball).result()
        say("Compiled plans that continue earlier ones, part 3 of 3.")
        self._sight.forget()
        self.report.begin()

    def answer(self, data: bytes, sender: Hashable, received: float) -> bytes | None:
        """Use the measurement in a packet; return the answer, or None for no answer.

        `received` [s] is the arrival time by `time.perf_counter()`. The attribute `fault` is then
        the reason why the packet is not used. An unreadable packet gets no answer. A refused one
        gets an answer without setpoints, but at most one per sender in a second.
        """
        self._complete()
        report = self.report
        report.counts["packets"] += 1
        packet = packets.read_request(data)
        if isinstance(packet, Fault):
            assert packet in SILENT
            self.fault = packet
            report.faults[packet] += 1
            return None
        if not packet.fault and is_absurd(packet, float(self._limits.speed)):
            packet = dataclasses.replace(packet, fault=Fault.ABSURD)
        self.fault, is_anew = self._arrivals.check(packet, sender, received)
        if self.fault:
            report.faults[self.fault] += 1
            is_answered = self._arrivals.begin_refusal(sender, received)
            return self._pack(packet, packet.sent) if is_answered else None
        if is_anew:
            report.counts["clocks"] += 1
            self._forget()
        report.stages["read"].add(time.perf_counter() - received)
        # The setpoints start at the sending time of this packet, but not in the future, and not
        # before the current trajectory.
        due = packet.sent - self._arrivals.ahead
        due = due if self._flight is None else max(due, self._flight.start)
        use = self._use_ball if packet.kind == BALL else self._use_robot
        self.fault = use(packet, due, received)
        if self.fault:
            report.faults[self.fault] += 1
        else:
            report.counts["used"] += 1
            report.counts["late"] += self._arrivals.was_late
        with report.stages["setpoints"].measure():
            return self._pack(packet, due, self._flight)

    def record_sent(self, data: bytes, received: float) -> None:
        """Record a sent answer's delay; only then compute the stop after a new plan."""
        taken = time.perf_counter() - received
        self.report.counts["answered"] += 1
        self.report.counts["missed"] += taken > self.deadline
        self.report.stages["answer"].add(taken)
        if data[5] == BALL and (not self.fault or self.fault in USUAL):
            self.report.stages["ball"].add(taken)
        self._complete()

    def _use_robot(self, packet: Packet, due: float, _: float) -> Fault:
        self._collect(due)
        pos, vel, acc = np.reshape(packet.values, (3, 3))
        flight = self._flight
        if flight is not None:
            on_course = state_of(flight.course, max(packet.measured - flight.start, 0.0))
            away = math.dist(on_course[0], pos)
            self.report.tracking = max(self.report.tracking, away)
            if away <= _ASTRAY:
                return Fault.NONE
            self.report.counts["astray"] += 1
        state = np.stack([pos + vel * (due - packet.measured), vel, acc, 0.0 * pos])
        self._flight = self._recover(state.astype(np.float32), due)
        self._before = self._job = None
        return Fault.NONE

    def _recover(self, state: np.ndarray, start: float) -> Flight[PlanT]:
        course, is_within = recovery_from(state, self.stroke.pieces, self._gravity, self._limits)
        self.report.counts["hard_rests"] += not is_within
        if (yaw := heading_at(self.stroke, self._flight, start)) is not None:
            course = dataclasses.replace(course, heading=hold_heading(yaw[0]))
        return Flight(course, start)

    def _use_ball(self, packet: Packet, due: float, received: float) -> Fault:
        begun, number = self._sight.begun, packet.ball
        with self.report.stages["estimate"].measure():
            ball, fault = self._sight.see(number, packet.values, packet.measured, due)
        self.report.counts["balls"] += self._sight.begun - begun
        self._collect(due)
        if packet.measured - self._done.get(number, math.inf) > _FORGOTTEN:
            del self._done[number]
        if number in self._done:
            self._done[number] = packet.measured
        flight = self._flight
        if ball is not None and flight is not None and self._job is None:
            if self._is_worth_planning(flight, number, due):
                if self._reason in (Reason.NO_BALL, Reason.UNCERTAIN):
                    self._reason = Reason.SEARCHING
                found = self._worker.submit(self._search, ball, flight, number, due)
                self._job = _Job(found, due, number)
        if self._job is not None:
            left = _PATIENCE * self.deadline - (time.perf_counter() - received)
            with contextlib.suppress(TimeoutError):
                self._job.found.result(max(left, 0.0))
            self._collect(due)
            self.report.counts["busy"] += self._job is not None
        return fault

    def _is_worth_planning(self, flight: Flight[PlanT], ball: int, due: float) -> bool:
        if not self._sight.is_known(ball, _KNOWN):
            if ball not in self._done:
                self._reason = Reason.UNCERTAIN
            return False
        if flight.plan is not None and flight.ball == ball:
            return flight.contact - due >= self.stroke.shortest
        is_busy = flight.plan is not None and due < flight.contact
        return ball not in self._done and not (is_busy and self._sight.is_seen(flight.ball))

    def _search(
        self, ball: BallState, flight: Flight[PlanT], number: int, due: float
    ) -> Flight[PlanT] | None:
        elapsed, stages = due - flight.start, self.report.stages
        if flight.plan is not None and flight.ball == number:
            with stages["again"].measure():
                plan = self.stroke.again(flight.plan, elapsed, ball)
            if is_solved(plan.status):
                return flight_of(self.stroke, plan, number, due)
            self.report.counts["refused"] += 1
        with stages["first"].measure():
            yaw = heading_at(self.stroke, flight, due)
            plan = self.stroke.first(ball, state_of(flight.course, elapsed), yaw)
        if is_solved(plan.status):
            return flight_of(self.stroke, plan, number, due)
        self.report.counts["refused"] += 1
        is_too_far = plan.status in (Status.TOO_FAR, Status.OUT_OF_REACH)
        self._reason = Reason.TOO_FAR if is_too_far else Reason.NO_PLAN
        return None

    def _collect(self, due: float) -> None:
        flight, job = self._flight, self._job
        if flight is not None and flight.plan is not None and due >= flight.contact:
            if flight is not self._met:
                self._met, self._done[flight.ball], self._reason = flight, due, Reason.DONE
        if job is None or not job.found.done() or due < job.start:
            return
        self._job = None
        found = job.found.result()
        if found is None or flight is None or job.ball in self._done:
            return
        if due > job.start and not joins(flight, found, due):
            self.report.counts["unjoined"] += 1
            self._reason = Reason.TOO_LATE
            return
        is_again = flight.plan is not None and flight.ball == job.ball
        self.report.counts["replans" if is_again else "plans"] += 1
        self._before, self._flight = flight, found
        if due + self._num * self._period > found.contact:
            self._complete()

    def _complete(self) -> None:
        flight, before = self._flight, self._before
        if flight is None or flight.plan is None or before is None:
            return
        with self.report.stages["rest"].measure():
            course, is_within = with_recovery(flight.plan.trajectory, self._gravity, self._limits)
        course = dataclasses.replace(course, heading=flight.course.heading)
        self.report.counts["endless"] += not is_within
        self._flight = dataclasses.replace(flight, course=course) if is_within else before
        self._reason = self._reason if is_within else Reason.NO_RECOVERY
        self._before = None

    def _pack(self, packet: Packet, begin: float, flight: Flight[PlanT] | None = None) -> bytes:
        """Return an answer, with the setpoints of a trajectory if there is one."""
        motion, contact, setpoints = Motion.NONE, math.nan, _NOTHING
        if flight is not None:
            begin = max(begin, flight.start)
            motion = Motion.PLAN if begin < flight.contact else Motion.SAFE
            contact = flight.contact if motion is Motion.PLAN else math.nan
            setpoints = sample_setpoints(flight, begin, self._period, self._num)
        reason = Reason.NONE if motion is Motion.PLAN else self._reason
        times = begin, self._period, contact
        return packets.answer(packet, self.fault, motion, reason, times, setpoints)
