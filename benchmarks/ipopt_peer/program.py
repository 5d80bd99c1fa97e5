"""The nonlinear program of one minimum-snap trajectory with exact derivatives, for IPOPT.

`benchmarks.ipopt` compares the planners with IPOPT on this program. It has the decision variables x
of `HitProblem` and `CatchProblem`: offsets of the waypoints from the smoothest trajectory, in
scaled ("whitened") coordinates, and a few variables that describe the state at its end.
The program shares only the trajectory's constant matrices and the settings with the planners.

The program is computed in three steps:
1. The variables of the end determine the boundary conditions: position to jerk at both ends, in
   units of the mean duration h of a piece. They also determine h.
2. Boundary conditions and offsets form the coefficients of the trajectory. The samples of the
   trajectory, in units of h, are constant matrices times the coefficients.
3. The limits are evaluated at each sample.

CasADi differentiates only the small functions of steps 1 and 3 symbolically. The chain rule through
the matrices of step 2 is implemented here. If CasADi differentiated the whole program, its
expression graph would be about a hundred times larger, and IPOPT slower.
"""

import dataclasses
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from planner_jax.benchmarks.ipopt_peer.basis import ORDERS, PLACES, Basis, ca
from planner_jax.cost.penalty import join_trapezoid_weights

COMPILER = ("cc", "-O3", "-march=native", "-ffast-math", "-fPIC", "-shared")


@dataclasses.dataclass(frozen=True)
class Problem:
    """Definition of the trajectory problem of a task, a hit or a catch.

    All functions take and return CasADi symbols. Their argument `params` is a dict of the
    parameters of a case by name, with the lengths in `sizes`. An excess is positive if a limit is
    exceeded.
    """

    ours: Any  # the `HitProblem` or `CatchProblem` whose settings are used
    sizes: dict[str, int]  # names of the parameters of a case, with their numbers of values
    num_natural: int  # number of variables that describe the end of the trajectory
    # Function of the end's variables and `params`. Returns position to jerk at the end (4, 3), the
    # duration [s], a list of excesses over limits at the end, and a cost.
    ends: Callable[[Any, dict], tuple[Any, Any, list, Any]]
    # Function of height, velocity, acceleration and jerk at a sample, and `params`. Returns a list
    # of excesses over limits.
    limits: Callable[[Any, Any, Any, Any, dict], list]
    # Factor for each limit. The limit's penalty starts at the excess -margin * factor, where
    # `margin` is a setting of the ours.
    factors: tuple[float, ...]
    impact_weight: float  # [s], weight of the penalties at the end


def hinge(x: Any, width: float) -> Any:
    """Return a smooth approximation of max(x, 0), the penalty of an excess [Yu2023catch, eq. 27b].

    It is 0 for x <= 0, and x - `width` / 2 for x >= `width`.
    """
    blend = (width - 0.5 * x) * (x / width) ** 3
    return ca.if_else(x <= 0.0, 0.0, ca.if_else(x < width, blend, x - 0.5 * width))


def rate_squared(acc: Any, jerk: Any, gravity: Any) -> Any:
    """Return the squared body rate [rad^2/s^2] from acceleration and jerk, by flatness.

    The attitude is given by the Hopf fibration at zero heading.
    """
    thrust = acc + ca.vertcat(0.0, 0.0, gravity)
    squared = ca.fmax(ca.sumsqr(thrust), 1e-4)
    size = ca.sqrt(squared)
    tilt = (ca.sumsqr(jerk) - ca.dot(thrust, jerk) ** 2 / squared) / squared
    twist = (thrust[1] * jerk[0] - thrust[0] * jerk[1]) / size
    return tilt + (twist / ca.fmax(size + thrust[2], 1e-2)) ** 2


def body_axes(axis: Any) -> tuple[Any, Any]:
    """Return the body's x and y axes from its z axis, by the Hopf fibration at zero heading."""
    x, y, z = axis[0], axis[1], axis[2]
    k = 1.0 / ca.fmax(1.0 + z, 1e-6)
    return ca.vertcat(1.0 - k * x * x, -k * x * y, -x), ca.vertcat(-k * x * y, 1.0 - k * y * y, -y)


def compile_functions(functions: list) -> list:
    """Generate C code of all functions, compile it, and load the compiled functions.

    The temporary files are deleted, because the loaded library does not need them.
    """
    code = ca.CodeGenerator("program.c")
    for function in functions:
        code.add(function)
    with tempfile.TemporaryDirectory(prefix="ipopt-") as folder:
        source, library = Path(folder, "program.c"), Path(folder, "program.so")
        code.generate(f"{folder}/")
        subprocess.run([*COMPILER, str(source), "-o", str(library)], check=True)
        return [ca.external(function.name(), str(library)) for function in functions]


class Program:
    """The nonlinear program of a problem with its derivatives, built once for all cases.

    Args:
        problem: definition of the task's problem.
        penalised: whether limits are penalties in the objective, as in the ours, or constraints.
        backoff: margin of the constraints: every excess must be at most -backoff.
        compiled: whether functions are compiled C code, or run by CasADi's virtual machine.
    """

    def __init__(
        self, problem: Problem, penalised: bool, backoff: float = 0.0, *, compiled: bool = False
    ):
        ours = problem.ours
        self.problem, self.penalised, self.backoff = problem, penalised, backoff
        self._maps = ours.maps
        self._basis = Basis(ours)
        weights = join_trapezoid_weights(ours.nodes, self._maps.proportions)
        self._weights, self.num_samples = ca.DM(weights).T, len(weights)
        self.num_params = sum(problem.sizes.values())
        self._power = 2 * self._maps.order - 1
        self._own = ours.energy_weight * self._maps.offset_energy
        self._build_ends()
        self._build_limits()
        self.worst = self._worst()
        self.functions = [self._nlp(), self._gradient(), self._jacobian(), self._hessian()]
        if compiled:
            self.functions = compile_functions(self.functions)

    def solver(self, options: dict[str, Any], callback: Any = None) -> Callable:
        """Return a function that runs IPOPT from an initial guess of the n variables x.

        The function's arguments are the initial guess (n,) and the parameters of a case. It returns
        CasADi's result and statistics. `callback` is called in each iteration.
        """
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

        def solve_case(start: np.ndarray, params: np.ndarray) -> tuple[dict, dict]:
            found = solve(x0=start, p=params, lbg=least, ubg=-self.backoff)
            return found, solve.stats()

        return solve_case

    def _split(self, vector: Any) -> dict:
        ends = np.cumsum([0, *self.problem.sizes.values()]).tolist()
        return {n: vector[ends[i] : ends[i + 1]] for i, n in enumerate(self.problem.sizes)}

    def _build_ends(self) -> None:
        """Build the function of the variables that describe the trajectory's end.

        Its outputs are the boundary conditions by axis, the mean duration of a piece, the cost, and
        the excesses over limits at the end. Also build its Jacobian, and the Hessian of a weighted
        sum of its outputs.
        """
        problem, ours = self.problem, self.problem.ours
        natural = ca.SX.sym("natural", problem.num_natural)
        params = ca.SX.sym("params", self.num_params)
        named = self._split(params)
        tail, time, excess, cost = problem.ends(natural, named)
        duration, excess = time / ours.num_pieces, ca.vertcat(*excess)
        head = ca.reshape(named["head_state"], 3, ORDERS).T
        scale = ca.repmat(ca.vertcat(*[duration**k for k in range(ORDERS)]), 1, 3)
        rows = ca.vertcat(head * scale, tail * scale)
        gram = ca.DM(self._maps.boundary_energy)
        energy = ca.sum1(ca.sum2(rows * (gram @ rows))) / duration**self._power
        core = cost + ours.energy_weight * energy
        self._num_at_ends = excess.numel()
        if self.penalised:
            inside = ca.vertsplit(excess + ours.margin)
            hinges = sum(hinge(each, ours.hinge_width) for each in inside)
            core = core + problem.impact_weight * hinges
        outward = ca.vertcat(ca.vec(rows), duration)
        together = ca.vertcat(outward, core, excess)
        weights = ca.SX.sym("weights", together.numel())
        slopes = ca.densify(ca.jacobian(together, natural))
        bend = ca.densify(ca.hessian(ca.dot(weights, together), natural)[0])
        given, found = [natural, params], [outward, core, excess]
        self._ends = ca.Function("ends", given, found)
        self._ends_slopes = ca.Function("ends_slopes", given, [*found, slopes])
        self._ends_bend = ca.Function("ends_bend", [*given, weights], [bend])

    def _build_limits(self) -> None:
        """Build the functions of the limits at a sample with derivatives, mapped over all samples.

        Their inputs are the sample, in units of the mean duration h of a piece, h itself, and the
        parameters. If limits are penalties, the functions return one value: the sum of the sample's
        penalties times h.
        """
        ours, factors = self.problem.ours, self.problem.factors
        unit, h = ca.SX.sym("unit", len(PLACES)), ca.SX.sym("h")
        params = ca.SX.sym("params", self.num_params)
        at = [unit[i] / h**order for i, (order, _) in enumerate(PLACES)]
        vel, acc, jerk = (ca.vertcat(*at[i : i + 3]) for i in (1, 4, 7))
        limits = ca.vertcat(*self.problem.limits(at[0], vel, acc, jerk, self._split(params)))
        values = limits
        if self.penalised:
            inside = limits + ours.margin * ca.DM(factors)
            values = h * sum(hinge(each, ours.hinge_width) for each in ca.vertsplit(inside))
        self._num_values = values.numel()
        num_limits = self._num_values * self.num_samples + self._num_at_ends
        self.num_constraints = 0 if self.penalised else num_limits
        multipliers = ca.SX.sym("multipliers", self._num_values)
        variables = ca.vertcat(unit, h)
        slopes = ca.jacobian(values, variables)
        bend, gradient = ca.hessian(ca.dot(multipliers, values), variables)
        bend = ca.triu(bend)
        self._slope_places = list(zip(*slopes.sparsity().get_triplet(), strict=True))
        self._bend_places = list(zip(*bend.sparsity().get_triplet(), strict=True))

        def map_samples(name: str, given: list, found: list) -> Any:
            of_sample = ca.Function(name, [unit, h, params, *given], found)
            return of_sample.map(f"{name}_map", "serial", self.num_samples, [1, 2], [])

        filled = lambda matrix: ca.vertcat(*matrix.nonzeros())  # noqa: E731
        self._limits = map_samples("limits", [], [limits])
        self._values = map_samples("values", [], [values])
        self._slopes = map_samples("slopes", [], [values, filled(slopes)])
        self._bends = map_samples("bends", [multipliers], [ca.densify(gradient), filled(bend)])

    def _point(self) -> tuple[Any, Any, Any, Any]:
        """Return symbols of the decision variables x and of the parameters, and the parts of x.

        The parts are the unscaled variables of the trajectory's end, and the offsets (M - 1, 3) of
        the waypoints from the smoothest trajectory, for M pieces.
        """
        num = self.problem.ours.num_offsets
        scale = self._basis.scale
        x, params = ca.MX.sym("x", scale.numel()), ca.MX.sym("params", self.num_params)
        natural = x * scale.T
        return x, params, natural[num:], ca.reshape(natural[:num], 3, num // 3).T

    def _offset_energy(self, offsets: Any, h: Any) -> Any:
        return self._own * ca.sumsqr(offsets) / h**self._power

    def _worst(self) -> Any:
        """Build a function of the decision variables: the largest excess over a limit."""
        x, params, natural, offsets = self._point()
        outward, _, at_ends = self._ends(natural, params)
        columns, h = self._basis.join(outward, offsets)
        limits = self._limits(self._basis.sample(columns), h, params)
        return ca.Function("worst", [x, params], [ca.fmax(ca.mmax(limits), ca.mmax(at_ends))])

    def _nlp(self) -> Any:
        """Build the objective and the constraints of IPOPT's program, from the variables x.

        The constraints are the limits at the samples of the trajectory, and then the limits at its
        end. There are none if the limits are penalties in the objective.
        """
        x, params, natural, offsets = self._point()
        outward, core, at_ends = self._ends(natural, params)
        columns, h = self._basis.join(outward, offsets)
        values = self._values(self._basis.sample(columns), h, params)
        f, g = core + self._offset_energy(offsets, h), ca.MX(0, 1)
        if self.penalised:
            f = f + ca.sum2(values * self._weights)
        else:
            g = ca.vertcat(ca.vec(values.T), at_ends)
        return ca.Function("nlp", [x, params], [f, g], ["x", "p"], ["f", "g"])

    def _gradient(self) -> Any:
        x, params, natural, offsets = self._point()
        outward, core, _, by_natural = self._ends_slopes(natural, params)
        columns, h = self._basis.join(outward, offsets)
        energy, num_in = self._offset_energy(offsets, h), len(self._basis.inner) + 1
        f = core + energy
        by_outer = 2.0 * self._own / h**self._power * ca.vec(offsets).T
        by_inner, by_h = ca.MX.zeros(1, len(self._basis.inner)), -self._power * energy / h
        if self.penalised:
            unit = self._basis.sample(columns)
            f = f + ca.sum2(self._values(unit, h, params) * self._weights)
            of_samples, _ = self._bends(unit, h, params, self._weights)
            by_columns = self._basis.gradient(of_samples)
            by_outer = by_outer + by_columns[:, self._basis.outer]
            by_inner = by_columns[:, self._basis.inner]
            by_h = by_h + ca.sum2(of_samples[len(PLACES), :])
        inward = ca.horzcat(by_inner, by_h) @ by_natural[:num_in, :] + by_natural[num_in, :]
        gradient = self._basis.to_x(by_outer, inward).T
        return ca.Function("gradient", [x, params], [f, gradient], ["x", "p"], ["f", "grad_f_x"])

    def _jacobian(self) -> Any:
        x, params, natural, offsets = self._point()
        outward, _, at_ends, by_natural = self._ends_slopes(natural, params)
        columns, h = self._basis.join(outward, offsets)
        values, slopes = self._slopes(self._basis.sample(columns), h, params)
        g, jacobian = ca.MX(0, 1), ca.MX(0, x.numel())
        if not self.penalised:
            num_in, blocks = len(self._basis.inner) + 1, []
            for limit in range(self._num_values):
                by_columns, by_h = self._basis.limit_slopes(limit, slopes, self._slope_places)
                by_inner = ca.horzcat(by_columns[:, self._basis.inner], by_h)
                inward = by_inner @ by_natural[:num_in, :]
                blocks.append(self._basis.to_x(by_columns[:, self._basis.outer], inward))
            none = ca.MX.zeros(self._num_at_ends, len(self._basis.outer))
            blocks.append(self._basis.to_x(none, by_natural[num_in + 1 :, :]))
            g, jacobian = ca.vertcat(ca.vec(values.T), at_ends), ca.vertcat(*blocks)
        return ca.Function("jacobian", [x, params], [g, jacobian], ["x", "p"], ["g", "jac_g_x"])

    def _hessian(self) -> Any:
        """Build the upper triangle of the Hessian of the Lagrangian with respect to x."""
        x, params, natural, offsets = self._point()
        of_f, of_g = ca.MX.sym("of_f"), ca.MX.sym("of_g", self.num_constraints)
        outward, _, _, by_natural = self._ends_slopes(natural, params)
        columns, h = self._basis.join(outward, offsets)
        if self.penalised:
            multipliers, at_ends = of_f * self._weights, ca.MX.zeros(self._num_at_ends, 1)
        else:
            count = self._num_values * self.num_samples
            multipliers = ca.reshape(of_g[:count], self.num_samples, self._num_values).T
            at_ends = of_g[count:]
        of_samples, bends = self._bends(self._basis.sample(columns), h, params, multipliers)
        by_columns = self._basis.gradient(of_samples)
        full = self._basis.hessian(bends, self._bend_places)
        power, energy = self._power, of_f * self._offset_energy(offsets, h)
        bend = 2.0 * of_f * self._own / h**power
        outer, place = self._basis.outer, self._basis.place
        inner = [*self._basis.inner, 3 * self._basis.num]
        num_out, num_in = len(outer), len(inner)
        of_outer = full[outer, outer] + bend * ca.MX.eye(num_out)
        with_h = -power * bend / h * ca.vec(offsets)
        mixed = full[outer, inner]
        mixed = mixed + ca.horzcat(ca.MX.zeros(num_out, num_in - 1), with_h)
        of_h = ca.diagcat(ca.MX.zeros(num_in - 1, num_in - 1), power * (power + 1) * energy / h**2)
        of_inner = full[inner, inner] + of_h
        by_h = ca.sum2(of_samples[len(PLACES), :]) - power * energy / h
        weights = ca.vertcat(by_columns[:, self._basis.inner].T, by_h, of_f, at_ends)
        chain = by_natural[:num_in, :]
        of_natural = chain.T @ of_inner @ chain + self._ends_bend(natural, params, weights)
        mixed = (mixed @ chain)[place, :]
        hessian = ca.vertcat(
            ca.horzcat(of_outer[place, place], mixed),
            ca.horzcat(mixed.T, of_natural),
        )
        hessian = ca.triu(hessian * (self._basis.scale.T @ self._basis.scale))
        names = ["x", "p", "lam_f", "lam_g"]
        return ca.Function("hessian", [x, params, of_f, of_g], [hessian], names, ["hess"])
