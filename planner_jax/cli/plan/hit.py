"""The command `planner-jax plan hit`: one case in which a quadrotor returns a ball to a target."""

import numpy as np
from jaxtyping import PyTree

from planner_jax.cli.plan.answer import Answer, Margin, Single
from planner_jax.cli.plan.settings import SingleHitSettings
from planner_jax.core.origin import to_world


class SingleHit(Single[SingleHitSettings]):
    """One case in which a quadrotor returns a ball with its racket."""

    NAMES = {**Single.NAMES, **{f"{of}{x}": x for of in ("ball.", "ball_") for x in ("pos", "vel")}}

    def case(self) -> PyTree:
        """Make the case of the specified ball and target."""
        given = self.settings
        return self.task.case(given.pos, given.vel, given.target, **given.case_options())

    def contact(self, answer: Answer) -> list[str]:
        """Describe the impact and the ball's landing in one sentence."""
        stroke = answer.plan.stroke
        x, y, z = to_world(np.asarray(stroke.ball_pos), answer.plan.origin)
        before, after = map(float, map(np.linalg.norm, (stroke.ball_vel, stroke.ball_vel_after)))
        lands = float(stroke.time + stroke.flight_time)
        return [
            f"Hit at {float(stroke.time):.3f} s at ({x:.3f}, {y:.3f}, {z:.3f}) m: the ball comes "
            f"at {before:.2f} m/s, leaves at {after:.2f} m/s, and lands at {lands:.3f} s."
        ]

    def task_margins(self, answer: Answer) -> list[Margin]:
        """Return margins: ball's distance from racket, racket's speeds, returned ball's apex."""
        limits, verdict = answer.case.hit_limits, answer.verdict
        end = float(np.sum(answer.plan.trajectory.durations))
        speeds = np.abs(np.asarray(verdict.hitting_velocity))
        off, most = float(verdict.contact_error), float(answer.case.racket_radius)
        found = [Margin("racket's centre to ball [m]", off, most, end)]
        found += [
            Margin(f"hitting speed {axis} [m/s]", float(speed), float(most), end)
            for axis, speed, most in zip("xyz", speeds, limits.hitting_speed, strict=True)
        ]
        apex, rise = float(verdict.apex), float(answer.plan.stroke.ball_vel_after[2])
        at = end + max(rise, 0.0) / float(answer.case.gravity)
        found.append(Margin("apex, least [m]", apex, float(limits.min_apex), at, least=True))
        return [*found, Margin("apex, greatest [m]", apex, float(limits.max_apex), at)]
