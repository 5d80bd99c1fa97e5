"""The base planner of quadrotor trajectories: N minimum-snap segments with free end states.

A hit has one segment, which ends at the impact on the racket. Catches have one segment to each
target, and recovery trajectories one segment to standstill. The subclass of a task defines the
variables that determine the segments' ends.
"""

import abc
import dataclasses
import functools
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import Bool, Float, PyTree

from planner_jax.core.errors import ArgumentError
from planner_jax.core.planner import CaseT, PlanT
from planner_jax.core.protocol import require_settings
from planner_jax.cost.along import BETWEEN_NODES, Along, integrate_along
from planner_jax.cost.penalty import smooth_hinge
from planner_jax.cost.quadrotor import (
    QuadrotorCase,
    flight_along,
    greatest_excess,
    overturn_excess,
)
from planner_jax.optimise.planner import Problem
from planner_jax.optimise.settings import Curvature, Evaluation
from planner_jax.optimise.shipped import StartNetwork, load_scale
from planner_jax.trajectory.polynomial import PiecewisePolynomial
from planner_jax.trajectory.proportional_minco import (
    Chain,
    ProportionalMinco,
    boundary_energy,
    chain_rows,
    chain_trajectory,
    offset_energy,
    proportional_minco,
)

_ORDER = 4  # derivative whose square is minimised: snap


@struct.dataclass
class ChainEnds:
    """Durations and final states of N trajectory segments, computed from decision variables."""

    durations: Float[Array, " N"]  # [s], of the segments
    tail_states: Float[Array, "N 4 3"]  # position to jerk of the quadrotor at the segments' ends
    total_time: Float[Array, ""]  # [s], sum of the durations of the segments that the case uses
    excess: Float[Array, "..."]  # relative excess over the limits at the ends; feasible if <= 0
    contact: PyTree = None  # data of the contacts (such as an impact) that the plan stores
    cost: Array | float = 0.0  # (), further cost of the segments' ends, such as a preferred point


@dataclasses.dataclass(frozen=True)
class ChainProblem(Problem[CaseT, PlanT]):
    """A problem of N minimum-snap segments of M polynomial pieces each.

    The decision variables of a segment are whitened waypoint offsets (scaled deviations from the
    smoothest trajectory) and K end variables. Each is divided by its unit in `scale`. The first end
    variable is the logarithm of the segment's duration.

    Cost: energy_weight * integral |snap|^2 + time_weight * total time + integral of the smoothed
    hinges of the limits and of the user's extra terms + end_weight * smoothed hinges of the
    relative excess over the limits at the segments' ends.

    Attributes:
        proportions: relative durations of a segment's pieces.
        nodes: number of intervals of each piece, at whose ends penalties are evaluated.
        time_weight: weight of the total time.
        energy_weight: [s^8/m^2], weight of the integral of |snap|^2.
        margin: relative distance from a limit at which penalties start.
        hinge_width: width of the penalties' smoothed hinges, as a relative excess over a limit.
        scale: units of a segment's variables; if empty, the measured units.
    """

    subspace = 0
    package: ClassVar[str]  # package with the measured scales and the networks
    shipped_name: ClassVar[str] = "exact"  # first part of the scales' names in the package
    num_end_variables: ClassVar[int]  # K, for each segment
    guess_table: ClassVar[np.ndarray]  # one row for each starting point, best first
    decode_nodes: ClassVar[tuple[int, int]] = (32, 48)  # to check one, several segments
    stands: ClassVar[bool] = False  # whether the quadrotor stands still after the last segment
    weights: ClassVar[tuple[str, ...]] = ("energy_weight", "margin", "hinge_width")
    refinements: ClassVar[tuple[str, ...]] = ("nodes",)
    proportions: tuple[float, ...] = (1.0,) * 6
    nodes: int = 8
    time_weight: float = 0.005
    energy_weight: float = 3e-8
    margin: float = 0.03
    hinge_width: float = 0.1
    scale: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        require_settings(self)
        if len(self.proportions) < 2 or not all(0.0 < x < np.inf for x in self.proportions):
            raise ArgumentError("proportions", "of >= 2 pieces, finite and > 0", self.proportions)
        object.__setattr__(self, "scale", self._fit_scale(self.scale or self._usual_scale))
        size = self.num_offsets + self.num_end_variables
        if len(self.scale) != size:
            raise ArgumentError("scale", f"of {size} numbers", len(self.scale))

    @abc.abstractmethod
    def meet(self, natural: Float[Array, "N K"], context: PyTree) -> ChainEnds:
        """Return durations and final states of N segments from their K end variables, `natural`."""

    @abc.abstractmethod
    def guess_ends(self, context: PyTree, num: int) -> Float[Array, "num N K"]:
        """Return the K end variables (log duration, ...) of N segments at `num` starting points."""

    @abc.abstractmethod
    def make_plan(
        self,
        trajectory: PiecewisePolynomial,
        ends: ChainEnds,
        violation: Float[Array, ""],
        context: PyTree,
    ) -> PlanT:
        """Return the task's plan of a trajectory; the solver sets its cost and status later."""

    @property
    def end_weight(self) -> float:
        """Factor [s] that converts penalties at segments' ends to the unit of time integrals."""
        return 0.0

    def active(self, context: PyTree) -> Bool[Array, " N"]:
        """Return which of N segments a case uses, (N,) bool; by default its only one (N = 1)."""
        return jnp.ones(1, bool)

    def relative_excess(self, excess: Array) -> Array:
        """Convert excesses at the segments' ends to relative ones; unchanged by default."""
        return excess

    def start_network(self, case: PyTree) -> StartNetwork | None:
        """Return the network that corrects the first guess of a case, or None without a network."""
        return None

    def start_features(self, context: PyTree) -> Float[Array, " F"]:
        """Return the F features of a case from which the network predicts a starting point."""
        raise NotImplementedError

    def limit_learned(self, point: Float[Array, " n"]) -> Float[Array, " n"]:
        """Clip the starting point (n,) that the network proposes; by default it is unchanged."""
        return point

    def _fit_scale(self, scale: tuple[float, ...]) -> tuple[float, ...]:
        return scale

    @property
    def _usual_scale(self) -> tuple[float, ...]:
        return load_scale(self.package, f"{self.shipped_name}-{self.num_pieces}")

    @property
    def num_pieces(self) -> int:
        """Number of polynomial pieces of a segment."""
        return len(self.proportions)

    @property
    def num_offsets(self) -> int:
        """Number of coordinates of a segment's waypoint offsets, three for each inner waypoint."""
        return 3 * (self.num_pieces - 1)

    @property
    def maps(self) -> ProportionalMinco:
        """Linear maps from a segment's end states and waypoint offsets to its polynomials."""
        return proportional_minco(_ORDER, self.proportions)

    @property
    def size(self) -> int:
        """Number of variables of a segment."""
        return len(self.scale)

    def first_start(
        self, guess: Float[Array, " n"], features: Float[Array, " F"], context: PyTree
    ) -> Float[Array, " n"]:
        """Return the point at which the search starts: the prediction of a network, or `guess`."""
        network = self.start_network(context.case)
        return guess if network is None else self.limit_learned(guess + network(features))

    def guesses(self, context: PyTree, num: int) -> Float[Array, "num n"]:
        """Return starting points (num, n), whose waypoint offsets are zero."""
        if num > len(self.guess_table):
            raise ArgumentError("starts", f"<= {len(self.guess_table)}", num)
        natural = self.guess_ends(context, num)
        natural = jnp.pad(natural, ((0, 0), (0, 0), (self.num_offsets, 0)))
        return (natural / jnp.asarray(self.scale, natural.dtype)[None, None]).reshape(num, -1)

    def network_inputs(self, context: PyTree) -> Float[Array, " F"]:
        """Return the features of a case for its network; none without a network."""
        if self.start_network(context.case) is None:
            return jnp.zeros((0,), context.case.head_state.dtype)
        return self.start_features(context)

    def split(self, point: Float[Array, " n"]) -> tuple[Array, Array]:
        """Split a point: waypoint offsets (N, M - 1, 3), end variables (N, K) of N segments."""
        scale = jnp.asarray(self.scale, point.dtype)
        natural = point.reshape(-1, scale.size) * scale[None]
        offsets = natural[:, : self.num_offsets].reshape(natural.shape[0], -1, 3)
        return offsets, natural[:, self.num_offsets :]

    def join(self, offsets: Float[Array, "N O 3"], natural: Float[Array, "N K"]) -> Array:
        """Return the point (n,) with these waypoint offsets and end variables; inverts `split`."""
        together = jnp.concatenate([offsets.reshape(natural.shape[0], -1), natural], axis=1)
        return (together / jnp.asarray(self.scale, together.dtype)[None]).ravel()

    def along(self, nodes: int, case: QuadrotorCase) -> Along:
        """Return a segment's penalties, to be integrated with `nodes` intervals in each piece."""
        if self._has_run_time_hinges:
            return flight_along(self.maps, nodes, case, 1.0, None)
        return flight_along(self.maps, nodes, case, self.margin, self.hinge_width)

    def _parameters(self, case: QuadrotorCase) -> tuple:
        """Return the numbers that the integrals of `along` need."""
        numbers = case.gravity, case.limits, case.extras
        return (*numbers, self.margin, self.hinge_width) if self._has_run_time_hinges else numbers

    @property
    def _has_run_time_hinges(self) -> bool:
        return isinstance(self.margin, Array) or isinstance(self.hinge_width, Array)

    def evaluate_ends(
        self, natural: Float[Array, "N K"], context: PyTree
    ) -> tuple[Array, Array, Array, Array]:
        """Compute those parts of the objective that depend only on N segments' K end variables.

        Returns:
            Scaled states at both ends of the segments (N, 8, 3); mean duration of a piece (N,) [s];
            cost () of time, ends, and energy at offsets 0; greatest relative excess at the ends ().
        """
        ends = self.meet(natural, context)
        durations = ends.durations / self.num_pieces
        rows = chain_rows(context.case.head_state, ends.tail_states, durations)
        energies = jax.vmap(functools.partial(boundary_energy, self.maps))(rows, durations)
        spent = self.energy_weight * self._count(energies, context) + ends.cost
        if self.time_weight:
            spent = spent + self.time_weight * ends.total_time
        hinges = smooth_hinge(ends.excess + self.margin, self.hinge_width)
        return rows, durations, self.end_weight * jnp.sum(hinges) + spent, jnp.max(ends.excess)

    def _count(self, values: Float[Array, " N"], context: PyTree) -> Array:
        return jnp.sum(jnp.where(self.active(context), values, 0.0))

    def objective(self, point: Float[Array, " n"], context: PyTree) -> Evaluation:
        """Return the cost, and the largest excess at sampled times, mostly q^2 / limit^2 - 1."""
        case, moving = _split_moving(context.case)
        offsets, natural = self.split(point)
        rows, durations, core, at_ends = self.evaluate_ends(natural, context)
        along, columns = self.along(self.nodes, case), jnp.concatenate([rows, offsets], axis=1)
        parameters = self._parameters(case)
        penalties, worst = integrate_along(along, columns, durations, parameters)
        if moving:
            lasting = jnp.where(self.active(context), durations, 0.0)
            more, deepest = moving(along, columns, lasting, self.stands, parameters)
            penalties, worst = penalties + more, jnp.maximum(worst, deepest)
        energies = jax.vmap(functools.partial(offset_energy, self.maps))(offsets, durations)
        energy = self.energy_weight * self._count(energies, context)
        worst = jnp.max(jnp.where(self.active(context), worst, -1.0))
        return Evaluation(
            cost=self._count(penalties, context) + core + energy,
            violation=jnp.maximum(worst, at_ends) + BETWEEN_NODES,
        )

    def curvature_at(self, point: Float[Array, " n"], context: PyTree) -> Curvature:
        """Return evaluation, gradient, Hessian products and preconditioner at a point (n,)."""
        from planner_jax.optimise.chain_curvature import chain_curvature  # for Newton's method

        case, moving = _split_moving(context.case)
        if moving:
            return super().curvature_at(point, context)
        offsets, natural = self.split(point)
        return chain_curvature(
            self.maps,
            self.along(self.nodes, case),
            lambda natural: self.evaluate_ends(natural, context),
            self.evaluate_ends(natural, context),
            natural,
            offsets,
            jnp.asarray(self.scale, point.dtype),
            self._parameters(case),
            self.energy_weight,
            self.active(context),
        )

    def decode(self, point: Float[Array, " n"], context: PyTree) -> PlanT:
        """Return the plan at a point (n,); its violation includes peaks between sampled times."""
        offsets, natural = self.split(point)
        ends = self.meet(natural, context)
        durations = ends.durations / self.num_pieces
        rows = chain_rows(context.case.head_state, ends.tail_states, durations)
        chain = Chain(rows=rows, offsets=offsets, piece_durations=durations)
        nodes = self.decode_nodes[len(natural) > 1]
        case, moving = _split_moving(context.case)
        active = self.active(context)
        greatest = greatest_excess(self.maps, nodes, chain.columns, durations, case)
        if moving:
            lasting = jnp.where(active, durations, 0.0)
            of_moving = self.along(nodes, case), chain.columns, lasting, self.stands
            greatest.append(moving(*of_moving, self._parameters(case))[1])
        trajectory = chain_trajectory(self.maps, chain, active)
        along = [jnp.max(jnp.where(active, each, -1.0)) for each in greatest]
        along.append(overturn_excess(trajectory, case.gravity, case.limits))
        at_ends = jnp.max(self.relative_excess(ends.excess))
        violation = functools.reduce(jnp.maximum, [*along, at_ends])
        return self.make_plan(trajectory, ends, violation, context)


def _split_moving(case: QuadrotorCase) -> tuple[QuadrotorCase, PyTree]:
    if not case.extras:
        return case, None
    from planner_jax.cost.moving import split_moving  # few cases have extras

    return split_moving(case)
