"""The planner `LibraryBlock`, which looks up the stored arm motion that blocks a given ball."""

import os
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.baselines.block.library.file import load_library
from planner_jax.baselines.block.library.table import (
    Library,
    Setting,
    Table,
    fingerprint,
    lookup,
    setting_of,
)
from planner_jax.core.choices import require
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import FEASIBILITY_TOLERANCE, BaseAttempt, Status, status_of
from planner_jax.robot.arm import product, shield_sides
from planner_jax.robot.arm_motion import polynomial
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan
from planner_jax.trajectory.polynomial import PiecewisePolynomial

# Greatest difference of joint angles [rad] from a start pose, and of joint rates [rad/s] from 0.
_SAME_START = 1e-4


@struct.dataclass
class LibraryBlock(Planner):
    """A planner that returns the motion stored for the two cells that a ball passes.

    Cells are rectangles on the faces of two boxes around the arm. The cost is the motion's duration
    [s]. The arm must stand at a start pose of the library. If the motion must end at standstill, it
    starts as soon as the arm may start, and the shield then waits for the ball. Otherwise it starts
    so late that it ends at the contact.

    The status is OUT_OF_REACH if no motion is stored for a ball. It is BLOCKED if the arm does not
    stand at a start pose, or if arm, limits or scene differ from the library's; the method `check`
    then raises an error. It is INFEASIBLE if the stored motion ends too late, or if the ball passes
    farther from the shield's centre than the case allows.
    """

    library: Library

    case_type: ClassVar[type] = BlockCase

    @property
    def attempts(self) -> tuple[BaseAttempt, ...]:
        """The only attempt, since a second lookup would find the same motion."""
        return (BaseAttempt(),)

    def check(self, cases: BlockCase) -> None:
        """Raise `ArgumentError` unless arm, limits, scene and start of case 0 fit the library.

        Other cases of a batch that do not fit get plans with the status BLOCKED.
        """
        first = jax.tree.map(lambda leaf: np.asarray(leaf), cases)
        if cases.batch_shape:
            first = jax.tree.map(lambda leaf: leaf[0], first)
        own, other = fingerprint(self.library.setting), fingerprint(setting_of(first))
        shown = f"one of {own} for cases of {other}"
        require(own == other, "library", "of the cases' arm, limits and scene", shown=shown)
        radius = float(first.ball_radius)
        require(radius == 0.0, "ball_radius", "0 for stored motions", radius)
        homes = np.asarray(self.library.table.homes)
        off = np.abs(homes - first.angles).max(axis=1).min()
        rule, shown = f"a home of the library to {_SAME_START} rad", f"{off:.3g} rad off"
        require(bool(off <= _SAME_START), "angles", rule, shown=shown)

    def solve(self, case: BlockCase, attempt: BaseAttempt) -> BlockPlan:
        """Return the plan of one case, with the motion stored for its ball."""
        home, fits = self.home_of(case)
        plan = _plan_from_answer(self.library.table, case, home)
        status = jnp.where(fits, plan.status, Status.BLOCKED)
        return plan.replace(status=status.astype(jnp.int32))  # type: ignore[attr-defined]

    def home_of(self, case: BlockCase) -> tuple[Array, Array]:
        """Return the index of the start pose nearest to the arm, and whether the library fits.

        The library fits if the arm stands still at this pose, and if arm, limits and scene equal
        the library's.
        """
        off = jnp.max(jnp.abs(jnp.asarray(self.library.table.homes) - case.angles[None]), axis=1)
        home = jnp.argmin(off)
        fits = (off[home] <= _SAME_START) & (jnp.max(jnp.abs(case.rates)) <= _SAME_START)
        return home, fits & _is_same(self.library.setting, setting_of(case))


def _is_same(own: Setting, other: Setting) -> Array:
    mine, theirs = jax.tree.leaves(own), jax.tree.leaves(other)
    if jax.tree.structure(own) != jax.tree.structure(other) or any(
        np.shape(a) != np.shape(b) for a, b in zip(mine, theirs, strict=True)
    ):
        return jnp.zeros((), bool)
    pairs = zip(mine, theirs, strict=True)
    equal = [jnp.all(jnp.asarray(a).astype(b.dtype) == b) for a, b in pairs]
    return jnp.all(jnp.stack(equal))


def library_planner(file: str | os.PathLike) -> LibraryBlock:
    """Return the lookup planner for a file that `planner-jax library build` wrote.

    Raises:
        ArgumentError: the file is not a complete library.
    """
    return LibraryBlock(load_library(file))


def _plan_from_answer(table: Table, case: BlockCase, home: Array) -> BlockPlan:
    answer = lookup(table, case.ball, case.gravity, home)
    row, stored = answer.row, answer.stored
    dtype = case.angles.dtype
    duration = jnp.where(stored, row.duration, 1.0).astype(dtype)
    steps = jnp.where(stored, row.steps, 0.0).astype(dtype)
    contact = jnp.where(stored, answer.time, case.delay + duration)
    spare = contact - case.delay - duration
    wait = jnp.where(case.ends_at_rest, 0.0, jnp.maximum(spare, 0.0))
    start = jnp.asarray(table.homes)[home].astype(dtype)
    motion = polynomial(start, jnp.zeros_like(start), steps, duration)
    waits = jnp.zeros_like(motion.coeffs[:1]).at[0, 0].set(start)
    # `status_of` accepts a violation up to FEASIBILITY_TOLERANCE. The factor cancels the tolerance,
    # since a motion that ends after the ball's arrival does not block the ball.
    early = (1.0 + FEASIBILITY_TOLERANCE) * duration / jnp.maximum(contact - case.delay, 1e-6)
    beside = jnp.stack(answer.beside)
    angle = jnp.arccos(jnp.clip(answer.cosine, -1.0, 1.0))
    excess = [
        early - 1.0,
        jnp.max(product(shield_sides(case.arm), beside)) - 1.0,
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
