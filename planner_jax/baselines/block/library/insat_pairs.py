"""Motions of a library by INSAT: for each pair of cells the motion of least duration.

This is [Natarajan2024, Algorithm 1]. For equidistant points of the line between the two cells'
centres, inverse kinematics finds poses of the arm with the shield orthogonal to the line. INSAT
plans a spline from the start pose to each of them, and the quickest motion is stored. As in
`pairs`, the line is the parabola of a ball that flies from centre to centre, and its points are
equidistant in time. Poses to which even the quickest motion without obstacles takes longer than the
best motion so far are left out, which changes no result.

Libraries store motions whose rates are linear between equidistant knots. `find_steps` converts a
spline to such a motion, which ends at the same angles. The referee judges every motion before it is
stored.
"""

import functools
import time

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.baselines.block.b_spline import basis, hodograph
from planner_jax.baselines.block.free_space import FreeSpace
from planner_jax.baselines.block.insat import CONTROL_POINTS, DEGREE, InsatBlock
from planner_jax.baselines.block.library.cells import Tunnels, nominal_ball
from planner_jax.baselines.block.library.pairs import PairCase, PairPlanner
from planner_jax.baselines.block.library.table import Setting
from planner_jax.baselines.block.pose_by_pose import Goal
from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.protocol import Status
from planner_jax.optimise.lbfgs import LbfgsConfig
from planner_jax.referee.block import referee_blocks
from planner_jax.robot.arm_motion import least_times, polynomial, step_weights
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan

# The library is built offline, so that splines are optimised for more iterations than online.
PLANNER = InsatBlock(solver=LbfgsConfig(max_steps=24), norms=(8.0, 64.0))
_SPARE = 1e-4  # additional relative duration of a motion, because of rounding errors


def find_steps(
    points: np.ndarray, pieces: int, velocity: np.ndarray, acceleration: np.ndarray
) -> tuple[np.ndarray, float]:
    """Convert a spline to a motion whose rates are linear between knots, at its least duration.

    A parabola is added to the rates of each joint, so that the motion ends where the spline ends.

    Args:
        points: (7, n) [rad], control points of a spline that starts at standstill.
        pieces: number K of pieces of the motion.
        velocity: (n,) [rad/s], limits of the joints.
        acceleration: (n,) [rad/s^2], limits of the joints.

    Returns:
        Joint rates at the ends of the pieces, times the duration (K, n) [rad], and the duration
        [s].
    """
    shares = np.arange(1, pieces + 1) / pieces
    rates = basis(DEGREE - 1, CONTROL_POINTS - 1, shares) @ hodograph(DEGREE, 1, CONTROL_POINTS)
    steps, weights = rates @ points, step_weights(pieces, (1.0,))[1][0]
    bump = shares * (1.0 - shares)
    steps += np.outer(bump, points[-1] - points[0] - weights @ steps) / (weights @ bump)
    rises = pieces * np.abs(np.diff(steps, axis=0, prepend=0.0))
    least = max(np.max(np.abs(steps) / velocity), np.sqrt(np.max(rises / acceleration)))
    return steps, float((1.0 + _SPARE) * max(least, 1e-3))


@jax.jit
def _list_goals(planner: PairPlanner, pair: PairCase) -> tuple[Array, Array, Array, Array]:
    """Return angles (C, 6) [rad] of end poses, whether they exist, when they meet the ball [s].

    The times (C,) count from the ball's entry. The last result has the durations (C,) [s] of the
    quickest motions without obstacles.
    """
    poses, limits = planner.poses(pair), planner.setting.limits
    span = nominal_ball(pair.outer, pair.inner)[1]
    shares = np.repeat(np.arange(1, planner.points + 1) / (planner.points + 1), 8)
    given = jnp.zeros_like(planner.home), limits.velocity, limits.acceleration
    of_pose = lambda turn: least_times(turn, *given, planner.setting.ends_at_rest)[0]  # noqa: E731
    least = jnp.max(jax.vmap(of_pose)(poses.angles - planner.home[None]), axis=1)
    after = jnp.asarray(shares, span.dtype) * span
    return poses.angles, jnp.isfinite(poses.effort), after, least


_case_of = jax.jit(lambda planner, pair, entry: planner.case_of(pair, entry)[0])
_polynomial = jax.jit(polynomial)


def plan_pairs_by_insat(
    setting: Setting, home: np.ndarray, tunnel: Tunnels, pairs: np.ndarray, *, budget: float = 0.5
) -> tuple[np.ndarray, np.ndarray]:
    """Plan the motion of least duration for each of N pairs of cells.

    Args:
        setting: arm, limits and scene, with NumPy leaves.
        home: (6,) [rad], joint angles at which motions start.
        tunnel: tunnels of all pairs.
        pairs: (N,), numbers of the pairs to plan for.
        budget: [s], longest search for one end pose.

    Returns:
        point: (N, 6 K + 1), motions as in `PairPlan.point`; 0 without a motion.
        entry: (N,) [s], when the ball that the motion blocks enters the outer box; infinite
            without a motion.
    """
    planner = PairPlanner(setting, host_leaf(home, np.float32))
    size = 6 * planner.online.pieces + 1
    points, entries = np.zeros((len(pairs), size), np.float32), np.full(len(pairs), np.inf)
    for k, number in enumerate(pairs):
        pair = PairCase(
            outer=host_leaf(tunnel.outer[number], np.float32),
            inner=host_leaf(tunnel.inner[number], np.float32),
            is_coarse=host_leaf(False),
            best=host_leaf(np.inf, np.float32),
            start=host_leaf(0, np.int32),
            given=host_leaf(np.zeros(size), np.float32),
        )
        points[k], entries[k] = _plan_pair(planner, pair, budget)
    return points, entries.astype(np.float32)


def _plan_pair(planner: PairPlanner, pair: PairCase, budget: float) -> tuple[np.ndarray, float]:
    goals, exists, after, least = map(np.asarray, _list_goals(planner, pair))
    case = jax.device_get(_case_of(planner, pair, np.float32(0.0)))
    PLANNER.compile(case)
    free = FreeSpace(case, PLANNER.margin)
    limits = (np.asarray(case.limits.velocity, float), np.asarray(case.limits.acceleration, float))
    possible = np.flatnonzero(exists & free.is_free(goals))
    best, quickest, entry = np.asarray(pair.given), np.inf, np.inf
    for k in possible[np.argsort(least[possible])]:
        if least[k] >= quickest:
            break
        until = time.perf_counter() + budget
        left = lambda until=until: until - time.perf_counter()  # noqa: E731
        found = PLANNER.find_spline(case, free, Goal(goals[k], quickest), left)
        if found is None:
            continue
        steps, duration = find_steps(found.points, planner.online.pieces, *limits)
        arrives = np.float32(duration - after[k])
        ball = jax.device_get(_case_of(planner, pair, arrives))
        if duration < quickest and _is_accepted(ball, free, steps, duration):
            best, quickest, entry = np.append(steps, duration), duration, float(arrives)
    return best, entry


def _is_accepted(case: BlockCase, free: FreeSpace, steps: np.ndarray, duration: float) -> bool:
    """Return whether a motion keeps its distance from obstacles and the referee accepts it."""
    leaf = functools.partial(host_leaf, dtype=np.float32)
    motion = _polynomial(case.angles, np.zeros_like(case.angles), leaf(steps), leaf(duration))
    if not free.is_motion_free(*(np.asarray(x, float) for x in (motion.coeffs, motion.durations))):
        return False
    plan = BlockPlan(
        motion=motion,
        contact_time=leaf(duration),
        cost=leaf(duration),
        violation=leaf(0.0),
        iterations=host_leaf(0, np.int32),
        status=host_leaf(Status.FEASIBLE, np.int32),
    )
    cases, plans = jax.tree.map(lambda x: np.asarray(x)[None], (case, plan))
    return bool(np.all(referee_blocks(cases, plans).success))
