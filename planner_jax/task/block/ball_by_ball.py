"""One ball after another, planned at the least latency."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.planning.programs import solve_cases
from planner_jax.protocol import Attempt, is_solved
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan

_CONSTANT = 1 << 16  # bytes of a planner's leaf; larger ones are arguments of what is compiled


class BallByBall:
    """Plans for one ball after another, by programs compiled for the CPU.

    `pj.plan` of one case takes the arm, its limits and the scene in with every ball. Here these,
    and all else but the ball, are those of one case: they are constants of the programs, so that
    what depends on them alone is worked out by the compiler. A ball goes in as one vector, and its
    plan comes back as one: every array that crosses takes a microsecond.
    """

    def __init__(self, planner: Any, case: BlockCase):
        """Compile every attempt of a planner.

        Args:
            planner: with `attempts` and `solve`, such as `OnlineBlock` or `AdaptBlock`.
            case: one case; its ball does not count.
        """
        self.attempts: tuple[Attempt, ...] = tuple(planner.attempts)
        case = jax.tree.map(np.asarray, case)
        leaves, tree = jax.tree.flatten(planner)
        is_large = [np.asarray(leaf).nbytes > _CONSTANT for leaf in leaves]
        cpu = jax.local_devices(backend="cpu")[0]
        large = [leaf for leaf, out in zip(leaves, is_large, strict=True) if out]
        self._large = jax.device_put(large, cpu)

        def packed(attempt: Attempt) -> Callable[[list[Array], Array], Array]:
            def solve(large: list[Array], vector: Array) -> Array:
                given = iter(large)
                own = [next(given) if out else x for x, out in zip(leaves, is_large, strict=True)]
                ball = BallState(pos=vector[:3], vel=vector[3:])
                known = dataclasses.replace(case, ball=ball)
                plan = solve_cases(jax.tree.unflatten(tree, own), known, attempt)
                flat = [jnp.ravel(leaf).astype(vector.dtype) for leaf in jax.tree.leaves(plan)]
                return jnp.concatenate(flat)

            return solve

        dtype = np.asarray(case.angles).dtype
        self._vector = np.zeros(6, dtype)
        shape = jax.ShapeDtypeStruct((6,), dtype)
        plan = jax.eval_shape(lambda case: solve_cases(planner, case, self.attempts[0]), case)
        self._fields, self._tree = jax.tree.flatten(plan)
        with jax.default_device(cpu):
            self._solvers = [
                jax.jit(packed(attempt)).lower(self._large, shape).compile()
                for attempt in self.attempts
            ]

    def plan(self, pos: Any, vel: Any) -> BlockPlan:
        """The plan for a ball, NumPy leaves: that of the first attempt which solves it.

        Where none does it is that of the last one.

        Args:
            pos: (3,) [m], when it is first seen.
            vel: (3,) [m/s].
        """
        vector = self._vector.copy()
        vector[:3], vector[3:] = pos, vel
        plan: Any = None
        for solver in self._solvers:
            plan = self._unpacked(np.asarray(solver(self._large, vector)))
            if is_solved(int(plan.status)):
                break
        return plan

    def _unpacked(self, vector: np.ndarray) -> BlockPlan:
        """The plan whose leaves lie one after another in a vector."""
        leaves, begin = [], 0
        for field in self._fields:
            end = begin + field.size
            leaves.append(vector[begin:end].reshape(field.shape).astype(field.dtype, copy=False))
            begin = end
        return jax.tree.unflatten(self._tree, leaves)
