"""Measure whether the live planning server serves its first client during floods of packets.

    python -m benchmarks.serve_floods [--floods garbage,lies,...] [--throws 3] [--out DIR]

The benchmark starts `planner-jax serve catch` as a separate process. Its client is the first one
that the server knows. It throws a simulated ball every 2.7 s, always with the same number, and
sends the robot's state all the time, both 100 times a second. The robot follows the setpoints
exactly; before each throw it is moved back. Then another process sends one flood after another
from other addresses of this machine. `benchmarks/floods.py` defines their packets and rates; a
flood that the machine cannot send at its rate has a lower rate in the table.

A throw is planned if an answer has a plan for it, and met if the net meets the ball. The table has
the largest distance between the first setpoints of two answers that are one period apart. It also
has the largest jump: the distance of a setpoint from the setpoint that the answer before had for
the same time. The success rate in the run's summary is the share of planned throws.
"""

import signal
import socket
import subprocess
import sys
import time
from typing import Any

import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.floods import FLOODS, HOST, NUMBER
from planner_jax.benchmarks.run import argument_parser, begin, parse_names
from planner_jax.benchmarks.serve_soak import NUM, distance_off, draw_paths, start_server
from planner_jax.host.machine import format_size
from planner_jax.live.packets import BALL, LONGEST, ROBOT, Answer, Motion, read_answer, request
from planner_jax.live.report import Latencies

RATE, EVERY = 100.0, 2.7  # [Hz] rate of the client's observations; [s] time between two throws
NOISE, PATIENCE = 0.005, 0.1  # [m] standard deviation of a coordinate; [s] wait for an answer


class Honest:
    """The first client of the server, and what it observes during one flood."""

    def __init__(self, port: int, home: np.ndarray, tool: tuple[float, float], gravity: float):
        self.home, self.tool, self.gravity = home, tool, gravity
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((HOST, port))
        self._sequence, self._random = 0, np.random.default_rng(0)
        self.reset()

    def reset(self) -> None:
        """Start new counts."""
        self.trips, self.silent = Latencies(), 0
        self.thrown = self.planned = self.met = 0
        self.step = self.jump = 0.0  # [m]
        self._last: Answer | None = None

    def send(self, kind: int, measured: float, values: np.ndarray) -> Answer | None:
        """Send what was measured at a time [s]; return the answer, None without setpoints."""
        self._sequence += 1
        sent = time.monotonic()
        self._socket.send(request(kind, self._sequence, sent, measured, tuple(values), NUMBER))
        while (left := sent + PATIENCE - time.monotonic()) > 0.0:
            self._socket.settimeout(left)
            try:
                answer = read_answer(self._socket.recv(LONGEST))
            except TimeoutError:
                break
            if answer is not None and answer.sequence == self._sequence:
                self.trips.add(time.monotonic() - sent)
                if not len(answer.setpoints):
                    return None
                self._compare(answer)
                return answer
        self.silent += 1
        return None

    def _compare(self, answer: Answer) -> None:
        last, self._last = self._last, answer
        if last is None or not last.begin < answer.begin < last.begin + 9 * last.period:
            return
        new, old = answer.column("pos")[0], last.column("pos")
        times = last.begin + last.period * np.arange(len(old))
        expected = [np.interp(answer.begin, times, old[:, k]) for k in range(3)]
        self.jump = max(self.jump, float(np.linalg.norm(new - expected)))
        if answer.begin - last.begin <= 1.5 / RATE:
            self.step = max(self.step, float(np.linalg.norm(new - old[0])))

    def throw(self, path: np.ndarray) -> None:
        """Send a ball along `path` (K, 3) [m] until it is met, and the robot for 2.7 s."""
        state, plan, is_met = np.stack([self.home, 0.0 * self.home, 0.0 * self.home]), None, False
        began, self._last = time.monotonic(), None
        for k in range(int(EVERY * RATE)):
            now = began + k / RATE
            time.sleep(max(0.0, now - time.monotonic()))
            answer = self.send(ROBOT, time.monotonic(), state.ravel())
            if k < len(path) and not is_met:
                seen = path[k] + self._random.normal(0.0, NOISE, 3)
                answer = self.send(BALL, now, seen) or answer
            if answer is not None:
                state = answer.setpoints[0, :9].astype(float).reshape(3, 3)
                plan = answer if answer.motion is Motion.PLAN else plan
            is_met = plan is not None and time.monotonic() > plan.contact
        self.thrown, self.planned = self.thrown + 1, self.planned + (plan is not None)
        if plan is not None:
            times = began + np.arange(len(path)) / RATE
            ball = np.array([np.interp(plan.contact, times, x) for x in path.T])
            self.met += distance_off(plan, self.tool[0], self.gravity, ball) < self.tool[1]

    def close(self) -> None:
        self._socket.close()


def fly_through(honest: Honest, balls: np.ndarray, name: str, port: int, throws: int) -> float:
    """Throw balls during a flood, or during none; return the flood's packets per second."""
    seconds = throws * EVERY
    honest.throw(balls[0, :0])  # the client comes first
    honest.reset()
    if name == "none":
        process = None
    else:
        words = [sys.executable, "-m", "planner_jax.benchmarks.floods", name, str(port)]
        process = subprocess.Popen([*words, str(seconds)], stdout=subprocess.PIPE, text=True)
    for k in range(throws):
        honest.throw(balls[k % NUM])
    return 0.0 if process is None else int(process.communicate()[0]) / seconds


def memory_of(pid: int) -> int:
    """Return the resident memory [bytes] of another process."""
    with open(f"/proc/{pid}/status", encoding="ascii") as file:
        line = next(each for each in file if each.startswith("VmRSS"))
    return 1024 * int(line.split()[1])


def main() -> None:
    parser = argument_parser("serve_floods", __doc__, throws=3)
    names = ",".join(FLOODS)
    parser.add_argument("--floods", default=names, help=f"some of {names}; default: all")
    parser.add_argument("--server-core", type=int, help="core to which the server is bound")
    options: Any = parser.parse_args()
    floods = parse_names(parser, "--floods", options.floods, FLOODS)
    options.task, options.deadline, options.rate = "catch", 0.01, RATE
    with begin(parser, options) as bench:
        balls, case = draw_paths("catch", RATE), pj.take(pj.catch.draw(1), 0)
        tool = float(case.net.height), float(case.net.radius)
        process, port, _ = start_server(options)
        honest = Honest(port, np.asarray(case.head_state[0], float), tool, float(case.gravity))
        bench.say(
            "| flood | packets/s | thrown | planned | met | step | jump | unanswered | p50 | p99 "
            "| memory |",
            "|---" * 11 + "|",
        )
        for name in ("none", *floods):
            rate = fly_through(honest, balls, name, port, options.throws)
            trips = [1e3 * honest.trips.quantile(share) for share in (0.5, 0.99)]
            words = FLOODS[name].words if name in FLOODS else name
            bench.say(
                f"| {words} | {rate:,.0f} | {honest.thrown} | {honest.planned} | {honest.met} "
                f"| {honest.step:.3f} m | {honest.jump:.3f} m | {honest.silent} of "
                f"{honest.silent + honest.trips.num} | {trips[0]:.1f} ms | {trips[1]:.1f} ms "
                f"| {format_size(memory_of(process.pid))} |"
            )
            bench.count(np.arange(honest.thrown) < honest.planned)
            bench.row(
                flood=name,
                rate=rate,
                thrown=honest.thrown,
                planned=honest.planned,
                met=honest.met,
                step=honest.step,
                jump=honest.jump,
                silent=honest.silent,
                p50_ms=trips[0],
                p99_ms=trips[1],
            )
        honest.close()
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=30.0)
        bench.say("", "the server's own report:", output.strip(), errors.strip())


if __name__ == "__main__":
    main()
