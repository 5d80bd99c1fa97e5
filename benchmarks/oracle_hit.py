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
from collections.abc import Iterator
from pathlib import Path
from typing import Any

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
BALL_DEGREE = 10  # of the ball's path up to its landing; 1e-8 m off the integration
# Sizes of position, velocity, acceleration and jerk, and of snap, in the program's variables.
STATE_SCALE, SNAP_SCALE = np.array([1.0, 3.0, 10.0, 60.0]), 600.0
LEAST_THRUST = 1.0  # [m/s^2]; below it the attitude turns faster than samples can follow
REFINED_BELOW = 0.08  # largest coarse excess that is refined; halving takes off 0.03 at most
NEW_BELOW = 0.003  # by how much a coarse excess must be lower than those refined before
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
START_RANGES = np.array([(0.5, 0.98), (0.6, 2.3), (0.8, 2.3)])  # of those beyond

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

# Monotone barriers leave a good guess that is nearly feasible less than adaptive ones do; these
# converge from far away.
COARSE_OPTIONS = {"max_iter": 250, "mu_strategy": "adaptive"}
FINE_OPTIONS = {"max_iter": 200, "mu_init": 1e-4} | {
    f"{name}bound_{kind}": 1e-4 for name in ("", "slack_") for kind in ("push", "frac")
}


def _unpack(vector, sizes: dict[str, int]) -> dict:
    """Named parts of a vector, symbolic or not."""
    ends = np.cumsum([0, *sizes.values()]).tolist()
    return {name: vector[ends[i] : ends[i + 1]] for i, name in enumerate(sizes)}


def _variables(pieces: int) -> dict[str, int]:
    """Unknowns of a program: states are those at the ends of the pieces."""
    path = {"durations": pieces, "states": 12 * pieces, "snaps": 3 * pieces}
    return path | {"flight_time": 1, "thrust": 1, "excess": 1}


def _later(motion: list, time) -> list:
    """Position, velocity and so on after `time`; the last derivative in `motion` is constant."""
    orders = range(len(motion))
    return [
        sum(motion[n + i] * (time**i / math.factorial(i)) for i in orders[: len(motion) - n])
        for n in orders
    ]


def case_parameters(scenario: HitScenario) -> dict[str, np.ndarray]:
    """The values of `PARAMETERS` for one scenario (no batch axis); the ball by integration."""
    limits, stroke = scenario.limits, scenario.hit_limits
    gravity = np.array([0.0, 0.0, float(scenario.gravity)])
    drag, floor = float(scenario.drag), float(scenario.target[2])

    def rate(_, state):
        return np.r_[state[3:], -gravity - drag * np.linalg.norm(state[3:]) * state[3:]]

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
    for source in (scenario, limits, stroke):
        names = PARAMETERS.keys() & {field.name for field in dataclasses.fields(source)}
        case |= {name: getattr(source, name) for name in names if name not in case}
    return {name: np.asarray(case[name], float).ravel() for name in PARAMETERS if name in case}


def _impact(ball, landing_time, target, gravity, time, flight_time, size):
    """Ball at the impact, its velocity before and after, and their difference's direction, size.

    `size` is the Euclidean norm: that of NumPy or of CasADi.
    """
    share = time / landing_time
    pos = sum(ball[k] * share**k for k in range(BALL_DEGREE + 1))
    before = sum(k * ball[k] * share ** (k - 1) for k in range(1, BALL_DEGREE + 1)) / landing_time
    after = (target - pos) / flight_time + 0.5 * gravity * flight_time
    kick = size(after - before)
    return pos, before, after, (after - before) / kick, kick


def _path_limits(motion: list, case: dict, room) -> tuple[list, Any, Any]:
    """What must be <= 0 at one sample, the body z axis there, and its uprightness.

    Body rates are those of the Hopf fibration, multiplied by the squared thrust: without the
    division the solver does not run away where the thrust is small.
    """
    pos, vel, acc, jerk = motion[:4]
    gravity = case["gravity"]
    thrust = acc + ca.vertcat(0.0, 0.0, gravity)
    cross, squared = ca.cross(thrust, jerk), ca.sumsqr(thrust)
    # The constants are small beside the square of LEAST_THRUST; they keep the root smooth.
    upright = ca.sqrt(squared + 0.1) + thrust[2]
    turning = ca.sumsqr(cross) + cross[2] ** 2 * (squared + 0.1) / upright**2
    allowed = (case["body_rate"] * room * squared) ** 2
    limits = [
        ca.sumsqr(vel) / case["speed"] ** 2 - room**2,
        ca.sumsqr(acc) / case["acceleration"] ** 2 - room**2,
        (turning - allowed / squared**0) / (case["body_rate"] * gravity**2) ** 2,
        case["min_height"] * (2.0 - room) - pos[2],
        (LEAST_THRUST**2 - squared) / gravity**2,
        0.05 - upright / gravity,
    ]
    return limits, thrust / ca.sqrt(squared + 1e-3), upright
