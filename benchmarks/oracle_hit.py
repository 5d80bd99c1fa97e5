"""Does any feasible hit exist? A direct transcription with an interior-point solver looks for it.

    python -m benchmarks.oracle_hit [--serves DIR] [--delay S] [--limit-scale F]
        [--failures plans.parquet | --indices FILE.npy] [--num N] [--starts K] [--out DIR]

It draws a sample of the serves on which a planner failed and looks for hits by other means than
the planners', with which it shares no code. The quadrotor's snap is constant on pieces of free
duration, so that position to jerk are continuous. The impact, its time and the ball's flight
after it are equations of the program, limits are inequalities at samples of every piece, and
IPOPT minimises the largest relative excess over a limit. Coarse pieces come first, from many
starts. Where their excess is small they are halved, and limits that still peak between samples
are tightened on their piece. A hit counts only if the library's referee passes it.

A hit that is found proves its case feasible. That none is found proves nothing; but where all
starts end at the same excess, this is how far all limits together would have to give way. Needs
the extra `oracle` (CasADi).
"""

import argparse
import dataclasses
import functools
import json
import math
import multiprocessing
import time
from pathlib import Path

import casadi as ca
import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet as pq
from scipy.integrate import solve_ivp
from scipy.interpolate import BPoly
from tqdm import tqdm

from planner_jax.referee.hit import referee_hits
from planner_jax.sweep.summary import wilson_interval
from planner_jax.task.hit.plan import HitPlan, Stroke
from planner_jax.task.hit.scenario import HitScenario
from planner_jax.task.hit.serves import generate_serves, read_serves, to_scenarios
from planner_jax.task.hit.validate import ServeError
from planner_jax.trajectory.polynomial import PiecewisePolynomial

NUM_GENERATED = 9000  # serves that are drawn where no folder is given
TOLERANCE = 1e-3  # of the referee, relative

COARSE_PIECES, COARSE_SAMPLES = 20, 2  # samples of a piece, its end included
FINE_SAMPLES = 4
COARSE_FLOOR, FINE_FLOOR = -0.01, -0.003  # excesses at which the solver may rest
BALL_DEGREE = 10  # of the ball's path up to its landing; below 1e-7 m off the integration
# Sizes of position, velocity, acceleration and jerk, and of snap, in a program's variables.
STATE_SCALE, SNAP_SCALE = np.array([1.0, 3.0, 10.0, 60.0]), 600.0
LEAST_THRUST = 1.0  # [m/s^2]; below it the attitude turns faster than samples can follow
REFINED_BELOW = 0.08  # coarse excesses above it are left: halving takes off 0.03 at most
NEW_BELOW = 0.003  # by how much a coarse excess must be lower than one refined in vain
MOST_TIGHTENINGS = 4
INFEASIBLE_ABOVE = 0.01  # a case whose least excess is larger is called infeasible

# Impact over landing time, flight time after the impact [s], thrust at the impact [g]. The
# fifth is a smash from above the least apex.
STARTS = (
    (0.93, 1.6, 1.2),
    (0.80, 1.3, 1.0),
    (0.70, 1.8, 1.5),
    (0.95, 1.2, 2.2),
    (0.55, 0.7, 1.2),
    (0.87, 2.1, 1.5),
    (0.65, 1.1, 0.8),
    (0.97, 1.0, 1.4),
)
START_RANGES = ((0.5, 0.98), (0.6, 2.3), (0.8, 2.3))  # of starts beyond these

# What a program is told about a case, and how many numbers that is. SI units.
PARAMETERS = {
    "ball": 3 * (BALL_DEGREE + 1),  # position = sum_k ball[k] (t / landing_time)^k
    "landing_time": 1,
    "head_state": 12,
    "target": 3,
    "gravity": 1,
    "restitution": 1,
    "racket_height": 1,
    "speed": 1,
    "acceleration": 1,
    "body_rate": 1,
    "min_height": 1,
    "hitting_speed": 3,
    "min_apex": 1,
    "max_apex": 1,
}

# Adaptive barriers converge from far away; a monotone one that begins small stays near a good
# guess.
COARSE_OPTIONS = {"max_iter": 250, "mu_strategy": "adaptive"}
FINE_OPTIONS = {"max_iter": 200, "mu_init": 1e-4} | {
    f"{kind}bound_{amount}": 1e-4 for kind in ("", "slack_") for amount in ("push", "frac")
}


def case_parameters(scenario: HitScenario) -> dict[str, np.ndarray]:
    """The values of `PARAMETERS` for one scenario (no batch axis); the ball by integration."""
    drag, floor = float(scenario.drag), float(scenario.target[2])
    fall = np.array([0.0, 0.0, -float(scenario.gravity)])

    def rate(_, state):
        return np.r_[state[3:], fall - drag * np.linalg.norm(state[3:]) * state[3:]]

    def height(_, state):
        return state[2] - floor

    height.terminal, height.direction = True, -1.0
    begin = np.r_[np.asarray(scenario.ball.pos, float), np.asarray(scenario.ball.vel, float)]
    accuracy = {"rtol": 1e-11, "atol": 1e-11, "dense_output": True}
    flight = solve_ivp(rate, (0.0, 30.0), begin, "DOP853", events=height, **accuracy)
    nodes = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 41))
    path = flight.sol(nodes * flight.t[-1])[:3].T
    case = {
        "ball": np.polynomial.polynomial.polyfit(nodes, path, BALL_DEGREE),
        "landing_time": flight.t[-1],
    }
    for source in (scenario, scenario.limits, scenario.hit_limits):
        fields = {field.name for field in dataclasses.fields(source)}
        case |= {name: getattr(source, name) for name in fields & PARAMETERS.keys() - case.keys()}
    return {name: np.asarray(case[name], float).ravel() for name in PARAMETERS}


def unpack(vector, sizes: dict[str, int]) -> dict:
    """Named parts of a vector, symbolic or not."""
    ends = np.cumsum([0, *sizes.values()]).tolist()
    return {name: vector[ends[i] : ends[i + 1]] for i, name in enumerate(sizes)}


def later(motion: list, time) -> list:
    """Position, velocity and so on after `time`; the last derivative in `motion` is constant."""
    orders = range(len(motion))
    return [
        sum(motion[n + i] * (time**i / math.factorial(i)) for i in orders[: len(motion) - n])
        for n in orders
    ]


def impact(case: dict, ball: list, impact_time, flight_time, up, norm) -> tuple:
    """Ball position, velocity before and after, racket normal, and size of the velocity's jump.

    Args:
        case: parameters, symbolic or not.
        ball: coefficients (3,) of the ball's path, ascending.
        impact_time: [s].
        flight_time: [s], from the impact to the target, under gravity alone.
        up: (3,) unit vector.
        norm: the function that gives a vector's length.
    """
    share = impact_time / case["landing_time"]
    pos = sum(c * share**k for k, c in enumerate(ball))
    before = sum(k * c * share ** (k - 1) for k, c in enumerate(ball) if k) / case["landing_time"]
    after = (case["target"] - pos) / flight_time + 0.5 * case["gravity"] * flight_time * up
    jump = norm(after - before)
    return pos, before, after, (after - before) / jump, jump


def path_limits(motion: list, case: dict, room) -> tuple[list, ca.SX]:
    """What must be <= 0 at one sample, and the body z axis there.

    `room` is 1 + the excess that is granted. Body rates (Hopf fibration, zero heading) are
    multiplied by the squared thrust: divided by it, the solver runs away where it is small.
    """
    pos, vel, acc, jerk = motion[:4]
    gravity = case["gravity"]
    thrust = acc + ca.vertcat(0.0, 0.0, gravity)
    cross, squared = ca.cross(thrust, jerk), ca.sumsqr(thrust)
    # The constants keep roots smooth; they are small beside the square of LEAST_THRUST.
    upright = ca.sqrt(squared + 0.1) + thrust[2]
    turning = ca.sumsqr(cross) + cross[2] ** 2 * (squared + 0.1) / upright**2
    limits = [
        ca.sumsqr(vel) / case["speed"] ** 2 - room**2,
        ca.sumsqr(acc) / case["acceleration"] ** 2 - room**2,
        (turning / case["body_rate"] ** 2 - (room * squared) ** 2) / gravity**4,
        case["min_height"] * (2.0 - room) - pos[2],
        (LEAST_THRUST**2 - squared) / gravity**2,
        0.05 - upright / gravity,
    ]
    return limits, thrust / ca.sqrt(squared + 1e-3)


def impact_limits(case: dict, unknown: dict, end: list, impact_time) -> tuple[list, list]:
    """What must be 0, and what must be <= 0, at the impact."""
    ball = ca.horzsplit(ca.reshape(case["ball"], 3, BALL_DEGREE + 1))
    up, room = ca.DM([0.0, 0.0, 1.0]), 1.0 + unknown["excess"]
    pos, before, after, normal, jump = impact(
        case, ball, impact_time, unknown["flight_time"], up, ca.norm_2
    )
    stroke = ca.dot(before, normal) + jump / (1.0 + case["restitution"])
    thrust = unknown["thrust"] * case["gravity"] * normal
    equal = [
        end[0] + case["racket_height"] * normal - pos,
        (ca.dot(end[1], normal) - stroke) / STATE_SCALE[1],
        (end[2] + case["gravity"] * up - thrust) / STATE_SCALE[2],
    ]
    apex = pos[2] + ca.fmax(after[2], 0.0) ** 2 / (2.0 * case["gravity"])
    below = [
        end[1] / case["hitting_speed"] - room,
        -end[1] / case["hitting_speed"] - room,
        2.0 - room - apex / case["min_apex"],
        apex / case["max_apex"] - room,
        impact_time / case["landing_time"] - 0.99,
    ]
    return equal, below


class Program:
    """The nonlinear program with a given number of pieces, built once for all cases."""

    def __init__(self, pieces: int, samples: int, floor: float, options: dict):
        path = {"durations": pieces, "states": 12 * pieces, "snaps": 3 * pieces}
        self.sizes = path | {"flight_time": 1, "thrust": 1, "excess": 1}
        self.pieces = pieces
        unknowns = ca.SX.sym("unknowns", sum(self.sizes.values()))
        parameters = PARAMETERS | {"margins": pieces}
        told = ca.SX.sym("told", sum(parameters.values()))
        cost, equal, below = self._build(
            unpack(unknowns, self.sizes), unpack(told, parameters), samples
        )
        num_equal, num = equal.numel(), equal.numel() + below.numel()
        self._bounds = {
            "lbx": self._bound(0.004, -np.inf, 0.15, 0.05, floor),
            "ubx": self._bound(0.5, np.inf, 3.0, 3.0, np.inf),
            "lbg": np.where(np.arange(num) < num_equal, 0.0, -np.inf),
            "ubg": np.zeros(num),
        }
        quiet = {"print_level": 0, "sb": "yes", "max_cpu_time": 10.0, "tol": 1e-5}
        problem = {"x": unknowns, "p": told, "f": cost, "g": ca.vertcat(equal, below)}
        settings = {"ipopt": quiet | options, "print_time": False, "error_on_fail": False}
        self._solver = ca.nlpsol("hit", "ipopt", problem, settings)

    def _bound(self, duration, state, flight_time, thrust, excess) -> np.ndarray:
        values = (duration, state, state, flight_time, thrust, excess)
        return np.repeat(values, list(self.sizes.values()))

    def _build(self, unknown: dict, case: dict, samples: int) -> tuple:
        """Cost, what must be 0, and what must be <= 0."""
        states = ca.horzcat(
            case["head_state"],
            ca.reshape(unknown["states"], 12, self.pieces) * np.repeat(STATE_SCALE, 3),
        )
        impact_time = ca.sum1(unknown["durations"])
        equal, below, axis = [], [], path_limits(self._motion(states[:, 0]), case, 1.0)[1]
        for k in range(self.pieces):
            duration = unknown["durations"][k]
            motion = [*self._motion(states[:, k]), SNAP_SCALE * unknown["snaps"][3 * k : 3 * k + 3]]
            room = 1.0 + unknown["excess"] - case["margins"][k]
            # What the axis can turn from sample to sample keeps it from flipping in between.
            turn = case["body_rate"] * room * duration / samples
            for i in range(1, samples + 1):
                last = i == samples
                here = (
                    self._motion(states[:, k + 1])
                    if last
                    else later(motion, duration * i / samples)
                )
                limits, ahead = path_limits(here, case, room)
                below += [*limits, 1.0 - ca.dot(axis, ahead) - turn**2 / 2.0 - 1.5e-3]
                axis = ahead
            defects = zip(later(motion, duration), self._motion(states[:, k + 1]), STATE_SCALE)
            equal += [(there - node) / scale for there, node, scale in defects]
            share = duration * self.pieces / impact_time
            below += [0.1 - share, share - 2.0]
        at_impact = impact_limits(case, unknown, self._motion(states[:, -1]), impact_time)
        cost = unknown["excess"] + 1e-5 * ca.sumsqr(unknown["snaps"]) / self.pieces
        return cost, ca.vertcat(*equal, *at_impact[0]), ca.vertcat(*below, *at_impact[1])

    @staticmethod
    def _motion(state) -> list:
        return [state[3 * n : 3 * n + 3] for n in range(4)]

    def solve(self, case: dict, guess: np.ndarray, margins=None) -> tuple[np.ndarray, bool]:
        """The unknowns where the solver stops, and whether it has converged."""
        margins = np.zeros(self.pieces) if margins is None else margins
        found = self._solver(x0=guess, p=np.concatenate([*case.values(), margins]), **self._bounds)
        return np.asarray(found["x"]).ravel(), self._solver.stats()["success"]

    def guess(self, case: dict, start: tuple) -> np.ndarray:
        """The polynomial of degree 7 from the head state to the impact of a start."""
        share, flight_time, thrust = start
        duration, up = share * case["landing_time"][0], np.array([0.0, 0.0, 1.0])
        pos, before, _, normal, jump = impact(
            case, [*case["ball"].reshape(-1, 3)], duration, flight_time, up, np.linalg.norm
        )
        vel = (before @ normal + jump / (1.0 + case["restitution"])) * normal
        acc = case["gravity"] * (thrust * normal - up)
        end = [pos - case["racket_height"] * normal, vel, acc, np.zeros(3)]
        path = BPoly.from_derivatives([0.0, duration], [case["head_state"].reshape(4, 3), end])
        times = np.linspace(0.0, duration, self.pieces + 1)
        states = np.stack([path(times[1:], n) / s for n, s in enumerate(STATE_SCALE)], axis=1)
        snaps = path(0.5 * (times[1:] + times[:-1]), 4) / SNAP_SCALE
        tail = [flight_time, thrust, 0.5]
        return np.concatenate([np.diff(times), states.ravel(), snaps.ravel(), tail])

    def halved(self, case: dict, unknowns: np.ndarray) -> np.ndarray:
        """The same path for a program with twice as many pieces."""
        motion, durations = self.motion(case, unknowns)
        half = 0.5 * durations
        nodes = np.stack([later(motion, half[:, None]), later(motion, durations[:, None])])
        states = np.moveaxis(nodes[:, :4], (0, 1), (1, 2)) / STATE_SCALE[:, None]
        snaps = np.repeat(motion[4], 2, axis=0) / SNAP_SCALE
        return np.concatenate([np.repeat(half, 2), states.ravel(), snaps.ravel(), unknowns[-3:]])

    def motion(self, case: dict, unknowns: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
        """Position to snap (M, 3) where the pieces begin, and their durations (M,)."""
        found = unpack(unknowns, self.sizes)
        states = found["states"].reshape(-1, 4, 3)[:-1] * STATE_SCALE[:, None]
        states = np.concatenate([case["head_state"].reshape(1, 4, 3), states])
        snaps = SNAP_SCALE * found["snaps"].reshape(-1, 3)
        return [*np.moveaxis(states, 1, 0), snaps], found["durations"]


def worst_ratios(motion: list[np.ndarray], durations: np.ndarray, case: dict) -> np.ndarray:
    """Largest of speed, acceleration and body rate over their limits on every piece, (M,)."""
    times = durations[:, None, None] * np.linspace(0.0, 1.0, 41)[:, None]
    _, vel, acc, jerk, _ = later([part[:, None] for part in motion], times)
    thrust = acc + case["gravity"] * np.array([0.0, 0.0, 1.0])
    size, cross = np.linalg.norm(thrust, axis=-1), np.cross(thrust, jerk)
    rate = np.hypot(np.linalg.norm(cross, axis=-1) / size, cross[..., 2] / (size + thrust[..., 2]))
    ratios = {
        "speed": np.linalg.norm(vel, axis=-1),
        "acceleration": np.linalg.norm(acc, axis=-1),
        "body_rate": rate / size,
    }
    return np.max([value / case[name] for name, value in ratios.items()], axis=(0, 2))


@dataclasses.dataclass
class Finding:
    """What the oracle found about one case."""

    feasible: bool = False  # the referee passed a hit
    least_excess: float = math.inf  # of the programs that converged
    starts: int = 0  # how many were used
    seconds: float = 0.0
    impact_time: float = math.nan  # [s], of the hit, or of the least excess
    flight_time: float = math.nan  # [s]
    thrust: float = math.nan  # [g], at the impact
    coeffs: np.ndarray | None = None  # (M, 5, 3) of a hit
    durations: np.ndarray | None = None  # (M,) [s]

    def note(self, unknowns: np.ndarray, durations: np.ndarray) -> None:
        """Keep the result of a program that converged if it is the best so far."""
        if unknowns[-1] < self.least_excess:
            self.impact_time = float(durations.sum())
            self.flight_time, self.thrust, self.least_excess = unknowns[-3:].tolist()

    @property
    def verdict(self) -> str:
        """feasible, infeasible (as far as the programs can tell), or undecided."""
        if self.feasible:
            return "feasible"
        clear = INFEASIBLE_ABOVE < self.least_excess < math.inf
        return "infeasible" if clear else "undecided"


class Oracle:
    """Coarse and fine program."""

    def __init__(self):
        self.coarse = Program(COARSE_PIECES, COARSE_SAMPLES, COARSE_FLOOR, COARSE_OPTIONS)
        self.fine = Program(2 * COARSE_PIECES, FINE_SAMPLES, FINE_FLOOR, FINE_OPTIONS)

    def find(self, scenario: HitScenario, starts) -> Finding:
        """Look for a hit in one scenario (NumPy leaves, no batch axis) from several starts."""
        began, finding, in_vain = time.perf_counter(), Finding(), math.inf
        case = case_parameters(scenario)
        for start in starts:
            finding.starts += 1
            unknowns, converged = self.coarse.solve(case, self.coarse.guess(case, start))
            if unknowns[-1] < min(REFINED_BELOW, in_vain - NEW_BELOW):
                guess = self.coarse.halved(case, unknowns)
                if self._refine(scenario, case, guess, finding) > TOLERANCE:
                    in_vain = unknowns[-1]
                if finding.feasible:
                    break
            elif converged:
                finding.note(unknowns, unknowns[: self.coarse.pieces])
        finding.seconds = time.perf_counter() - began
        return finding

    def _refine(self, scenario, case: dict, guess: np.ndarray, finding: Finding) -> float:
        """Solve the fine program, tightening what peaks between samples; its last excess."""
        margins = np.zeros(self.fine.pieces)
        for _ in range(1 + MOST_TIGHTENINGS):
            guess, converged = self.fine.solve(case, guess, margins)
            motion, durations = self.fine.motion(case, guess)
            coeffs = np.stack([m / math.factorial(k) for k, m in enumerate(motion)], axis=1)
            finding.feasible = passes_referee(scenario, coeffs, durations)
            if converged or finding.feasible:
                finding.note(guess, durations)
            if finding.feasible:
                finding.coeffs, finding.durations = coeffs, durations
                break
            peaks = worst_ratios(motion, durations, case) - 1.0 - max(guess[-1], 0.5 * TOLERANCE)
            if guess[-1] > TOLERANCE or peaks.max() <= 0.0:
                break
            margins += np.maximum(peaks, 0.0)
        return guess[-1]


def passes_referee(scenario: HitScenario, coeffs: np.ndarray, durations: np.ndarray) -> bool:
    """Whether the library's referee passes one trajectory."""
    none = np.zeros(1)
    stroke = Stroke(
        time=durations.sum(keepdims=True),
        ball_pos=none,
        ball_vel=none,
        ball_vel_after=none,
        normal=none,
        flight_time=none,
    )
    plan = HitPlan(
        trajectory=PiecewisePolynomial(coeffs=coeffs[None], durations=durations[None]),
        stroke=stroke,
        cost=none,
        violation=none,
        iterations=none,
        status=none,
    )
    batch = jax.tree.map(lambda leaf: leaf[None], scenario)
    return bool(referee_hits(batch, plan, tolerance=TOLERANCE).success[0])


def starting_points(num: int, seed: int) -> list[tuple[float, ...]]:
    """`STARTS`, then random ones."""
    low, high = np.transpose(START_RANGES)
    draws = np.random.default_rng(seed).uniform(low, high, (max(num - len(STARTS), 0), 3))
    return [*STARTS, *map(tuple, draws)][:num]


@functools.cache
def oracle() -> Oracle:
    """The one oracle of a process; building it takes a second."""
    return Oracle()


def find_hit(scenario: HitScenario, starts) -> Finding:
    """What the process's oracle finds about one scenario."""
    return oracle().find(scenario, starts)


def find_hits(scenarios: HitScenario, starts, workers: int = 1) -> list[Finding]:
    """Findings for a batch of scenarios, in order, with a progress bar."""
    scenarios = jax.tree.map(np.asarray, scenarios)
    num = len(scenarios.drag)
    lanes = [jax.tree.map(lambda leaf, i=i: leaf[i], scenarios) for i in range(num)]
    look = functools.partial(find_hit, starts=starts)
    if workers == 1:
        return list(tqdm(map(look, lanes), total=num, unit="case"))
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        return list(tqdm(pool.imap(look, lanes), total=num, unit="case"))


def failed_indices(plans: Path) -> np.ndarray:
    """Indices of the serves whose plan did not succeed, from a sweep's `plans.parquet`."""
    table = pq.read_table(plans, columns=["index", "success"])
    return table["index"].to_numpy()[~table["success"].to_numpy()]


def summarise(findings: list[Finding]) -> dict:
    """Counts with Wilson intervals, and times."""
    num, summary = len(findings), {"num": len(findings)}
    for name in ("feasible", "infeasible", "undecided"):
        count = sum(finding.verdict == name for finding in findings)
        interval = list(wilson_interval(count, num))
        summary[name] = {"count": count, "share": count / num, "wilson_95": interval}
    excess = [f.least_excess for f in findings if f.verdict == "infeasible"]
    quartiles = np.quantile(excess, (0.0, 0.25, 0.5, 0.75, 1.0)).tolist() if excess else None
    seconds = np.array([finding.seconds for finding in findings])
    return summary | {
        "least_excess_quartiles_of_infeasible": quartiles,
        "seconds_per_case_median": float(np.median(seconds)),
        "seconds_per_case_p90": float(np.quantile(seconds, 0.9)),
        "seconds": float(seconds.sum()),
    }


def table_of(summary: dict) -> str:
    """The summary as a Markdown table and two sentences."""
    lines = ["| verdict | cases | share | 95 % interval |", "|---|---|---|---|"]
    for name in ("feasible", "infeasible", "undecided"):
        row = summary[name]
        low, high = (100.0 * bound for bound in row["wilson_95"])
        share = 100.0 * row["share"]
        lines.append(f"| {name} | {row['count']} | {share:.1f} % | {low:.1f}..{high:.1f} % |")
    if quartiles := summary["least_excess_quartiles_of_infeasible"]:
        listed = ", ".join(f"{100.0 * value:.1f}" for value in quartiles)
        lines += ["", f"Least excess of the infeasible, quartiles: {listed} % of every limit."]
    lines += [
        "",
        f"{summary['seconds_per_case_median']:.2f} s a case (median), "
        f"{summary['seconds_per_case_p90']:.2f} s (90 %), {summary['seconds']:.0f} s in all.",
    ]
    return "\n".join(lines)


def write(out: Path, arguments: dict, summary: dict, indices, findings: list[Finding]) -> None:
    """oracle.json, table.md, and hits.npz with the trajectories that were found."""
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for index, finding in zip(indices, findings, strict=True):
        numbers = {k: v for k, v in vars(finding).items() if k not in ("coeffs", "durations")}
        finite = {k: None if v in (math.inf, math.nan) or v != v else v for k, v in numbers.items()}
        rows.append({"index": int(index), "verdict": finding.verdict} | finite)
    record = {"arguments": arguments, "summary": summary, "cases": rows}
    (out / "oracle.json").write_text(json.dumps(record, indent=1, allow_nan=False) + "\n", "utf-8")
    (out / "table.md").write_text(table_of(summary) + "\n", "utf-8")
    hits = [(i, f) for i, f in zip(indices, findings, strict=True) if f.feasible]
    np.savez(
        out / "hits.npz",
        index=np.array([i for i, _ in hits], int),
        coeffs=np.array([f.coeffs for _, f in hits]),
        durations=np.array([f.durations for _, f in hits]),
    )


def arguments_of(line: list[str] | None) -> tuple[argparse.ArgumentParser, argparse.Namespace]:
    """The parser, and the arguments checked."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.oracle_hit", description=__doc__.splitlines()[0]
    )
    add = parser.add_argument
    add("--serves", type=Path, help="folder of published trial files (default: draw serves)")
    add("--delay", type=float, default=0.0, help="seconds from the serve to the planning")
    add("--limit-scale", type=float, default=1.0, help="of speed, acceleration, body rate")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--failures", type=Path, help="plans.parquet of a sweep (default: all)")
    which.add_argument("--indices", type=Path, help=".npy file with indices of serves")
    add("--num", type=int, default=200, help="size of the sample")
    add("--starts", type=int, default=len(STARTS), help="starts a case")
    add("--seed", type=int, default=0, help="of the sample, further starts and drawn serves")
    add("--workers", type=int, default=1, help="processes")
    add("--out", type=Path, help="folder for oracle.json, table.md and hits.npz")
    options = parser.parse_args(line)
    for name, least in (("num", 1), ("starts", 1), ("seed", 0), ("workers", 1)):
        if getattr(options, name) < least:
            parser.error(f"argument --{name}: must be >= {least}, got {getattr(options, name)}")
    return parser, options


def main(line: list[str] | None = None) -> None:
    """Judge a sample of cases."""
    parser, options = arguments_of(line)
    try:
        drawn = functools.partial(generate_serves, NUM_GENERATED, options.seed)
        serves = read_serves(options.serves) if options.serves else drawn()
        pool = np.arange(len(serves))
        if options.failures:
            pool = failed_indices(options.failures)
        elif options.indices:
            pool = np.load(options.indices)
        if not (pool.size and 0 <= pool.min() and pool.max() < len(serves)):
            parser.error(f"indices must be some of 0..{len(serves) - 1}, got {pool}")
        sample = np.random.default_rng(options.seed).permutation(pool)[: options.num]
        with jax.enable_x64(True):
            scenarios = to_scenarios(
                serves[sample],
                delay=options.delay,
                limit_scale=options.limit_scale,
                dtype=jnp.float64,
            )
    except (ServeError, OSError, ValueError) as error:
        parser.error(str(error))
    findings = find_hits(
        scenarios, starting_points(options.starts, options.seed), workers=options.workers
    )
    summary = summarise(findings) | {"of": int(pool.size)}
    if options.out:
        arguments = {
            name: str(value) if isinstance(value, Path) else value
            for name, value in vars(options).items()
        }
        write(options.out, arguments, summary, sample, findings)
    print(table_of(summary))


if __name__ == "__main__":
    main()
