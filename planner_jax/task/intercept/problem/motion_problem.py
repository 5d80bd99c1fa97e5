"""The unknowns of an interception, its cost as a function of them, and its stages."""

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from planner_jax.core.protocol import is_solved, select
from planner_jax.optimise.levenberg import LevenbergState, Model, least_squares
from planner_jax.plane.cell_paths import CellPath
from planner_jax.plane.distance_field import DistanceField
from planner_jax.plane.reach import Grid
from planner_jax.robot.car_motion import Quadratic, by_unknowns, motion
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan, make_plan
from planner_jax.task.intercept.problem import terms
from planner_jax.task.intercept.problem.drives import (
    Drive,
    drive_along,
    drive_directly,
    earliest_time,
)
from planner_jax.task.intercept.searches import Search, Warm
from planner_jax.task.intercept.units import Units

_LITTLE = 1e-3  # the last stage ends if four steps each lower the cost by less than this share
_HIGHEST = lax.Precision.HIGHEST
_SOONEST = 0.01  # earliest time of a meeting, divided by the case's time

# Weights of the cost in the three stages: follow the path of grid cells, keep all limits, and
# reduce the discomfort.
_FOLLOWING = terms.Weights(follow=10.0, obstacle=0.0, early=0.0)
_KEEPING = terms.Weights()
_SETTLING = terms.Weights(effort=10.0)
# Weights of the last stage if the meeting shall be as early as possible.
_HURRYING = terms.Weights(early=1000.0)


@struct.dataclass
class Stage:
    """A stage of least squares: Levenberg-Marquardt steps with fixed weights of the cost."""

    weights: terms.Weights
    steps: Array | int  # greatest number of steps
    tolerance: Array | float = 1.0  # as in `LevenbergConfig`; 1 ends at the first feasible point
    settled: Array | int = 1  # as in `LevenbergConfig`
    only_feasible: Array | bool = False  # whether to skip the stage at a point that breaks a limit


@struct.dataclass
class Guess:
    """A starting point of least squares, and K positions that the motion shall follow at first."""

    point: Array  # (n,), the n unknowns
    positions: Array  # (K, 2) [m], rear axle's middle at the knots 1..K, on a path of cells


@dataclasses.dataclass(frozen=True)
class MotionProblem:
    """The least-squares problem of an interception, which `SpacetimeIntercept` solves.

    `meet` selects the time of the meeting: the case's time, the earliest, or the time of the least
    discomfort.
    """

    meet: Literal["given", "early", "least"] = "given"  # as in `SpacetimeIntercept`
    pieces: int = 32  # number of pieces of speed and curvature
    samples: int = 3  # samples of each piece at which the cost checks obstacles
    checked: int = 16  # samples of each piece at which the finished plan is checked

    @property
    def is_time_free(self) -> bool:
        """Whether the time of the meeting is an unknown instead of a number of the case."""
        return self.meet != "given"

    @property
    def weights(self) -> terms.Weights:
        """Weights of the last stage, which reduces the meeting time or the discomfort."""
        return _HURRYING if self.meet == "early" else _SETTLING

    def pack(self, speed: Array, curvature: Array, time: Array) -> Array:
        """Join speed and curvature (..., K) at the knots 1 to K, and the time if it is free."""
        parts = [speed, curvature, time[..., None]]
        return jnp.concatenate(parts if self.is_time_free else parts[:2], axis=-1)

    def enter_units(self, point: Array, units: Units) -> Array:
        """Convert unknowns (n,) in SI units to the units of a case."""
        num = self.pieces
        speed, curvature = point[:num] / units.speed, point[num : 2 * num] * units.length
        return self.pack(speed, curvature, point[-1] / units.time)

    def unpack(self, case: InterceptCase, point: Array) -> tuple[Array, Array, Array]:
        """Split the unknowns into speed and curvature at all K + 1 knots, and the meeting time.

        The speed at the end is the prescribed one if `terms.held_end_speed` returns such a speed.
        """
        speed, curvature = point[: self.pieces], point[self.pieces : 2 * self.pieces]
        soonest = jnp.maximum(_SOONEST * case.time, case.earliest)
        time = jnp.clip(point[-1], jnp.minimum(soonest, case.time), case.time)
        is_held, at_end = terms.held_end_speed(case)
        speed = speed.at[-1].set(jnp.where(is_held, at_end, speed[-1]))
        return (
            jnp.concatenate([case.speed[None], speed]),
            jnp.concatenate([case.curvature[None], curvature]),
            time if self.is_time_free else case.time,
        )

    def decode(self, case: InterceptCase, point: Array, steps: Array) -> InterceptPlan:
        """Make the plan of the unknowns `point`; check limits at more samples than the cost."""
        speed, curvature, time = self.unpack(case, point)
        plan = make_plan(case, time, speed, curvature, samples=self.checked, points=12, steps=steps)
        return dataclasses.replace(plan, cost=time) if self.meet == "early" else plan

    def guess_at(self, point: Array) -> Guess:
        """Return a starting point with given unknowns, for stages without a path of grid cells."""
        return Guess(point=point, positions=jnp.zeros((self.pieces, 2), point.dtype))

    def guess_along(
        self, case: InterceptCase, grid: Grid, speeds: Array, path: CellPath, layer: Array
    ) -> Guess:
        """Return a starting point whose motion follows a path of cells; see `drive_along`."""
        return self._guess(drive_along(case, grid, speeds, path, layer, self.pieces))

    def guess_directly(self, case: InterceptCase, is_late: Array | bool) -> Guess:
        """Return a starting point that leads directly to the target; see `drive_directly`.

        It is at the target at the case's time, or at an earlier time if the meeting shall be early,
        unless `is_late` is true.
        """
        soonest = earliest_time(case) if self.meet == "early" else case.time
        time = jnp.where(is_late, case.time, soonest)
        return self._guess(drive_directly(case, time, self.pieces))

    def _guess(self, drive: Drive) -> Guess:
        return Guess(self.pack(*drive[:3]), drive.positions)

    def build_model(
        self,
        point: Array,
        case: InterceptCase,
        field: DistanceField,
        weights: terms.Weights,
        positions: Array,
        discs: int = 3,
    ) -> Model:
        """Return the cost, a sum of squares, at the unknowns `point`, and its quadratic model.

        `field` has the distances from walls. `positions` (K, 2) [m] are the points that the rear
        axle should follow at the knots 1 to K. `discs` discs cover the car's body.
        """
        speed, curvature, time = self.unpack(case, point)
        if self.meet == "early":  # else the pull of an earlier meeting exceeds a small tolerance
            share = jnp.maximum(terms.TOLERANCE / case.tolerance, 1.0)
            weights = dataclasses.replace(weights, miss=weights.miss * share)
        drive = motion(case.start, time, speed, curvature, self.samples)
        limits, violation, _ = terms.limit_terms(case, time, speed, curvature, weights, 4)
        end, missed = terms.meeting_terms(case, drive, time, weights)
        squares, close = terms.obstacle_terms(case, field, drive, weights, discs)
        squares = squares.at[:, -1].add(terms.following_terms(drive, positions, weights))
        squares = squares.at[-1, -1].add(end)
        cost = Quadratic(
            push=squares[..., :4, 4],
            stiffness=squares[..., :4, :4],
            piece_push=limits[:, :5, 5],
            piece_stiffness=limits[:, :5, :5],
        )
        gradient, curvature = by_unknowns(drive, cost, self.is_time_free)
        total = jnp.sum(squares[..., 4, 4]) + jnp.sum(limits[:, 5, 5])
        if (most := case.limits.jerk) is not None:

            def exceed(point: Array) -> Array:
                speed, _, time = self.unpack(case, point)
                return jnp.maximum(terms.jerk_excess(most, time, speed) + weights.slack, 0.0)

            def penalise() -> tuple[Array, Array, Array]:
                over, slope = exceed(point), jax.jacfwd(exceed)(point)
                push = jnp.matmul(over, slope, precision=_HIGHEST)
                square = jnp.matmul(slope.T, slope, precision=_HIGHEST)
                own = jnp.sum(over**2), push, square
                return jax.tree.map(lambda term: weights.limit * term, own)

            # On a CPU a car without a limit of jerk skips the penalty.
            before = total, gradient, curvature
            nothing = lambda: jax.tree.map(jnp.zeros_like, before)  # noqa: E731
            added = lax.cond(jnp.isfinite(most), penalise, nothing)
            total, gradient, curvature = jax.tree.map(jnp.add, before, added)
        if self.is_time_free:
            # Add two costs of the meeting time: a penalty if it exceeds the case's time, and, if
            # the meeting shall be early, the square of the time.
            late = jnp.maximum(point[-1] / case.time - 1.0, 0.0)
            pull = weights.early if self.meet == "early" else 0.0
            pull /= terms.HORIZON**2
            gradient = gradient.at[-1].add(weights.limit * late / case.time + pull * time)
            stiffness = jnp.where(late > 0.0, weights.limit, 0.0) / case.time**2
            curvature = curvature.at[-1, -1].add(stiffness + pull)
            total += weights.limit * late**2 + pull * time**2
        # A fixed time and a prescribed speed at the end are decoupled from the other unknowns. The
        # steps of the time are zero. The unknown that the speed replaces moves to the speed.
        is_held, at_end = terms.held_end_speed(case)
        lag = jnp.where(is_held, point[self.pieces - 1] - at_end, 0.0)
        is_moved = jnp.ones(point.size, bool).at[self.pieces - 1].set(~is_held)
        if self.is_time_free:
            is_moved = is_moved.at[-1].set(~jnp.asarray(weights.is_time_fixed))
        gradient = jnp.where(is_moved, gradient, 0.0).at[self.pieces - 1].add(lag)
        eye = jnp.eye(gradient.size, dtype=gradient.dtype)
        curvature = jnp.where(is_moved[:, None] & is_moved[None], curvature, eye)
        total += lag**2
        return Model(
            cost=total,
            gradient=gradient,
            curvature=curvature,
            violation=jnp.maximum(jnp.maximum(violation, missed), close),
        )

    def list_stages(self, attempt: Search) -> list[Stage]:
        """Return the three stages of least squares that start along a path of grid cells.

        They follow the path, keep all limits, and reduce discomfort or meeting time. The settings
        `attempt` determine their numbers of steps, tolerances and margins.
        """
        following = Stage(_FOLLOWING, attempt.following)
        keeping, last = self.list_last_stages(attempt)
        if self.is_time_free:
            late = jnp.asarray(attempt.is_late)
            following, keeping = (
                dataclasses.replace(
                    each, weights=dataclasses.replace(each.weights, is_time_fixed=late)
                )
                for each in (following, keeping)
            )
            # At a fixed time the stage ends at the first point that keeps all limits.
            keeping = dataclasses.replace(
                keeping,
                tolerance=jnp.where(late, 1.0, keeping.tolerance),
                settled=jnp.where(late, 1, keeping.settled),
            )
        return [following, keeping, last]

    def list_last_stages(self, attempt: Search | Warm) -> list[Stage]:
        """Return the last two stages: keep all limits, then reduce acceleration or meeting time."""
        margins = {"margin": attempt.margin, "slack": attempt.slack}
        solver, steps = attempt.solver, attempt.settling
        keeping = Stage(dataclasses.replace(_KEEPING, **margins), solver.max_steps)
        if self.is_time_free:
            until = {"tolerance": solver.tolerance, "settled": solver.settled}
            keeping = dataclasses.replace(keeping, **until)
        weights = dataclasses.replace(self.weights, **margins)
        last = Stage(weights, steps, tolerance=_LITTLE, settled=4, only_feasible=True)
        return [keeping, last]

    def run_stages(
        self,
        case: InterceptCase,
        field: DistanceField,
        guess: Guess,
        attempt: Search | Warm,
        stages: list[Stage],
    ) -> tuple[Array, Array]:
        """Run S stages of least squares, each from the point at which the previous stage ended.

        Returns:
            points: (S, n), the n unknowns at the end of each stage.
            steps: () int32, number of iterations of all stages together.
        """

        def run(state: tuple[Array, Array], stage: Stage) -> tuple[tuple, LevenbergState]:
            point, is_feasible = state
            most = jnp.where(stage.only_feasible & ~is_feasible, 0, stage.steps)
            config = dataclasses.replace(
                attempt.solver, max_steps=most, tolerance=stage.tolerance, settled=stage.settled
            )
            inputs = (case, field, stage.weights, guess.positions, attempt.discs)
            end = least_squares(lambda x: self.build_model(x, *inputs), point, config)
            return (end.point, end.model.violation <= 0.0), end

        stacked = jax.tree.map(lambda *each: jnp.stack([jnp.asarray(x) for x in each]), *stages)
        _, ends = lax.scan(run, (guess.point, jnp.asarray(False)), stacked)
        return ends.point, jnp.sum(ends.steps).astype(jnp.int32)

    def refine(
        self,
        case: InterceptCase,
        field: DistanceField,
        guess: Guess,
        attempt: Search | Warm,
        stages: list[Stage],
    ) -> InterceptPlan:
        """Run the stages from `guess`, and return the better of the last two stages' plans.

        A plan that keeps all limits is better than a plan that does not. If both plans keep all
        limits, the cheaper plan is better; if no plan does, the one with the smaller violation.
        """
        points, steps = self.run_stages(case, field, guess, attempt, stages)
        plans = lax.map(lambda point: self.decode(case, point, steps), points[-2:])
        before, after = (jax.tree.map(lambda leaf, k=k: leaf[k], plans) for k in range(2))
        return select(after, before)

    def refine_solved(
        self, case: InterceptCase, field: DistanceField, plan: InterceptPlan, attempt: Search
    ) -> InterceptPlan:
        """Run the last stage from a solved plan; return its result if it is solved at less cost."""
        guess = self.guess_at(self.pack(plan.speed[1:], plan.curvature[1:], plan.time))
        last = self.list_last_stages(attempt)[-1]
        steps = jnp.where(is_solved(plan.status), last.steps, 0)
        stage = dataclasses.replace(last, steps=steps, only_feasible=False)
        points, steps = self.run_stages(case, field, guess, attempt, [stage])
        return select(self.decode(case, points[0], plan.iterations + steps), plan)
