"""Run IPOPT on a batch of cases, one after another on one core, time it, and record its iterates.

`benchmarks.ipopt` uses this module.
"""

import dataclasses
import shutil
import time
from types import ModuleType
from typing import Any

import jax
import numpy as np

from planner_jax.benchmarks.ipopt_peer.program import COMPILER, Program, ca
from planner_jax.core.protocol import take
from planner_jax.cost.along import BETWEEN_NODES

# Options of the linear solver MUMPS: its defaults; or no scaling and a cheap reordering, because
# the matrices are small.
_USUAL: dict[str, Any] = {}
_PLAIN = {"mumps_scaling": 0, "mumps_permuting_scaling": 0, "mumps_pivot_order": 0}
_ADAPTIVE = {"mu_strategy": "adaptive"}
# Options of IPOPT for initial guesses that are close to the optimum.
_NEAR = {"mu_init": 1e-3, "bound_push": 1e-3, "slack_bound_push": 1e-3}
_QUASI_NEWTON = {"hessian_approximation": "limited-memory", "max_iter": 100}
# For limits as constraints and for limits as penalties, the settings to try: (tolerance, options of
# IPOPT, whether the functions are compiled C code).
TRIED: dict[str, tuple[tuple[float, dict[str, Any], bool], ...]] = {
    "limits": (
        (1e-6, _PLAIN, True),
        (1e-6, _PLAIN | _ADAPTIVE, True),
        (1e-4, _PLAIN, True),
        (1e-4, _PLAIN | _ADAPTIVE, True),
        (1e-3, _PLAIN, True),
        (1e-3, _PLAIN | _ADAPTIVE, True),
        (1e-3, _USUAL | _ADAPTIVE, True),
        (1e-3, _PLAIN | _ADAPTIVE, False),
        (1e-3, _PLAIN | _NEAR, True),
        (1e-2, _PLAIN | _ADAPTIVE, True),
        (1e-3, _PLAIN | _QUASI_NEWTON, True),
    ),
    "penalties": (
        (1e-6, _PLAIN, True),
        (1e-4, _PLAIN, True),
        (1e-4, _PLAIN, False),
        (1e-4, _USUAL, True),
        (1e-3, _PLAIN, True),
        (1e-2, _PLAIN, True),
        (1e-4, _PLAIN | _QUASI_NEWTON, True),
    ),
}
MOST_STEPS = 300  # Maximum number of IPOPT's iterations.
# A setting of IPOPT is accepted if in nine of ten cases its objective exceeds the least objective
# of all settings by at most this relative amount.
AS_GOOD = 1e-3


@dataclasses.dataclass
class Batch:
    """Parameters and initial guesses of B cases (planning problems) for IPOPT."""

    params: np.ndarray  # (B, P), the P parameters of each case
    starts: np.ndarray  # (B, n), initial guesses of the n decision variables


@dataclasses.dataclass
class Solutions:
    """Results of IPOPT on B cases."""

    points: np.ndarray  # (B, n), decision variables at which IPOPT stopped
    objectives: np.ndarray  # (B,), the objective that IPOPT minimised
    seconds: np.ndarray  # (B,) [s], CPU time
    steps: np.ndarray  # (B,), number of iterations
    converged: np.ndarray  # (B,) bool, as reported by IPOPT


def stack_params(module: ModuleType, ours: Any, contexts: Any) -> np.ndarray:
    """Return the numbers of B cases on which IPOPT's problem depends, such as limits, (B, P).

    `contexts` are the results of the planner's `prepare` for the cases: each has a case and
    precomputed data, such as a table of a ball's path. `module` is `hits` or `catches`.
    """
    contexts = jax.tree.map(np.asarray, contexts)
    sizes = module.make_problem(ours).sizes
    num = jax.tree.leaves(contexts)[0].shape[0]
    each = (module.read_params(take(contexts, k)) for k in range(num))
    return np.stack([np.concatenate([np.ravel(one[name]) for name in sizes]) for one in each])


class Peer:
    """IPOPT on the problem of a ours, with limits as constraints or as penalties.

    Args:
        module: defines the task's problem, `hits` or `catches`.
        ours: a `HitProblem` or `CatchProblem`.
        form: "limits" has limits as constraints, "penalties" minimises the planner's own objective.
        unit: a typical cost; IPOPT's tolerances are relative to it.
        compiled: whether to compile the functions as C code too, if there is a compiler.
    """

    def __init__(
        self, module: ModuleType, ours: Any, form: str, unit: float, compiled: bool = True
    ):
        problem, penalised = module.make_problem(ours), form == "penalties"
        self.form, self._scale, began = form, 1.0 / unit, time.perf_counter()
        self.programs = {False: Program(problem, penalised, BETWEEN_NODES)}
        self.build_seconds, began = time.perf_counter() - began, time.perf_counter()
        if compiled and shutil.which(COMPILER[0]):
            self.programs[True] = Program(problem, penalised, BETWEEN_NODES, compiled=True)
        self.compile_seconds = time.perf_counter() - began

    def solve(
        self, setting: tuple[float, dict[str, Any], bool], batch: Batch, repeat: int = 1
    ) -> Solutions:
        """Solve all cases with one setting; the fastest of `repeat` tries of a case is its time.

        A setting is (tolerance, options of IPOPT, whether to use compiled C code).
        """
        solver, options = self._solver(setting)
        solver(batch.starts[0], batch.params[0])  # IPOPT's first call initialises it
        found, seconds = [], np.full(len(batch.starts), np.inf)
        for _ in range(repeat):
            found = []
            for k, (start, params) in enumerate(zip(batch.starts, batch.params, strict=True)):
                began = time.process_time()
                result, stats = solver(start, params)
                seconds[k] = min(seconds[k], time.process_time() - began)
                found.append((np.ravel(np.asarray(result["x"])), float(result["f"]), stats))
        points, objectives, stats = zip(*found, strict=True)
        return Solutions(
            points=np.stack(points),
            objectives=np.array(objectives),
            seconds=seconds,
            steps=np.array([each["iter_count"] for each in stats]),
            converged=np.array([each["success"] for each in stats]),
        )

    def iterates(
        self, setting: tuple[float, dict[str, Any], bool], batch: Batch
    ) -> list[np.ndarray]:
        """Return for each case the n variables after each iteration of IPOPT, (steps + 1, n).

        A setting is (tolerance, options of IPOPT, whether to use compiled C code).
        """
        size = batch.starts.shape[1]
        program = self.programs[False]
        callback = _Recorder(size, program.num_constraints, batch.params.shape[1])
        solver, _ = self._solver(setting, callback)
        paths = []
        for start, params in zip(batch.starts, batch.params, strict=True):
            callback.points.clear()
            solver(start, params)
            paths.append(np.stack(callback.points))
        return paths

    def _solver(self, setting: tuple[float, dict, bool], callback: Any = None) -> Any:
        tolerance, options, compiled = setting
        given = {"max_iter": MOST_STEPS, "obj_scaling_factor": self._scale, "tol": tolerance}
        given |= options
        return self.programs[compiled].solver(given, callback), given


class _Recorder(ca.Callback):
    """Callback that CasADi calls in each iteration of IPOPT, to store the iterate."""

    def __init__(self, size: int, constraints: int, params: int):
        ca.Callback.__init__(self)
        self.points: list[np.ndarray] = []
        self._sizes = {"x": size, "f": 1, "g": constraints, "lam_x": size}
        self._sizes |= {"lam_g": constraints, "lam_p": params}
        self.construct("recorder", {})

    def get_n_in(self):
        return ca.nlpsol_n_out()

    def get_n_out(self):
        return 1

    def get_name_in(self, i):
        return ca.nlpsol_out(i)

    def get_name_out(self, i):
        return "ret"

    def get_sparsity_in(self, i):
        return ca.Sparsity.dense(self._sizes[ca.nlpsol_out(i)], 1)

    def eval(self, arg):
        self.points.append(np.ravel(np.asarray(arg[0])))
        return [0]


def best_setting(peer: Peer, batch: Batch, accepted: Any) -> tuple[tuple, list[dict[str, Any]]]:
    """Select the fastest setting of IPOPT among those with the highest success rate.

    Moreover, in nine of ten cases the setting's objective must be at most 0.1 % above the least
    objective of all settings. If no setting fulfils both conditions, the setting is selected whose
    90 % quantile of the relative excess over the least objective is the smallest.

    Args:
        peer: IPOPT on one form of the problem; the settings for this form are tried.
        batch: cases that are used for tuning only.
        accepted: function that maps n decision variables of B cases (B, n) to whether the referee,
            an independent check, accepts the plans, (B,) bool.

    Returns:
        The selected setting, and a row of figures for each tried setting.
    """
    tried = [each for each in TRIED[peer.form] if each[2] in peer.programs]
    found = [peer.solve(each, batch) for each in tried]
    passed = np.stack([accepted(each.points) for each in found])
    objectives = np.stack([each.objectives for each in found])
    least = np.min(np.where(passed, objectives, np.inf), axis=0)
    above = objectives / least - 1.0
    known = np.isfinite(least)
    quantiles = np.quantile(above[:, known], 0.9, axis=1)
    seconds = np.array([each.seconds.mean() for each in found])
    fit = (passed.sum(axis=1) == passed.sum(axis=1).max()) & (quantiles <= AS_GOOD)
    chosen = np.argmin(np.where(fit, seconds, np.inf)) if fit.any() else np.argmin(quantiles)
    rows = [
        {
            "form": peer.form,
            "tolerance": setting[0],
            "options": setting[1],
            "compiled": setting[2],
            "success_rate": passed[k].mean(),
            "above_p90": quantiles[k],
            "steps": found[k].steps.mean(),
            "milliseconds": 1e3 * seconds[k],
            "chosen": k == chosen,
        }
        for k, setting in enumerate(tried)
    ]
    return tried[chosen], rows
