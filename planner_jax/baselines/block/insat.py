"""The planners `insat` and `pinsat`: a search over joint steps, interleaved with splines.

This is Algorithm 2 of [Natarajan2024]. The search over joint angles (states) is ePA*SE, as in
`epase`; with a `width` of 1 it is weighted A*. The paper leaves its parallel version, PINSAT, to
[Natarajan2024pinsat]. Each state has a spline from the start. With the setting lift="edge", as in
Algorithm 2, a spline is computed for every successor x of an expanded state, in three steps:

1. For each ancestor of x, a spline from the ancestor to x is optimised (TRAJOPT).
2. If this spline is free of collisions, it is appended to the ancestor's spline. Control points
   are fitted to both, and optimised to one spline from the start to x (WARMSTARTOPT).
3. The collision-free spline of least cost becomes the spline of x, and its ancestor the parent.

With lift="expansion" a state gets its spline only when it is expanded, and step 1 is a straight
joint motion. From every expanded state a spline to the goal is tried first, as in the authors'
code. All splines of a batch of states are optimised in one call. States are ordered by the length
of their splines in joint space, which is the g of the authors' code.

A spline x(t) of duration t_f has degree 3 and 7 control points; the authors' code has 4 to 7.
Velocity and acceleration are bounded at the control points of the derivatives. With only 4 control
points these bounds would double the duration of a motion between standstills. The control points
and t_f solve

    min  w_1 t_f + w_2 int_0^{t_f} |x'(t)|_2 dt               [Natarajan2024, eq. 4a]
    s.t. x twice continuously differentiable                  (eq. 4b)
         x(t) free of collisions                              (eq. 4c)
         |x'(t)| <= limits, |x''(t)| <= limits                (eq. 4d, without accelerations)
         t_min <= t_f <= t_max                                (eq. 4e)
         x(0) and x(t_f) given                                (eq. 4f)
         x'(0) = 0, and x'(t_f) = 0 if the arm must end at rest    (eq. 4g)

For given control points the least t_f within the bounds is a maximum in closed form, so that every
iterate keeps the bounds. The maximum is smoothed for the gradient. The optimisation ignores
obstacles and t_max: every iterate is checked afterwards, and the last iterate that passes is used.
Splines to inner states are checked at 33 samples, a spline to the goal at samples that are at most
0.0167 rad apart.

Two parts of the authors' code that the paper does not mention are left out: bounds on jerk, and a
cost that attracts the last control points.
"""

import dataclasses
import functools
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.baselines.block.b_spline import b_spline, basis, hodograph
from planner_jax.baselines.block.epase import OpenStates, State, are_edges_free, list_steps, search
from planner_jax.baselines.block.free_space import FreeSpace
from planner_jax.baselines.block.pose_by_pose import Clock, Goal, HostMotion, PoseByPose
from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.choices import require, require_one_of
from planner_jax.optimise import lbfgs
from planner_jax.penalties.paths import WEIGHTS, polyline_length, spline_cost
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan

DEGREE = 3  # degree of the splines
CONTROL_POINTS = 7  # number of control points of a spline
ANCESTORS = 8  # number of a state's ancestors that are tried: the nearest ones and the start
_SHARES = np.linspace(0.0, 1.0, 33)  # sample times, as fractions of a spline's duration
_SAMPLES = basis(DEGREE, CONTROL_POINTS, _SHARES)  # (33, 7), from control points to samples
_OUTSIDE = 100.0  # [1/rad^2], penalty weight of control points beyond the position limits
_UNIT = 0.3  # [rad], unit of the optimiser's variables, which are joint angles


@struct.dataclass
class Terms:
    """Limits of n joints and of the duration that a spline must keep, and weights of its cost."""

    lower: Array  # (n,) [rad]
    upper: Array  # (n,) [rad]
    velocity: Array  # (n,) [rad/s]
    acceleration: Array  # (n,) [rad/s^2]
    least_time: Array  # () [s]
    weights: Array  # (2,) [1/s], [1/rad], w_1 and w_2 of eq. 4a
    norms: Array  # (K - 1,), exponent of the norm that replaces a maximum, in each iteration


@struct.dataclass
class Splines:
    """N splines of joint angles: all K iterates of an optimisation, or one iterate (no axis K)."""

    points: Array | np.ndarray  # (N, K, m, n) [rad], m control points
    time: Array | np.ndarray  # (N, K) [s], duration
    length: Array | np.ndarray  # (N, K) [rad], length of the path in joint space


class Lift(NamedTuple):
    """A collision-free spline from the start to a state."""

    state: State
    parent: State  # the ancestor whose spline it extends
    points: np.ndarray  # (m, n) [rad], control points
    time: float  # [s], duration
    length: float  # [rad], length of the path in joint space

    def store(self) -> None:
        """Store the spline and the parent in the state."""
        state = self.state
        state.spline, state.length = _SAMPLES @ self.points, self.length
        state.parent = self.parent


@dataclasses.dataclass(frozen=True)
class InsatBlock(PoseByPose):
    """The planner `insat`: a search over joint steps, interleaved with spline optimisation."""

    pieces: ClassVar[int] = CONTROL_POINTS - DEGREE + 1  # the spline's pieces and an initial wait
    degree: ClassVar[int] = DEGREE
    # [s], longest search for one end pose. Few searches that take longer succeed.
    longest: float = 0.05
    weight: float = 10.0  # factor on the heuristic (distance to the goal) in weighted A*
    width: int = 1  # greatest number of states that are expanded at once
    lift: str = "edge"  # whether a state's spline is computed with its "edge" or its "expansion"
    weights: tuple[float, float] = WEIGHTS  # [1/s], [1/rad], of duration and length in the cost
    # [s], least and greatest duration of a spline. A spline also ends before the ball arrives.
    duration: tuple[float, float] = (0.1, np.inf)
    # Exponents of the norm that replaces a maximum, in the first and in the last iteration.
    norms: tuple[float, float] = (16.0, 16.0)
    solver: lbfgs.LbfgsConfig = lbfgs.LbfgsConfig(max_steps=12)

    def __post_init__(self) -> None:
        super().__post_init__()
        require_one_of(("edge", "expansion"), "lift", self.lift)
        for name, least in (("weights", 0.0), ("duration", 1e-3), ("norms", 1.0)):
            value = getattr(self, name)
            is_valid = len(value) == 2 and min(value) >= least
            require(is_valid, name, f"two numbers >= {least:g}", list(value))

    def plan_of(self, case: BlockCase) -> BlockPlan:
        """Return the plan of one case; compile first, so that only the search is timed."""
        self.compile(case)
        return super().plan_of(case)

    def compile(self, case: BlockCase) -> None:
        """Compile the spline programs for the joints of a case."""
        dtype = np.asarray(case.angles).dtype
        _compile(case.arm.num, dtype, self.solver, self._sizes(case.arm.num))

    def motion_to(
        self, case: BlockCase, free: FreeSpace, goal: Goal, left: Clock
    ) -> HostMotion | None:
        """Return the first collision-free spline to the goal that the search finds, or None.

        It lasts at most `goal.available` [s], so that the arm is there before the ball. `free`
        checks collisions, and `left` returns the remaining search time [s].
        """
        found = self.find_spline(case, free, goal, left)
        return found and _motion(case, goal, found.points, found.time)

    def open_states(self, case: BlockCase, goal: Goal) -> OpenStates:
        """Return the states of a search before its first expansion: the start alone."""
        start = np.asarray(case.angles, float)
        first = State(start, 0.0, spline=np.tile(start, (len(_SHARES), 1)))
        return OpenStates(first, np.asarray(goal.angles, float), self.weight)

    def find_spline(self, case: BlockCase, free: FreeSpace, goal: Goal, left: Clock) -> Lift | None:
        """Return the first collision-free spline to the goal; see `motion_to`."""
        states = self.open_states(case, goal)

        def lift(news: list[State]) -> list[State]:
            for found in self.lifts(case, free, goal, news, rests=False):
                if found.state.spline is None:  # The splines come by rising cost.
                    found.store()
            return [new for new in news if new.spline is not None]

        def expand(some: list[State]) -> tuple[float, Lift | None]:
            lift([each for each in some if each.spline is None])
            ready = [each for each in some if each.spline is not None]
            goals = [State(states.goal, np.inf, each) for each in ready]
            for found in self.lifts(case, free, goal, goals, bool(case.ends_at_rest)):
                if free.is_motion_free(*_pieces(found.points, found.time)):
                    return 0.0, found
            news = states.steps_from(ready)
            news = [news[k] for k in np.flatnonzero(are_edges_free(free, news))]
            for new in lift(news) if self.lift == "edge" else news:
                states.push(new)
            return np.inf, None

        return search(states, self.width, left, expand)

    def lifts(
        self, case: BlockCase, free: FreeSpace, goal: Goal, news: list[State], rests: bool
    ) -> list[Lift]:
        """Return splines from the start to states that have parents, by rising cost (eq. 4a).

        A state has at most one spline for each of its ancestors. Splines last at most
        `goal.available` [s] and are free of collisions at samples. If `rests` is True, the arm
        stands still at the end.
        """
        pairs = [(new, each) for new in news for each in _ancestors(new)]
        if not pairs:
            return []
        begins, ends = (np.stack([pair[k].angles for pair in pairs])[:, None] for k in (1, 0))
        onward = begins + _SHARES[:, None] * (ends - begins)
        settings = case, free, goal, rests
        if self.lift == "edge":
            still = np.repeat(begins, len(_SHARES), axis=1)
            which, edges = self._free_splines(*settings, still, onward)
            pairs, onward = [pairs[k] for k in which], _SAMPLES @ edges.points
        if not pairs:
            return []
        before = np.stack([each.spline for _, each in pairs if each.spline is not None])
        which, splines = self._free_splines(*settings, before, onward)
        points, time, length = (
            np.asarray(leaf) for leaf in (splines.points, splines.time, splines.length)
        )
        cost = self.weights[0] * time + self.weights[1] * length
        return [
            Lift(
                pairs[which[k]][0], pairs[which[k]][1], points[k], float(time[k]), float(length[k])
            )
            for k in np.argsort(cost, kind="stable")
        ]

    def _free_splines(
        self,
        case: BlockCase,
        free: FreeSpace,
        goal: Goal,
        rests: bool,
        before: np.ndarray,
        after: np.ndarray,
    ) -> tuple[np.ndarray, Splines]:
        """Optimise N splines; return the indices of those that are free, and these splines.

        The splines are fitted to the paths `before` and `after` (N, 33, n) [rad]. The path `after`
        starts at the end of the path `before`.
        """
        dtype = np.asarray(case.angles).dtype
        curves = np.concatenate([before, after[:, 1:]], axis=1).astype(dtype)
        num = len(curves)
        size = next(size for size in self._sizes(case.arm.num) if size >= num)
        terms = Terms(
            case.arm.lower,
            case.arm.upper,
            case.limits.velocity,
            case.limits.acceleration,
            host_leaf(self.duration[0], dtype),
            host_leaf(self.weights, dtype),
            host_leaf(np.geomspace(*self.norms, self.solver.max_steps), dtype),
        )
        filled = curves[np.minimum(np.arange(size), num - 1)]
        found = _optimise(filled, np.asarray(rests), terms, self.solver)
        found = jax.tree.map(lambda leaf: np.asarray(leaf)[:num], found)
        return _select_free(free, found, min(goal.available, self.duration[1]))

    def _sizes(self, joints: int) -> tuple[int, ...]:
        """Return the sizes of batches of splines for which programs are compiled."""
        few = ANCESTORS * self.width
        return (few,) if self.lift == "expansion" else (few, 4 * few, len(list_steps(joints)) * few)


@dataclasses.dataclass(frozen=True)
class PinsatBlock(InsatBlock):
    """The planner `pinsat`: `insat`, with the splines of up to `width` states in one call."""

    width: int = 64


def _ancestors(state: State) -> list[State]:
    before = [each for each in state.path()[1:] if each.spline is not None]
    return before[: ANCESTORS - 1] + before[ANCESTORS - 1 :][-1:]


def _select_free(free: FreeSpace, splines: Splines, available: float) -> tuple[np.ndarray, Splines]:
    """Return the indices of splines with a free iterate in time [s], and the last such iterates."""
    lanes, iterates = np.nonzero(splines.time <= available)
    is_free = np.zeros(splines.time.shape, bool)
    newest = is_free.shape[1] - 1
    # The last iterates are checked first, and of each iterate every eighth sample, which rejects
    # most iterates that collide.
    for is_newest in (True, False):
        checked = ((iterates == newest) == is_newest) & ~is_free[lanes, newest]
        some = np.stack([lanes, iterates])[:, checked]
        for samples in (_SAMPLES[::8], np.delete(_SAMPLES, np.s_[::8], axis=0)):
            if some.size:
                angles = samples @ splines.points[tuple(some)]
                flat = free.is_free(angles.reshape(-1, angles.shape[-1]))
                some = some[:, flat.reshape(angles.shape[:2]).all(axis=1)]
        is_free[tuple(some)] = True
    which = np.flatnonzero(is_free.any(axis=1))
    last = newest - np.argmax(is_free[which, ::-1], axis=1)
    return which, jax.tree.map(lambda leaf: leaf[which, last], splines)


@functools.cache
def _compile(num: int, dtype: np.dtype, config: lbfgs.LbfgsConfig, sizes: tuple[int, ...]) -> None:
    """Compile the spline programs before the search, so that its time does not count."""
    shapes = (num,), (num,), (num,), (num,), (), (2,), (config.max_steps,)
    terms = Terms(*(host_leaf(np.ones(shape), dtype) for shape in shapes))
    for size in sizes:
        curves = np.zeros((size, 2 * len(_SHARES) - 1, num), dtype)
        _optimise(curves, np.asarray(False), terms, config)
    _pieces(np.zeros((CONTROL_POINTS, num), dtype), 1.0)


def _product(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)


def _fit_points(curve: Array, rests: Array) -> Array:
    """Return the control points (m, n) of a spline that is fitted to a path (C, n) [rad]."""
    lengths = jnp.cumsum(jnp.sqrt(jnp.sum(jnp.diff(curve, axis=0) ** 2, axis=1)))
    lengths = jnp.concatenate([jnp.zeros_like(lengths[:1]), lengths])
    at = lambda joint: jnp.interp(_SHARES * lengths[-1], lengths, joint)  # noqa: E731
    samples = jax.vmap(at, 1, 1)(curve)
    points = jnp.stack([curve[0]] * 2 + [curve[-1]] * (CONTROL_POINTS - 2))
    off = samples - _product(jnp.asarray(_SAMPLES, curve.dtype), points)

    def correct(stop: int) -> Array:
        of_free = jnp.asarray(np.linalg.pinv(_SAMPLES[:, 2:stop]), curve.dtype)
        return points.at[2:stop].add(_product(of_free, off))

    return jnp.where(rests, correct(CONTROL_POINTS - 2), correct(CONTROL_POINTS - 1))


@functools.partial(jax.jit, static_argnames="config")
def _optimise(curves: Array, rests: Array, terms: Terms, config: lbfgs.LbfgsConfig) -> Splines:
    """Minimise the cost (eq. 4a) of N splines that are fitted to paths; return all K iterates.

    Args:
        curves: (N, C, n) [rad], paths from the start to the end of the splines.
        rests: () bool, whether the arm stands still at the end.
        terms: limits of the splines, and weights of the cost.
        config: settings of the optimiser.
    """
    dtype, num, joints = curves.dtype, CONTROL_POINTS, curves.shape[2]
    first, second = (jnp.asarray(hodograph(DEGREE, k, num), dtype) for k in (1, 2))
    of_points = jnp.asarray(_SAMPLES, dtype)

    def squares_of(points: Array) -> Array:
        rates = (_product(first, points) / terms.velocity[None]) ** 2
        rises = jnp.abs(_product(second, points)) / terms.acceleration[None]
        return jnp.maximum(jnp.concatenate([rates, rises]), terms.least_time**2)

    def of_one(curve: Array) -> Splines:
        guess = _fit_points(curve, rests)

        def points_of(x: Array) -> Array:
            moved = _UNIT * x.reshape(num - 3, joints)
            before = jnp.where(rests, curve[-1], moved[-1])
            return jnp.concatenate([guess[:2], moved[:-1], before[None], guess[-1:]])

        def objective(norm: Array, x: Array) -> lbfgs.Evaluation:
            points = points_of(x)
            squares = squares_of(points)
            most = lax.stop_gradient(jnp.max(squares))
            total = jnp.sum((squares / most) ** (0.5 * norm))
            time = jnp.sqrt(most) * total ** (1.0 / norm)
            lower, upper = terms.lower[None], terms.upper[None]
            beyond = jnp.maximum(jnp.maximum(points - upper, lower - points), 0.0)
            length = polyline_length(_product(of_points, points))
            cost = spline_cost(length, time, terms.weights)
            return lbfgs.Evaluation(cost + _OUTSIDE * jnp.sum(beyond**2), jnp.zeros((), dtype))

        def next_one(state: lbfgs.LbfgsState, norm: Array) -> tuple[lbfgs.LbfgsState, Array]:
            state = lbfgs.step(functools.partial(objective, norm), state, config)
            return state, state.point

        x = (guess[2:-1] / _UNIT).reshape(-1)
        _, later = lax.scan(next_one, lbfgs.init(x, config), terms.norms)
        points = jax.vmap(points_of)(jnp.concatenate([x[None], later]))
        return Splines(
            points=points,
            time=jax.vmap(lambda each: jnp.sqrt(jnp.max(squares_of(each))))(points),
            length=jax.vmap(lambda each: polyline_length(_product(of_points, each)))(points),
        )

    return jax.vmap(of_one)(curves)


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
