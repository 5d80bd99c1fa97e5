"""The planner of quadrotor trajectories of N minimum-snap segments with free ends.

Hits have one segment that ends at the impact on the racket, catches one segment to each target, and
recovery trajectories one segment to standstill. A task defines the meaning of the end variables.
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
from planner_jax.cost.quadrotor import QuadrotorCase, flight_along, greatest_excess
from planner_jax.optimise.planner import OptimisedPlanner
from planner_jax.optimise.settings import Curvature, Evaluation
from planner_jax.optimise.shipped import StartNetwork, load_scale, select_start
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

_ORDER = 4  # minimum snap


@struct.dataclass
class ChainEnds:
    """The ends of N segments, as functions of the end variables."""

    durations: Float[Array, " N"]  # [s], of the segments
    tail_states: Float[Array, "N 4 3"]  # position to jerk of the quadrotor
    total_time: Float[Array, ""]  # [s], of the active segments
    excess: Float[Array, "..."]  # over the limits at the ends; feasible if <= 0
    contact: PyTree = None  # task-specific data of the ends for the plan


@dataclasses.dataclass(frozen=True)
class ChainPlanner(OptimisedPlanner[CaseT, PlanT]):
    """A planner of N minimum-snap segments of M pieces each.

    Decision variables, for each segment in units of `scale`: whitened waypoint offsets, and K end
    variables. The first end variable is the logarithm of the segment's duration.

    Cost: energy_weight * integral |snap|^2 + time_weight * total time + integral of the smoothed
    hinges of the limits and of the case's extras + end_weight * smoothed hinges of the excess at
    the ends.
    """

    subspace = 0
    package: ClassVar[str]  # package with the measured scales and the networks
    shipped_name: ClassVar[str] = "exact"  # of the scales in the package
    num_end_variables: ClassVar[int]  # K
    guess_table: ClassVar[np.ndarray]  # one row for each starting point, best first
    # Intervals a piece at which finished plans of one and of several segments are checked. Body
    # rates peak sharply where the thrust is small, which happens between catches.
    decode_nodes: ClassVar[tuple[int, int]] = (32, 48)
    proportions: tuple[float, ...] = (1.0,) * 6  # relative durations of the pieces
    nodes: int = 8  # penalty intervals a piece
    time_weight: float = 0.005
    energy_weight: float = 3e-8
    margin: float = 0.03  # relative distance from a limit at which penalties start
    hinge_width: float = 0.1
    scale: tuple[float, ...] = ()  # of one segment

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
        """Return the ends for end variables in SI units."""

    @abc.abstractmethod
    def guess_ends(self, context: PyTree, num: int) -> Float[Array, "num N K"]:
        """Return the end variables of the first starting points, in SI units."""

    @abc.abstractmethod
    def make_plan(
        self,
        trajectory: PiecewisePolynomial,
        ends: ChainEnds,
        violation: Float[Array, ""],
        context: PyTree,
    ) -> PlanT:
        """Return the plan of a trajectory, with `pending` cost and status."""

    @property
    def end_weight(self) -> float:
        """Weight [s] of the hinges at the ends, relative to the integrals."""
        return 0.0

    def active(self, context: PyTree) -> Bool[Array, " N"]:
        """Return which segments exist."""
        return jnp.ones(1, bool)

    def relative_excess(self, excess: Array) -> Array:
        """Return the excess at the ends of a finished plan relative to the limits."""
        return excess

    def start_network(self, case: PyTree) -> StartNetwork | None:
        """Return the network for the first starting point of such cases, or None."""
        return None

    def start_features(self, context: PyTree) -> Float[Array, " F"]:
        """Return the inputs of the network."""
        raise NotImplementedError

    def limit_learned(self, point: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return a starting point of the network, changed where a search could not leave it."""
        return point

    def _fit_scale(self, scale: tuple[float, ...]) -> tuple[float, ...]:
        """Return a scale for the planner's variables, made from a scale for fewer variables."""
        return scale

    @property
    def _usual_scale(self) -> tuple[float, ...]:
        """Measured scale for this number of pieces."""
        return load_scale(self.package, f"{self.shipped_name}-{self.num_pieces}")

    @property
    def num_pieces(self) -> int:
        """M, the number of pieces of a segment."""
        return len(self.proportions)

    @property
    def num_offsets(self) -> int:
        """Number of waypoint variables of a segment."""
        return 3 * (self.num_pieces - 1)

    @property
    def maps(self) -> ProportionalMinco:
        """Constant maps from boundary rows and offsets to a segment."""
        return proportional_minco(_ORDER, self.proportions)

    def guesses(self, context: PyTree, num: int) -> Float[Array, "num n"]:
        """Return smooth trajectories to guessed ends; a network may improve the first one."""
        if num > len(self.guess_table):
            raise ArgumentError("starts", f"<= {len(self.guess_table)}", num)
        natural = self.guess_ends(context, num)
        natural = jnp.pad(natural, ((0, 0), (0, 0), (self.num_offsets, 0)))
        points = (natural / jnp.asarray(self.scale, natural.dtype)[None, None]).reshape(num, -1)
        network = self.start_network(context.case)
        if network is None:
            return points
        learned = self.limit_learned(points[0] + network(self.start_features(context)))
        cost = lambda point: self.objective(point, context).cost  # noqa: E731
        return points.at[0].set(select_start(cost, points[0], learned))

    def split(self, point: Float[Array, " n"]) -> tuple[Array, Array]:
        """Return the whitened offsets (N, O, 3), and the end variables (N, K) in SI units."""
        scale = jnp.asarray(self.scale, point.dtype)
        natural = point.reshape(-1, scale.size) * scale[None]
        offsets = natural[:, : self.num_offsets].reshape(natural.shape[0], -1, 3)
        return offsets, natural[:, self.num_offsets :]

    def join(self, offsets: Float[Array, "N O 3"], natural: Float[Array, "N K"]) -> Array:
        """Return the point (n,) of offsets and end variables: the inverse of `split`."""
        together = jnp.concatenate([offsets.reshape(natural.shape[0], -1), natural], axis=1)
        return (together / jnp.asarray(self.scale, together.dtype)[None]).ravel()

    def along(self, nodes: int, case: QuadrotorCase) -> Along:
        """Return the penalties along the trajectory."""
        return flight_along(self.maps, nodes, case, self.margin, self.hinge_width)

    def evaluate_ends(
        self, natural: Float[Array, "N K"], context: PyTree
    ) -> tuple[Array, Array, Array, Array]:
        """Return the contribution of the end variables to the objective.

        Returns:
            Boundary rows (N, 8, 3) and mean durations of a piece (N,) [s] of the segments, the cost
            of time and of the ends (), and the greatest excess at the ends ().
        """
        ends = self.meet(natural, context)
        durations = ends.durations / self.num_pieces
        rows = chain_rows(context.case.head_state, ends.tail_states, durations)
        energies = jax.vmap(functools.partial(boundary_energy, self.maps))(rows, durations)
        spent = self.energy_weight * self._count(energies, context)
        if self.time_weight:
            spent = spent + self.time_weight * ends.total_time
        hinges = smooth_hinge(ends.excess + self.margin, self.hinge_width)
        core = self.end_weight * jnp.sum(hinges) + spent
        return rows, durations, core, jnp.max(ends.excess)

    def _count(self, values: Float[Array, " N"], context: PyTree) -> Array:
        """Return the sum over the active segments."""
        return jnp.sum(jnp.where(self.active(context), values, 0.0))

    def objective(self, point: Float[Array, " n"], context: PyTree) -> Evaluation:
        """Return cost and largest excess at the penalty nodes, as a ratio of squares."""
        case = context.case
        offsets, natural = self.split(point)
        rows, durations, core, at_ends = self.evaluate_ends(natural, context)
        penalties, worst = integrate_along(
            self.along(self.nodes, case),
            jnp.concatenate([rows, offsets], axis=1),
            durations,
            (case.gravity, case.limits, case.extras),
        )
        energies = jax.vmap(functools.partial(offset_energy, self.maps))(offsets, durations)
        energy = self.energy_weight * self._count(energies, context)
        worst = jnp.max(jnp.where(self.active(context), worst, -1.0))
        return Evaluation(
            cost=self._count(penalties, context) + core + energy,
            violation=jnp.maximum(worst, at_ends) + BETWEEN_NODES,
        )

    def curvature_at(self, point: Float[Array, " n"], context: PyTree) -> Curvature:
        """Return evaluation, gradient, and second derivatives; see `chain_curvature`."""
        # Only Newton's method needs it
        from planner_jax.optimise.chain_curvature import chain_curvature

        case = context.case
        offsets, natural = self.split(point)
        return chain_curvature(
            self.maps,
            self.along(self.nodes, case),
            lambda natural: self.evaluate_ends(natural, context),
            self.evaluate_ends(natural, context),
            natural,
            offsets,
            jnp.asarray(self.scale, point.dtype),
            (case.gravity, case.limits, case.extras),
            self.energy_weight,
            self.active(context),
        )

    def decode(self, point: Float[Array, " n"], context: PyTree) -> PlanT:
        """Return the plan at a point; its violation covers `decode_nodes` and the peaks between."""
        offsets, natural = self.split(point)
        ends = self.meet(natural, context)
        durations = ends.durations / self.num_pieces
        rows = chain_rows(context.case.head_state, ends.tail_states, durations)
        chain = Chain(rows=rows, offsets=offsets, piece_durations=durations)
        nodes = self.decode_nodes[len(natural) > 1]
        greatest = greatest_excess(self.maps, nodes, chain.columns, durations, context.case)
        active = self.active(context)
        along = [jnp.max(jnp.where(active, each, -1.0)) for each in greatest]
        at_ends = jnp.max(self.relative_excess(ends.excess))
        violation = functools.reduce(jnp.maximum, [*along, at_ends])
        return self.make_plan(chain_trajectory(self.maps, chain, active), ends, violation, context)
