"""The default planner of blocks: a straight joint motion if one is free, else least squares.

An end pose is a pose of the arm in which the shield meets the ball, between the outer box and the
protected inner box around the arm. A straight motion follows a straight line in joint space to an
end pose. The planner checks straight motions by rising cost, and returns the first one that is free
of collisions. If there is none, Levenberg-Marquardt optimises end pose, time of contact and motion
together. It starts from straight motions with an added bump (a detour of the joints), until one
start leads to a plan that keeps every limit. [Natarajan2024] takes its motions from a library; this
planner stores only the bumps.
"""

import dataclasses
import functools
from typing import TYPE_CHECKING, ClassVar, Self

import jax
import jax.numpy as jnp
from jax import Array

from planner_jax.core.choices import EFFORTS, require_one_of
from planner_jax.core.compiled import place_numbers
from planner_jax.core.errors import NotOffered
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import require_settings
from planner_jax.core.shapes import fit_resident
from planner_jax.optimise import levenberg
from planner_jax.optimise.levenberg import LevenbergConfig, Model
from planner_jax.robot import arm_motion
from planner_jax.robot.arm_clearance import least_clearances
from planner_jax.robot.scene_sizes import fit_scene
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan, explain_status
from planner_jax.task.block.problem.check import checked_shares, make_plan
from planner_jax.task.block.problem.end_poses import EndPoses, all_profiles, coast
from planner_jax.task.block.problem.flight import Flight, flight_of
from planner_jax.task.block.problem.model import build_model
from planner_jax.task.block.problem.terms import Weights
from planner_jax.task.block.search.attempts import (
    LAST,
    SEARCHES,
    Search,
    StraightSearch,
    count_starts,
    settle_by,
)
from planner_jax.task.block.search.least_squares import (
    rank_end_poses,
    refine_at_once,
    refine_in_turn,
    settle_plan,
)
from planner_jax.task.block.search.straight import plan_straight

if TYPE_CHECKING:
    from planner_jax.task.block.problem.smooth import SmoothBlock
    from planner_jax.task.block.replan import ReplanBlock

_SETTLING = {"good": 24, "best": 48}  # effort -> number of steps that lower the cost


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class OnlineBlock(Planner):
    """Planner of arm motions that block a ball outside a protected box.

    The arm moves until the contact. The cost of a plan is the root mean square, over joints and
    time, of the joints' accelerations divided by their limits. With `brisk` it is the duration [s].

    Attributes:
        pieces: number of pieces of each joint's rate.
        points: number of points of the ball's path for which end poses are computed.
        samples: number of samples of a motion at which least squares compute distances.
        worst: number of samples with the least distances, at which least squares compute
            derivatives.
        checked: number of samples of the returned plan at which limits are checked.
        margin: [m], least distance of the arm from all obstacles and itself. If the arm starts
            nearer, the margin is half of the distance at the start.
        obstacle_margin: [m], least distance from capsules, boxes and cylinders; it covers the gaps
            between samples.
        slack: fraction of every limit that plans leave unused.
        brisk: whether motions from standstill to standstill are as fast as the limits allow: the
            arm then waits for the ball. Otherwise the arm moves until the contact, which needs less
            torque.
        settling: number of steps of least squares that lower the cost of a solved plan, unless
            `brisk` is true. If the number is not 0, all straight motions and starting points of a
            search are compared.
        weights: weights of the terms of least squares.
        searches: searches in their order; each tries the cases that earlier ones left unsolved.
    """

    case_type: ClassVar[type] = BlockCase
    is_sequential: ClassVar[bool] = True
    pieces: int = 10
    points: int = 48
    samples: int = 32
    worst: int = 8
    checked: int = 96
    margin: float = 0.003
    obstacle_margin: float = 0.012
    slack: float = 0.004
    brisk: bool = False
    settling: int = 0
    weights: Weights = Weights()
    searches: tuple[Search, ...] = SEARCHES

    def __post_init__(self) -> None:
        require_settings(self)

    def with_effort(self, effort: str) -> Self:
        """Return a planner that compares motions, and selects the motion of least cost.

        Args:
            effort: "good" compares 48 straight motions, or starting points of least squares if none
                is solved, and lowers the cost of the best plan by up to 24 steps. "best" compares
                straight motions and all starting points, with up to 48 steps for each starting
                point. Both make a last search for balls that are nearly blocked. "feasible" returns
                the planner itself, which ends with the first plan.
        """
        require_one_of(EFFORTS, "effort", effort)
        if effort not in _SETTLING:
            return self
        straight = max(search.straight for search in self.searches)
        bent = tuple(search for search in self.searches if search.tries)
        if effort == "good":
            searches = (Search(straight=straight, tries=0), *bent)
        else:
            solver = dataclasses.replace(self.searches[0].solver, **settle_by(_SETTLING[effort]))
            tries = max(count_starts(bent), 1)
            searches = (Search(straight=straight, tries=tries, solver=solver),)
        settling = _SETTLING[effort]
        return dataclasses.replace(self, searches=(*searches, LAST), settling=settling)

    @property
    def attempts(self) -> tuple[Search, ...]:
        """The searches for a plan, in the order in which they are tried."""
        return self.searches

    def fit_shapes(self, cases: BlockCase) -> BlockCase:
        """Return cases with the same plans, whose scene is padded to one of few shapes."""
        return fit_resident(_fit_case, cases)

    def load_attempt(self, attempt: Search, cases: BlockCase) -> Search:
        """Return a search whose numbers are arrays, so that all searches use one compiled program.

        Searches without least squares use a smaller program for a single case, so that the first
        plan comes early, and for batches on a GPU.
        """
        is_small = cases.batch_shape == () or jax.default_backend() != "cpu"
        is_straight = is_small and not attempt.tries
        return place_numbers(StraightSearch(**vars(attempt)) if is_straight else attempt)

    def compiles_quickly(self, attempt: Search) -> bool:
        """Return whether a search's program is compiled in less time, though it then runs slower.

        This is true for least squares: few cases need them, so that their run time matters less.
        """
        return attempt.tries > 0

    def solve(self, case: BlockCase, attempt: Search) -> BlockPlan:
        """Return the plan of one case: a straight motion, else least squares from starting points.

        The search ends at the first solved plan, unless `settling` requires a comparison.
        """
        if isinstance(attempt, StraightSearch):
            plan, poses = plan_straight(self, case, attempt)
            plan = settle_plan(self, case, flight_of(case), plan)
        else:
            plan, poses = refine_in_turn(self, case, attempt)
        return dataclasses.replace(plan, status=explain_status(poses, plan.status))

    def solve_at_once(self, cases: BlockCase, attempt: Search) -> BlockPlan:
        """Return the plans of a batch, on a GPU: the cases take the steps of searches together."""
        flights = jax.vmap(flight_of)(cases)
        best, poses = jax.vmap(lambda case: plan_straight(self, case, attempt))(cases)
        if not isinstance(attempt, StraightSearch):
            _, poses, orders = jax.vmap(lambda case: rank_end_poses(self, case))(cases)
            best = refine_at_once(self, cases, flights, poses, orders, best, attempt)
        best = jax.vmap(functools.partial(settle_plan, self))(cases, flights, best)
        return dataclasses.replace(best, status=jax.vmap(explain_status)(poses, best.status))

    def refine(
        self, case: BlockCase, flight: Flight, start: Array, solver: LevenbergConfig
    ) -> BlockPlan:
        """Return the plan that least squares find from a start: joint rates and time of contact."""
        end = levenberg.least_squares(lambda point: self.model(point, case, flight), start, solver)
        return self.finish(case, flight, end.point, end.steps)

    def encode_straight(self, case: BlockCase, poses: EndPoses, index: Array) -> Array:
        """Return the unknowns, joint rates and time of contact, of a straight motion to a pose.

        The pose is the entry `index` of `poses`, in which the shield meets the ball.
        """
        time = poses.time[index]
        duration = jnp.maximum(time - case.delay, 1e-3)
        turned = poses.angles[index] - coast(case, duration, self.pieces)
        shapes = jnp.asarray(all_profiles(self.pieces)[0], turned.dtype)
        steps = shapes[poses.profile[index]][:, None] * turned[None]
        return jnp.append(steps.reshape(-1), time)

    def decode(self, case: BlockCase, point: Array) -> tuple[Array, Array, Array]:
        """Split the unknowns into joint rates and a duration.

        Returns:
            The rates after each of K pieces (K, n) and at the start (n,), both multiplied by the
            duration [rad], and the duration () [s].
        """
        steps = point[:-1].reshape(self.pieces, case.arm.num)
        duration = jnp.maximum(point[-1] - case.delay, 1e-3)
        last = jnp.where(case.ends_at_rest, 0.0, steps[-1])
        return steps.at[-1].set(last), case.rates * duration, duration

    def model(self, point: Array, case: BlockCase, flight: Flight) -> Model:
        """Return the cost, a sum of squares, and its quadratic model; see `build_model`."""
        return build_model(self, point, case, flight)

    def finish(self, case: BlockCase, flight: Flight, point: Array, steps: Array) -> BlockPlan:
        """Return the plan of the unknowns `point`, which are joint rates and time of contact.

        Limits are checked at `checked` samples. The plan reports `steps` as its iterations.
        """
        moves, first, _ = self.decode(case, point)
        angles = arm_motion.angles_at(case.angles, first, moves, checked_shares(self))
        gaps = least_clearances(case.arm, case.scene, angles)
        return make_plan(self, case, flight, point, steps, angles, gaps)

    def plan_once(self, cases: BlockCase) -> BlockPlan:
        """Return the plan of one case by a search from all starting points; pure."""
        return self.solve(cases, self.load_attempt(Search(), cases))

    def smooth(self) -> "SmoothBlock":
        """Return the problem whose minima are near this planner's plans."""
        from planner_jax.task.block.problem.smooth import SmoothBlock  # few plans need it

        if self.brisk:
            raise NotOffered(
                "Plans of the planner brisk have no gradient: use online, whose plans are optima"
            )
        return SmoothBlock(dataclasses.replace(self, worst=self.samples, settling=0))

    def replanner(self) -> "ReplanBlock":
        """Return the planner by which `pj.replan` updates motions that are being executed."""
        from planner_jax.task.block.replan import ReplanBlock, WarmBlock

        return ReplanBlock(warm=WarmBlock(planner=self), planner=self)


def _fit_case(case: BlockCase) -> BlockCase:
    scene = fit_scene(case.scene, case.batch_shape)
    return case if scene is case.scene else dataclasses.replace(case, scene=scene)


def brisk(**fields: object) -> OnlineBlock:
    """Make an `OnlineBlock` whose motions end as early as possible; the arm waits for the ball."""
    return OnlineBlock(**{"brisk": True, **fields})
