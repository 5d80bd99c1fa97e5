"""Measure how often the live planning server misses its deadline, with imperfect packets.

    python -m benchmarks.serve_soak [--task catch] [--minutes 1] [--rate 100] [--bad 2]
        [--deadline 0.01] [--server-core N] [--out DIR]

The planning server receives positions of a flying ball and states of a robot, and answers with
setpoints of a plan. The benchmark starts `planner-jax serve TASK --report` as a separate process,
and then acts as its client. It sends noisy positions of simulated balls, and the state of a robot
that follows the last answer exactly. --bad per cent of the packets are imperfect: a third of them
is lost, a third is delayed by 30 ms, and a third is sent twice. A round trip longer than --deadline
is a miss.

A miss can also happen because the operating system did not run the server. To recognise such
misses, a third process does nothing but sleep for short times, and records when it was woken too
late. With --server-core the server is bound to one core, another sleeping process records gaps on
this core, and the client uses the other cores. Misses during a recorded gap are attributed to the
host.

The program prints misses, times, and the server's own report with its memory at the start and at
the end. The success rate in the run's summary is the share of balls that the tool (net or racket)
meets. A ball is met if it is within the tool's radius of the tool's centre at the planned time of
contact, for a robot that follows the setpoints exactly.
"""

import gc
import heapq
import os
import signal
import socket
import subprocess
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax as pj
from planner_jax.ball.flight import fly
from planner_jax.benchmarks.run import argument_parser, begin
from planner_jax.live.client import HOST
from planner_jax.live.packets import (
    BALL,
    LONGEST,
    ROBOT,
    Answer,
    Motion,
    read_answer,
    request,
)
from planner_jax.live.report import Latencies

NUM = 200  # Number of different balls, which are thrown repeatedly.
SECONDS = 1.8  # [s] Duration of the flight of a thrown ball.
NOISE = 0.005  # [m] Standard deviation of each observed coordinate of a ball.
LATE = 0.03  # [s] Delay of packets that are sent late.
TOOLS = {"hit": "racket", "catch": "net"}
# [s] Duration of each sleep of the sleeping process, and the least delay that it records as a gap.
NAP, GAP = 0.001, 0.004
SLEEPER = """
import os, sys, time
nap, gap = map(float, sys.argv[1:3])
if sys.argv[3:]:
    os.sched_setaffinity(0, {int(sys.argv[3])})
before, asker = time.monotonic(), os.getppid()
while os.getppid() == asker:
    time.sleep(nap)
    now = time.monotonic()
    if now - before > nap + gap:
        print(before + nap, now, flush=True)
    before = now
"""


def draw_paths(task: str, rate: float) -> np.ndarray:
    """Draw 200 balls of a task; return K positions of each, (200, K, 3) [m], at a rate [Hz]."""
    steps = int(SECONDS * rate)
    if task == "hit":
        cases = pj.hit.draw(NUM)

        def of_one(ball, drag, gravity):
            return fly(ball, jnp.asarray(SECONDS), drag, gravity, num_steps=steps)[1].pos

        flown = jax.jit(jax.vmap(of_one))(cases.ball, cases.drag, cases.gravity)
    else:
        targets = jax.tree.map(lambda leaf: leaf[:, 0], pj.catch.draw(NUM).targets)
        times = jnp.arange(1, steps + 1) / rate
        flown = jax.jit(jax.vmap(lambda path: jax.vmap(lambda t: path.at(t).pos)(times)))(targets)
    return np.asarray(flown, float)


def distance_off(answer: Answer, height: float, gravity: float, ball: np.ndarray) -> float:
    """Return the distance [m] of the tool's centre from a ball (3,) [m] at the planned contact.

    The tool, net or racket, is `height` [m] above the quadrotor's body, along its thrust. The
    quadrotor follows the setpoints in the server's answer.
    """
    times = answer.begin + answer.period * np.arange(answer.setpoints.shape[0])
    pos, acc = (
        np.array([np.interp(answer.contact, times, x) for x in answer.column(name).T])
        for name in ("pos", "acc")
    )
    thrust = acc + [0.0, 0.0, gravity]
    return float(np.linalg.norm(pos + height * thrust / np.linalg.norm(thrust) - ball))


class Naps:
    """Process that sleeps repeatedly, and records when the system woke it too late.

    Deadlines that the server misses during these gaps are attributed to the operating system.
    """

    def __init__(self, core: int | None = None) -> None:
        words = [sys.executable, "-S", "-c", SLEEPER, str(NAP), str(GAP)]
        words += [] if core is None else [str(core)]
        self._process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        # Start and end [s] of each gap, in which the system did not run the process; set by `end`.
        self.gaps: list[tuple[float, float]] = []

    def end(self) -> None:
        """Stop the process, and read the recorded gaps, in which the system did not run it."""
        self._process.terminate()
        output, _ = self._process.communicate()
        lines = output.splitlines(keepends=True)
        pairs = (x.split() for x in lines if x.endswith("\n"))
        self.gaps = [(float(begin), float(end)) for begin, end in pairs]

    def __str__(self) -> str:
        longest = max((end - begin for begin, end in self.gaps), default=0.0)
        return f"{len(self.gaps)} times for more than {1e3 * GAP:g} ms, at most {1e3 * longest:.1f}"


class Soak:
    """Client of the planning server: simulates thrown balls and a robot, and counts answers."""

    def __init__(self, port: int, options: Any, tool: tuple[float, float], gravity: float) -> None:
        (self.height, self.radius), self.gravity = tool, gravity  # [m], [m/s^2]
        self.options, self.trips = options, Latencies()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((HOST, port))
        self._random = np.random.default_rng(options.seed)
        self._sequence = self._tie = 0
        self._later: list[tuple[float, int, bytes]] = []
        self.lost = self.late = self.repeated = self.silent = 0
        self.missed: list[tuple[float, float]] = []  # start and end [s] of trips above the deadline
        self.thrown = self.met = 0

    def send(self, kind: int, measured: float, values: tuple, ball: int) -> Any:
        """Send a packet and wait for the answer; return None if there is no answer in 0.25 s.

        Some packets are intentionally lost, delayed or sent twice.

        Args:
            kind: kind of the packet, an observed ball or the robot's state.
            measured: time of the measurement [s].
            values: measured numbers.
            ball: number of the ball.
        """
        self._sequence = (self._sequence + 1) % 2**32
        sent = time.monotonic()
        data = request(kind, self._sequence, sent, measured, values, ball)
        fate = self._random.random() * 300.0 / max(self.options.bad, 1e-9)
        if fate < 1.0:
            self.lost += 1
            return None
        if fate < 2.0:
            self.late, self._tie = self.late + 1, self._tie + 1
            heapq.heappush(self._later, (sent + LATE, self._tie, data))
            return None
        if fate < 3.0:
            self.repeated += 1
            self._socket.send(data)
        self._socket.send(data)
        return self._answer(sent)

    def _answer(self, sent: float) -> Any:
        while (left := sent + 0.25 - time.monotonic()) > 0.0:
            self._socket.settimeout(left)
            try:
                answer = read_answer(self._socket.recv(LONGEST))
            except TimeoutError:
                break
            if answer is not None and answer.sequence == self._sequence:
                taken = time.monotonic() - sent
                self.trips.add(taken)
                if taken > self.options.deadline:
                    self.missed.append((sent, sent + taken))
                return answer
        self.silent += 1
        return None

    def throw(self, path: np.ndarray, start: np.ndarray, ball: int) -> None:
        """Simulate one ball until its contact, with a robot that first hovers at `start` (3,) [m].

        Args:
            path: (K, 3) [m], K true positions of the ball, one for each period of 1 / rate.
            start: (3,) [m], initial position of the robot.
            ball: number of the ball in the packets.
        """
        self.thrown += 1
        period, state_now, planned = 1.0 / self.options.rate, None, None
        began = time.monotonic()
        for k, place in enumerate(path):
            now = began + k * period
            time.sleep(max(0.0, now - time.monotonic()))
            while self._later and self._later[0][0] < time.monotonic():
                self._socket.send(heapq.heappop(self._later)[2])
            state = np.zeros((3, 3)) if state_now is None else state_now
            if state_now is None:
                state[0] = start
            known = self.send(ROBOT, time.monotonic(), tuple(state.ravel()), ball)
            seen = place + self._random.normal(0.0, NOISE, 3)
            answer = self.send(BALL, now, tuple(seen), ball) or known
            # Until the server first answers a packet with the robot's state, the robot hovers. Then
            # it follows the setpoints in the answers.
            if answer is None or (state_now is None and known is None):
                continue
            if not len(answer.setpoints):  # the packet is refused
                continue
            state_now = answer.setpoints[0, :9].astype(float).reshape(3, 3)
            planned = answer if answer.motion is Motion.PLAN else planned
            if planned is not None and time.monotonic() > planned.contact:
                times = began + period * np.arange(len(path))
                at = np.array([np.interp(planned.contact, times, x) for x in path.T])
                off = distance_off(planned, self.height, self.gravity, at)
                self.met += off < self.radius
                break

    def count_misses(self, gaps: list[tuple[float, float]]) -> int:
        """Count late answers of the planning server during gaps, when the system ran no processes.

        `gaps` are (start, end) [s] of the times at which a process that only sleeps was woken too
        late. The server could presumably not run at these times either.
        """
        return sum(any(a < end and b > begin for a, b in gaps) for begin, end in self.missed)

    def end(self) -> None:
        self._socket.close()


def start_server(options: Any) -> tuple[subprocess.Popen, int, float]:
    """Start the planning server; return its process, its port and how long its start took [s]."""
    words = [sys.executable, "-m", "planner_jax", "serve", options.task, "--port", "0", "--report"]
    words += ["--deadline", str(options.deadline), "--rate", str(options.rate)]
    if options.server_core is not None:
        words = ["taskset", "-c", str(options.server_core), *words]
    began = time.perf_counter()
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    line = process.stdout.readline()
    if "Answering" not in line:
        raise SystemExit(process.communicate()[1])
    port = int(line.split(":")[1].split(";")[0])
    return process, port, time.perf_counter() - began


def main() -> None:
    parser = argument_parser("serve_soak", __doc__, seed=0)
    parser.add_argument("--task", choices=("hit", "catch"), default="catch", help="default: catch")
    parser.add_argument("--minutes", type=float, default=1.0, help="duration [min]; default: 1")
    parser.add_argument(
        "--rate", type=float, default=100.0, help="observations per second [Hz]; default: 100"
    )
    parser.add_argument(
        "--bad",
        type=float,
        default=2.0,
        help="per cent of packets that are lost, late or repeated (default: 2)",
    )
    parser.add_argument(
        "--deadline", type=float, default=0.01, help="deadline of a round trip [s] (default: 0.01)"
    )
    parser.add_argument("--server-core", type=int, help="core to which the server is bound")
    options = parser.parse_args()
    with begin(parser, options) as bench:
        balls = draw_paths(options.task, options.rate)
        if options.task == "hit":
            case = pj.take(pj.hit.draw(1), 0)
            tool = float(case.racket_height), float(np.asarray(case.racket_radius))
        else:
            case = pj.take(pj.catch.draw(1), 0)
            tool = float(case.net.height), float(case.net.radius)
        start = np.asarray(case.head_state[0], float)
        process, port, seconds = start_server(options)
        naps = {"any core": Naps()}
        if options.server_core is not None:
            naps["the server's core"] = Naps(options.server_core)
            others = os.sched_getaffinity(0) - {options.server_core}
            os.sched_setaffinity(0, others or {options.server_core})
        gc.disable()  # A garbage collection of the client would count as time of the server.
        soak = Soak(port, options, tool, float(case.gravity))
        ends = time.monotonic() + 60.0 * options.minutes
        while time.monotonic() < ends:
            soak.throw(balls[soak.thrown % NUM], start, soak.thrown % 2**16)
        soak.end()
        for sleeper in naps.values():
            sleeper.end()
        by_host = soak.count_misses([gap for sleeper in naps.values() for gap in sleeper.gaps])
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=30.0)
        trips = [1e3 * soak.trips.quantile(share) for share in (0.5, 0.99)]
        bench.say(
            f"{options.task}, {options.minutes:g} min at {options.rate:g} observations/s: first "
            f"answer {seconds:.1f} s after the start; {soak.thrown} balls, {soak.met} met by the "
            f"{TOOLS[options.task]}",
            f"{soak.trips.num:,} round trips: p50 {trips[0]:.2f} ms, p99 {trips[1]:.2f} ms, max "
            f"{1e3 * soak.trips.longest:.1f} ms; {len(soak.missed)} took longer "
            f"than {1e3 * options.deadline:g} ms, {by_host} of these while the host did not run "
            f"the sleeping process; {soak.silent} without an answer",
            f"lost {soak.lost}, late {soak.late}, repeated {soak.repeated}",
            "the host did not run the sleeping process, on "
            + ", on ".join(f"{where} {sleeper}" for where, sleeper in naps.items()),
            "the server's own report:",
            output.strip(),
        )
        bench.count(np.arange(soak.thrown) < soak.met)
        bench.note(
            p50_ms=trips[0],
            p99_ms=trips[1],
            trips=soak.trips.num,
            missed=len(soak.missed),
            missed_by_host=by_host,
            start_seconds=seconds,
        )


if __name__ == "__main__":
    main()
