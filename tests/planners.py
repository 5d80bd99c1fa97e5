"""Planners of every task and of a user's task, each with a function that draws its problems."""

import dataclasses
import functools
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from test_block_library import make_library

import planner_jax as pj
from planner_jax.baselines.block.library.planner import LibraryBlock
from planner_jax.baselines.intercept.projection import Projection
from planner_jax.baselines.intercept.static_paths import PathSource
from planner_jax.baselines.parts.lbfgs_lite import LiteRule
from planner_jax.core.outcome import outcome
from planner_jax.core.planner import Kind
from planner_jax.core.protocol import BaseAttempt, Plan
from planner_jax.optimise.levenberg import LevenbergConfig
from planner_jax.optimise.settings import Attempt, LbfgsConfig
from planner_jax.plane.reach import Lattice
from planner_jax.task.block.search.attempts import Search as BlockSearch
from planner_jax.task.intercept.problem.motion_problem import MotionProblem
from planner_jax.task.intercept.searches import Search

NUM = 6  # Number of cases in a batch, which fits into the smallest padded batch size.

# The following classes define a task as a user would: approach a point in the plane.


@struct.dataclass
class Place:
    goal: Array  # (2,), position of the goal
    reach: Array  # (), greatest permitted distance from the goal

    @property
    def batch_shape(self):
        return np.shape(self.reach)


@struct.dataclass
class Stand(Plan):
    point: Array  # (2,), the point that is reached


def places(num):
    goals = np.random.default_rng(0).uniform(-1.0, 1.0, (num, 2)).astype(np.float32)
    return Place(goals, np.full(num, 0.4, np.float32))


@struct.dataclass
class LibraryPlanner(pj.Planner):
    """A planner that selects the stored point nearest to the goal, of 8 points and then of 64."""

    points: Array  # (K, 2), stored points
    attempts: ClassVar[tuple[BaseAttempt, ...]] = (BaseAttempt(1), BaseAttempt(2))
    case_type: ClassVar[type] = Place

    def solve(self, case: Place, attempt: BaseAttempt) -> Stand:
        points = self.points[: 8 * attempt.starts**3]
        along = jnp.matmul(points, case.goal, precision=lax.Precision.HIGHEST)
        away = jnp.sum(points**2, axis=1) - 2.0 * along + jnp.sum(case.goal**2)
        nearest = jnp.argmin(away)
        excess = jnp.sqrt(jnp.maximum(away[nearest], 0.0)) - case.reach
        return Stand(point=points[nearest], **outcome(away[nearest], excess, stationary=False))


@dataclasses.dataclass(frozen=True)
class NumpyPlanner(pj.Planner):
    """A planner in NumPy that steps by 0.5 towards the goal, and by 1 in its second attempt."""

    attempts: ClassVar[tuple[BaseAttempt, ...]] = (BaseAttempt(1), BaseAttempt(2))
    case_type: ClassVar[type] = Place

    def solve_on_host(self, cases: Place, attempt: BaseAttempt) -> Stand:
        away = np.linalg.norm(cases.goal, axis=1)
        share = np.minimum(0.5 * attempt.starts / away, 1.0)[:, None]
        point = share * cases.goal
        left = np.linalg.norm(cases.goal - point, axis=1)
        fields = jax.vmap(outcome)(left, left - cases.reach)
        return Stand(point=point, **jax.tree.map(np.asarray, fields))


def library(seed):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (64, 2)).astype(np.float32)


# Settings with which each planner compiles quickly, because compilation takes most of the tests'
# time: two iterations of the optimiser, or none.
FEW = {"attempts": (Attempt(solver=LbfgsConfig(max_steps=2, memory=1, trial_steps=(1.0,))),)}
NONE = {"attempts": (Attempt(solver=LbfgsConfig(max_steps=0)),)}
# Several test modules plan blocks with these settings, so that they share compiled programs.
SMALL_SEARCH = {
    "pieces": 6,
    "points": 10,
    "searches": (BlockSearch(straight=12, tries=3, solver=LevenbergConfig(8)),),
}
SHORT = {"proportions": (0.2, 0.5, 1.0, 1.0, 1.0, 1.0), "nodes": 3}


@dataclasses.dataclass(frozen=True)
class Entry:
    """A planner that is tested, with a function that draws its cases."""

    planner: Any
    cases: Any  # function that draws a given number of cases
    broken: str  # name of a floating-point array of the case, which tests fill with NaN
    gradient: dict[str, Any] | None = None  # arguments of `pj.gradient`; None without a gradient

    @functools.cached_property
    def batch(self):
        return jax.tree.map(np.asarray, self.cases(NUM))

    @functools.cached_property
    def plans(self):
        return pj.plan(self.planner, self.batch)

    @property
    def on_host(self):
        return self.planner.kind is Kind.HOST


def hit(name, gradient, **options):
    return Entry(pj.hit.planner(name, **options), pj.hit.draw, "ball.pos", gradient)


def catch(name, suite, gradient, **options):
    cases = lambda num: pj.catch.draw(num, suite, 4)  # noqa: E731
    return Entry(pj.catch.planner(name, **options), cases, "targets.ball.vel", gradient)


def path_then_speed(name, **options):
    small = MotionProblem(pieces=12, samples=2, checked=2)
    source = PathSource(problem=small, drawn=2, later=2, points=33)
    projection = Projection(runs=1, slabs=2)
    step = pj.intercept.planner(name).step
    speed = step.speed and dataclasses.replace(step.speed, pieces=4)
    step = dataclasses.replace(step, speed=speed, projection=projection, pieces=40)
    searches = (Search(2, LevenbergConfig(15), lattice=Lattice(layers=20)),)
    options |= {"source": source, "step": step, "searches": searches}
    draw = lambda num: pj.intercept.draw(num, "easy", 4)  # noqa: E731
    return Entry(pj.intercept.planner(name, **options), draw, "start")


def block(name, suite="pole", **options):
    cases = lambda num: pj.block.draw(num, suite, 8, regime="R1", wide=True)  # noqa: E731
    return Entry(pj.block.planner(name, **options), cases, "ball.vel")


def with_room(cases):
    """Return a batch of interceptions with room for as many obstacles as `pj.intercept.case` has.

    Absent obstacles come first, and each last corner is repeated. All tests that plan with
    `ONE_SEARCH` thus share one compiled program.
    """

    def fill(leaf):
        leaf = np.asarray(leaf)
        return np.concatenate([np.zeros_like(leaf[:, :1])] * (16 - leaf.shape[1]) + [leaf], axis=1)

    def widen(group):
        corners = np.asarray(group.corners)
        last = [corners[:, :, -1:]] * (8 - corners.shape[2])
        wide = group.replace(corners=np.concatenate([corners, *last], axis=2))
        return jax.tree.map(lambda leaf: jnp.asarray(fill(leaf)), wide)

    return cases.replace(walls=widen(cases.walls), movers=widen(cases.movers))


BY_NET = {"of": lambda plan: plan.times[-1], "by": "net"}
ONE_SEARCH = (Search(12, lattice=Lattice(layers=22)),)
ENTRIES = {
    "hit exact": hit("exact", {"of": "cost", "by": "racket_height", "steps": 0}, **SHORT, **NONE),
    "hit bat": hit(
        "bat", {"of": "cost", "by": ["target", "gravity"]}, nodes=6, rule=LiteRule(max_steps=0)
    ),
    "hit bat-fitted": hit("bat-fitted", {"of": "cost", "by": "target"}, nodes=6, **NONE),
    "hit bat-lite-fitted": hit(
        "bat-lite-fitted", {"of": "stroke.time", "by": "limits"}, nodes=6, **NONE
    ),
    "hit juggle": hit("juggle", None, nodes=6),
    "catch exact": catch("exact", "throws", BY_NET, decide="greedy", nodes=3, **FEW),
    "catch catch": catch(
        "catch", "throws", {"of": "cost", "by": "net.height"}, decide="given", nodes=6, **NONE
    ),
    "catch mpp": catch(
        "mpp", "parabola2", None, decide=pj.catch.Best(finalists=2), speeds=(0.0, 1.0), nodes=6
    ),
    "intercept spacetime": Entry(
        pj.intercept.planner(searches=ONE_SEARCH),
        lambda num: with_room(pj.intercept.draw(num, "easy", 4)),
        "start",
        {"of": "cost", "by": "time", "steps": 0},
    ),
    "intercept lattice": path_then_speed("lattice"),
    "intercept em": path_then_speed("em", tries=1),
    "intercept constant": path_then_speed("constant", tries=1),
    "block online": block("online", **SMALL_SEARCH),
    "block brisk": block("brisk", **SMALL_SEARCH),
    "block direct": block("direct", points=6),
    "block insat": block("insat", "open", points=6, budget=20.0, longest=20.0),
    "block library": Entry(
        LibraryBlock(make_library(regime="R1")),
        lambda num: pj.block.draw(num, "pole", 8, regime="R1", anywhere=True),
        "ball.vel",
    ),
    "library": Entry(LibraryPlanner(library(1)), places, "goal"),
    "NumPy": Entry(NumpyPlanner(), places, "goal"),
}
