"""The command `planner-jax plan catch`: one case in which a quadrotor catches balls with a net."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from planner_jax.ball.flight import BallState
from planner_jax.ball.target import BallPath
from planner_jax.cli.plan.answer import Answer, Margin, Single
from planner_jax.cli.plan.settings import SingleCatchSettings
from planner_jax.core import GRAVITY
from planner_jax.core.origin import to_world
from planner_jax.core.protocol import take


class SingleCatch(Single[SingleCatchSettings]):
    """One case in which a quadrotor catches one ball, or several balls one after another."""

    NAMES = {**Single.NAMES, **{f"net.{name}": f"net_{name}" for name in ("height", "radius")}}

    def case(self) -> PyTree:
        """Make the case of the specified balls, all to be caught before the time `horizon`."""
        given = self.settings
        balls: PyTree = np.asarray(given.balls, float)  # (N, 2, 3)
        num = len(balls)
        pull = GRAVITY if given.gravity is None else given.gravity
        path = BallPath(
            ball=BallState(balls[:, 0], jnp.asarray(balls[:, 1], jnp.float32)),
            drag=jnp.full((num, 3), given.drag or 0.0, jnp.float32),
            gravity=jnp.full(num, pull, jnp.float32),
        )
        return self.task.case(path, np.full(num, given.horizon), **given.case_options())

    def contact(self, answer: Answer) -> list[str]:
        """Describe each catch in a sentence: time, position, speed, distance from net's centre."""
        lines, targets, verdict = [], answer.case.targets, answer.verdict
        numbers = (answer.plan.order, verdict.catch_times, verdict.net_distance)
        for target, time, away in zip(*map(np.asarray, numbers), strict=True):
            ball = take(targets, int(target)).at(jnp.asarray(time, jnp.float32))
            x, y, z = to_world(np.asarray(ball.pos), answer.plan.origin)
            which = f"Ball {target + 1} caught" if len(targets.gravity) > 1 else "Caught"
            off = 1e3 * float(away)
            lines.append(
                f"{which} at {time:.3f} s at ({x:.3f}, {y:.3f}, {z:.3f}) m, flying at "
                f"{float(np.linalg.norm(ball.vel)):.2f} m/s, {off:.1f} mm from the net's centre."
            )
        return lines

    def task_margins(self, answer: Answer) -> list[Margin]:
        """Return the margins of the catches: time, net angle, ball's distance from net's centre."""
        net, verdict = answer.case.net, answer.verdict
        times = np.asarray(verdict.catch_times)
        horizons = np.asarray(answer.case.horizon)[np.asarray(answer.plan.order)]
        limits = [
            ("net's centre to ball [m]", np.asarray(verdict.net_distance), float(net.radius)),
            ("angle of the net [rad]", np.asarray(verdict.angle), float(net.max_angle)),
            ("time of the catch [s]", times, float(horizons[0])),
        ]
        found = []
        for words, values, allowed in limits:
            at = int(np.argmax(np.nan_to_num(values, nan=-np.inf)))
            found.append(Margin(words, float(values[at]), allowed, float(times[at])))
        return found
