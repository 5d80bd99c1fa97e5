"""Speed along a known way: the second half of [Qu2022] (Section IV), and what it is compared with.

Dynamic programming finds a line through the graph of station and time; a quadratic program finds
the curve of least acceleration beside the polygons on the same sides. The planners differ in how
the polygons become bounds of that program.
"""

import dataclasses
import functools
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.baselines.intercept.bezier import (
    BezierCurve,
    bernstein,
    bounds_of_pieces,
    energy_of_pieces,
    hodograph,
    joints,
    rows_of_pieces,
)
from planner_jax.baselines.intercept.qp import QpConfig, QpTemplate, qp_template, solve_qp
from planner_jax.baselines.intercept.station_time import (
    ReferenceLine,
    StationTimeGrid,
    StationTimeProblem,
    corridor,
    free_intervals,
    reference_line,
    stations_at_joints,
)
from planner_jax.core.protocol import Plan, Status


@struct.dataclass
class SpeedPlan(Plan):
    """One plan, or a batch of them with a leading axis on every leaf.

    Its cost is that of [Qu2022, eq. 19], by w_1: the integral of the squared acceleration
    [m^2/s^3] and, of a soft end, its share. It is violated relative to length and horizon.
    """

    curve: BezierCurve  # station [m] over time [s]
    reference: ReferenceLine  # beside which it runs


@dataclasses.dataclass(frozen=True)
class SpeedPlanner:
    """How a curve is found; all of it shapes the compiled program.

    `SPEED_PLANNERS` has those of Table II by name.
    """

    pieces: int = 10
    degree: int = 5
    continuity: int = 2  # derivatives that neighbours have in common, two at least
    lines: Literal["tilted", "edges", "flat", "exact"] = "tilted"
    # Rows of every piece: bounds on its points, so that they hold everywhere, or on this many
    # samples, its end among them.
    samples: int | None = None
    # How often a curve is sought: lines are tilted to the reference, then to the curve before.
    rounds: int = 1
    margin: float = 1e-3  # [m], from polygons
    # w_2 T^3 / w_1 of a soft end, 300 for the paper's weights and T = 10 s; else it is exact.
    end_weight: float | None = None
    grid: StationTimeGrid = StationTimeGrid()
    solver: QpConfig = QpConfig()


# Tilted lines are this library's, continued `edges` the paper's. EM is the speed step of [Fan2018]:
# bounds at samples, every 0.1 s of a horizon of 10 s, from intervals that are free for a whole
# piece, or only at that moment.
SPEED_PLANNERS = {
    "trapezoid": SpeedPlanner(),
    "trapezoid-twice": SpeedPlanner(rounds=2),
    "trapezoid-edges": SpeedPlanner(lines="edges"),
    "rectangle": SpeedPlanner(lines="flat"),
    "em": SpeedPlanner(lines="flat", samples=10),
    "em-exact": SpeedPlanner(lines="exact", samples=10),
}


def plan_speed(problem: StationTimeProblem, planner: SpeedPlanner = SpeedPlanner()) -> SpeedPlan:
    """Station over time of least acceleration [Qu2022, eqs 17-24]; pure, for one problem.

    Status NO_PATH where the graph has no free line on the grid, INFEASIBLE where no curve fits
    the bounds around it.
    """
    pieces, degree = planner.pieces, planner.degree
    dtype = problem.horizon.dtype
    reference = reference_line(problem, planner.grid)
    # Round one begins with the line itself.
    ends = stations_at_joints(reference.station, pieces)
    shares = jnp.linspace(0.0, 1.0, degree + 1, dtype=dtype)
    points = ends[:-1, None] + (ends[1:] - ends[:-1])[:, None] * shares
    start = SpeedPlan(
        cost=jnp.asarray(jnp.inf, dtype),
        violation=jnp.asarray(jnp.inf, dtype),
        iterations=jnp.asarray(0, jnp.int32),
        status=jnp.asarray(Status.MAX_STEPS, jnp.int32),
        curve=BezierCurve(points=points, horizon=problem.horizon),
        reference=reference,
    )

    def improve(best: SpeedPlan, _: None) -> tuple[SpeedPlan, None]:
        points = best.curve.points
        slope = (points[:, -1] - points[:, 0]) * pieces / problem.horizon
        bounds = speed_bounds(problem, reference, planner, slope)
        found = solve_qp(speed_template(planner), *bounds, planner.solver)
        again = SpeedPlan(
            cost=found.cost * problem.end_station**2 / problem.horizon**3,
            violation=found.violation,
            iterations=best.iterations + found.steps,
            status=found.status,
            curve=BezierCurve(
                points=problem.end_station * found.point[: points.size].reshape(points.shape),
                horizon=problem.horizon,
            ),
            reference=reference,
        )
        is_better = (best.status != Status.CONVERGED) | (
            (again.status == Status.CONVERGED) & (again.cost < best.cost)
        )
        kept = jax.tree.map(functools.partial(jnp.where, is_better), again, best)
        return dataclasses.replace(kept, iterations=again.iterations), None

    best, _ = lax.scan(improve, start, length=planner.rounds)
    is_lost = ~reference.found & (best.status != Status.NON_FINITE)
    status = jnp.where(is_lost, Status.NO_PATH, best.status).astype(jnp.int32)
    return dataclasses.replace(best, status=status)


def constant_speed(problem: StationTimeProblem, degree: int = 5) -> BezierCurve:
    """The straight line from beginning to end, which looks at no polygon and no initial speed."""
    points = jnp.linspace(0.0, 1.0, degree + 1)[None] * problem.end_station
    return BezierCurve(points=points, horizon=problem.horizon)


@functools.cache
def speed_matrices(planner: SpeedPlanner) -> dict[str, np.ndarray]:
    """The program of a planner for a way of length 1 and a horizon of 1, as `qp_template` takes it.

    Unknowns are the points of all pieces, of a soft end also the station that it should have.
    Right sides are speed and acceleration at the beginning and the station at the end. What is
    bounded is the station, then the speed, then the acceleration: each of its points, or samples.
    """
    pieces, degree = planner.pieces, planner.degree
    size = pieces * (degree + 1)
    ends = np.zeros((4, size))
    for order in range(3):
        ends[order, : degree + 1] = hodograph(degree, order, pieces)[0]
    ends[3, -1] = 1.0
    hessian = 2.0 * energy_of_pieces(degree, 2, pieces)
    rows = np.concatenate([rows_of_pieces(_rows_of_piece(planner, k), pieces) for k in range(3)])
    zeros = np.concatenate([ends[:1], joints(degree, planner.continuity, pieces)])
    equalities = ends[1:]
    if planner.end_weight is not None:
        one_more = ((0, 0), (0, 1))
        pull = np.append(-ends[3], 1.0)
        hessian = np.pad(hessian, (0, 1)) + 2.0 * planner.end_weight * np.outer(pull, pull)
        rows, zeros = np.pad(rows, one_more), np.pad(zeros, one_more)
        equalities = np.append(np.pad(ends[1:3], one_more), np.eye(size + 1)[-1:], axis=0)
    return {"hessian": hessian, "equalities": equalities, "rows": rows, "zeros": zeros}


@functools.cache
def speed_template(planner: SpeedPlanner) -> QpTemplate:
    """What all programs of a planner share."""
    return qp_template(**speed_matrices(planner))


def _rows_of_piece(planner: SpeedPlanner, order: int) -> np.ndarray:
    """What is bounded of a derivative in one piece: its points, or its values at samples."""
    rows = hodograph(planner.degree, order, planner.pieces)
    if planner.samples is None:
        return rows
    return bernstein(planner.degree - order, _shares(planner)) @ rows


def _shares(planner: SpeedPlanner) -> np.ndarray:
    """The shares of a piece at which its stations are bounded.

    A curve is beside a straight line if its points are beside that line's, which lie on it at
    equal shares.
    """
    num = planner.samples or planner.degree
    return np.arange(num + 1) / num


def speed_bounds(
    problem: StationTimeProblem, reference: ReferenceLine, planner: SpeedPlanner, slope: Array
) -> tuple[Array, Array, Array]:
    """Right sides (3,), lower and upper bounds (M,) of one problem's program.

    In units of the length of the way and the horizon.

    Args:
        problem: one problem.
        reference: beside which the curve has to run.
        planner: whose program it is.
        slope: (K,) [m/s], mean speed of each piece, to which `tilted` lines tilt.
    """
    pieces = planner.pieces
    shares = jnp.asarray(_shares(planner), problem.horizon.dtype)
    is_exact = planner.lines == "exact"
    lines = "edges" if planner.lines == "exact" else planner.lines
    around = corridor(problem, reference.station, pieces, lines, slope)
    if is_exact:
        times = (jnp.arange(pieces)[:, None] + shares) * (problem.horizon / pieces)
        lower, upper = free_intervals(problem, reference.station, times.reshape(-1))
        lower = jnp.where(lower > 0.0, lower, -jnp.inf).reshape(times.shape)
        upper = jnp.where(upper < problem.end_station, upper, jnp.inf).reshape(times.shape)
    else:
        lower, upper = around.bounds(shares)
    speed, acceleration = (
        jnp.broadcast_to(limit, (pieces, len(_rows_of_piece(planner, order))))
        for order, limit in ((1, around.speed[:, None]), (2, problem.acceleration_limit))
    )
    units = [problem.end_station / problem.horizon**order for order in range(3)]
    least = lower + planner.margin, jnp.zeros_like(speed), -acceleration
    most = upper - planner.margin, speed, acceleration
    bounds = [
        bounds_of_pieces(low / unit, high / unit)
        for low, high, unit in zip(least, most, units, strict=True)
    ]
    low, high = (jnp.concatenate(each) for each in zip(*bounds, strict=True))
    beginning = [problem.initial_speed / units[1], problem.initial_acceleration / units[2]]
    return jnp.stack([*beginning, jnp.ones_like(problem.horizon)]), low, high
