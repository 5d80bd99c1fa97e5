"""Ways to rest from any state, within all limits of a flight."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.core.choices import ENDINGS
from planner_jax.core.protocol import require_settings
from planner_jax.cost.along import Along, integrate_along
from planner_jax.cost.quadrotor import flight_along, greatest_excess, limits_along
from planner_jax.optimise.evaluation import Evaluation
from planner_jax.optimise.lbfgs import LbfgsConfig
from planner_jax.optimise.planner import OptimisedPlanner, pending
from planner_jax.optimise.problem import Round
from planner_jax.optimise.scaling import shipped_scale
from planner_jax.recovery.case import EndingCase, EndingPlan
from planner_jax.trajectory.proportional_minco import (
    ProportionalMinco,
    boundary_energy,
    boundary_rows,
    offset_energy,
    proportional_minco,
    proportional_trajectory,
    sample_motion,
)

_ORDER = 4  # minimum snap
_DECODE_NODES = 40  # intervals a piece at which a finished plan is looked at
_ABOVE_GROUND = 0.2  # [m], of a guessed place of rest
# Starting points, best first: duration [s] beside the way at half the greatest speed, and how far
# along the way that even braking takes the quadrotor it comes to rest.
_GUESSES = np.array([(1.0, 1.0), (1.6, 1.0), (0.7, 0.7), (2.5, 1.5), (1.2, 0.3), (4.0, 1.0)])


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class RestPlanner(OptimisedPlanner):
    """Minimum-snap ways to rest, of free duration.

    Decision variables, n = 3 (M - 1) + 4, in units of `scale`: whitened waypoint offsets, log
    duration, and the place of rest; with `to` home the place is the case's and its variables do
    nothing.

    Cost: energy_weight * integral |snap|^2 + time_weight * duration + integral of the smoothed
    hinges of the limits, and of the case's extras.
    """

    case_type = EndingCase
    to: str = "brake"  # wherever it may be, or "home"
    proportions: tuple[float, ...] = (0.4, 0.8, 1.0, 1.0, 1.0)  # relative durations of the pieces
    nodes: int = 8  # penalty intervals a piece
    time_weight: float = 0.005
    energy_weight: float = 3e-8
    margin: float = 0.03  # penalties begin this far inside a limit, relative
    hinge_width: float = 0.1
    # The plan before it may end right at its limits: then the margin has to give.
    rounds: tuple[Round, ...] = (
        Round(starts=1, solver=LbfgsConfig(max_steps=25)),
        Round(starts=2, solver=LbfgsConfig(max_steps=80), settings=(("margin", 0.01),)),
        Round(
            starts=6,
            solver=LbfgsConfig(max_steps=200),
            settings=(("energy_weight", 1e-10), ("margin", 0.005)),
        ),
    )
    scale: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        require_settings(self)
        if self.to not in ENDINGS:
            raise ValueError(f"to must be one of {', '.join(ENDINGS)}, got {self.to!r}")
        if not self.scale:
            object.__setattr__(self, "scale", shipped_scale(__package__, f"rest-{self.num_pieces}"))
        if len(self.scale) != self.num_offsets + 4:
            rule = f"of {self.num_offsets + 4} numbers"
            raise ValueError(f"scale must be {rule}, got {len(self.scale)}")

    @property
    def num_pieces(self) -> int:
        """M."""
        return len(self.proportions)

    @property
    def num_offsets(self) -> int:
        """Number of waypoint variables."""
        return 3 * (self.num_pieces - 1)

    @property
    def maps(self) -> ProportionalMinco:
        """Constant maps from boundary and offsets to the trajectory."""
        return proportional_minco(_ORDER, self.proportions)

    def prepare(self, case: EndingCase) -> EndingCase:
        """The case as it is."""
        return case

    def guesses(self, context: EndingCase, num: int) -> Array:
        """Smooth ways of a few durations to a few places, (num, n)."""
        if num > len(_GUESSES):
            raise ValueError(f"starts must be <= {len(_GUESSES)}, got {num}")
        pos, vel = context.head_state[0], context.head_state[1]
        beside, share = jnp.asarray(_GUESSES[:num], pos.dtype).T[..., None]
        low = jnp.minimum(context.limits.min_height + _ABOVE_GROUND, pos[2] + 1.0)
        place = pos + 0.5 * share * beside * vel
        place = place.at[:, 2].max(low)
        if self.to == "home":
            place = jnp.broadcast_to(context.home, place.shape)
        way = jnp.sqrt(jnp.sum((place - pos) ** 2, axis=1, keepdims=True))
        duration = beside + way / (0.5 * context.limits.speed)
        zeros = jnp.zeros((num, self.num_offsets), pos.dtype)
        natural = jnp.concatenate([zeros, jnp.log(duration), place - pos], axis=1)
        return natural / jnp.asarray(self.scale, pos.dtype)

    def _unpack(self, point: Array, context: EndingCase) -> tuple[Array, Array, Array]:
        """Whitened offsets (M - 1, 3), boundary rows (8, 3) and mean duration of a piece [s]."""
        natural = point * jnp.asarray(self.scale, point.dtype)
        offsets = natural[: self.num_offsets].reshape(-1, 3)
        duration = jnp.exp(natural[self.num_offsets]) / self.num_pieces
        at_rest = context.home
        if self.to == "brake":
            at_rest = context.head_state[0] + natural[self.num_offsets + 1 :]
        tail = jnp.zeros_like(context.head_state).at[0].set(at_rest)
        return offsets, boundary_rows(context.head_state, tail, duration), duration

    def _along(self, nodes: int, case: EndingCase) -> Along:
        """Penalties along the way."""
        return flight_along(self.maps, nodes, case, self.margin, self.hinge_width)

    def objective(self, point: Array, context: EndingCase) -> Evaluation:
        """Cost, and the largest excess at the penalty nodes."""
        offsets, rows, duration = self._unpack(point, context)
        penalties, worst = integrate_along(
            self._along(self.nodes, context),
            jnp.concatenate([rows, offsets])[None],
            duration[None],
            (context.gravity, context.limits, context.extras),
        )
        energy = boundary_energy(self.maps, rows, duration)
        energy += offset_energy(self.maps, offsets, duration)
        spent = self.time_weight * self.num_pieces * duration
        cost = penalties[0] + self.energy_weight * energy + spent
        # Peaks between nodes are a little higher than the nodes show.
        return Evaluation(cost=cost, violation=worst[0] + 0.004)

    def residuals(self, point: Array, context: EndingCase) -> Array:
        """Squared hinges, energy and time as residuals, for `measure_scale`."""
        offsets, rows, duration = self._unpack(point, context)
        along = self._along(self.nodes, context)
        columns = jnp.concatenate([rows, offsets])
        motion = sample_motion(self.maps, self.nodes, columns, duration, along.orders)
        excess = jnp.stack(limits_along(motion, (context.gravity, context.limits, context.extras)))
        inside = jnp.maximum(excess + jnp.asarray(along.margins, point.dtype)[:, None], 0.0)
        weights = duration * jnp.asarray(along.weights(), point.dtype)
        bend = jnp.sqrt(1.5 / self.hinge_width) * inside * jnp.sqrt(weights)
        energy = boundary_energy(self.maps, rows, duration)
        energy += offset_energy(self.maps, offsets, duration)
        smooth = jnp.sqrt(2.0 * self.energy_weight * jnp.maximum(energy, 1e-6))
        spent = jnp.sqrt(2.0 * self.time_weight * self.num_pieces * duration)
        return jnp.concatenate([bend.ravel(), smooth[None], spent[None]])

    def decode(self, point: Array, context: EndingCase) -> EndingPlan:
        """The plan at a point, its violation looked for at `_DECODE_NODES` and between them."""
        offsets, rows, duration = self._unpack(point, context)
        greatest = greatest_excess(
            self.maps,
            _DECODE_NODES,
            jnp.concatenate([rows, offsets])[None],
            duration[None],
            context,
        )
        violation = functools.reduce(jnp.maximum, greatest)[0]
        return EndingPlan(
            trajectory=proportional_trajectory(self.maps, rows, offsets, duration),
            gravity=context.gravity,
            **pending(violation),
        )
