"""Count wrong plans for served balls with weak to strong drag, in hits and rallies.

    python -m benchmarks.served_balls [--num 10000] [--rows hit,spin,rally] [--seed 0] [--out DIR]

The ball is served with the velocity (-7, 0, 6) m/s times a factor from 0.7 to 4; its drag K_D is
0.01 to 0.5 1/m. Both are uniform. The quadrotor starts below a random point of the ball's path, in
which the ball falls through a height of 1.2 to 2 m. The path comes from an integration by this
program, not from the planner.

A row plans all cases. Each plan that is solved by its status is checked twice: by the referee, and
by this program, which integrates the ball in float64 by Runge-Kutta steps that are shorter where
the ball is faster. The table has the cases, the solved plans, and the wrong plans: those that
referee or program reject. Row `hit` has hits without spin, row `spin` the same balls with
`spin=(0, 0, 0)`, so that the flight after the impact has drag too, and row `rally` two hits.
"""

import collections
from typing import Any

import jax
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.run import Bench, argument_parser, begin, parse_names
from planner_jax.core import GRAVITY
from planner_jax.trajectory.polynomial import states_at

ROWS = ("hit", "spin", "rally")
_BATCH = 1000  # number of cases that are planned together
_STEPS = 400  # number of Runge-Kutta steps of a flight
_LIMITS = {"speed": 15.0, "hitting_speed": (15.0,) * 3, "min_apex": 1.5, "max_apex": 20.0}
_RACKET = 5e-3  # [m], greatest accepted distance of racket centre and ball
_TARGET = 0.01  # [m], greatest accepted distance of the ball from target or place


class Air:
    """Acceleration of B balls: gravity, quadratic drag, and the lift of their spin."""

    def __init__(self, drag: np.ndarray, lift: np.ndarray | None = None, reach: Any = 0.0) -> None:
        self.drag, self.lift, self.reach = drag[:, None], lift, np.reshape(reach, (-1, 1))

    def __call__(self, vel: np.ndarray) -> np.ndarray:
        square, acc = (vel * vel).sum(axis=1, keepdims=True), np.array([0.0, 0.0, -GRAVITY])
        if self.lift is not None:
            push = np.cross(self.lift, vel)
            turning = (push * push).sum(axis=1, keepdims=True) / np.maximum(square, 1e-12)
            square, acc = square + self.reach**2 * turning, acc + push
        return acc - self.drag * np.sqrt(square) * vel


def fly(pos: np.ndarray, vel: np.ndarray, air: Air, duration: np.ndarray) -> tuple:
    """Integrate B flights; return times (S + 1, B), and positions, velocities (S + 1, B, 3).

    The steps grow with the time in proportion to the slowing of a ball by drag alone.
    """
    pace = np.maximum(air.drag[:, 0] * np.linalg.norm(vel, axis=1), 1e-3)
    shares = np.linspace(0.0, 1.0, _STEPS + 1)[:, None]
    times = np.expm1(shares * np.log1p(pace * duration)) / pace
    states = [(pos, vel)]
    for h in np.diff(times, axis=0)[:, :, None]:
        a1 = air(vel)
        a2 = air(vel + 0.5 * h * a1)
        a3 = air(vel + 0.5 * h * a2)
        a4 = air(vel + h * a3)
        pos = pos + h * vel + h * h / 6.0 * (a1 + a2 + a3)
        vel = vel + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
        states.append((pos, vel))
    return times, *map(np.stack, zip(*states, strict=True))


def draw(row: str, num: int, seed: int) -> Any:
    """Draw `num` cases of a row of the table."""
    random = np.random.default_rng(seed)
    drag = random.uniform(0.01, 0.5, num)
    vel = random.uniform(0.7, 4.0, num)[:, None] * np.array([-7.0, 0.0, 6.0])
    ball = np.array([4.0, 0.5, 2.0]) + random.normal(0.0, 0.2, (num, 3))
    height = random.uniform(1.2, 2.0, num)
    without_drag = (vel[:, 2] + np.sqrt(vel[:, 2] ** 2 + 2.0 * GRAVITY * ball[:, 2])) / GRAVITY
    _, path, speeds = fly(ball, vel, Air(drag), 1.5 * without_drag)
    first = ((path[..., 2] < height) & (speeds[..., 2] < 0.0)).argmax(axis=0)
    meeting = path[first, np.arange(num)]
    start = meeting + random.uniform(-1.0, 1.0, (num, 3)) * np.array([0.6, 0.6, 0.2])
    start[:, 2] = np.maximum(start[:, 2] - 0.3, 0.8)
    options: dict[str, Any] = {"start": start, "drag": drag, **_LIMITS}
    if row == "rally":
        place = np.append(meeting[:, :2], np.full((num, 1), 1.5), axis=1)
        return pj.rally.case(ball, vel, np.repeat(place[:, None], 2, axis=1), **options)
    target = meeting + random.uniform(-1.0, 1.0, (num, 3)) * np.array([3.0, 3.0, 0.0])
    target[:, 2] = 0.0
    if row == "spin":
        options["spin"] = (0.0, 0.0, 0.0)
    return pj.hit.case(ball, vel, target, **options)


class Check:
    """Errors of B plans, by this program's own integration of their balls."""

    def __init__(self, cases: Any, plans: Any) -> None:
        self.cases, self.plans = cases, plans
        self.ball = np.asarray(cases.ball.pos, float), np.asarray(cases.ball.vel, float)
        self.drag = np.asarray(cases.drag, float)
        self.air, self.is_wrong = Air(self.drag), np.zeros(len(self.drag), bool)

    def meet(self, since: np.ndarray, time: np.ndarray) -> None:
        """Follow the balls from one time to an impact, test the contact, and apply the impact."""
        _, pos, vel = fly(*self.ball, self.air, time - since)
        state = states_at(self.plans.trajectory, time)
        normal = state[:, 2] + np.array([0.0, 0.0, GRAVITY])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        racket = state[:, 0] + np.asarray(self.cases.racket_height, float)[:, None] * normal
        coming = vel[-1] - state[:, 1]
        along = (coming * normal).sum(axis=1, keepdims=True)
        push = -(1.0 + np.asarray(self.cases.restitution, float)[:, None]) * along
        self.is_wrong |= np.linalg.norm(racket - pos[-1], axis=1) > _RACKET
        self.is_wrong |= along[:, 0] >= 0.0
        self.ball = pos[-1], vel[-1] + push * normal
        if self.cases.lift is not None:
            self._rub(coming - along * normal, push, normal)

    def _rub(self, slip: np.ndarray, push: np.ndarray, normal: np.ndarray) -> None:
        """Apply the friction of the racket to balls that do not rotate before the impact."""
        around = self.cases.around
        friction, grip, reach = (
            np.asarray(each, float)[:, None]
            for each in (around.friction, around.grip, around.reach)
        )
        size = np.maximum(np.linalg.norm(slip, axis=1, keepdims=True), 1e-12)
        change = -np.minimum(friction * push / size, grip) * slip
        self.ball = self.ball[0], self.ball[1] + change
        self.air = Air(self.drag, (1.0 / grip - 1.0) / reach * np.cross(change, normal), reach)

    def land(self, duration: np.ndarray, place: np.ndarray) -> None:
        """Test the place (B, 3) of balls after a duration (B,) [s], and their greatest height."""
        _, pos, _ = fly(*self.ball, self.air, duration)
        self.is_wrong |= np.linalg.norm(pos[-1] - place, axis=1) > _TARGET
        apex = pos[..., 2].max(axis=0)
        self.is_wrong |= apex > _LIMITS["max_apex"] * 1.002
        self.is_wrong |= apex < _LIMITS["min_apex"] * 0.998


def find_wrong(row: str, cases: Any, plans: Any) -> np.ndarray:
    """Return which of B plans miss the ball, the target or a place, (B,) bool."""
    check = Check(cases, plans)
    if row == "rally":
        times, flights = (
            np.asarray(plans.strokes.time, float),
            np.asarray(plans.strokes.flight_time),
        )
        before = np.asarray(cases.ball_time, float)
        for k in range(times.shape[1]):
            check.meet(before, times[:, k])
            check.land(flights[:, k], np.asarray(plans.places)[:, k])
            before = times[:, k]
        return check.is_wrong
    time = np.asarray(plans.stroke.time, float)
    check.meet(np.zeros_like(time), time)
    if row == "hit":  # the planner of hits assumes no drag after the impact, unless it is requested
        check.air = Air(0.0 * check.drag)
    check.land(np.asarray(plans.stroke.flight_time, float), np.asarray(cases.target, float))
    return check.is_wrong


def measure(bench: Bench, options: Any, names: list[str]) -> None:
    """Plan and check the cases of the rows with the given names, and print a table of counts."""
    bench.say(
        f"seed {options.seed}, {jax.devices()[0].device_kind}, jax {jax.__version__}",
        "| row | cases | solved | rejected by referee | wrong by own integration | failed limits |",
        "|---|---|---|---|---|---|",
    )
    for name in names:
        solved, refused, wrong = 0, 0, 0
        limits: collections.Counter[str] = collections.Counter()
        judge = pj.rally.judge if name == "rally" else pj.hit.judge
        planner: Any = pj.rally.planner() if name == "rally" else pj.hit.planner()
        for first in range(0, options.num, _BATCH):
            cases = draw(name, min(_BATCH, options.num - first), options.seed + first)
            cases = jax.tree.map(np.asarray, cases)
            plans = jax.tree.map(np.asarray, pj.plan(planner, cases))
            verdict, is_solved = judge(cases, plans), np.asarray(pj.are_solved(plans))
            with np.errstate(all="ignore"):  # unsolved plans may have any numbers
                wrong += int((is_solved & find_wrong(name, cases, plans)).sum())
            rejected = is_solved & ~verdict.success
            solved, refused = solved + int(is_solved.sum()), refused + int(rejected.sum())
            limits.update(verdict.failed_limit[rejected].tolist())
            bench.count(verdict.success)
        failed = ", ".join(f"{limit} {count}" for limit, count in limits.items())
        bench.say(f"| {name} | {options.num:,} | {solved:,} | {refused} | {wrong} | {failed} |")
        bench.row(row=name, num=options.num, solved=solved, refused=refused, wrong=wrong)


def main() -> None:
    parser = argument_parser("served_balls", __doc__, num=10_000, seed=0)
    parser.add_argument(
        "--rows", default=",".join(ROWS), help="rows, comma-separated; default: all"
    )
    options = parser.parse_args()
    names = parse_names(parser, "--rows", options.rows, ROWS)
    with begin(parser, options) as bench:
        measure(bench, options, names)


if __name__ == "__main__":
    main()
