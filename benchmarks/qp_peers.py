"""Clarabel and OSQP, published solvers of quadratic programs, for comparison in `intercept_speed`.

They are installed with the extra `peers`, and solve the programs of `baselines.intercept.qp`:
minimise x' Q x / 2 over x, subject to equalities and to lower and upper bounds of R x, where Q and
R are constant matrices.
"""

import dataclasses
import importlib
import importlib.util
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import scipy.sparse

INSTALL = "pip install 'planner-jax[peers]' adds Clarabel and OSQP to compare with"


def is_installed(name: str) -> bool:
    """Return whether the Python package of a solver is installed."""
    return importlib.util.find_spec(name) is not None


@dataclasses.dataclass(frozen=True)
class PeerSolution:
    """Solution of one quadratic program by Clarabel or OSQP, and the duration of the call."""

    point: np.ndarray  # (n,), the n unknowns x
    cost: float  # minimised cost x' Q x / 2, with the Hessian Q
    solved: bool  # as reported by the solver
    seconds: float  # duration of the call [s], NaN if the solver was not called


def clarabel_solver(matrices: Mapping[str, np.ndarray]) -> Callable[..., PeerSolution]:
    """Return a function that solves quadratic programs with given matrices by Clarabel.

    Clarabel is an interior-point method. The returned function takes right-hand sides of the
    equalities, lower bounds and upper bounds. Clarabel is set up anew for every program, because
    its interface cannot change which bounds are infinite. This is part of the measured time.

    Args:
        matrices: "hessian" (n, n), the cost x' Q x / 2 of n unknowns x; "equalities" (q, n); "rows"
            (M, n), whose products with x are bounded; "zeros" (z, n), equalities with right-hand
            sides 0.
    """
    clarabel: Any = importlib.import_module("clarabel")

    hessian, equalities, rows = _to_sparse(matrices)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-9

    def solve(right_side: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> PeerSolution:
        has_lower, has_upper = np.isfinite(lower), np.isfinite(upper)
        matrix = scipy.sparse.vstack([equalities, rows[has_upper], -rows[has_lower]], format="csc")
        known = np.concatenate(
            [_equality_values(matrices, right_side), upper[has_upper], -lower[has_lower]]
        )
        inequalities = len(known) - equalities.shape[0]
        cones = [
            clarabel.ZeroConeT(equalities.shape[0]),
            clarabel.NonnegativeConeT(inequalities),
        ]
        began = time.perf_counter()
        linear = np.zeros(hessian.shape[0])
        found = clarabel.DefaultSolver(hessian, linear, matrix, known, cones, settings).solve()
        seconds = time.perf_counter() - began
        solved = str(found.status) in ("Solved", "AlmostSolved")
        return _make_solution(matrices, np.asarray(found.x), solved, seconds)

    return solve


def osqp_solver(matrices: Mapping[str, np.ndarray]) -> Callable[..., PeerSolution]:
    """Return a function that solves quadratic programs with given matrices by OSQP.

    OSQP is the solver of [Qu2022]. The returned function takes right-hand sides of the equalities,
    lower bounds and upper bounds. OSQP is set up once. For every program it gets new bounds, and
    starts at the solution of the previous program.

    Args:
        matrices: "hessian" (n, n), the cost x' Q x / 2 of n unknowns x; "equalities" (q, n); "rows"
            (M, n), whose products with x are bounded; "zeros" (z, n), equalities with right-hand
            sides 0.
    """
    osqp: Any = importlib.import_module("osqp")

    hessian, equalities, rows = _to_sparse(matrices)
    matrix = scipy.sparse.vstack([equalities, rows], format="csc")
    unbounded = np.full(equalities.shape[0] + rows.shape[0], np.inf)
    solver = osqp.OSQP()
    solver.setup(
        hessian,
        np.zeros(hessian.shape[0]),
        matrix,
        -unbounded,
        unbounded,
        verbose=False,
        eps_abs=1e-5,
        eps_rel=1e-5,
        max_iter=20_000,
    )

    def solve(right_side: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> PeerSolution:
        known = _equality_values(matrices, right_side)
        low, high = np.concatenate([known, lower]), np.concatenate([known, upper])
        if (low > high).any():  # OSQP rejects a lower bound above its upper bound.
            return _make_solution(matrices, np.full(hessian.shape[0], np.nan), False, np.nan)
        began = time.perf_counter()
        solver.update(l=low, u=high)
        found = solver.solve(raise_error=False)
        seconds = time.perf_counter() - began
        return _make_solution(matrices, np.asarray(found.x), found.info.status == "solved", seconds)

    return solve


def _to_sparse(matrices: Mapping[str, np.ndarray]) -> tuple[Any, Any, Any]:
    equalities = np.concatenate([matrices["equalities"], matrices["zeros"]])
    hessian = scipy.sparse.csc_matrix(np.triu(matrices["hessian"]))
    return hessian, scipy.sparse.csr_matrix(equalities), scipy.sparse.csr_matrix(matrices["rows"])


def _equality_values(matrices: Mapping[str, np.ndarray], right_side: np.ndarray) -> np.ndarray:
    return np.concatenate([np.asarray(right_side, float), np.zeros(len(matrices["zeros"]))])


def _make_solution(
    matrices: Mapping[str, np.ndarray], point: np.ndarray, solved: bool, seconds: float
) -> PeerSolution:
    cost = 0.5 * point @ matrices["hessian"] @ point
    return PeerSolution(point=point, cost=float(cost), solved=solved, seconds=seconds)


PEERS = {"clarabel": clarabel_solver, "osqp": osqp_solver}
