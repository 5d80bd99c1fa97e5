"""Problem of recovery trajectories: a quadrotor from any state to standstill, within limits."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.core.choices import RECOVERIES, require_one_of
from planner_jax.optimise.chain import ChainEnds, ChainProblem
from planner_jax.optimise.planner import pending
from planner_jax.optimise.settings import Attempt, LbfgsConfig
from planner_jax.recovery.case import RecoveryCase
from planner_jax.robot.quadrotor import QuadrotorPlan
from planner_jax.trajectory.polynomial import PiecewisePolynomial

# [m], guessed trajectories end at least this far above the least allowed height.
_ABOVE_GROUND = 0.2
# Starting points of the search in the order of trial: rows of a time T_0 [s] and a factor c. The
# displacement to standstill is d = c T_0 v / 2 for the initial velocity v, and the duration is
# T_0 + |d| / (v_max / 2) for the greatest allowed speed v_max.
_GUESSES = np.array([(1.0, 1.0), (1.6, 1.0), (0.7, 0.7), (2.5, 1.5), (1.2, 0.3), (4.0, 1.0)])


@struct.dataclass
class RecoveryContext:
    """The data with which `RecoveryProblem` evaluates the cost of a trajectory: only the case."""

    case: RecoveryCase


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class RecoveryProblem(ChainProblem[RecoveryCase, QuadrotorPlan]):
    """Minimum-snap trajectories to standstill, whose durations are free.

    A trajectory of M pieces has n = 3 (M - 1) + 4 decision variables, in units of `scale`: offsets
    (3,) of M - 1 waypoints from the smoothest trajectory, the logarithm of the duration, and the
    displacement (3,) to standstill. With `to="home"` the trajectory ends at the case's `home`, and
    the displacement has no effect.

    Cost: energy_weight * integral |snap|^2 + time_weight * duration + integral of smooth one-sided
    penalties on the limits and of the user's extra terms.

    Attributes:
        proportions: relative durations of the pieces.
        to: place of the standstill: "brake" for any place, "home" for the case's `home`.
    """

    case_type = RecoveryCase
    # The recovery starts where the preceding plan ends, which may be closer to a limit than the
    # distance at which penalties start. So later attempts reduce this distance, `margin`.
    attempts = (
        Attempt(starts=1, solver=LbfgsConfig(max_steps=25)),
        Attempt(starts=2, solver=LbfgsConfig(max_steps=80), settings=(("margin", 0.01),)),
        Attempt(
            starts=6,
            solver=LbfgsConfig(max_steps=200),
            settings=(("energy_weight", 1e-10), ("margin", 0.005)),
        ),
    )
    package = "planner_jax.recovery"
    shipped_name = "rest"
    num_end_variables = 4
    guess_table = _GUESSES
    decode_nodes = (40, 40)
    stands = True
    proportions: tuple[float, ...] = (0.4, 0.8, 1.0, 1.0, 1.0)
    to: str = "brake"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_one_of(RECOVERIES, "to", self.to)

    def prepare(self, case: RecoveryCase) -> RecoveryContext:
        """Return the data of a case for evaluations of the cost: only the case itself."""
        return RecoveryContext(case)

    def guess_ends(self, context: RecoveryContext, num: int) -> Array:
        """Return starting values (num, 1, 4) of log duration and displacement to standstill [m]."""
        case = context.case
        pos, vel = case.head_state[None, 0], case.head_state[None, 1]
        base, share = jnp.asarray(_GUESSES[:num], pos.dtype).T[..., None]
        low = jnp.minimum(case.limits.min_height + _ABOVE_GROUND, pos[0, 2] + 1.0)
        end = pos + 0.5 * share * base * vel
        end = end.at[:, 2].max(low)
        if self.to == "home":
            end = jnp.broadcast_to(case.home, end.shape)
        distance = jnp.sqrt(jnp.sum((end - pos) ** 2, axis=1, keepdims=True))
        duration = base + distance / (0.5 * case.limits.speed)
        return jnp.concatenate([jnp.log(duration), end - pos], axis=1)[:, None]

    def meet(self, natural: Array, context: RecoveryContext) -> ChainEnds:
        """Return duration and final state, from log duration and displacement (3,) in `natural`."""
        case, duration = context.case, jnp.exp(natural[:, 0])
        at_rest = case.head_state[:1] + natural[:, 1:] if self.to == "brake" else case.home[None]
        return ChainEnds(
            durations=duration,
            tail_states=jnp.zeros_like(case.head_state)[None].at[:, 0].set(at_rest),
            total_time=duration[0],
            excess=jnp.full((1,), -1.0, natural.dtype),
        )

    def make_plan(
        self,
        trajectory: PiecewisePolynomial,
        ends: ChainEnds,
        violation: Array,
        context: RecoveryContext,
    ) -> QuadrotorPlan:
        """Return the plan of a trajectory; the solver sets its cost and status later."""
        gravity = context.case.gravity
        return QuadrotorPlan(trajectory=trajectory, gravity=gravity, **pending(violation))
