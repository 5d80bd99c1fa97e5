"""The nonlinear program that searches a feasible hit, for CasADi and IPOPT.

A quadrotor hits a ball with a racket such that it lands at a target. The quadrotor's snap is
constant on each piece of its trajectory. Equality constraints describe the impact, and inequalities
at samples the limits. The program is built once with symbols, and the numbers of a case are its
parameters. It shares no code with the planners. Positions are in the world frame, with z up, in SI
units.
"""

import dataclasses
import importlib
import math
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import BPoly

from planner_jax.task.hit.case import HitCase

ca: Any = importlib.import_module("casadi")  # CasADi is installed with the extra `oracle`.

# Degree of the polynomial that approximates the ball's path until it lands, to 1e-7 m.
BALL_DEGREE = 10
# Typical sizes of position [m], velocity [m/s], acceleration [m/s^2] and jerk [m/s^3], and of snap
# [m/s^4]. The variables of the program are divided by these numbers.
STATE_SCALE, SNAP_SCALE = np.array([1.0, 3.0, 10.0, 60.0]), 600.0
# [m/s^2] Least thrust per mass. With less thrust the attitude could turn too far between samples.
LEAST_THRUST = 1.0
GUESSED_EXCESS = 0.5  # Initial guess of the greatest relative excess over a limit.

# Name of each parameter of the program -> number of its values. Parameters describe a case, in SI
# units.
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

# Options of IPOPT. With the adaptive strategy for the barrier parameter, IPOPT also converges from
# poor initial guesses and from a solution of the program with fewer pieces.
OPTIONS = {
    "max_iter": 250,
    "max_cpu_time": 10.0,
    "mu_strategy": "adaptive",
    "tol": 1e-5,
    "print_level": 0,
    "sb": "yes",
}


def case_parameters(case: HitCase) -> dict[str, np.ndarray]:
    """Return the numbers of one case on which the program depends, by name, in SI units.

    The case has no batch axis. The ball's path with drag is integrated numerically and approximated
    by a polynomial.
    """
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
    """Split a vector, numeric or symbolic, into parts; `sizes` has the length of each part."""
    ends = np.cumsum([0, *sizes.values()]).tolist()
    return {name: vector[ends[i] : ends[i + 1]] for i, name in enumerate(sizes)}


def advance(motion: list, time) -> list:
    orders = range(len(motion))
    return [
        sum(motion[n + i] * (time**i / math.factorial(i)) for i in orders[: len(motion) - n])
        for n in orders
    ]


def impact(case: dict, ball: list, impact_time, flight_time, up, norm) -> tuple:
    """Compute the impact from its time and from the ball's flight time to the target.

    The racket's normal is parallel to the change of the ball's velocity.

    Args:
        case: parameters, numeric or symbolic.
        ball: coefficients (3,) of the polynomial of the ball's path, by ascending power.
        impact_time: [s], from the start of the plan.
        flight_time: [s], from the impact to the target, under gravity alone.
        up: (3,) unit vector along z.
        norm: function that returns the length of a vector.

    Returns:
        The ball's position, its velocities before and after the impact, the racket's unit normal,
        and the length of the velocity change [m/s].
    """
    share = impact_time / case["landing_time"]
    pos = sum(c * share**k for k, c in enumerate(ball))
    before = sum(k * c * share ** (k - 1) for k, c in enumerate(ball) if k) / case["landing_time"]
    after = (case["target"] - pos) / flight_time + 0.5 * case["gravity"] * flight_time * up
    jump = norm(after - before)
    return pos, before, after, (after - before) / jump, jump


def path_limits(motion: list, case: dict, allowance) -> tuple[list, Any]:
    """Return the limits at one sample as expressions that must be <= 0, and the body z axis.

    The limits are on speed, acceleration, body rate, height and thrust. `motion` has position to
    snap, and `allowance` is 1 + the permitted relative excess. The body rate follows from the Hopf
    fibration at zero heading: a quotient with the squared thrust as denominator. The limit on it is
    multiplied by the squared thrust, because with the quotient IPOPT diverges if the thrust is
    small.
    """
    pos, vel, acc, jerk = motion[:4]
    gravity = case["gravity"]
    thrust = acc + ca.vertcat(0.0, 0.0, gravity)
    cross, squared = ca.cross(thrust, jerk), ca.sumsqr(thrust)
    # The added constants keep square roots differentiable at zero. They are small relative to the
    # square of LEAST_THRUST.
    upright = ca.sqrt(squared + 0.1) + thrust[2]
    turning = ca.sumsqr(cross) + cross[2] ** 2 * (squared + 0.1) / upright**2
    limits = [
        ca.sumsqr(vel) / case["speed"] ** 2 - allowance**2,
        ca.sumsqr(acc) / case["acceleration"] ** 2 - allowance**2,
        (turning / case["body_rate"] ** 2 - (allowance * squared) ** 2) / gravity**4,
        case["min_height"] * (2.0 - allowance) - pos[2],
        (LEAST_THRUST**2 - squared) / gravity**2,
        0.05 - upright / gravity,
    ]
    return limits, thrust / ca.sqrt(squared + 1e-3)


def impact_limits(case: dict, unknown: dict, end: list, impact_time) -> tuple[list, list]:
    """Return the constraints at the impact: expressions that must be 0, and that must be <= 0.

    The racket's centre must meet the ball, with the speed and the direction of thrust that send the
    ball to its target. Inequalities bound the quadrotor's velocity, the ball's highest point and
    the impact time. `unknown` has the program's unknowns by name. `end` has the quadrotor's
    position, velocity and acceleration at the impact.
    """
    ball = ca.horzsplit(ca.reshape(case["ball"], 3, BALL_DEGREE + 1))
    up, allowance = ca.DM([0.0, 0.0, 1.0]), 1.0 + unknown["excess"]
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
        end[1] / case["hitting_speed"] - allowance,
        -end[1] / case["hitting_speed"] - allowance,
        2.0 - allowance - apex / case["min_apex"],
        apex / case["max_apex"] - allowance,
        impact_time / case["landing_time"] - 0.99,
    ]
    return equal, below


class Program:
    """Nonlinear program of a hit with a given number of pieces, built once for all cases.

    The unknowns are the durations of the pieces, the states at their ends, their snaps, the ball's
    flight time after the impact, the thrust at the impact [g], and the excess. The excess is the
    greatest relative amount by which any limit is exceeded. IPOPT minimises it.

    Args:
        pieces: number of pieces of the trajectory.
        samples: number of samples of a piece at which limits are checked, including its end.
        floor: lower bound of the excess; a negative bound gives solutions with a margin to the
            limits.
    """

    def __init__(self, pieces: int, samples: int, floor: float):
        path = {"durations": pieces, "states": 12 * pieces, "snaps": 3 * pieces}
        self.sizes = path | {"flight_time": 1, "thrust": 1, "excess": 1}
        self.pieces = pieces
        unknowns = ca.SX.sym("unknowns", sum(self.sizes.values()))
        parameters = PARAMETERS | {"margins": pieces}
        values = ca.SX.sym("values", sum(parameters.values()))
        cost, equal, below = self._build(
            unpack(unknowns, self.sizes), unpack(values, parameters), samples
        )
        num_equal, num = equal.numel(), equal.numel() + below.numel()
        self._bounds = {
            "lbx": self._repeat_bounds(0.004, -np.inf, 0.15, 0.05, floor),
            "ubx": self._repeat_bounds(0.5, np.inf, 3.0, 3.0, np.inf),
            "lbg": np.where(np.arange(num) < num_equal, 0.0, -np.inf),
            "ubg": np.zeros(num),
        }
        problem = {"x": unknowns, "p": values, "f": cost, "g": ca.vertcat(equal, below)}
        settings = {"ipopt": OPTIONS, "print_time": False, "error_on_fail": False}
        self._solver = ca.nlpsol("hit", "ipopt", problem, settings)

    def _repeat_bounds(self, duration, state, flight_time, thrust, excess) -> np.ndarray:
        values = (duration, state, state, flight_time, thrust, excess)
        return np.repeat(values, list(self.sizes.values()))

    def _build(self, unknown: dict, case: dict, samples: int) -> tuple:
        """Return the program's cost, and expressions that must be 0 and that must be <= 0.

        `unknown` and `case` have the symbols of unknowns and parameters by name, and `samples` is
        the number of samples of a piece.
        """
        states = ca.horzcat(
            case["head_state"],
            ca.reshape(unknown["states"], 12, self.pieces) * np.repeat(STATE_SCALE, 3),
        )
        impact_time = ca.sum1(unknown["durations"])
        equal, below, axis = [], [], path_limits(self._motion(states[:, 0]), case, 1.0)[1]
        for k in range(self.pieces):
            duration = unknown["durations"][k]
            motion = [*self._motion(states[:, k]), SNAP_SCALE * unknown["snaps"][3 * k : 3 * k + 3]]
            allowance = 1.0 + unknown["excess"] - case["margins"][k]
            # Between two samples the body z axis must not turn farther than the limit of the body
            # rate permits. Otherwise the quadrotor could flip over between samples.
            turn = case["body_rate"] * allowance * duration / samples
            ends = self._motion(states[:, k + 1])
            inside = [advance(motion, duration * i / samples) for i in range(1, samples)]
            for here in (*inside, ends):
                limits, ahead = path_limits(here, case, allowance)
                below += [*limits, 1.0 - ca.dot(axis, ahead) - turn**2 / 2.0 - 1.5e-3]
                axis = ahead
            defects = zip(advance(motion, duration)[:4], ends, STATE_SCALE, strict=True)
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
        """Run IPOPT; return the unknowns at which it stops, and whether it has converged.

        Args:
            case: numbers of the case by name, such as limits, in SI units.
            guess: initial guess of the unknowns.
            margins: (M,), relative amounts by which the limits on each of M pieces are tightened.
                With margins the durations keep their initial values, so that each piece remains the
                same part of the trajectory. None for no margins.
        """
        bounds = dict(self._bounds)
        if margins is not None:
            for side in ("lbx", "ubx"):
                bounds[side] = np.r_[guess[: self.pieces], bounds[side][self.pieces :]]
        margins = np.zeros(self.pieces) if margins is None else margins
        found = self._solver(x0=guess, p=np.concatenate([*case.values(), margins]), **bounds)
        return np.asarray(found["x"]).ravel(), self._solver.stats()["success"]

    def guess(self, case: dict, start: tuple) -> np.ndarray:
        """Return an initial guess: a polynomial of degree 7 from the initial state to an impact.

        `start` defines the impact: its time over the ball's landing time, the ball's flight time
        [s] after the impact, and the thrust at the impact [g].
        """
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

    def halve(self, case: dict, unknowns: np.ndarray) -> np.ndarray:
        """Return the unknowns of the same trajectory for a program with twice as many pieces."""
        motion, durations = self.motion(case, unknowns)
        half = 0.5 * durations
        nodes = np.stack([advance(motion, half[:, None]), advance(motion, durations[:, None])])
        states = np.moveaxis(nodes[:, :4], (0, 1), (1, 2)) / STATE_SCALE[:, None]
        snaps = np.repeat(motion[4], 2, axis=0) / SNAP_SCALE
        return np.concatenate([np.repeat(half, 2), states.ravel(), snaps.ravel(), unknowns[-3:]])

    def motion(self, case: dict, unknowns: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
        """Return the motion at the start of each of M pieces, and the pieces' durations (M,) [s].

        The motion is a list of position, velocity, acceleration, jerk and snap, (M, 3) each.
        """
        found = unpack(unknowns, self.sizes)
        states = found["states"].reshape(-1, 4, 3)[:-1] * STATE_SCALE[:, None]
        states = np.concatenate([case["head_state"].reshape(1, 4, 3), states])
        snaps = SNAP_SCALE * found["snaps"].reshape(-1, 3)
        return [*np.moveaxis(states, 1, 0), snaps], found["durations"]
