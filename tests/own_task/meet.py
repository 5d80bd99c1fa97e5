"""A task from outside the library: a point mass in the plane meets a point in uniform motion.

The robot is a double integrator with the acceleration a(t) = b + c t, whose magnitude is limited.
The decision variables are the meeting time and b. The vector c follows from them, so that every
plan meets the target. The planner minimises the meeting time.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from scipy.optimize import minimize

import planner_jax as pj


@struct.dataclass
class MeetCase:
    """The states of robot and target in the plane at time 0, and the acceleration limit."""

    pos: Array  # (2,) [m], of the robot
    vel: Array  # (2,) [m/s]
    target_pos: Array  # (2,) [m]
    target_vel: Array  # (2,) [m/s]
    most: Array  # () [m/s^2], greatest acceleration

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return np.shape(self.most)


@struct.dataclass
class MeetPlan(pj.Plan):
    time: Array  # () [s], of the meeting
    acc: Array  # (2, 2) [m/s^2], at the start and at the meeting


def plan_at(point, case: MeetCase) -> tuple:
    """Return meeting time, and accelerations (2, 2) at both ends, of decision variables `point`."""
    time, first = jnp.exp(point[0]), point[1:]
    way = case.target_pos - case.pos + (case.target_vel - case.vel) * time
    last = 6.0 * way / time**2 - 2.0 * first  # way = (2 first + last) time^2 / 6
    return time, jnp.stack([first, last])


def excess(acc: Array, case: MeetCase) -> Array:
    """Return |acceleration| / limit - 1, (2,), at start and meeting; it is convex between them."""
    return jnp.sqrt(jnp.sum(acc**2, axis=1) + 1e-12) / case.most - 1.0


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class SmoothMeet(pj.Problem):
    """The meeting time, and a penalty on accelerations close to the limit."""

    case_type = MeetCase
    attempts = (pj.Attempt(1, pj.LbfgsConfig(200, tolerance=1e-7, patience=6)),)
    weight: float = 30.0
    margin: float = 0.05

    def prepare(self, case: MeetCase) -> MeetCase:
        return case

    def guesses(self, case: MeetCase, num: int) -> Array:
        away = jnp.sqrt(jnp.sum((case.target_pos - case.pos) ** 2) + 1e-6)
        return jnp.stack([jnp.log(4.0 * jnp.sqrt(away / case.most)), 0.0, 0.0])[None]

    def objective(self, point: Array, case: MeetCase) -> tuple[Array, Array]:
        time, acc = plan_at(point, case)
        over = jnp.maximum(excess(acc, case) + self.margin, 0.0)
        cost = time + self.weight * jnp.sum(over**2) + 1e-4 * jnp.sum(acc**2)
        return cost, jnp.max(excess(acc, case))

    def decode(self, point: Array, case: MeetCase) -> MeetPlan:
        time, acc = plan_at(point, case)
        return MeetPlan(time=time, acc=acc, **pj.pending(jnp.max(excess(acc, case))))


@dataclasses.dataclass(frozen=True)
class ScipyMeet(pj.Planner):
    """A planner that calls SciPy's SLSQP on the host for one case after another."""

    case_type = MeetCase

    def solve_on_host(self, cases: MeetCase, attempt: pj.Attempt) -> MeetPlan:
        plans = [self._solve(pj.take(cases, k)) for k in range(cases.batch_shape[0])]
        return jax.tree.map(lambda *leaves: np.stack(leaves), *plans)

    def _solve(self, case: MeetCase) -> MeetPlan:
        start = np.asarray(SmoothMeet().guesses(case, 1)[0], float)
        room = {"type": "ineq", "fun": lambda x: -np.asarray(excess(plan_at(x, case)[1], case))}
        eps = {"eps": 1e-3}  # of differences in float32
        found = minimize(lambda x: np.exp(x[0]), start, constraints=[room], options=eps)
        time, acc = plan_at(found.x.astype(np.float32), case)
        return MeetPlan(time=time, acc=acc, **pj.outcome(time, jnp.max(excess(acc, case))))


@dataclasses.dataclass(frozen=True)
class MeetVerdict(pj.Verdict):
    SENTENCES = {
        "not finite": "the plan or its case is not finite",
        "meeting": "{excess:.3g} m from the target at {time:.3f} s",
        "acceleration": "{excess:.2%} above its limit",
    }
    miss: np.ndarray  # (B,) [m]


def judge(cases: MeetCase, plans: MeetPlan) -> MeetVerdict:
    """Integrate each plan in 400 float64 steps, and judge its end and its acceleration."""
    case, plan = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), (cases, plans))
    pos, vel, step = case.pos, case.vel, plan.time[:, None] / 400
    for k in range(400):  # the midpoint rule is exact for a velocity that bends evenly, to 1e-5
        acc = plan.acc[:, 0] + (plan.acc[:, 1] - plan.acc[:, 0]) * (k + 0.5) / 400
        pos, vel = pos + step * (vel + 0.5 * step * acc), vel + step * acc
    there = case.target_pos + case.target_vel * plan.time[:, None]
    miss = np.linalg.norm(pos - there, axis=1)
    over = np.linalg.norm(plan.acc, axis=2).max(axis=1) / case.most - 1.0
    tests = [~np.isfinite(miss + over), miss > 1e-3, over > 1e-3]
    names = np.array([*MeetVerdict.SENTENCES, ""])
    first = np.where(np.any(tests, axis=0), np.argmax(tests, axis=0), 3)
    excess = np.choose(first, [miss, miss, over, np.full_like(miss, np.nan)])
    return MeetVerdict(first == 3, names[first], plan.time, excess, miss)


def case(pos, vel, target_pos, target_vel, most=2.0) -> MeetCase:
    given = (pos, vel, target_pos, target_vel, np.broadcast_to(most, np.shape(pos)[:-1]))
    return MeetCase(*(jnp.asarray(leaf, jnp.float32) for leaf in given))


def draw(num: int, suite: str | None = None, seed: int = 0, *, first: int = 0) -> MeetCase:
    u = np.random.default_rng(seed).uniform(-1.0, 1.0, (first + num, 4, 2))[first:]
    return case(u[:, 0], u[:, 1], 5.0 * u[:, 2], u[:, 3])


def planner(name: str = "smooth", **options):
    return TASK.make_planner(name, options)


TASK = pj.Task(
    name="meet",
    summary="a point mass in the plane meets a moving point",
    home="meet",
    planners={"smooth": "meet:SmoothMeet.planner", "scipy": "meet:ScipyMeet"},
    suites={"square": "Targets anywhere in a square of 10 m, up to 1.4 m/s on either axis."},
)
