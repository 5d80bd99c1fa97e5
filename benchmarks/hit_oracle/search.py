"""Decide whether a hit is feasible, by searches from many starting points.

Each search solves the nonlinear program of `program.py` with few pieces. If the limits nearly hold,
it solves the program with twice as many pieces, and tightens limits that are exceeded between
samples. A hit counts as found only if the referee, an independent check in float64, accepts it.
`benchmarks.oracle_hit` calls this module.
"""

import dataclasses
import functools
import math
import multiprocessing
import time
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from planner_jax.benchmarks.hit_oracle.program import Program, advance, case_parameters
from planner_jax.referee.hit import referee_hits
from planner_jax.task.hit.case import HitCase
from planner_jax.task.hit.plan import HitPlan, Stroke
from planner_jax.trajectory.polynomial import PiecewisePolynomial

# An excess is the greatest relative amount by which a trajectory exceeds any limit.
TOLERANCE = 1e-3  # The referee accepts an excess up to this value.
COARSE_PIECES, COARSE_SAMPLES = 20, 3  # Number of pieces, and of samples of each piece, at first.
FINE_SAMPLES = 4  # Number of samples of each piece after the pieces were halved.
# Lower bounds of the excess before and after the pieces are halved. The minimum of the excess is
# negative if all limits hold with a margin; IPOPT stops at these margins, 1 % and 0.3 %.
COARSE_FLOOR, FINE_FLOOR = -0.01, -0.003
# A solution is refined by halving its pieces only if it exceeds limits by less than this relative
# amount. Halving reduces the excess by at most 0.03, and the threshold is twice this reduction.
REFINED_BELOW = 0.06
# A solution is refined by halving its pieces only if its excess is lower, by at least this amount,
# than the excess of every solution whose refinement has failed. The refinement of a worse solution
# would presumably fail, too.
NEW_BELOW = 0.001
# A case is abandoned after 4 starting points if the trajectory from each of them exceeds some
# limit by more than 10 %.
HOPELESS_ABOVE, HOPELESS_STARTS = 0.1, 4
MOST_TIGHTENINGS = 5  # Maximum number of times that limits of a solution are tightened.
INFEASIBLE_ABOVE = 0.01  # A case counts as infeasible if its least excess is above this value.

# Initial guesses of the impact: its time over the ball's landing time, the ball's flight time after
# it [s], and the thrust [g]. The fifth is a smash, after which the ball flies fast.
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
# Ranges of random guesses of the impact: its time over the ball's landing time, the ball's flight
# time after it [s], and the thrust [g].
START_RANGES = ((0.5, 0.98), (0.6, 2.3), (0.8, 2.3))


def worst_ratios(motion: list[np.ndarray], durations: np.ndarray, values: dict) -> np.ndarray:
    """Return for each of M pieces (M,) the largest ratio of a quantity to its limit.

    The quantities are speed, acceleration and body rate. They are evaluated at 41 times of each
    piece; IPOPT's program checks limits at 3 or 4 samples only. `motion` has position to snap at
    the pieces' starts, `values` the limits by name.
    """
    times = durations[:, None, None] * np.linspace(0.0, 1.0, 41)[:, None]
    _, vel, acc, jerk, _ = advance([part[:, None] for part in motion], times)
    thrust = acc + values["gravity"] * np.array([0.0, 0.0, 1.0])
    size, cross = np.linalg.norm(thrust, axis=-1), np.cross(thrust, jerk)
    rate = np.hypot(np.linalg.norm(cross, axis=-1) / size, cross[..., 2] / (size + thrust[..., 2]))
    ratios = {
        "speed": np.linalg.norm(vel, axis=-1),
        "acceleration": np.linalg.norm(acc, axis=-1),
        "body_rate": rate / size,
    }
    return np.max([value / values[name] for name, value in ratios.items()], axis=(0, 2))


@dataclasses.dataclass
class Finding:
    """Result of the search for one case: whether a hit exists, and the best trajectory found.

    The best trajectory is a hit that the referee, an independent check, accepts, or else the
    trajectory with the least excess. An excess is the greatest relative amount by which a limit is
    exceeded.
    """

    feasible: bool = False  # whether the referee accepts a hit
    least_excess: float = math.inf  # least relative excess over the limits, of converged programs
    starts: int = 0  # number of starting points used
    cpu_seconds: float = 0.0
    impact_time: float = math.nan  # [s], of the hit, or of the trajectory with the least excess
    flight_time: float = math.nan  # [s], from the impact until the ball reaches its target
    thrust: float = math.nan  # [g], thrust of the quadrotor at the impact
    coeffs: np.ndarray | None = None  # (M, 5, 3), polynomial coefficients of a feasible hit
    durations: np.ndarray | None = None  # (M,) [s], durations of the pieces of a feasible hit

    def note(self, unknowns: np.ndarray, durations: np.ndarray) -> None:
        """Store a converged solution if its excess over the limits is the least so far."""
        if unknowns[-1] < self.least_excess:
            self.impact_time = float(durations.sum())
            self.flight_time, self.thrust, self.least_excess = unknowns[-3:].tolist()

    @property
    def verdict(self) -> str:
        """The verdict "feasible", "infeasible" or "undecided".

        "Feasible" is proven by a hit. "Infeasible" means that every converged program exceeds a
        limit clearly, which is no proof.
        """
        if self.feasible:
            return "feasible"
        clear = INFEASIBLE_ABOVE < self.least_excess < math.inf
        return "infeasible" if clear else "undecided"


class Oracle:
    """Search for a feasible hit: with 20 pieces, and from nearly feasible solutions with 40 pieces.

    The trajectory consists of these pieces, on which the snap is constant. A solution is nearly
    feasible if it exceeds limits by less than 6 %.
    """

    def __init__(self):
        self.coarse = Program(COARSE_PIECES, COARSE_SAMPLES, COARSE_FLOOR)
        self.fine = Program(2 * COARSE_PIECES, FINE_SAMPLES, FINE_FLOOR)

    def find(self, case: HitCase, starts) -> Finding:
        """Search for a feasible hit in one case.

        `starts` are initial guesses of the impact: (its time over the ball's landing time, the
        ball's flight time after it [s], thrust [g]). The case has NumPy leaves without a batch
        axis. The search ends at the first hit that the referee, an independent check, accepts.
        """
        began, finding, in_vain = time.process_time(), Finding(), math.inf
        values = case_parameters(case)
        for start in starts:
            finding.starts += 1
            unknowns, converged = self.coarse.solve(values, self.coarse.guess(values, start))
            excess = unknowns[-1]
            if excess < min(REFINED_BELOW, in_vain - NEW_BELOW):
                refined = self._refine(case, values, unknowns, finding)
                if finding.feasible:
                    break
                if TOLERANCE < refined < math.inf:
                    in_vain = excess
            elif converged:
                finding.note(unknowns, unknowns[: self.coarse.pieces])
            if (
                finding.starts >= HOPELESS_STARTS
                and HOPELESS_ABOVE < finding.least_excess < math.inf
            ):
                break
        finding.cpu_seconds = time.process_time() - began
        return finding

    def _refine(self, case: HitCase, values: dict, coarse: np.ndarray, finding: Finding) -> float:
        """Divide each piece of the solution `coarse` into two, and solve the program again.

        The result is the greatest relative excess of the new solution over a limit; it is infinite
        if the solver does not converge.
        If the trajectory exceeds limits between samples, the limits on these pieces are tightened,
        and the program is solved again: at most five times, or until the referee (an independent
        check) accepts the hit. The result is stored in `finding`.
        """
        guess, margins = self.coarse.halve(values, coarse), np.zeros(self.fine.pieces)
        unknowns, converged = self.fine.solve(values, guess)
        if not converged:
            unknowns, converged = self.fine.solve(values, guess, margins)
        if not converged:
            return math.inf
        for _ in range(1 + MOST_TIGHTENINGS):
            motion, durations = self.fine.motion(values, unknowns)
            finding.note(unknowns, durations)
            coeffs = np.stack([m / math.factorial(k) for k, m in enumerate(motion)], axis=1)
            finding.feasible = passes_referee(case, coeffs, durations)
            if finding.feasible:
                finding.coeffs, finding.durations = coeffs, durations
                break
            excess = max(unknowns[-1], 0.5 * TOLERANCE)
            peaks = np.maximum(worst_ratios(motion, durations, values) - 1.0 - excess, 0.0)
            if unknowns[-1] > TOLERANCE or not peaks.any():
                break
            margins = margins + peaks
            unknowns, _ = self.fine.solve(values, unknowns, margins)
        return unknowns[-1]


def passes_referee(case: HitCase, coeffs: np.ndarray, durations: np.ndarray) -> bool:
    """Return whether the referee, an independent check in float64, accepts a trajectory as a hit.

    The trajectory has M pieces with `durations` (M,) [s]. `coeffs` (M, 5, 3) has for each piece the
    coefficients of x, y and z by ascending power of the time since the piece's start.
    """
    none: Any = np.zeros(1)
    path: Any = coeffs[None], durations[None]
    stroke = Stroke(
        time=durations.sum(keepdims=True),
        ball_pos=none,
        ball_vel=none,
        ball_vel_after=none,
        normal=none,
        flight_time=none,
    )
    plan = HitPlan(
        trajectory=PiecewisePolynomial(*path),
        gravity=none,
        stroke=stroke,
        cost=none,
        violation=none,
        iterations=none,
        status=none,
    )
    batch = jax.tree.map(lambda leaf: leaf[None], case)
    return bool(referee_hits(batch, plan, tolerance=TOLERANCE).success[0])


def starting_points(num: int, seed: int) -> list[tuple[float, ...]]:
    """Return `num` starting points of the search: eight fixed points, then random points.

    A point has the impact time over the ball's landing time, the ball's flight time after the
    impact [s], and the thrust at the impact [g].
    """
    low, high = np.transpose(START_RANGES)
    draws = np.random.default_rng(seed).uniform(low, high, (max(num - len(STARTS), 0), 3))
    return [*STARTS, *map(tuple, draws)][:num]


@functools.cache
def oracle() -> Oracle:
    return Oracle()


def find_hit(case: HitCase, starts) -> Finding:
    return oracle().find(case, starts)


def find_hits(cases: HitCase, starts, workers: int = 1) -> list[Finding]:
    """Search for a feasible hit in each case of a batch, in `workers` processes.

    `starts` are initial guesses of the impact: (its time over the ball's landing time, the ball's
    flight time after it [s], thrust [g]). Shows a progress bar, and returns one result for each
    case.
    """
    cases = jax.tree.map(np.asarray, cases)
    num = len(cases.drag)
    lanes = [jax.tree.map(lambda leaf, i=i: leaf[i], cases) for i in range(num)]
    search = functools.partial(find_hit, starts=starts)
    if workers == 1:
        return list(tqdm(map(search, lanes), total=num, unit="case"))
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        return list(tqdm(pool.imap(search, lanes), total=num, unit="case"))
