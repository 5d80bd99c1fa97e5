"""The command `planner-jax plan block`: one thrown ball that an arm blocks with its shield."""

import jax
import numpy as np
from jaxtyping import PyTree

from planner_jax.cli.plan.answer import Answer, Margin, Single, closest_to
from planner_jax.cli.plan.settings import SingleBlockSettings
from planner_jax.runs.manifest import Entries
from planner_jax.task.block.case import case
from planner_jax.task.block.explain import prospects
from planner_jax.task.block.suites import scene_for

_RATE = 4000.0  # [Hz], rate of the samples that are compared with the limits


class SingleBlock(Single[SingleBlockSettings]):
    """One case in which an arm blocks a ball with its shield."""

    NAMES = {"ball.pos": "pos", "ball.vel": "vel", "ball_pos": "pos", "ball_vel": "vel"}

    def case(self) -> PyTree:
        """Make the case of the specified ball."""
        given = self.settings
        own: Entries = {"regime": given.regime} | given.arm_options()
        own.setdefault("scene", scene_for(own.get("arm"), has_pole=not given.no_pole))
        return case(given.pos, given.vel, delay=given.delay, wide=given.wide, **own)

    def contact(self, answer: Answer) -> list[str]:
        """Describe the contact of ball and shield in one sentence."""
        verdict, end = answer.verdict, answer.plan.sample(_RATE).angles[-1]
        return [
            f"Blocked at {float(verdict.contact_time):.3f} s, {1e3 * float(verdict.miss):.1f} mm "
            f"from the shield's middle; the arm moves for {float(verdict.execution_time):.3f} s, "
            f"to the angles {np.array2string(end, precision=3)} rad."
        ]

    def describe(self, answer: Answer) -> list[str]:
        """Describe the answer, and the reason if the ball is not blocked, in lines of text."""
        lines = super().describe(answer)
        if not answer.success:
            lines.insert(1, f"Prospects: {prospects(answer.case).sentence()}.")
        meshes = answer.case.scene.meshes
        for k, (most, mean) in enumerate([] if meshes is None else 1e3 * meshes.excess, 1):
            lines.append(
                f"The planner's solids around mesh {k} exceed its hull by {most:.1f} mm at "
                f"most, {mean:.1f} mm on average."
            )
        return lines

    def task_margins(self, answer: Answer) -> list[Margin]:
        """Return how close the joints come to their limits, and the ball to the shield's edge."""
        limits, names = answer.case.limits, answer.case.arm.joint_names
        moved = answer.plan.sample(_RATE)
        times = float(answer.case.delay) + moved.time
        margins = [
            closest_to(times, f"{joint} [{unit}]", values, allowed)
            for unit, sampled, most in (
                ("rad/s", moved.rates, limits.velocity),
                ("rad/s^2", moved.accelerations, limits.acceleration),
            )
            for joint, values, allowed in zip(names, np.abs(sampled).T, most, strict=True)
        ]
        miss, allowed = float(answer.verdict.miss), float(answer.case.offset)
        words = "ball from the shield's middle [m]"
        return [Margin(words, miss, allowed, float(answer.plan.contact_time)), *margins]

    def margins(self, answer: Answer) -> list[Margin]:
        """Return how close the plan comes to each limit of the arm."""
        return self.task_margins(answer)

    def play(self, answer: Answer) -> None:
        """Serve a 3-D view of ball and arm to a browser until Ctrl-C, if `view` is set."""
        given = self.settings
        if given.view:
            from planner_jax.sims.block_settings import BlockFly
            from planner_jax.sims.tasks.block_flights import Throws, follow_plans
            from planner_jax.sims.view import Viewer

            own = {name: vars(given)[name] for name in ("arm", "tip", "shield", "scene")}
            task = BlockFly(num=1, suite="open" if given.no_pole else "pole", **own).flight()
            cases, plans = (
                jax.tree.map(lambda leaf: np.asarray(leaf)[None], each)
                for each in (answer.case, answer.plan)
            )
            flights = follow_plans(cases, plans)
            viewer = Viewer(
                task, task.recording(Throws(np.zeros(1, int), cases), flights, [0]), port=0
            )
            print(f"Playing the plan at {viewer.url}; Ctrl-C stops.", flush=True)
            viewer.run()
