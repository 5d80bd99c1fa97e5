"""The planner that looks motions up; see `planner_jax.baselines.block.library.table`."""

import os
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.typing import ArrayLike

from planner_jax.ball.flight import BallState
from planner_jax.baselines.block.library.file import load_library
from planner_jax.baselines.block.library.table import (
    Answer,
    Library,
    Setting,
    Table,
    fingerprint,
    lookup,
    setting_of,
    unpacked,
)
from planner_jax.core.errors import ArgumentError
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import FEASIBILITY_TOLERANCE, Attempt, Status, status_of
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.motion import polynomial
from planner_jax.task.block.plan import BlockPlan, has_nan
from planner_jax.trajectory.polynomial import PiecewisePolynomial

_SAME_START = 1e-4  # [rad] and [rad/s], how exactly the arm has to be where stored motions begin


@struct.dataclass
class LibraryBlock(Planner):
    """Answers with the stored motion of a ball's pair of cells; the cost is its duration [s].

    The arm stands at a home of the library. A motion that must end at rest begins when the arm may
    start, and the shield then waits; any other one begins so late that it ends at the contact.
    Where nothing is stored for a ball the status is OUT_OF_REACH; it is BLOCKED where the arm does
    not stand at a home, or where the case has another arm, other limits or another scene than the
    library, as `check` says on the host. A stored motion that comes too late, or a ball farther off
    the shield's middle than the case allows, is INFEASIBLE.
    """

    library: Library

    case_type: ClassVar[type] = BlockCase

    @property
    def attempts(self) -> tuple[Attempt, ...]:
        """One: an answer does not get better."""
        return (Attempt(),)

    def check(self, cases: BlockCase) -> None:
        """Raise `ArgumentError` unless the first of the cases is what the library was built for.

        Args:
            cases: one, or a batch.
        """
        first = jax.tree.map(lambda leaf: np.asarray(leaf), cases)
        if cases.batch_shape:
            first = jax.tree.map(lambda leaf: leaf[0], first)
        own, asked = fingerprint(self.library.setting), fingerprint(setting_of(first))
        if own != asked:
            raise ArgumentError(
                "library",
                "of the cases' arm, limits and scene",
                shown=f"one of {own} for cases of {asked}",
            )
        homes = np.asarray(self.library.table.homes)
        off = np.abs(homes - first.angles).max(axis=1).min()
        if off > _SAME_START:
            raise ArgumentError(
                "angles", f"a home of the library to {_SAME_START} rad", shown=f"{off:.3g} rad off"
            )

    def solve(self, case: BlockCase, attempt: Attempt) -> BlockPlan:
        """Return the plan of one case; pure."""
        home, fits = self.home_of(case)
        plan = _answered(self.library.table, case, home)
        status = jnp.where(fits, plan.status, Status.BLOCKED)
        status = jnp.where(has_nan(case), Status.NON_FINITE, status)
        return plan.replace(status=status.astype(jnp.int32))  # type: ignore[attr-defined]

    def home_of(self, case: BlockCase) -> tuple[Array, Array]:
        """Return the nearest home () int32 to the arm, and whether the library fits the case."""
        off = jnp.max(jnp.abs(jnp.asarray(self.library.table.homes) - case.angles), axis=1)
        home = jnp.argmin(off)
        fits = (off[home] <= _SAME_START) & (jnp.max(jnp.abs(case.rates)) <= _SAME_START)
        return home, fits & _is_same(self.library.setting, setting_of(case))


class OneBall:
    """Looks up one ball after another at the least latency, by a program compiled for the CPU.

    A ball goes in as one vector and its answer comes back as one: every array that crosses into a
    compiled program, or out of it, costs a microsecond. The motion is left as it is stored.
    """

    def __init__(self, library: Library, gravity: float = 9.81, home: int = 0):
        """Compile the lookup of a library, for an arm that waits at one of its homes."""
        own = library.table

        def packed(rows: Array, vector: Array) -> Array:
            table = Table(
                rows=rows, homes=own.homes, inner=own.inner, outer=own.outer, layout=own.layout
            )
            ball = BallState(pos=vector[:3], vel=vector[3:])
            found = lookup(table, ball, jnp.asarray(gravity, vector.dtype), home)
            numbers = (found.pair, found.stored, found.time, found.slack, *found.beside)
            numbers = jnp.stack([jnp.asarray(x, vector.dtype) for x in (*numbers, found.cosine)])
            return jnp.concatenate([rows[home, found.pair], numbers])

        self._rows = jax.device_put(own.rows, jax.local_devices(backend="cpu")[0])
        vector = jax.ShapeDtypeStruct((6,), np.float32)
        self._lookup = jax.jit(packed).lower(self._rows, vector).compile()

    def answer(self, pos: ArrayLike, vel: ArrayLike) -> Answer:
        """Look up a ball; return the answer in NumPy arrays and plain numbers.

        Args:
            pos: (3,) [m], when it is first seen.
            vel: (3,) [m/s].
        """
        vector = np.empty(6, np.float32)
        vector[:3], vector[3:] = pos, vel
        found = np.asarray(self._lookup(self._rows, vector))
        pair, stored, time, slack, along, across, cosine = found[-7:].tolist()
        row = unpacked(found[:-7])
        return Answer(row, int(pair), bool(stored), time, slack, (along, across), cosine)


def _is_same(own: Setting, asked: Setting) -> Array:
    """Return whether two settings are equal, () bool; false where their shapes differ."""
    mine, theirs = jax.tree.leaves(own), jax.tree.leaves(asked)
    if jax.tree.structure(own) != jax.tree.structure(asked) or any(
        np.shape(a) != np.shape(b) for a, b in zip(mine, theirs, strict=True)
    ):
        return jnp.zeros((), bool)
    pairs = zip(mine, theirs, strict=True)
    equal = [jnp.all(jnp.asarray(a).astype(b.dtype) == b) for a, b in pairs]
    return jnp.all(jnp.stack(equal))


def library_planner(file: str | os.PathLike) -> LibraryBlock:
    """Return the planner of a file that `planner-jax library build` wrote.

    Raises:
        ArgumentError: the file is no whole library; one line.
    """
    return LibraryBlock(load_library(file))


def _answered(table: Table, case: BlockCase, home: Array) -> BlockPlan:
    """Return the plan of a case whose arm stands at a home."""
    answer = lookup(table, case.ball, case.gravity, home)
    row, stored = answer.row, answer.stored
    dtype = case.angles.dtype
    duration = jnp.where(stored, row.duration, 1.0).astype(dtype)
    steps = jnp.where(stored, row.steps, 0.0).astype(dtype)
    contact = jnp.where(stored, answer.time, case.delay + duration)
    room = contact - case.delay - duration
    wait = jnp.where(case.ends_at_rest, 0.0, jnp.maximum(room, 0.0))
    start = jnp.asarray(table.homes)[home].astype(dtype)
    motion = polynomial(start, jnp.zeros_like(start), steps, duration)
    waits = jnp.zeros_like(motion.coeffs[:1]).at[0, 0].set(start)
    # What counts is whether it is on time; a limit of the contact may be met to a tolerance.
    early = (1.0 + FEASIBILITY_TOLERANCE) * duration / jnp.maximum(contact - case.delay, 1e-6)
    beside = jnp.stack(answer.beside)
    angle = jnp.arccos(jnp.clip(answer.cosine, -1.0, 1.0))
    excess = [
        early - 1.0,
        jnp.max(jnp.abs(beside)) / case.arm.shield_half - 1.0,
        jnp.sqrt(jnp.maximum(jnp.sum(beside**2), 1e-12)) / case.offset - 1.0,
        angle / case.tilt - 1.0,
        -answer.slack / 1e-3,
    ]
    violation = jnp.where(stored, jnp.max(jnp.stack(excess)), jnp.inf).astype(dtype)
    status = status_of(duration, violation, True)
    return BlockPlan(
        motion=PiecewisePolynomial(
            coeffs=jnp.concatenate([waits, motion.coeffs]),
            durations=jnp.concatenate([wait[None], motion.durations]),
        ),
        contact_time=contact,
        cost=jnp.where(stored, duration, jnp.inf),
        violation=violation,
        iterations=jnp.zeros((), jnp.int32),
        status=jnp.where(stored, status, Status.OUT_OF_REACH),
    )
