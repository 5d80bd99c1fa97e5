"""The nonlinear program of a hit: snap constant on pieces, the impact as equations.

Shares no code with the planners. Written once with symbols, for CasADi and IPOPT; what differs
from case to case are parameters. World frame, z up, SI units.
"""

import dataclasses
import importlib
import math
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import BPoly

from planner_jax.task.hit.case import HitCase

ca: Any = importlib.import_module("casadi")  # of the extra `oracle`

BALL_DEGREE = 10  # of the ball's path up to its landing; below 1e-7 m off the integration
# Sizes of position, velocity, acceleration and jerk, and of snap, in a program's variables.
STATE_SCALE, SNAP_SCALE = np.array([1.0, 3.0, 10.0, 60.0]), 600.0
LEAST_THRUST = 1.0  # [m/s^2]; below it the attitude turns faster than samples can follow
GUESSED_EXCESS = 0.5

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

# Adaptive barriers converge from far away, and from a solution on coarser pieces.
OPTIONS = {
    "max_iter": 250,
    "max_cpu_time": 10.0,
    "mu_strategy": "adaptive",
    "tol": 1e-5,
    "print_level": 0,
    "sb": "yes",
}


def case_parameters(case: HitCase) -> dict[str, np.ndarray]:
    """The values of `PARAMETERS` for one case (no batch axis); the ball by integration."""
    drag, floor = float(case.drag), float(case.target[2])
    fall = np.array([0.0, 0.0, -float(case.gravity)])

    def rate(_, state):
        return np.r_[state[3:], fall - drag * np.linalg.norm(state[3:]) * state[3:]]

    def height(_, state):
        return state[2] - floor

    height.terminal, height.direction = True, -1.0  # pyright: ignore[reportFunctionMemberAccess]
    begin = np.r_[np.asarray(case.ball.pos, float), np.asarray(case.ball.vel, float)]
    accuracy = {"rtol": 1e-11, "atol": 1e-11, "dense_output": True}
    flight = solve_ivp(rate, (0.0, 30.0), begin, "DOP853", events=height, **accuracy)
    nodes = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 41))
    path = flight.sol(nodes * flight.t[-1])[:3].T
    found = {
        "ball": np.polynomial.polynomial.polyfit(nodes, path, BALL_DEGREE),
        "landing_time": flight.t[-1],
    }
    for source in (case, case.limits, case.hit_limits):
        fields = {field.name for field in dataclasses.fields(source)}
        found |= {name: getattr(source, name) for name in fields & PARAMETERS.keys() - found.keys()}
    return {name: np.asarray(found[name], float).ravel() for name in PARAMETERS}


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


def path_limits(motion: list, case: dict, room) -> tuple[list, Any]:
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
    """The nonlinear program with a given number of pieces, built once for all cases.

    The unknowns are the durations of the pieces, the states at their ends, their snaps, the
    ball's flight time after the impact, the thrust at the impact [g], and the excess: by which
    share every limit is exceeded at most. The last is minimised.

    Args:
        pieces: how many.
        samples: of a piece, its end included, at which limits are looked at.
        floor: excess below which the solver need not go.
    """

    def __init__(self, pieces: int, samples: int, floor: float):
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
        problem = {"x": unknowns, "p": told, "f": cost, "g": ca.vertcat(equal, below)}
        settings = {"ipopt": OPTIONS, "print_time": False, "error_on_fail": False}
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
            ends = self._motion(states[:, k + 1])
            inside = [later(motion, duration * i / samples) for i in range(1, samples)]
            for here in (*inside, ends):
                limits, ahead = path_limits(here, case, room)
                below += [*limits, 1.0 - ca.dot(axis, ahead) - turn**2 / 2.0 - 1.5e-3]
                axis = ahead
            defects = zip(later(motion, duration)[:4], ends, STATE_SCALE, strict=True)
            equal += [(there - node) / scale for there, node, scale in defects]
            share = duration * self.pieces / impact_time
            below += [0.1 - share, share - 2.0]
        at_impact = impact_limits(case, unknown, self._motion(states[:, -1]), impact_time)
        cost = unknown["excess"] + 1e-5 * ca.sumsqr(unknown["snaps"]) / self.pieces
        return cost, ca.vertcat(*equal, *at_impact[0]), ca.vertcat(*below, *at_impact[1])

    @staticmethod
    def _motion(state) -> list:
        return [state[3 * n : 3 * n + 3] for n in range(4)]

    def solve(
        self, case: dict, guess: np.ndarray, margins: np.ndarray | None = None
    ) -> tuple[np.ndarray, bool]:
        """The unknowns where the solver stops, and whether it has converged.

        Args:
            case: values of `PARAMETERS`.
            guess: of the unknowns.
            margins: (M,) by which share the limits are tightened on each piece; the durations
                then stay those of the guess, so that each margin stays where it belongs.
        """
        bounds = dict(self._bounds)
        if margins is not None:
            for side in ("lbx", "ubx"):
                bounds[side] = np.r_[guess[: self.pieces], bounds[side][self.pieces :]]
        margins = np.zeros(self.pieces) if margins is None else margins
        found = self._solver(x0=guess, p=np.concatenate([*case.values(), margins]), **bounds)
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
        tail = [flight_time, thrust, GUESSED_EXCESS]
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
