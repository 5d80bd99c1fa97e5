"""Paths among what stands, each another way round it: what a split of path and speed begins with.

They come from the machinery of `spacetime`, with nothing that moves and a target that stands where
it will be met. Random ways through the reach set are told apart by the side on which they pass
each wall: the angle by which a way turns around a wall's middle differs from that of another one
by whole turns just if the wall lies between them. Those that differ most are refined by least
squares, each at the time of its own arrival, and their speed is forgotten. Some are longer than
they need to be: what moves may block all the short ones.
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
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.motion import motion
from planner_jax.task.intercept.problem import Guess, MotionProblem
from planner_jax.task.intercept.searches import Reachability, Search, draw_cell_path, search_reach
from planner_jax.task.intercept.terms import wrap

_SHARES = 8  # of a way, where it is compared with others
_OTHER_SIDE = 8.0  # [m], how much farther apart ways are that pass a wall on different sides


@struct.dataclass
class StaticPaths:
    """P paths of one case."""

    paths: Path  # leaves (P, ...)
    violation: Array  # (P,), largest relative excess of the drive they come from; <= 0 is good
    is_reached: Array  # () bool, whether a way of cells leads to the meeting in time
    steps: Array  # () int32, of least squares, the most of any path


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class PathSource:
    """Finds paths; as many as an attempt has ways."""

    problem: MotionProblem = MotionProblem()
    drawn: int = 8  # ways for every path, of which those that differ are refined
    later: int = 10  # layers after the earliest arrival that ways arrive at, in turns
    points: int = 129  # of a path

    def paths(
        self, case: InterceptCase, attempt: Search, layers: Array | None = None
    ) -> StaticPaths:
        """Find the paths of one case; see `search_reach` for the layers of a batch."""
        still = standing(case)
        found = search_reach(still, attempt, is_time_free=True, layers=layers)
        arrivals, is_reached = found.layers, found.is_reached
        first = jnp.argmax(arrivals)
        num = self.drawn * attempt.paths
        layer = jnp.minimum(first + 1 + np.arange(num) % self.later, found.grid.num)
        layer = jnp.where(arrivals[layer], layer, first).astype(jnp.int32)
        noise = draw_noise(attempt.lattice, num, attempt.seed, 1)
        times, guesses = jax.vmap(lambda n, noise: self.guess(still, found, n, noise))(layer, noise)
        chosen = self.different(still, times, guesses, attempt.paths)

        def path(start: tuple[Array, Guess]) -> tuple[Path, Array, Array]:
            time, guess = start
            drive = dataclasses.replace(still, time=time)
            stages = self.problem.list_stages(attempt)
            plan = self.problem.refine(drive, found.field, guess, attempt, stages)
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
        """When a random way arrives that ends at a layer, and where least squares begin."""
        grid = found.grid
        path = draw_cell_path(case, found, layer, noise, 0.0)
        time = (layer + 0.5) * grid.step
        guess = self.problem.guess_along(dataclasses.replace(case, time=time), grid, path, layer)
        return time, guess

    def different(self, case: InterceptCase, times: Array, guesses: Guess, num: int) -> Array:
        """Places of some of D guesses, the shortest first, then those farthest from the rest.

        Ways are as far apart as their points at equal shares of their lengths are on average, and
        farther apart than any others if they pass a wall on different sides.
        """
        goal = case.target.at(case.time).pos

        def way(time: Array, guess: Guess) -> tuple[Array, Array, Array]:
            speed, curvature, _ = self.problem.unpack(case, guess.point)
            pos = motion(case.start, time, speed, curvature, 1).pos[:, 0]
            step = time / (speed.shape[0] - 1)
            station = jnp.cumsum(jnp.maximum(0.5 * (speed[1:] + speed[:-1]), 1e-3) * step)
            at = jnp.linspace(0.0, 1.0, _SHARES + 1)[1:] * station[-1]
            points = jnp.stack([jnp.interp(at, station, pos[:, k]) for k in range(2)], axis=1)
            turns = turns_around(case.walls, case.start[:2], pos, goal)
            return points, turns, station[-1]

        points, turns, length = jax.vmap(way)(times, guesses)
        apart = jnp.mean(jnp.linalg.norm(points[:, None] - points, axis=-1), axis=-1)
        is_other = jnp.any((turns[:, None] != turns) & case.walls.present, axis=2)
        apart = apart + jnp.where(is_other, _OTHER_SIDE, 0.0)
        first = jnp.argmin(length)

        def farthest(nearest: Array, _: None) -> tuple[Array, Array]:
            place = jnp.argmax(nearest)
            return jnp.minimum(nearest, apart[place]), place

        _, others = lax.scan(farthest, apart[first], length=num - 1)
        return jnp.concatenate([first[None], others])


def standing(case: InterceptCase) -> InterceptCase:
    """The case without movers, of a target that stands where it will be met."""
    goal = case.target.at(case.time).pos
    still = TurningPath(pos=goal, vel=jnp.zeros_like(goal), turn_rate=jnp.zeros_like(case.time))
    # One that is absent, so that nothing is worked out for movers.
    none = Obstacles(
        centre=jnp.zeros((1, 2), goal.dtype),
        corners=jnp.zeros((1, 3, 2), goal.dtype),
        velocity=jnp.zeros((1, 2), goal.dtype),
        present=jnp.zeros(1, bool),
    )
    return dataclasses.replace(case, target=still, movers=none)


def turns_around(walls: Obstacles, start: Array, pos: Array, goal: Array) -> Array:
    """How many turns more than the straight line a way makes around every wall's middle, (N,).

    Args:
        walls: N of them.
        start: (2,) [m].
        pos: (M, 2) [m], of the way, close enough together not to jump past a wall's middle.
        goal: (2,) [m].
    """
    points = jnp.concatenate([start[None], pos, goal[None]])[:, None] - walls.centre
    angle = jnp.arctan2(points[..., 1], points[..., 0])  # (M + 2, N)
    turned = jnp.sum(wrap(jnp.diff(angle, axis=0)), axis=0)
    straight = wrap(angle[-1] - angle[0])
    return jnp.round((turned - straight) / (2.0 * np.pi)).astype(jnp.int32)
