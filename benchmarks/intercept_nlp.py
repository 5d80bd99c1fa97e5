"""Compare the default planner of interceptions with IPOPT on the same nonlinear program.

    python -m benchmarks.intercept_nlp [--suite hard] [--num 40] [--seed 977] [--paths 1]
        [--out DIR]

The program has the planner's unknowns, cost and limits: speed and curvature at equally spaced
times, the discomfort of `terms.limit_terms`, and the limits of speed, acceleration, curvature,
steering rate, lateral acceleration, map and meeting. CasADi builds it, with the car's poses at the
knots as further variables, and IPOPT solves it with exact second derivatives (extra `oracle`).

Of every obstacle the body's rectangle must keep `GRAZING` at `SAMPLES` times of each piece, or its
distance at the start if that is less. The planner penalises distances below 3 cm, and its finished
plans touch nothing. The distance of two convex polygons is at least the greatest gap along the
normals of their edges. Since IPOPT needs smooth functions, a soft maximum replaces it, which is too
great by at most log(2) / `SHARPNESS` = 1.7 mm if two gaps are equal.

IPOPT starts where the planner starts: first from the direct motion to the target, then from --paths
paths of reachable cells, up to the first plan that the referee accepts. Another row starts from the
planner's own plans, and shows how far these are from a local optimum. Costs, the total variation of
the curvature and the lateral jerk are compared on the cases that both solve; a gap is the cost of
the planner `spacetime` with the default effort, divided by the row's cost, minus 1.

Cases are planned one at a time. The time of the planner is the fastest of three calls. The drawn
cars have the length and acceleration in which the discomfort is defined (`units`).
"""

import contextlib
import dataclasses
import importlib
import importlib.metadata
import importlib.util
import os
import shutil
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.run import Bench, argument_parser, at_least, begin
from planner_jax.core.missing_extra import install_line
from planner_jax.optimise.levenberg import LevenbergConfig
from planner_jax.referee.clearance import edges
from planner_jax.runs.table import rate_cells
from planner_jax.task.intercept.problem.terms import JERK, STEERING
from planner_jax.task.intercept.searches import SEARCHES
from planner_jax.task.intercept.spec import SUITES
from planner_jax.task.intercept.units import enter_units, units_of

SAMPLES = 8  # times of each piece at which IPOPT's obstacles are constraints
POINTS = 6  # points of each piece at which its lateral acceleration is limited
CORNERS = 6  # greatest number of corners of an obstacle
SHARPNESS = 400.0  # [1/m], of the soft maximum of gaps
GRAZING = 0.01  # [m], least distance from obstacles, and of the body's middle from the map's edge
OPTIONS = {"max_iter": 200, "tol": 1e-4, "acceptable_tol": 1e-2, "mu_strategy": "adaptive"}
OPTIONS |= {"acceptable_iter": 8, "acceptable_obj_change_tol": 1e-4, "print_level": 0, "sb": "yes"}
# Numbers of a case on which the program depends, besides its obstacles.
NUMBERS = (
    *("time", "tolerance", "target_x", "target_y", "middle", "half_length", "half_width"),
    *("wheelbase", "speed", "acceleration", "lateral_acceleration", "curvature", "steering_rate"),
    *("lower_x", "upper_x", "lower_y", "upper_y"),
)
# Entries of an obstacle: its corners [m] at time 0, the normals and offsets of its edges, velocity.
CUTS = np.cumsum([2 * CORNERS, 2 * CORNERS, CORNERS, 2])


def read_numbers(case: Any) -> np.ndarray:
    """Return the values of `NUMBERS` for one case with NumPy leaves."""
    body, limits = case.body, case.limits
    target = case.target.at(case.time).pos
    edge = [side for k in range(2) for side in (case.lower[k] + GRAZING, case.upper[k] - GRAZING)]
    values = [case.time, case.tolerance, *target, body.middle, 0.5 * body.length, 0.5 * body.width]
    values += [body.wheelbase, limits.speed, limits.acceleration, limits.lateral_acceleration]
    return np.array([*values, limits.curvature, limits.steering_rate, *edge], float)


def read_obstacles(case: Any, num: int) -> np.ndarray:
    """Return the entries of `num` obstacles, in columns; absent ones are far away."""
    columns = []
    for group in (case.walls, case.movers):
        corners = np.asarray(group.vertices(0.0), float)
        normals, offsets = edges(corners)
        for k in np.flatnonzero(group.present):
            real = np.flatnonzero(np.isfinite(offsets[k]))  # edges of a length above 0
            spare = ((0, CORNERS - len(real)), (0, 0))
            padded = np.pad(corners[k, real], spare, mode="edge"), np.pad(normals[k, real], spare)
            # The gap along an edge that is padding must not be the greatest.
            offset = np.pad(offsets[k, real], spare[0], constant_values=1e3)
            columns.append(np.concatenate([*map(np.ravel, padded), offset, group.velocity[k]]))
    away = np.concatenate([np.full(2 * CORNERS, 1e3), np.zeros(2 * CORNERS)])
    away = np.concatenate([away, np.full(CORNERS, 1e3), np.zeros(2)])
    return np.stack(columns + [away] * (num - len(columns)), axis=1)


class Program:
    """The nonlinear program of K pieces among N obstacles, as a solver of CasADi.

    The variables are the knots (5, K + 1): x [m], y [m], heading [rad], speed [m/s] and curvature
    [1/m] in columns.

    Args:
        pieces: number K of pieces of the motion.
        obstacles: greatest number of obstacles of a case.
        folder: folder for the program as C code, which is compiled if there is a compiler. None:
            the program is not compiled.
    """

    def __init__(self, pieces: int, obstacles: int, folder: Path | None = None):
        self.ca: Any = importlib.import_module("casadi")
        ca, self.pieces, self.obstacles = self.ca, pieces, obstacles
        began, times = time.perf_counter(), pieces * SAMPLES
        knots, numbers = ca.MX.sym("knots", 5, pieces + 1), ca.MX.sym("numbers", len(NUMBERS))
        around = ca.MX.sym("obstacles", int(CUTS[-1]), obstacles)
        self.piece, self.gap = self._make_piece(), self._make_gap()
        every = self.piece.map("pieces", "serial", pieces, [2], [])
        ends, values, poses, costs = every(knots[:, :-1], knots[:, 1:], numbers)
        step = numbers[NUMBERS.index("time")] / times
        gaps = self.gap.map("gaps", "serial", times * obstacles, [3], [])(
            ca.repmat(ca.reshape(poses, 3, times), 1, obstacles),
            ca.repmat(step * ca.DM(np.arange(1.0, times + 1.0)).T, 1, obstacles),
            ca.reshape(ca.repmat(around, times, 1), int(CUTS[-1]), times * obstacles),
            numbers,
        )
        joints = ca.vec(ends - knots[:3, 1:])
        parts = [joints, ca.vec(values), self._make_miss()(knots[:, -1], numbers), ca.vec(gaps)]
        num = [part.numel() for part in parts]
        self._least = np.repeat([0.0, -np.inf, -np.inf], num[:-1])  # of all but the gaps
        self._most = np.repeat([0.0, 0.0, 0.0, np.inf], num)
        given = ca.vertcat(numbers, ca.vec(around))
        program = {"x": ca.vec(knots), "p": given, "f": ca.sum2(costs), "g": ca.vertcat(*parts)}
        self._cost = ca.Function("cost", [program["x"], given], [program["f"]])
        options: dict[str, Any] = {"print_time": False, "ipopt": OPTIONS}
        if folder and shutil.which("gcc"):  # the program as C code is some ten times faster
            flags = {"flags": ["-O1", "-march=native"]}
            options |= {"jit": True, "compiler": "shell", "jit_options": flags}
        with contextlib.chdir(folder or "."):  # where CasADi writes its C code
            self._solver = ca.nlpsol("solver", "ipopt", program, options)
        self.build_seconds = time.perf_counter() - began

    def _names(self) -> tuple[Any, dict[str, Any]]:
        numbers = self.ca.SX.sym("numbers", len(NUMBERS))
        return numbers, {name: numbers[k] for k, name in enumerate(NUMBERS)}

    def _make_piece(self) -> Any:
        """Return a function of one piece: its end, limited values <= 0, sampled poses, cost."""
        ca, (numbers, of) = self.ca, self._names()
        left, right, step = ca.SX.sym("left", 5), ca.SX.sym("right", 5), of["time"] / self.pieces
        v0, c0, v1, c1 = left[3], left[4], right[3], right[4]
        rise, bend = (v1 - v0) / step, (c1 - c0) / step
        node, weight = np.polynomial.legendre.leggauss(4)

        def turn_by(t: Any) -> Any:
            rate = v0 * c0 + t * (0.5 * (v0 * bend + rise * c0) + t * rise * bend / 3.0)
            return left[2] + t * rate

        x, y, poses, tick = left[0], left[1], [], step / SAMPLES
        for k in range(SAMPLES):
            for u, w in zip((0.5 * node + 0.5).tolist(), (0.5 * weight).tolist(), strict=True):
                t = tick * (k + u)
                x += w * tick * (v0 + rise * t) * ca.cos(turn_by(t))
                y += w * tick * (v0 + rise * t) * ca.sin(turn_by(t))
            poses.append(ca.vertcat(x, y, turn_by(tick * (k + 1))))
        flat = ca.if_else(c0 * c1 > 0.0, ca.fmin(c0**2, c1**2), 0.0)
        steering = of["wheelbase"] / (1.0 + of["wheelbase"] ** 2 * flat) * bend
        limited = [(rise, "acceleration"), (steering, "steering_rate"), (c1, "curvature")]
        for k in range(POINTS):
            share = (k + 1) / POINTS
            v, c = v0 + share * (v1 - v0), c0 + share * (c1 - c0)
            limited.append((v**2 * c, "lateral_acceleration"))
        values = [-v1, v1 - of["speed"]]
        values += [sign * value / of[name] - 1.0 for value, name in limited for sign in (1.0, -1.0)]
        for pose in poses:
            for axis, ahead in (("x", ca.cos(pose[2])), ("y", ca.sin(pose[2]))):
                middle = pose["xy".index(axis)] + of["middle"] * ahead
                values += [of[f"lower_{axis}"] - middle, middle - of[f"upper_{axis}"]]
        lateral = v1**2 * c1
        jerk = (lateral - v0**2 * c0) / step
        cost = step * (rise**2 + lateral**2 + (JERK * jerk) ** 2 + (STEERING * steering) ** 2)
        outputs = [poses[-1], ca.vertcat(*values), ca.vertcat(*poses), cost]
        return ca.Function("piece", [left, right, numbers], outputs)

    def _make_gap(self) -> Any:
        """Return a function of the gap between the body at a pose and an obstacle at a time."""
        ca, (numbers, of) = self.ca, self._names()
        pose, when = ca.SX.sym("pose", 3), ca.SX.sym("when")
        around = ca.SX.sym("obstacle", int(CUTS[-1]))
        corners, normals, offsets, velocity = ca.vertsplit(around, [0, *map(int, CUTS)])
        corners, normals = ca.reshape(corners, 2, CORNERS), ca.reshape(normals, 2, CORNERS)
        ahead = ca.vertcat(ca.cos(pose[2]), ca.sin(pose[2]))
        sides = [(ahead, of["half_length"])]
        sides += [(ca.vertcat(-ahead[1], ahead[0]), of["half_width"])]
        middle = pose[:2] + of["middle"] * ahead - velocity * when
        gaps = []
        for k in range(CORNERS):
            normal = normals[:, k]
            extent = sum(half * ca.sqrt(ca.dot(normal, a) ** 2 + 1e-6) for a, half in sides)
            gaps.append(ca.dot(normal, middle) - offsets[k] - extent)
        for axis, half in sides:
            along = axis.T @ (corners - ca.repmat(middle, 1, CORNERS))
            gaps += [ca.mmin(along) - half, -ca.mmax(along) - half]
        most = ca.mmax(ca.vertcat(*gaps))
        soft = most + ca.log(sum(ca.exp(SHARPNESS * (gap - most)) for gap in gaps)) / SHARPNESS
        return ca.Function("gap", [pose, when, around, numbers], [soft])

    def _make_miss(self) -> Any:
        """Return a function of the last knot: the squared miss beyond the tolerance, <= 0."""
        ca, (numbers, of) = self.ca, self._names()
        knot = ca.SX.sym("knot", 5)
        x = (knot[0] + of["middle"] * ca.cos(knot[2]) - of["target_x"]) / of["tolerance"]
        y = (knot[1] + of["middle"] * ca.sin(knot[2]) - of["target_y"]) / of["tolerance"]
        return ca.Function("miss", [knot, numbers], [x**2 + y**2 - 1.0])

    def knots(self, case: Any, plan: Any) -> np.ndarray:
        """Return the knots (5, K + 1) of a plan's speeds and curvatures."""
        numbers, knots = read_numbers(case), np.zeros((5, self.pieces + 1))
        knots[3], knots[4], knots[:3, 0] = plan.speed, plan.curvature, case.start
        for k in range(self.pieces):
            knots[:3, k + 1] = self.piece(knots[:, k], knots[:, k + 1], numbers)[0].full()[:, 0]
        return knots

    def params(self, case: Any) -> np.ndarray:
        """Return the numbers of a case on which the program depends."""
        entries = read_obstacles(case, self.obstacles)
        return np.concatenate([read_numbers(case), entries.T.ravel()])

    def cost(self, case: Any, plan: Any) -> float:
        """Return the discomfort [m^2/s^3] of a plan."""
        return float(self._cost(self.knots(case, plan).T.ravel(), self.params(case)))

    def solve(self, case: Any, plan: Any) -> tuple[Any, float]:
        """Solve a case from a plan's speeds and curvatures; return a plan, and the time [s]."""
        knots, params = self.knots(case, plan), self.params(case)
        low, high = np.full_like(knots, -np.inf), np.full_like(knots, np.inf)
        low[:, 0] = high[:, 0] = knots[:, 0]
        bounds = {"lbx": low.T.ravel(), "ubx": high.T.ravel()}
        # A car that starts nearer to an obstacle need not leave it.
        entries = params[len(NUMBERS) :].reshape(self.obstacles, -1)
        gaps = [float(self.gap(knots[:3, 0], 0.0, each, read_numbers(case))) for each in entries]
        least = np.repeat(np.clip(gaps, 0.0, GRAZING), self.pieces * SAMPLES)
        bounds |= {"lbg": np.concatenate([self._least, least]), "ubg": self._most}
        began = time.perf_counter()
        found = self._solver(x0=knots.T.ravel(), p=params, **bounds)
        seconds = time.perf_counter() - began
        end = found["x"].full().reshape(-1, 5).T
        return dataclasses.replace(plan, speed=end[3], curvature=end[4]), seconds


def start_plans(planner: Any, cases: Any, plans: Any, paths: int) -> list[Any]:
    """Return the planner's starting points, hardly optimised, in the form of plans of all cases.

    The first are direct motions, the others follow random paths of reachable cells. The remaining
    fields of the direct motions are copied from `plans`.
    """
    problem, given = planner.problem, SEARCHES["given"]

    def guess(case: Any) -> tuple[jax.Array, jax.Array]:
        local = enter_units(case, units_of(case))
        return problem.unpack(local, problem.guess_directly(local, False).point)[:2]

    speed, curvature = jax.jit(jax.vmap(guess))(cases)
    found = [dataclasses.replace(plans, speed=speed, curvature=curvature)]
    for k in range(paths):
        raw = {"solver": LevenbergConfig(1), "settling": 0, "is_direct": False, "paths": 1}
        search = dataclasses.replace(given[min(k, len(given) - 1)], **raw, seed=k)
        found.append(pj.plan(dataclasses.replace(planner, searches=(search,)), cases))
    return [jax.tree.map(np.asarray, each) for each in found]


@dataclasses.dataclass
class Results:
    """Results of one planner on B cases."""

    plans: list[Any]
    seconds: np.ndarray  # (B,) [s]
    cost: np.ndarray  # (B,) [m^2/s^3]
    verdicts: list[Any]

    @property
    def success(self) -> np.ndarray:
        """The referee's acceptance of each plan, (B,) bool."""
        return np.array([bool(verdict.success) for verdict in self.verdicts])

    def measure(self, name: str) -> np.ndarray:
        """Return a measured quantity of the verdicts, (B,)."""
        return np.array([float(getattr(verdict, name)) for verdict in self.verdicts])


def run_planner(planner: Any, lanes: list[Any], program: Program) -> Results:
    """Plan cases one by one with this library; the fastest of three calls is a case's time."""
    lanes_of_jax = [jax.tree.map(jnp.asarray, lane) for lane in lanes]
    plans: list[Any] = []
    seconds = np.full(len(lanes), np.inf)
    for k, lane in enumerate(lanes_of_jax):
        for _ in range(3):
            began = time.perf_counter()
            plans[k:] = [jax.block_until_ready(pj.plan(planner, lane))]
            seconds[k] = min(seconds[k], time.perf_counter() - began)
    plans = [jax.tree.map(np.asarray, plan) for plan in plans]
    return finish(program, lanes, plans, seconds)


def run_ipopt(program: Program, lanes: list[Any], starts: list[Any]) -> Results:
    """Solve cases by IPOPT, each from its starts in turn until the referee accepts a plan."""
    plans: list[Any] = []
    seconds = np.zeros(len(lanes))
    for k, lane in enumerate(lanes):
        for start in starts:
            plan, spent = program.solve(lane, pj.take(start, k))
            seconds[k] += spent
            plans[k:] = [plan]
            if pj.intercept.judge(lane, plan).success:
                break
    return finish(program, lanes, plans, seconds)


def finish(program: Program, lanes: list[Any], plans: list[Any], seconds: np.ndarray) -> Results:
    """Judge plans, and compute their costs by the program."""
    pairs = list(zip(lanes, plans, strict=True))
    cost = np.array([program.cost(lane, plan) for lane, plan in pairs])
    return Results(plans, seconds, cost, [pj.intercept.judge(*pair) for pair in pairs])


def say_row(bench: Bench, name: str, one: Results, ours: Results) -> None:
    """Print a row of one planner, and the default plans' cost and smoothness beside it."""
    both = one.success & ours.success
    gap = ours.cost[both] / one.cost[both] - 1.0
    gaps = np.percentile(gap, [10, 50, 90]) if both.any() else np.full(3, np.nan)
    ways = int((gap > 0.01).sum()), int((gap < -0.01).sum()), int(both.sum())
    bends, jerk = (
        [np.median(each.measure(leaf)[both]) if both.any() else np.nan for each in (ours, one)]
        for leaf in ("total_curvature_variation", "rms_lateral_jerk")
    )
    times = 1e3 * np.percentile(one.seconds, [50, 90])
    bench.say(
        f"| {name} | {' | '.join(rate_cells(int(one.success.sum()), len(both)))} | "
        f"{' / '.join(f'{100 * each:.1f}' for each in gaps)} | {ways[0]} / {ways[1]} of {ways[2]} "
        f"| {bends[0]:.2f} / {bends[1]:.2f} | {jerk[0]:.3f} / {jerk[1]:.3f} | "
        f"{times[0]:.0f} / {times[1]:.0f} |"
    )
    figures = {"success": one.success, "cost": one.cost, "seconds": one.seconds}
    bench.row(planner=name, **figures, gaps=gaps, variation=bends, lateral_jerk=jerk)


def main() -> None:
    parser = argument_parser("intercept_nlp", __doc__, num=40, seed=977)
    parser.add_argument("--suite", choices=list(SUITES), default="hard", help="default: hard")
    parser.add_argument("--paths", type=at_least(0), default=1, help="further starts; default: 1")
    options = parser.parse_args()
    if importlib.util.find_spec("casadi") is None:
        parser.exit(2, f"benchmarks.intercept_nlp needs casadi: {install_line('oracle')}\n")
    with begin(parser, options) as bench:
        cases = pj.intercept.draw(options.num, options.suite, options.seed)
        lanes = [pj.take(jax.tree.map(np.asarray, cases), k) for k in range(options.num)]
        planner, began = pj.intercept.SpacetimeIntercept(), time.perf_counter()
        jax.block_until_ready(pj.plan(planner, jax.tree.map(jnp.asarray, lanes[0])))
        first = time.perf_counter() - began
        most = max(int(lane.walls.present.sum() + lane.movers.present.sum()) for lane in lanes)
        program = Program(planner.pieces, most, bench.path)
        ours = run_planner(planner, lanes, program)
        bench.say(
            f"{options.num} cases of suite {options.suite}, seed {options.seed}; jax "
            f"{jax.__version__}, casadi {importlib.metadata.version('casadi')}; {os.cpu_count()} "
            f"cores, load average {os.getloadavg()[0]:.1f}",
            f"first call of the planner {first:.1f} s; CasADi builds and compiles the program in "
            f"{program.build_seconds:.1f} s",
            "",
            "| planner | cases | success [%] | 95 % interval | gap of `spacetime`, p10 / p50 / p90 "
            "[%] | above 1 % / below -1 % | total variation of curvature, `spacetime` / this [1/m] "
            "| rms lateral jerk, `spacetime` / this [m/s3] | time p50 / p90 [ms] |",
            "|---|---|---|---|---|---|---|---|---|",
        )
        bench.count(ours.success)
        say_row(bench, "`spacetime`", ours, ours)
        good = run_planner(planner.with_effort("good"), lanes, program)
        say_row(bench, '`spacetime`, effort "good"', good, ours)
        plans = jax.tree.map(lambda *each: np.stack(each), *ours.plans)
        starts = start_plans(planner, cases, plans, options.paths)
        for name, given in (("IPOPT", starts), ("IPOPT, from our plans", [plans])):
            say_row(bench, name, run_ipopt(program, lanes, given), ours)


if __name__ == "__main__":
    main()
