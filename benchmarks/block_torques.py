# Pyright cannot see the names of MuJoCo's compiled module.
# pyright: reportAttributeAccessIssue=false
"""Execute planned blocks in MuJoCo with a heavy shield: `python -m benchmarks.block_torques`.

    python -m benchmarks.block_torques [--num 60] [--seed 977] [--regime R2] [--mass 1.5]

The arm is the IRB 1600 of the library, with a shield of --mass kg that the planner does not know.
MuJoCo's dynamics run in steps of 0.5 ms. A computed-torque controller with the masses of arm and
shield tracks each solved plan, and its torques are cut to the limits of `Drives`. A ball is blocked
if it is inside the shield's edges when it passes the shield's face, which then faces the ball.
"""

import argparse
import dataclasses
import importlib.resources

import mujoco
import numpy as np

import planner_jax as pj
from planner_jax.sims.robots.arm.drives import TORQUES

_STEP = 5e-4  # [s]
_STIFF, _DAMPED = 2500.0, 100.0  # [1/s^2] and [1/s], gains of the controller


def main() -> None:
    """Plan the throws, execute the solved plans, and print one line of results."""
    parser = argparse.ArgumentParser(description="Execute planned blocks in MuJoCo.")
    parser.add_argument("--num", type=int, default=60)
    parser.add_argument("--seed", type=int, default=977)
    parser.add_argument("--regime", default="R2")
    parser.add_argument("--mass", type=float, default=1.5)
    options = parser.parse_args()
    cases = pj.block.draw(options.num, "pole", options.seed, regime=options.regime)
    plans = pj.plan(pj.block.planner(), cases)
    solved = np.flatnonzero(np.asarray(pj.block.judge(cases, plans).success))
    model = _model(options.mass)
    runs = [_execute(model, pj.take(cases, int(k)), pj.take(plans, int(k))) for k in solved]
    shares = np.array([run.share for run in runs])
    off = 1e3 * np.array([run.miss for run in runs])
    print(
        f"{options.regime}, shield of {options.mass:g} kg: {sum(run.hit for run in runs)} of "
        f"{len(runs)} solved plans block the ball; off the shield's middle {np.median(off):.1f} mm "
        f"median, {off.max():.1f} mm at most; greatest torque / limit by joint "
        f"{np.array2string(shares.max(axis=0), precision=2)}"
    )


@dataclasses.dataclass(frozen=True)
class _Run:
    hit: bool
    miss: float  # [m], distance of the ball from the shield's middle when it passes the face
    share: np.ndarray  # (6,), greatest torque of each joint divided by its limit, before the cut


def _model(mass: float) -> mujoco.MjModel:
    file = importlib.resources.files("planner_jax.robot") / "models" / "irb1600.xml"
    spec = mujoco.MjSpec.from_string(file.read_text("utf-8"))
    spec.option.timestep = _STEP
    plate = spec.body("link_6").add_body(name="plate", pos=(0.005, 0.0, 0.0))
    thin, wide = mass * 0.01**2 / 12.0, mass * 0.3**2 / 12.0
    plate.mass, plate.explicitinertial = mass, True
    plate.inertia = (2.0 * wide, wide + thin, wide + thin)
    return spec.compile()


def _execute(model: mujoco.MjModel, case: pj.block.BlockCase, plan: pj.block.BlockPlan) -> _Run:
    data, solver = mujoco.MjData(model), mujoco.MjData(model)
    moved = plan.sample(1.0 / _STEP)
    delay, gravity = float(case.delay), float(case.gravity)
    pos, vel = (np.asarray(x, float) for x in (case.ball.pos, case.ball.vel))
    data.qpos[:], limit, share, before = case.angles, np.array(TORQUES), np.zeros(6), None
    for k in range(int((float(plan.contact_time) + 0.05) / _STEP)):
        time = k * _STEP
        at = min(max(round((time - delay) / _STEP), 0), len(moved.time) - 1)
        is_moving = time >= delay and at < len(moved.time) - 1
        rate, rise = (
            np.asarray(x[at], float) if is_moving else np.zeros(6)
            for x in (moved.rates, moved.accelerations)
        )
        solver.qpos[:], solver.qvel[:] = data.qpos, data.qvel
        lag = np.asarray(moved.angles[at], float) - data.qpos
        solver.qacc[:] = rise + _STIFF * lag + _DAMPED * (rate - data.qvel)
        mujoco.mj_inverse(model, solver)
        share = np.maximum(share, np.abs(solver.qfrc_inverse) / limit)
        data.qfrc_applied[:] = np.clip(solver.qfrc_inverse, -limit, limit)
        mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        face, turn = data.site("shield").xpos, data.site("shield").xmat.reshape(3, 3)
        ball = pos + vel * (time + _STEP) - 0.5 * gravity * (time + _STEP) ** 2 * np.eye(3)[2]
        now = turn.T @ (ball - face)
        if before is not None and before[0] > 0.0 >= now[0]:
            aside = now[1:] + (before[1:] - now[1:]) * now[0] / (now[0] - before[0])
            if np.all(np.abs(aside) < 0.15):
                return _Run(True, float(np.linalg.norm(aside)), share)
        before = now
    return _Run(False, float(np.linalg.norm(before[1:])) if before is not None else np.inf, share)


if __name__ == "__main__":
    main()
