"""The nonlinear program of one minimum-snap segment, its derivatives exact, for IPOPT.

A planner's decision variables x are whitened waypoint offsets and a few variables of the ends, as
`ExactHit` and `ExactCatch` have them. The ends make boundary rows R and the mean duration h of a
piece; rows and offsets are the columns C of the trajectory, and constant matrices times C are its
samples in time over h. So the ends are one small function, and a sample's limits another one:
CasADi differentiates both symbolically, and the chain rule through the matrices is written out
here. Differentiated as a whole the graph would be a hundred times larger, and IPOPT slower.

Shares no code with the planners but the trajectory's constant matrices and the settings.
"""

import dataclasses
import importlib
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from planner_jax.cost.penalty import joined_trapezoid_weights

ca: Any = importlib.import_module("casadi")  # of the extra `oracle`

ORDERS = 4  # position to jerk
# Of a sample: height, velocity, acceleration, jerk, each as (order, axis).
PLACES = ((0, 2), *((order, axis) for order in (1, 2, 3) for axis in range(3)))
COMPILER = ("cc", "-O3", "-march=native", "-ffast-math", "-fPIC", "-shared")


@dataclasses.dataclass(frozen=True)
class Problem:
    """What a task asks of a segment; all functions take and give CasADi's symbols.

    `told` is a dict of the numbers of a case by name, as in `sizes`.
    """

    planner: Any  # an `ExactHit` or `ExactCatch`, for its settings
    sizes: dict[str, int]  # what a program is told about a case, and how many numbers that is
    num_natural: int  # variables of the ends
    # Of those variables and `told`: tail state (4, 3), duration [s], list of excesses, and cost.
    ends: Callable[[Any, dict], tuple[Any, Any, list, Any]]
    # Of height, velocity, acceleration, jerk at a sample and `told`: list of excesses.
    limits: Callable[[Any, Any, Any, Any, dict], list]
    factors: tuple[float, ...]  # of the planner's margin, for each of these excesses
    impact_weight: float  # [s], of the hinges of the ends


def hinge(x: Any, width: float) -> Any:
    """The smoothed hinge of paper 000, eq. 27b."""
    blend = (width - 0.5 * x) * (x / width) ** 3
    return ca.if_else(x <= 0.0, 0.0, ca.if_else(x < width, blend, x - 0.5 * width))


def rate_squared(acc: Any, jerk: Any, gravity: Any) -> Any:
    """|omega|^2 of the Hopf fibration at zero heading, from flatness."""
    thrust = acc + ca.vertcat(0.0, 0.0, gravity)
    squared = ca.fmax(ca.sumsqr(thrust), 1e-4)
    size = ca.sqrt(squared)
    tilt = (ca.sumsqr(jerk) - ca.dot(thrust, jerk) ** 2 / squared) / squared
    twist = (thrust[1] * jerk[0] - thrust[0] * jerk[1]) / size
    return tilt + (twist / ca.fmax(size + thrust[2], 1e-2)) ** 2


def across(axis: Any) -> tuple[Any, Any]:
    """The body x and y axes at zero heading for a body z axis."""
    x, y, z = axis[0], axis[1], axis[2]
    k = 1.0 / ca.fmax(1.0 + z, 1e-6)
    return ca.vertcat(1.0 - k * x * x, -k * x * y, -x), ca.vertcat(-k * x * y, 1.0 - k * y * y, -y)


class Program:
    """The program of a problem, built once for all of its cases.

    Args:
        problem: of a task.
        penalised: whether limits are the planner's own penalties in the objective, and not
            constraints.
        backoff: by which excesses have to stay below zero where they are constraints.
        compiled: whether functions are compiled C code, or run by CasADi's virtual machine.
    """

    def __init__(
        self, problem: Problem, penalised: bool, backoff: float = 0.0, *, compiled: bool = False
    ):
        planner = problem.planner
        self.problem, self.penalised, self.backoff = problem, penalised, backoff
        self._maps = planner.maps
        self._matrices = [ca.DM(self._maps.sample_matrix(planner.nodes, d)) for d in range(ORDERS)]
        weights = joined_trapezoid_weights(planner.nodes, self._maps.proportions)
        self._weights, self.num_samples = ca.DM(weights), len(weights)
        self.num_told = sum(problem.sizes.values())
        self._build_small()
        self.functions = self._build()
        if compiled:
            self.functions = self._as_machine_code()

    def told(self, values: dict[str, Any]) -> np.ndarray:
        """The numbers of a case in one vector."""
        return np.concatenate([np.ravel(np.asarray(values[n], float)) for n in self.problem.sizes])

    def solver(self, options: dict[str, Any], callback: Any = None) -> Callable:
        """IPOPT on this program: a function of a start and of what is told, to CasADi's results."""
        nlp, gradient, jacobian, hessian = self.functions
        settings: dict[str, Any] = {"print_level": 0, "sb": "yes", "linear_solver": "mumps"}
        given: dict[str, Any] = {"ipopt": settings | options, "print_time": False}
        given |= {"error_on_fail": False, "show_eval_warnings": False}
        given |= {"no_nlp_grad": True, "calc_lam_p": False}
        given |= {"grad_f": gradient, "jac_g": jacobian, "hess_lag": hessian}
        if callback is not None:
            given["iteration_callback"] = callback
        if options.get("hessian_approximation") == "limited-memory":
            del given["hess_lag"]
        solve = ca.nlpsol("segment", "ipopt", nlp, given)
        least = -np.inf if self.num_constraints else []

        def solved(start: np.ndarray, told: np.ndarray) -> tuple[dict, dict]:
            found = solve(x0=start, p=told, lbg=least, ubg=-self.backoff)
            return found, solve.stats()

        return solved

    def _split(self, vector: Any) -> dict:
        """What is told, by name."""
        ends = np.cumsum([0, *self.problem.sizes.values()]).tolist()
        return {n: vector[ends[i] : ends[i + 1]] for i, n in enumerate(self.problem.sizes)}

    def _build_small(self) -> None:
        """The functions of the ends and of one sample, with their derivatives."""
        problem, planner = self.problem, self.problem.planner
        natural = ca.SX.sym("natural", problem.num_natural)
        told = ca.SX.sym("told", self.num_told)
        named = self._split(told)
        tail, time, excess, cost = problem.ends(natural, named)
        duration = time / planner.num_pieces
        head = ca.reshape(named["head_state"], 3, ORDERS).T
        powers = ca.vertcat(*[duration**k for k in range(ORDERS)])
        scale = ca.repmat(powers, 1, 3)
        rows = ca.vertcat(head * scale, tail * scale)
        excess = ca.vertcat(*excess)
        hinges = problem.impact_weight * ca.sum1(
            ca.vertcat(
                *[
                    hinge(excess[i] + planner.margin, planner.hinge_width)
                    for i in range(excess.numel())
                ]
            )
        )
        self.num_at_ends = excess.numel()
        gram = ca.DM(self._maps.boundary_energy)
        power = 2 * self._maps.order - 1
        energy = planner.energy_weight * ca.sum1(ca.sum2(rows * (gram @ rows))) / duration**power
        core = cost + energy + (hinges if self.penalised else 0.0)
        # What the rest of the program depends on: 24 rows axis by axis, and the duration.
        outward = ca.vertcat(ca.vec(rows), duration)
        weights = ca.SX.sym("weights", outward.numel() + 1 + excess.numel())
        together = ca.vertcat(outward, core, excess)
        self._ends = ca.Function("ends", [natural, told], [outward, core, excess])
        self._ends_slopes = ca.Function(
            "ends_slopes",
            [natural, told],
            [outward, core, excess, ca.densify(ca.jacobian(together, natural))],
        )
        bend = ca.hessian(ca.dot(weights, together), natural)[0]
        self._ends_bend = ca.Function("ends_bend", [natural, told, weights], [ca.densify(bend)])

        unit, h = ca.SX.sym("unit", len(PLACES)), ca.SX.sym("h")
        at = [unit[i] / h**order for i, (order, _) in enumerate(PLACES)]
        limits = problem.limits(at[0], *(ca.vertcat(*at[i : i + 3]) for i in (1, 4, 7)), named)
        limits = ca.vertcat(*limits)
        self.num_limits = limits.numel()
        self.num_constraints = (
            0 if self.penalised else self.num_limits * self.num_samples + self.num_at_ends
        )
        multipliers = ca.SX.sym("multipliers", 1 if self.penalised else self.num_limits)
        if self.penalised:  # one weighed sum of hinges stands for all limits of a sample
            margins = planner.margin * np.array(problem.factors)
            inside = [limits[i] + margins[i] for i in range(self.num_limits)]
            values = h * sum(hinge(x, planner.hinge_width) for x in inside)
        else:
            values = limits
        variables = ca.vertcat(unit, h)
        slopes = ca.jacobian(values, variables)
        total = ca.dot(multipliers, values)
        bend, gradient = ca.hessian(total, variables)
        bend = ca.triu(bend)
        self._slope_places = list(zip(*slopes.sparsity().get_triplet(), strict=True))
        self._bend_places = list(zip(*bend.sparsity().get_triplet(), strict=True))
        nonzeros = lambda matrix: ca.vertcat(*matrix.nonzeros())  # noqa: E731
        mapped = lambda f, given: f.map(  # noqa: E731
            f"{f.name()}_map", "serial", self.num_samples, given, []
        )
        self._limits = mapped(ca.Function("limits", [unit, h, told], [limits]), [1, 2])
        self._values = mapped(ca.Function("values", [unit, h, told], [values]), [1, 2])
        self._slopes = mapped(
            ca.Function("slopes", [unit, h, told], [values, nonzeros(slopes)]), [1, 2]
        )
        self._bends = mapped(
            ca.Function(
                "bends",
                [unit, h, told, multipliers],
                [ca.densify(gradient), nonzeros(bend)],
            ),
            [1, 2],
        )

    def _build(self) -> list:
        """Program, gradient, Jacobian and Hessian, as IPOPT asks for them."""
        planner, num_natural = self.problem.planner, self.problem.num_natural
        pieces, num_offsets = planner.num_pieces, planner.num_offsets
        size = num_offsets + num_natural
        rows, num_columns = 2 * ORDERS, 2 * ORDERS + pieces - 1
        x, told = ca.MX.sym("x", size), ca.MX.sym("told", self.num_told)
        scale = ca.DM(planner.scale)
        natural = x[num_offsets:] * scale[num_offsets:]
        offsets = ca.reshape(x[:num_offsets] * scale[:num_offsets], 3, pieces - 1).T
        outward, core, at_ends, by_natural = self._ends_slopes(natural, told)
        columns = ca.vertcat(ca.reshape(outward[: 3 * rows], rows, 3), offsets)
        h = outward[3 * rows]
        unit = self._unit(columns)
        power = 2 * self._maps.order - 1
        own = planner.energy_weight * self._maps.offset_energy
        of_offsets = own * ca.sumsqr(offsets) / h**power
        values, slopes = self._slopes(unit, h, told)
        weights = ca.MX(self._weights.T)
        f = core + of_offsets
        if self.penalised:
            f, g = f + ca.sum2(values * weights), ca.MX(0, 1)
        else:
            g = ca.vertcat(ca.vec(values.T), at_ends)  # limit by limit
        # x is laid out waypoint by waypoint, matrices here axis by axis.
        order = [3 * i + axis for axis in range(3) for i in range(pieces - 1)]
        place = np.argsort(order).tolist()
        # Derivatives by (offsets axis by axis, rows axis by axis, h).
        outer = [a * num_columns + rows + i for a in range(3) for i in range(pieces - 1)]
        inner = [a * num_columns + i for a in range(3) for i in range(rows)]
        num_out, num_in = len(outer), len(inner) + 1
        chain = by_natural[:num_in, :]  # (25, natural)
        by_core = by_natural[num_in : num_in + 1, :]
        by_ends = by_natural[num_in + 1 :, :]
        scale_row = ca.DM(np.concatenate([np.array(planner.scale)])).T

        def to_x(by_outer: Any, by_natural: Any) -> Any:
            wide = ca.horzcat(by_outer[:, place], by_natural)
            return wide * ca.repmat(scale_row, wide.shape[0], 1)

        def by_sample(of: int) -> tuple[Any, Any]:
            """Slopes of one value at all samples by columns axis by axis, and by h."""
            parts: list[Any] = [0.0] * 3
            by_h: Any = ca.MX.zeros(self.num_samples, 1)
            for k, (i, j) in enumerate(self._slope_places):
                if i != of:
                    continue
                factor = slopes[k, :].T
                if j == len(PLACES):
                    by_h = by_h + factor
                    continue
                degree, axis = PLACES[j]
                matrix = self._matrices[degree]
                parts[axis] = parts[axis] + ca.repmat(factor, 1, num_columns) * matrix
            zero = ca.MX.zeros(self.num_samples, num_columns)
            return ca.horzcat(*(zero if isinstance(p, float) else p for p in parts)), by_h

        offsets_row = ca.vec(offsets).T
        grad_outer = 2.0 * own / h**power * offsets_row
        grad_h = -power * of_offsets / h
        multipliers_f = ca.MX.sym("sigma")
        multipliers_g = ca.MX.sym("lambda", self.num_constraints)
        jacobian = ca.MX(0, size)
        gradient_columns = ca.MX.zeros(1, len(inner))
        if self.penalised:
            of_samples, of_h = self._bends(unit, h, told, weights)[0], None
            by_columns = self._columns_of(of_samples)
            of_h = ca.sum2(of_samples[len(PLACES), :])
            grad_outer = grad_outer + by_columns[:, outer]
            gradient_columns = by_columns[:, inner]
            grad_h = grad_h + of_h
        else:
            blocks = []
            for limit in range(self.num_limits):
                by_columns, by_h = by_sample(limit)
                inward = ca.horzcat(by_columns[:, inner], by_h) @ chain
                blocks.append(to_x(by_columns[:, outer], inward))
            blocks.append(to_x(ca.MX.zeros(self.num_at_ends, num_out), by_ends))
            jacobian = ca.vertcat(*blocks)
        inward = ca.horzcat(gradient_columns, grad_h) @ chain + by_core
        gradient = to_x(grad_outer, inward)

        # The Hessian of the Lagrangian.
        if self.penalised:
            multipliers = multipliers_f * weights
            at_ends_multipliers = ca.MX.zeros(self.num_at_ends, 1)
        else:
            count = self.num_limits * self.num_samples
            multipliers = ca.reshape(multipliers_g[:count], self.num_samples, self.num_limits).T
            at_ends_multipliers = multipliers_g[count:]
        of_samples, bends = self._bends(unit, h, told, multipliers)
        by_columns = self._columns_of(of_samples)
        full = self._hessian_of_columns(bends, num_columns)
        full_out_out = full[outer, outer] + multipliers_f * 2.0 * own / h**power * ca.MX.eye(
            num_out
        )
        with_h = multipliers_f * (-power) * grad_of_energy(own, offsets_row, h, power)
        inner_h = [*inner, 3 * num_columns]
        out_in = full[outer, inner_h]
        out_in = out_in + ca.horzcat(ca.MX.zeros(num_out, len(inner)), with_h.T)
        corner = multipliers_f * power * (power + 1) * of_offsets / h**2
        bump = ca.MX.zeros(num_in, num_in)
        bump[num_in - 1, num_in - 1] = corner
        in_in = full[inner_h, inner_h] + bump
        slope_h = ca.sum2(of_samples[len(PLACES), :])
        slope_h = slope_h - multipliers_f * power * of_offsets / h
        outward_weights = ca.vertcat(by_columns[:, inner].T, slope_h)
        bend = self._ends_bend(
            natural, told, ca.vertcat(outward_weights, multipliers_f, at_ends_multipliers)
        )
        mixed = out_in @ chain
        last = chain.T @ in_in @ chain + bend
        hessian = ca.vertcat(
            ca.horzcat(full_out_out[place, place], mixed[place, :]),
            ca.horzcat(mixed[place, :].T, last),
        )
        hessian = ca.triu(hessian * ca.repmat(scale_row, size, 1) * ca.repmat(scale_row.T, 1, size))
        cheap_outward, cheap_core, cheap_ends = self._ends(natural, told)
        cheap_columns = ca.vertcat(ca.reshape(cheap_outward[: 3 * rows], rows, 3), offsets)
        cheap_h = cheap_outward[3 * rows]
        cheap = self._values(self._unit(cheap_columns), cheap_h, told)
        cheap_f = cheap_core + own * ca.sumsqr(offsets) / cheap_h**power
        if self.penalised:
            cheap_f, cheap_g = cheap_f + ca.sum2(cheap * weights), ca.MX(0, 1)
        else:
            cheap_g = ca.vertcat(ca.vec(cheap.T), cheap_ends)
        names = ["x", "p"]
        # The excesses of a point, whether they are constraints or not: largest of all.
        limits = self._limits(self._unit(cheap_columns), cheap_h, told)
        self.worst = ca.Function(
            "worst", [x, told], [ca.fmax(ca.mmax(limits), ca.mmax(cheap_ends))], names, ["worst"]
        )
        return [
            ca.Function("nlp", [x, told], [cheap_f, cheap_g], names, ["f", "g"]),
            ca.Function("gradient", [x, told], [f, gradient.T], names, ["f", "grad_f_x"]),
            ca.Function("jacobian", [x, told], [g, jacobian], names, ["g", "jac_g_x"]),
            ca.Function(
                "hessian",
                [x, told, multipliers_f, multipliers_g],
                [hessian],
                ["x", "p", "lam_f", "lam_g"],
                ["hess"],
            ),
        ]

    def _unit(self, columns: Any) -> Any:
        """The samples (10, K) in time over h of columns (C, 3)."""
        sampled = [matrix @ columns for matrix in self._matrices]
        return ca.vertcat(*(sampled[order][:, axis].T for order, axis in PLACES))

    def _columns_of(self, of_samples: Any) -> Any:
        """Slopes (1, 3 C) by columns axis by axis, from those (11, K) by the samples."""
        parts = []
        for axis in range(3):
            part: Any = 0.0
            for i, (order, own) in enumerate(PLACES):
                if own == axis:
                    part = part + of_samples[i, :] @ self._matrices[order]
            parts.append(part)
        return ca.horzcat(*parts)

    def _hessian_of_columns(self, bends: Any, num_columns: int) -> Any:
        """The Hessian (3 C + 1, 3 C + 1) by columns and h, from that of every sample."""
        last = len(PLACES)
        blocks: list[list[Any]] = [[None] * 4 for _ in range(4)]

        def add(i: int, j: int, part: Any) -> None:
            blocks[i][j] = part if blocks[i][j] is None else blocks[i][j] + part

        # (order, axis, order', axis') -> factors (K, 1); both triangles.
        factors: dict[tuple, Any] = {}
        for k, (i, j) in enumerate(self._bend_places):
            value = bends[k, :].T
            if i == last and j == last:
                add(3, 3, ca.sum1(value))
            elif j == last:
                order, axis = PLACES[i]
                part = self._matrices[order].T @ value
                add(axis, 3, part)
                add(3, axis, part.T)
            else:
                factors[i, j] = value
                factors[j, i] = value
        for a in range(3):
            for b in range(a, 3):
                whole: Any = None
                for i, (order, axis) in enumerate(PLACES):
                    if axis != a:
                        continue
                    inside: Any = None
                    for j, (other, axis_other) in enumerate(PLACES):
                        if axis_other != b or (i, j) not in factors:
                            continue
                        part = ca.repmat(factors[i, j], 1, num_columns) * self._matrices[other]
                        inside = part if inside is None else inside + part
                    if inside is not None:
                        product = self._matrices[order].T @ inside
                        whole = product if whole is None else whole + product
                if whole is not None:
                    add(a, b, whole)
                    if a != b:
                        add(b, a, whole.T)
        sizes = (num_columns, num_columns, num_columns, 1)
        return ca.vertcat(
            *(
                ca.horzcat(
                    *(
                        ca.MX.zeros(sizes[i], sizes[j]) if part is None else part
                        for j, part in enumerate(line)
                    )
                )
                for i, line in enumerate(blocks)
            )
        )

    def _as_machine_code(self) -> list:
        """The functions, compiled."""
        self._folder = tempfile.TemporaryDirectory(prefix="ipopt-")
        folder = Path(self._folder.name)
        code = ca.CodeGenerator("program.c")
        for function in self.functions:
            code.add(function)
        code.generate(f"{folder}/")
        library = folder / "program.so"
        subprocess.run([*COMPILER, str(folder / "program.c"), "-o", str(library)], check=True)
        return [ca.external(function.name(), str(library)) for function in self.functions]


def grad_of_energy(own: float, offsets_row: Any, h: Any, power: int) -> Any:
    """Slope by the offsets and h of their energy, over minus the power: (1, 3 (M - 1))."""
    return 2.0 * own * offsets_row / h ** (power + 1)
