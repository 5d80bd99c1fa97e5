"""Speed of a car along a known path: the second half of [Qu2022] (Section IV), and baselines.

The station is the distance along the path. In the graph of station over time, moving obstacles
block polygons. Dynamic programming finds a line between the polygons. A quadratic program then
finds the curve of least acceleration that passes every polygon on the same side as the line. The
planners of this module derive different bounds from the polygons.
"""

import dataclasses
import functools
from typing import Literal

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.baselines.intercept.qp import QpConfig, QpTemplate, qp_template, solve_qp
from planner_jax.baselines.intercept.station_time import (
    ReferenceLine,
    StationTimeGrid,
    StationTimeProblem,
    corridor,
    reference_line,
)
from planner_jax.core.protocol import Plan, Status
from planner_jax.trajectory.bezier import (
    BezierCurve,
    bernstein,
    bounds_of_pieces,
    energy_of_pieces,
    hodograph,
    joints,
    rows_of_pieces,
)


@struct.dataclass
class SpeedPlan(Plan):
    """The station (distance along a path) over time; a batch of plans has one more leading axis.

    The cost is the integral of the squared acceleration [m^2/s^3], plus a weighted squared distance
    from the end of the path if the planner has an `end_weight` [Qu2022, eq. 19]. The violation is
    the largest excess over a bound, in units of path length and total time.
    """

    curve: BezierCurve  # station [m] as a function of time [s]
    reference: ReferenceLine  # the line that decides on which side of each polygon the curve is


@dataclasses.dataclass(frozen=True)
class SpeedPlanner:
    """Settings of a speed planner.

    `SPEED_PLANNERS` holds the planners of [Qu2022, Table II] by name.
    """

    pieces: int = 10  # number of Bezier pieces of a curve
    degree: int = 5  # degree of the pieces
    lines: Literal["tilted", "edges", "flat"] = "tilted"  # slope of bounds, see `corridor`
    # With None the bounds apply to the control points of each piece, so that they hold everywhere.
    # With a number they apply to that many samples of each piece, including its end.
    samples: int | None = None
    margin: float = 1e-3  # [m], least distance from polygons
    # Weight of the curve's squared final distance from the path's end, 300 in [Qu2022] for a
    # horizon of 10 s. With None the curve ends exactly at the path's end.
    end_weight: float | None = None
    grid: StationTimeGrid = StationTimeGrid()
    solver: QpConfig = QpConfig()


# Speed planners by name. "trapezoid" has bounds with the slope of the reference line, a choice of
# this library; "trapezoid-edges" has the polygons' edges as bounds [Qu2022]. "rectangle" and "em"
# use only stations that are free during a whole piece; "em" bounds only samples [Fan2018].
SPEED_PLANNERS = {
    "trapezoid": SpeedPlanner(),
    "trapezoid-edges": SpeedPlanner(lines="edges"),
    "rectangle": SpeedPlanner(lines="flat"),
    "em": SpeedPlanner(lines="flat", samples=10),
}


def plan_speed(problem: StationTimeProblem, planner: SpeedPlanner = SpeedPlanner()) -> SpeedPlan:
    """Return the distance along the path over time with the least acceleration [Qu2022, eqs 17-24].

    The status is NO_PATH if dynamic programming finds no collision-free line, and INFEASIBLE if no
    curve keeps the bounds around the line.
    """
    reference = reference_line(problem, planner.grid)
    bounds = speed_bounds(problem, reference, planner)
    found = solve_qp(speed_template(planner), *bounds, planner.solver)
    shape = planner.pieces, planner.degree + 1
    points = found.point[: shape[0] * shape[1]].reshape(shape)
    is_lost = ~reference.found & (found.status != Status.NON_FINITE)
    return SpeedPlan(
        cost=found.cost * problem.end_station**2 / problem.horizon**3,
        violation=found.violation,
        iterations=found.steps,
        status=jnp.where(is_lost, Status.NO_PATH, found.status).astype(jnp.int32),
        curve=BezierCurve(points=problem.end_station * points, horizon=problem.horizon),
        reference=reference,
    )


@functools.cache
def speed_matrices(planner: SpeedPlanner) -> dict[str, np.ndarray]:
    """Return the matrices of a planner's quadratic program, the arguments of `qp_template`.

    The path has length 1 and the horizon is 1. The unknowns are the control points of all pieces;
    with an `end_weight`, also the station at which the curve should end. The right sides of the
    equalities are initial speed, initial acceleration and final station. The bounded rows are
    stations, then speeds, then accelerations, each at control points or at samples.
    """
    pieces, degree = planner.pieces, planner.degree
    size = pieces * (degree + 1)
    ends = np.zeros((4, size))
    for order in range(3):
        ends[order, : degree + 1] = hodograph(degree, order, pieces)[0]
    ends[3, -1] = 1.0
    hessian = 2.0 * energy_of_pieces(degree, 2, pieces)
    rows = np.concatenate([rows_of_pieces(_rows_of_piece(planner, k), pieces) for k in range(3)])
    zeros = np.concatenate([ends[:1], joints(degree, 2, pieces)])
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
    """Return the arrays of the quadratic program that all problems of a speed planner share."""
    return qp_template(**speed_matrices(planner))


def _rows_of_piece(planner: SpeedPlanner, order: int) -> np.ndarray:
    rows = hodograph(planner.degree, order, planner.pieces)
    if planner.samples is None:
        return rows
    return bernstein(planner.degree - order, _shares(planner)) @ rows


def _shares(planner: SpeedPlanner) -> np.ndarray:
    """Return the positions in a piece, as fractions from 0 to 1, at which stations are bounded."""
    num = planner.samples or planner.degree
    return np.arange(num + 1) / num


def speed_bounds(
    problem: StationTimeProblem, reference: ReferenceLine, planner: SpeedPlanner
) -> tuple[Array, Array, Array]:
    """Return equality values (3,), lower and upper bounds (M,) of a plan's quadratic program.

    The equalities fix initial speed, initial acceleration and final station (distance along the
    path). Stations, speeds and accelerations, in this order, have lower and upper bounds, which
    keep the curve on the reference line's side of each polygon. The units are path length and
    horizon.
    """
    pieces = planner.pieces
    around = corridor(problem, reference.station, pieces, planner.lines)
    lower, upper = around.bounds(jnp.asarray(_shares(planner), problem.horizon.dtype))
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
