"""Re-planning of a hit: from the plan that is being flown, for what the ball now seems to do.

The stroke of the previous plan (when, how hard and how high) is where the search begins, on the
smoothest way to it from where the quadrotor will be; a few iterations mend the rest. The paper
plans once, because "even minor updates in the terminal state could lead to drastic deformations"
(002, Section VI-C): here the stroke moves as little as the ball's estimate does.
"""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.optimise.lbfgs import Evaluation, LbfgsConfig
from planner_jax.optimise.problem import Round
from planner_jax.robot.quadrotor import net_thrust, tangent_basis
from planner_jax.task.hit.exact import ExactHit, HitContext
from planner_jax.task.hit.plan import HitPlan
from planner_jax.task.hit.scenario import HitScenario
from planner_jax.trajectory.polynomial import evaluate, total_duration

_SHORTEST = 0.01  # [s], least time to the impact that is guessed
_TRIALS = (1.0, 0.2, 0.04)  # step lengths: the first direction, without curvature, is too long


@struct.dataclass
class ReplanHitScenario:
    """One case, or a batch of them. Times of `scenario` count from now."""

    scenario: HitScenario  # ball as estimated now, head_state where the quadrotor is now
    previous: HitPlan  # its times began `elapsed` ago
    elapsed: Array  # () [s]

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """() for one case, (B,) for a batch."""
        return self.scenario.batch_shape


@struct.dataclass
class ReplanHitContext:
    """What every evaluation needs, and where the search begins."""

    hit: HitContext
    start: Array  # (n,)


@dataclasses.dataclass(frozen=True)
class ReplanHit:
    """Hits re-planned from the previous plan, for `plan` or `solve_round`.

    The previous plan may be any planner's; what comes back is `planner`'s.
    """

    planner: ExactHit = ExactHit()
    rounds: tuple[Round, ...] = (
        Round(starts=1, solver=LbfgsConfig(max_steps=4, trial_steps=_TRIALS)),
        Round(starts=1, solver=LbfgsConfig(max_steps=40, trial_steps=_TRIALS)),
    )

    def prepare(self, scenario: ReplanHitScenario) -> ReplanHitContext:
        """The incoming ball's table, and the previous stroke as a point."""
        return ReplanHitContext(
            hit=self.planner.prepare(scenario.scenario), start=self._start(scenario)
        )

    def _start(self, scenario: ReplanHitScenario) -> Array:
        """The previous stroke, and no offset from the smoothest way to it, (n,)."""
        planner, stroke = self.planner, scenario.previous.stroke
        path = scenario.previous.trajectory
        vel, acc, jerk = (evaluate(path, total_duration(path), order) for order in (1, 2, 3))
        pull = net_thrust(acc, scenario.scenario.gravity)
        across_x, across_y = tangent_basis(stroke.normal)
        times = jnp.stack([stroke.time - scenario.elapsed, stroke.flight_time])
        sizes = jnp.append(times, jnp.sqrt(jnp.sum(pull**2)))
        natural = jnp.concatenate(
            [
                jnp.zeros(planner.num_offsets, sizes.dtype),
                jnp.log(jnp.maximum(sizes, _SHORTEST)),
                jnp.stack([jnp.sum(vel * across_x), jnp.sum(vel * across_y)]),
                jerk,
            ]
        )
        return natural / jnp.asarray(planner.scale, natural.dtype)

    def guesses(self, context: ReplanHitContext, num: int) -> Array:
        """The previous stroke, and then those from scratch, (num, n)."""
        first = context.start[None]
        if num == 1:
            return first
        return jnp.concatenate([first, self.planner.guesses(context.hit, num - 1)])

    def objective(self, point: Array, context: ReplanHitContext) -> Evaluation:
        """Of the planner."""
        return self.planner.objective(point, context.hit)

    def decode(self, point: Array, context: ReplanHitContext) -> HitPlan:
        """The plan at a point."""
        return self.planner.decode(point, context.hit)
