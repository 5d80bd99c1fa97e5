"""Paths of a car past standing obstacles on different sides, for planners of path, then speed.

The paths are planned by the parts of the planner `spacetime`, for a case without moving obstacles
and with a target that stands at the meeting point. Random paths are drawn through the reach set,
the cells that the car can reach at each time. Two paths pass a wall on different sides if they turn
by different angles around the wall's centre. The paths that differ most are refined by least
squares, each with its own arrival time; their speeds are then discarded. Some paths are longer than
necessary on purpose, because moving obstacles may block all short paths.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.baselines.intercept.path import Path, path_of_drive
from planner_jax.plane.cell_paths import PathNoise, draw_noise
from planner_jax.plane.obstacles import Obstacles
from planner_jax.plane.target import TurningPath
from planner_jax.robot.car_motion import motion
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.problem.clearance import wrap
from planner_jax.task.intercept.problem.motion_problem import Guess, MotionProblem
from planner_jax.task.intercept.searches import (
    Reachability,
    Search,
    draw_cell_path,
    make_field,
    make_grid,
    search_reach,
)

_SHARES = 8  # number of points of a path at which it is compared with other paths
_OTHER_SIDE = 8.0  # [m], added to the distance of two paths that pass a wall on different sides


@struct.dataclass
class StaticPaths:
    """P paths that pass the standing obstacles of a case on different sides, without speeds."""

    paths: Path  # leaves (P, ...)
    violation: Array  # (P,), largest relative excess over a limit; <= 0 if all limits hold
    is_reached: Array  # () bool, whether a sequence of cells reaches the meeting point in time
    steps: Array  # () int32, greatest number of least-squares steps of any path


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class PathSource:
    """Settings of the search for several different paths."""

    problem: MotionProblem = MotionProblem()
    drawn: int = 8  # number of random paths per returned path; the most different are refined
    later: int = 10  # number of arrival times, after the earliest, that random paths have in turn
    points: int = 129  # number of points of a path

    def paths(
        self, case: InterceptCase, attempt: Search, layers: Array | None = None
    ) -> StaticPaths:
        """Find `attempt.paths` different paths of one case past its standing obstacles.

        `layers` () is the number of equal time steps of the search, by default chosen for the case.
        """
        still = without_movers(case)
        grid = make_grid(still, attempt.lattice, is_time_free=True)
        field = make_field(still, grid)
        found = search_reach(still, attempt, grid, field, is_time_free=True, layers=layers)
        arrivals, is_reached = found.layers, found.is_reached
        first = jnp.argmax(arrivals)
        num = self.drawn * attempt.paths
        layer = jnp.minimum(first + 1 + np.arange(num) % self.later, found.grid.num)
        layer = jnp.where(arrivals[layer], layer, first).astype(jnp.int32)
        noise = draw_noise(attempt.lattice, num, attempt.seed, 1)
        times, guesses = jax.vmap(lambda n, noise: self.guess(still, found, n, noise))(layer, noise)
        chosen = self.select_different(still, times, guesses, attempt.paths)

        def path(start: tuple[Array, Guess]) -> tuple[Path, Array, Array]:
            time, guess = start
            drive = dataclasses.replace(still, time=time)
            stages = self.problem.list_stages(attempt)
            plan = self.problem.refine(drive, field, guess, attempt, stages)
            speed = jnp.maximum(plan.speed, 0.0)
            driven = path_of_drive(plan.start, time, speed, plan.curvature, self.points)
            return driven, plan.violation, plan.iterations

        paths, violation, steps = lax.platform_dependent(
            (times[chosen], jax.tree.map(lambda leaf: leaf[chosen], guesses)),
            cpu=lambda starts: lax.map(path, starts),
            default=jax.vmap(path),
        )
        return StaticPaths(
            paths=paths,
            violation=jnp.where(is_reached, violation, jnp.inf),
            is_reached=is_reached,
            steps=jnp.max(steps),
        )

    def guess(
        self, case: InterceptCase, found: Reachability, layer: Array, noise: PathNoise
    ) -> tuple[Array, Guess]:
        """Draw a random path to the target, as arrival time [s] and initial guess of the motion.

        The path leads through cells in `found`, which the car can reach, and ends in time step
        `layer`. The random numbers `noise` select the cells.
        """
        grid = found.grid
        path = draw_cell_path(case, found, layer, noise, 0.0)
        time = (layer + 0.5) * grid.step
        guess = self.problem.guess_along(
            dataclasses.replace(case, time=time), grid, found.reach.speeds, path, layer
        )
        return time, guess

    def select_different(
        self, case: InterceptCase, times: Array, guesses: Guess, num: int
    ) -> Array:
        """Return the indices of the `num` motions, of all `guesses`, whose paths differ most.

        The shortest path comes first. Each next path is the path farthest from all selected paths.
        The distance of two paths is the mean distance of their points at equal fractions of their
        lengths, plus a large constant if they pass a wall on different sides.
        """
        goal = case.target.at(case.time).pos

        def way(time: Array, guess: Guess) -> tuple[Array, Array, Array]:
            speed, curvature, _ = self.problem.unpack(case, guess.point)
            pos = motion(case.start, time, speed, curvature, 1).pos[:, 0]
            step = time / (speed.shape[0] - 1)
            station = jnp.cumsum(jnp.maximum(0.5 * (speed[1:] + speed[:-1]), 1e-3) * step)
            at = jnp.linspace(0.0, 1.0, _SHARES + 1)[1:] * station[-1]
            points = jnp.stack([jnp.interp(at, station, pos[:, k]) for k in range(2)], axis=1)
            turns = count_turns(case.walls, case.start[:2], pos, goal)
            return points, turns, station[-1]

        points, turns, length = jax.vmap(way)(times, guesses)
        apart = jnp.mean(jnp.linalg.norm(points[:, None] - points[None], axis=-1), axis=-1)
        is_other = jnp.any((turns[:, None] != turns[None]) & case.walls.present[None, None], axis=2)
        apart = apart + jnp.where(is_other, _OTHER_SIDE, 0.0)
        first = jnp.argmin(length)

        def farthest(nearest: Array, _: None) -> tuple[Array, Array]:
            place = jnp.argmax(nearest)
            return jnp.minimum(nearest, apart[place]), place

        _, others = lax.scan(farthest, apart[first], length=num - 1)
        return jnp.concatenate([first[None], others])


def without_movers(case: InterceptCase) -> InterceptCase:
    """Return the case without moving obstacles, with a target that stands at the meeting point."""
    goal = case.target.at(case.time).pos
    still = TurningPath(pos=goal, vel=jnp.zeros_like(goal), turn_rate=jnp.zeros_like(case.time))
    # One obstacle that is marked as absent, since arrays without obstacles are not supported.
    none = Obstacles(
        centre=jnp.zeros((1, 2), goal.dtype),
        corners=jnp.zeros((1, 3, 2), goal.dtype),
        velocity=jnp.zeros((1, 2), goal.dtype),
        present=jnp.zeros(1, bool),
        radius=jnp.zeros(1, goal.dtype),
        growth=jnp.zeros(1, goal.dtype),
    )
    return dataclasses.replace(case, target=still, movers=none)


def count_turns(walls: Obstacles, start: Array, pos: Array, goal: Array) -> Array:
    """Count the full turns of a path around every wall's centre, (N,) int32.

    The straight line from start to goal has 0 turns. Paths with different numbers pass the wall on
    different sides.

    Args:
        walls: N walls.
        start: (2,) [m], start of the path.
        pos: (M, 2) [m], M points of the path, close to each other.
        goal: (2,) [m], end of the path.
    """
    points = jnp.concatenate([start[None], pos, goal[None]])[:, None] - walls.centre[None]
    angle = jnp.arctan2(points[..., 1], points[..., 0])  # (M + 2, N)
    turned = jnp.sum(wrap(jnp.diff(angle, axis=0)), axis=0)
    straight = wrap(angle[-1] - angle[0])
    return jnp.round((turned - straight) / (2.0 * np.pi)).astype(jnp.int32)
