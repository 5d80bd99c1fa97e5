"""The coefficients of one minimum-snap trajectory, with the chain rule through its samples.

`program.py` builds IPOPT's nonlinear program on these functions. They convert derivatives with
respect to samples of a trajectory to derivatives with respect to its coefficients, and then to
derivatives with respect to the decision variables x.
"""

import importlib
from typing import Any

import numpy as np

ca: Any = importlib.import_module("casadi")  # CasADi is installed with the extra `oracle`.

ORDERS = 4  # Number of boundary conditions at each end: position, velocity, acceleration and jerk.
# The ten components of a sample as (order of the derivative, axis): height, then velocity,
# acceleration and jerk along x, y and z.
PLACES = ((0, 2), *((order, axis) for order in (1, 2, 3) for axis in range(3)))
Places = list[tuple[int, int]]  # indices (row, column) of the entries of a sparse matrix


class Basis:
    """Matrices of a trajectory's C coefficients per axis, and their order in IPOPT's variables x.

    The coefficients of an axis are the boundary conditions (position to jerk at both ends) and then
    the offsets of the waypoints from the smoothest trajectory. Samples of the trajectory are linear
    functions of the coefficients. IPOPT's decision variables x contain the offsets, ordered by
    waypoint, and a few variables of the trajectory's end, which determine the boundary conditions
    and the mean duration h of a piece. The offsets, which are variables themselves, are called
    outer coefficients; the boundary conditions and h, which are functions of variables, inner ones.

    Args:
        ours: the `HitProblem` or `CatchProblem` whose settings and constant matrices are used.
    """

    def __init__(self, ours: Any):
        rows, inside = 2 * ORDERS, ours.num_pieces - 1
        matrices = [ours.maps.sample_matrix(ours.nodes, d) for d in range(ORDERS)]
        self._matrices, self._num_samples = [ca.DM(m) for m in matrices], len(matrices[0])
        self.num = rows + inside
        self.outer = [a * self.num + rows + i for a in range(3) for i in range(inside)]
        self.inner = [a * self.num + i for a in range(3) for i in range(rows)]
        order = [3 * i + axis for axis in range(3) for i in range(inside)]
        self.place = np.argsort(order).tolist()
        self.scale = ca.DM(ours.scale).T

    def join(self, outward: Any, offsets: Any) -> tuple[Any, Any]:
        """Return the C coefficients per axis (C, 3), and the mean duration h of a piece [s].

        `outward` is one vector with the boundary conditions (position to jerk at both ends) and h.
        `offsets` are the offsets of the waypoints from the smoothest trajectory.
        """
        rows = 2 * ORDERS
        columns = ca.vertcat(ca.reshape(outward[: 3 * rows], rows, 3), offsets)
        return columns, outward[3 * rows]

    def sample(self, columns: Any) -> Any:
        """Return samples of the trajectory with coefficients `columns` (C, 3).

        The result (10, K) has for each of K samples the height, and velocity, acceleration and jerk
        along x, y and z. The unit of time is the mean duration of a piece.
        """
        sampled = [matrix @ columns for matrix in self._matrices]
        return ca.vertcat(*(sampled[order][:, axis].T for order, axis in PLACES))

    def to_x(self, by_outer: Any, by_natural: Any) -> Any:
        wide = ca.horzcat(by_outer[:, self.place], by_natural)
        return wide * ca.repmat(self.scale, wide.shape[0], 1)

    def limit_slopes(self, value: int, slopes: Any, places: Places) -> tuple[Any, Any]:
        parts = [ca.MX.zeros(self._num_samples, self.num)] * 3
        by_h = ca.MX.zeros(self._num_samples, 1)
        for k, (i, j) in enumerate(places):
            if i == value and j == len(PLACES):
                by_h = by_h + slopes[k, :].T
            elif i == value:
                order, axis = PLACES[j]
                factor = ca.repmat(slopes[k, :].T, 1, self.num)
                parts[axis] = parts[axis] + factor * self._matrices[order]
        return ca.horzcat(*parts), by_h

    def gradient(self, of_samples: Any) -> Any:
        parts = [ca.MX.zeros(1, self.num)] * 3
        for i, (order, axis) in enumerate(PLACES):
            parts[axis] = parts[axis] + of_samples[i, :] @ self._matrices[order]
        return ca.horzcat(*parts)

    def hessian(self, bends: Any, places: Places) -> Any:
        last, num = len(PLACES), self.num
        factors = {place: bends[k, :].T for k, place in enumerate(places)}
        sizes = (num, num, num, 1)
        blocks = [[ca.MX.zeros(a, b) for b in sizes] for a in sizes]
        for i, (order, axis) in enumerate(PLACES):
            inside: dict[int, Any] = {}
            for j, (other, of) in enumerate(PLACES):
                factor = factors.get((min(i, j), max(i, j)))
                if factor is not None and of >= axis:
                    part = ca.repmat(factor, 1, num) * self._matrices[other]
                    inside[of] = inside[of] + part if of in inside else part
            for of, part in inside.items():
                blocks[axis][of] = blocks[axis][of] + self._matrices[order].T @ part
            if (i, last) in factors:
                blocks[axis][3] = blocks[axis][3] + self._matrices[order].T @ factors[i, last]
        if (last, last) in factors:
            blocks[3][3] = ca.sum1(factors[last, last])
        lower = lambda a, b: blocks[a][b] if a <= b else blocks[b][a].T  # noqa: E731
        return ca.vertcat(*(ca.horzcat(*(lower(a, b) for b in range(4))) for a in range(4)))
