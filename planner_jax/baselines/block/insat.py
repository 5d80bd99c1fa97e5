"""The planner `insat` of [Natarajan2024]: a search over joint steps, interleaved with splines.

This is Algorithm 2 of the paper. The search over joint angles (states) is weighted A*, as in
`epase`. When the search expands a state, it computes a spline from the start to that state. For
this purpose the spline of each ancestor is extended straight to the state, control points are
fitted to each extension, and all these splines are optimised at once. The cheapest collision-free
spline becomes the state's spline. From every expanded state, a spline to the goal is tried.

A spline q(t) of duration t_f has degree 3 and 7 control points; the authors' code has 4 to 7.
Velocity and acceleration are bounded at the control points of the derivatives. With only 4 control
points these bounds would double the duration of a motion between standstills. The objective (eq.
4a)

    w_1 t_f + w_2 int_0^{t_f} |q'(t)|_2 dt,    w_1 = 1, w_2 = 0.1,

is minimised over the control points and t_f, between given positions (eq. 4f). The splines are
twice continuously differentiable (eq. 4b). The arm stands still at the start, and at the goal if
the case requires it (eq. 4g). Velocities have bounds (eq. 4d), and t_f is at least 0.1 s (eq. 4e).
For given control points the least t_f within the bounds is a maximum in closed form, so that every
iterate keeps the bounds. The maximum is smoothed for the gradient. The optimisation ignores
obstacles (eq. 4c): every iterate is checked afterwards, and the last collision-free iterate is
used.

Two parts of the authors' code that the paper does not mention are left out: bounds on jerk, and a
cost that attracts the last control points. The authors' code computes a state's spline when the
edge to the state is found, not when the state is expanded. The search uses one thread.
"""

import dataclasses
import functools
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.baselines.block.b_spline import b_spline, basis, hodograph
from planner_jax.baselines.block.epase import OpenStates, State
from planner_jax.baselines.block.free_space import FreeSpace
from planner_jax.baselines.block.pose_by_pose import Clock, Goal, HostMotion, PoseByPose
from planner_jax.core.arithmetic import host_leaf
from planner_jax.optimise import lbfgs
from planner_jax.penalties.paths import polyline_length, spline_cost
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan

DEGREE = 3  # degree of the splines
CONTROL_POINTS = 7  # number of control points of a spline
ANCESTORS = 8  # number of splines optimised at once: from the start and the nearest ancestors
LEAST_TIME = 0.1  # [s], least duration of a spline
_SHARES = np.linspace(0.0, 1.0, 33)  # sample times, as fractions of a spline's duration
_OUTSIDE = 100.0  # [1/rad^2], penalty weight of control points beyond the position limits
_NORM = 16  # exponent of the norm that replaces the maximum in the objective
_UNIT = 0.3  # [rad], unit of the optimiser's variables, which are joint angles


@struct.dataclass
class Bounds:
    """Limits of six joints that a spline must keep: angles, velocities and accelerations."""

    lower: Array  # (6,) [rad]
    upper: Array  # (6,) [rad]
    velocity: Array  # (6,) [rad/s]
    acceleration: Array  # (6,) [rad/s^2]


@struct.dataclass
class Splines:
    """All K iterates of an optimisation of several (A) splines of joint angles at once."""

    points: Array  # (A, K, m, 6) [rad], m control points
    time: Array  # (A, K) [s], duration
    length: Array  # (A, K) [rad], length of the path in joint space
    angles: Array  # (A, K, S, 6) [rad], joint angles at S samples


@dataclasses.dataclass(frozen=True)
class InsatBlock(PoseByPose):
    """The planner `insat`: weighted A* over joint steps, interleaved with spline optimisation."""

    pieces: ClassVar[int] = CONTROL_POINTS - DEGREE + 1  # the spline's pieces and an initial wait
    degree: ClassVar[int] = DEGREE
    # [s], longest search for one end pose. Few searches that take longer succeed.
    longest: float = 0.05
    weight: float = 10.0  # factor on the heuristic (distance to the goal) in weighted A*
    solver: lbfgs.LbfgsConfig = lbfgs.LbfgsConfig(max_steps=12)

    def plan_of(self, case: BlockCase) -> BlockPlan:
        """Return the plan of one case; compile first, so that only the search is timed."""
        _compile(case.arm.num, np.asarray(case.angles).dtype, self.solver)
        return super().plan_of(case)

    def motion_to(
        self, case: BlockCase, free: FreeSpace, goal: Goal, left: Clock
    ) -> HostMotion | None:
        """Return the first collision-free spline to the goal that the search finds, or None.

        It lasts at most `goal.available` [s], so that the arm is there before the ball. `free`
        checks collisions, and `left` returns the remaining search time [s].
        """
        start = np.asarray(case.angles, float)
        first = State(start, 0.0, spline=start[None])
        states = OpenStates(first, np.asarray(goal.angles, float), self.weight)
        while left() > 0.0 and (state := states.pop()) is not None:
            if state.spline is None and not self.lift(case, free, goal, state):
                continue
            end = State(goal.angles, np.inf, state)
            found = self.best_spline(case, free, goal, end, bool(case.ends_at_rest))
            if found is not None:
                return _motion(case, goal, *found[:2])
            neighbours = states.steps_from(state)
            if neighbours:
                ends = np.stack([new.angles for new in neighbours])
                for k in np.flatnonzero(free.are_edges_free(state.angles, ends)):
                    states.push(neighbours[k])
        return None

    def lift(self, case: BlockCase, free: FreeSpace, goal: Goal, state: State) -> bool:
        """Store in `state` the cheapest spline that leads to it; return whether one exists."""
        found = self.best_spline(case, free, goal, state, rests=False)
        if found is None:
            return False
        _, _, state.length, state.spline = found
        return True

    def best_spline(
        self, case: BlockCase, free: FreeSpace, goal: Goal, state: State, rests: bool
    ) -> tuple[np.ndarray, float, float, np.ndarray] | None:
        """Return the cheapest collision-free spline from the start to a state, or None.

        The cost is (duration [s]) + 0.1 (length [rad]), as in [Natarajan2024, eq. 4a]. A spline
        lasts at most `goal.available` [s]. Each candidate extends the spline of one ancestor of the
        state. If `rests` is True, the arm must stand still at the end.

        Returns:
            The spline's control points (m, 6) [rad], its duration [s], its length [rad] and its
            joint angles at samples (S, 6) [rad].
        """
        before = [each.spline for each in state.path()[1:] if each.spline is not None]
        dtype = case.angles.dtype
        before = before[: ANCESTORS - 1] + before[ANCESTORS - 1 :][-1:]
        guesses = np.stack([_fit_points(path, state.angles, rests) for path in before])
        filled = np.concatenate([guesses, np.repeat(guesses[:1], ANCESTORS - len(before), axis=0)])
        splines = jax.tree.map(
            lambda leaf: np.asarray(leaf)[: len(before)],
            _optimise(
                case.angles,
                state.angles.astype(dtype),
                filled.astype(dtype),
                rests,
                Bounds(
                    case.arm.lower, case.arm.upper, case.limits.velocity, case.limits.acceleration
                ),
                self.solver,
            ),
        )
        good = splines.time <= goal.available
        # Every eighth sample is checked first, which rejects most iterates that collide.
        is_first = np.arange(len(_SHARES)) % 8 == 0
        for some in (is_first, ~is_first):
            if good.any():
                samples = splines.angles[good][:, some]
                good[good] = (
                    free.is_free(samples.reshape(-1, samples.shape[-1]))
                    .reshape(samples.shape[:2])
                    .all(1)
                )
        last = good.shape[1] - 1 - np.argmax(good[:, ::-1], axis=1)
        each = np.arange(len(before))
        cost = spline_cost(splines.length, splines.time)
        cost = np.where(good[each, last], cost[each, last], np.inf)
        for k in np.argsort(cost)[: np.isfinite(cost).sum()]:
            place = k, last[k]
            points, time = splines.points[place], float(splines.time[place])
            if free.is_motion_free(*_pieces(points, time)):
                return points, time, float(splines.length[place]), splines.angles[place]
        return None


@functools.cache
def _compile(num: int, dtype: np.dtype, config: lbfgs.LbfgsConfig) -> None:
    """Compile the spline programs before the search, so that its time does not count."""
    joints = host_leaf(np.zeros(num, dtype))
    guesses = np.zeros((ANCESTORS, CONTROL_POINTS, num), dtype)
    bounds = Bounds(joints, joints, joints + 1, joints + 1)
    _optimise(joints, joints, host_leaf(guesses), host_leaf(False), bounds, config)
    _pieces(guesses[0], 1.0)


def _fit_points(path: np.ndarray, end: np.ndarray, rests: bool) -> np.ndarray:
    straight = path[-1] + _SHARES[1:, None] * (end - path[-1])
    curve = np.concatenate([path, straight])
    lengths = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1)))
    places = _SHARES * lengths[-1]
    samples = np.stack([np.interp(places, lengths, joint) for joint in curve.T], axis=1)
    points = np.stack([path[0]] * 2 + [end] * (CONTROL_POINTS - 2))
    free = slice(2, CONTROL_POINTS - (2 if rests else 1))
    of_points, of_free = _fit_matrices(free.stop)
    points[free] += of_free @ (samples - of_points @ points)
    return points


@functools.cache
def _fit_matrices(stop: int) -> tuple[np.ndarray, np.ndarray]:
    of_points = basis(DEGREE, CONTROL_POINTS, _SHARES)
    return of_points, np.linalg.pinv(of_points[:, 2:stop])


@functools.partial(jax.jit, static_argnames="config")
def _optimise(
    start: Array,
    end: Array,
    guesses: Array,
    rests: Array,
    bounds: Bounds,
    config: lbfgs.LbfgsConfig,
) -> Splines:
    """Minimise duration + 0.1 * length of A splines between two poses; return all K iterates.

    Args:
        start: (6,) [rad], joint angles at the start.
        end: (6,) [rad], joint angles at the end.
        guesses: (A, m, 6) [rad], m control points of each spline; they are the first iterates.
        rests: () bool, whether the arm stands still at the end.
        bounds: limits of the joints.
        config: settings of the optimiser.
    """
    num, dtype = guesses.shape[1], guesses.dtype
    first, second = (jnp.asarray(hodograph(DEGREE, k, num), dtype) for k in (1, 2))
    of_points = jnp.asarray(basis(DEGREE, num, _SHARES), dtype)

    def product(a: Array, b: Array) -> Array:
        return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)

    def points_of(x: Array) -> Array:
        moved = _UNIT * x.reshape(num - 3, start.size)
        before = jnp.where(rests, end, moved[-1])
        return jnp.concatenate([start[None], start[None], moved[:-1], before[None], end[None]])

    def squares_of(points: Array) -> Array:
        rates = (product(first, points) / bounds.velocity) ** 2
        rises = jnp.abs(product(second, points)) / bounds.acceleration
        return jnp.maximum(jnp.concatenate([rates, rises]), LEAST_TIME**2)

    def length_of(points: Array) -> tuple[Array, Array]:
        angles = product(of_points, points)
        return angles, polyline_length(angles)

    def objective(x: Array) -> lbfgs.Evaluation:
        points = points_of(x)
        squares = squares_of(points)
        most = lax.stop_gradient(jnp.max(squares))
        total = jnp.sum((squares / most) ** (_NORM // 2))
        time = jnp.sqrt(most) * total ** (1.0 / _NORM)
        beyond = jnp.maximum(jnp.maximum(points - bounds.upper, bounds.lower - points), 0.0)
        cost = spline_cost(length_of(points)[1], time)
        return lbfgs.Evaluation(cost + _OUTSIDE * jnp.sum(beyond**2), jnp.zeros((), dtype))

    def of_one(guess: Array) -> Splines:
        x = (guess[2:-1] / _UNIT).reshape(-1)

        def next_one(state: lbfgs.LbfgsState, _: None) -> tuple[lbfgs.LbfgsState, Array]:
            state = lbfgs.step(objective, state, config)
            return state, state.point

        _, later = lax.scan(next_one, lbfgs.init(x, config), length=config.max_steps)
        points = jax.vmap(points_of)(jnp.concatenate([x[None], later]))
        angles, length = jax.vmap(length_of)(points)
        time = jax.vmap(lambda points: jnp.sqrt(jnp.max(squares_of(points))))(points)
        return Splines(points=points, time=time, length=length, angles=angles)

    return jax.vmap(of_one)(guesses)


_of_points = jax.jit(functools.partial(b_spline, DEGREE))


def _pieces(points: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
    spline = _of_points(points, time)
    return np.asarray(spline.coeffs, float), np.asarray(spline.durations, float)


def _motion(case: BlockCase, goal: Goal, points: np.ndarray, time: float) -> HostMotion:
    # An arm that may move at the end waits first, so that it arrives together with the ball.
    coeffs, durations = _pieces(points, time)
    if not case.ends_at_rest:
        wait = np.zeros((1, DEGREE + 1, case.arm.num))
        wait[0, 0] = case.angles
        coeffs = np.concatenate([wait, coeffs])
        durations = np.append(goal.available - time, durations)
    return HostMotion(coeffs, durations, time)
