"""Fly plans of quadrotors in RotorPy, another simulator with its own robots and controller.

    python -m benchmarks.flown_by_rotorpy [--num 10] [--seed 0] [--out DIR]

For each robot, hits and catches with a recovery to standstill are planned, and flown from start to
standstill by controllers. "SE3" is RotorPy's `SE3Control` unchanged [Lee2010], with position,
velocity and acceleration of the plan and with yaw 0. Its attitude lags, because it has no
feed-forward of the body rate; "SE3, ahead" passes it the acceleration of the plan 0.1 s later.
"feed-forward" has the same gains, and follows the plan's thrust, attitude and body rate. The table
has the distance from the plan at the contact, its greatest value in the recovery, how many
recoveries stay within 20 cm, and in how many flights a rotor saturates. Robots are RotorPy's
Hummingbird and Crazyflie Brushless, and the Agilicious quadrotor of 0.752 kg [Foehn2022]; tools and
limits are assumptions. RotorPy's aerodynamics are off, or on with a wind of 0 or 3 m/s along x.
Then plans know the wind, and the drag that `pj.fit_drag` finds in a log of another flight in
RotorPy. RotorPy is in the extra `peers`.
"""

import dataclasses
import importlib
import importlib.util
import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import planner_jax as pj
from planner_jax.benchmarks.run import argument_parser, begin
from planner_jax.core import GRAVITY
from planner_jax.robot.quadrotor_model import (
    FlightLimits,
    QuadrotorModel,
    RotorDrag,
    Rotors,
    Tool,
)

RATE = 500.0  # [Hz], of setpoints, controllers and simulation
NEAR = 0.2  # [m], greatest distance from the plan of a recovery that counts as flown
AHEAD = 0.1  # [s], from a setpoint's time to the time of its acceleration, of "SE3, ahead"
# The Agilicious quadrotor in the names of RotorPy: differences from its Hummingbird.
_AGILICIOUS = {
    **{"mass": 0.752, "Ixx": 2.5e-3, "Iyy": 2.1e-3, "Izz": 4.3e-3, "tau_m": 0.033},
    **{"k_eta": 1.562522e-6, "k_m": 0.022 * 1.562522e-6, "rotor_speed_max": 2332.0},
    "rotor_pos": {
        f"r{k}": np.array([0.075 * x, 0.1 * y, 0.0])
        for k, (x, y) in enumerate(((1, 1), (1, -1), (-1, -1), (-1, 1)), 1)
    },
}


def robots() -> dict[str, tuple[dict[str, Any], float]]:
    """Return RotorPy's parameters, and the greatest speed [m/s], of each robot by name."""
    hummingbird, brushless = (
        importlib.import_module(f"rotorpy.vehicles.{name}_params").quad_params
        for name in ("hummingbird", "crazyfliebrushless")
    )
    return {
        "Hummingbird": (hummingbird, 5.0),
        "Crazyflie Brushless": (brushless, 3.0),
        "Agilicious": (hummingbird | _AGILICIOUS, 5.0),
    }


def model_of(name: str, params: dict[str, Any], speed: float, tool: Tool) -> QuadrotorModel:
    """Return the quadrotor with a massless tool that RotorPy's parameters describe."""
    places: Any = tuple(tuple(map(float, params["rotor_pos"][f"r{k}"][:2])) for k in (1, 4, 3, 2))
    rotors = Rotors(
        places=places,
        max_thrust=params["k_eta"] * params["rotor_speed_max"] ** 2,
        torque_ratio=params["k_m"] / params["k_eta"],
        lag=params["tau_m"],
    )
    inertia = (params["Ixx"], params["Iyy"], params["Izz"])
    limits = FlightLimits(speed=speed, body_rate=6.0)
    return QuadrotorModel(name, params["mass"], inertia, rotors, tool, limits)


def identify_drag(params: dict[str, Any]) -> RotorDrag:
    """Return the drag that `pj.fit_drag` finds in a log of RotorPy's own controller in still air.

    The flight of 12 s is along a Lissajous curve of 1.5 m that rises and falls by 0.5 m.
    """
    control, vehicles, curves = (
        importlib.import_module(f"rotorpy.{name}")
        for name in (
            *("controllers.quadrotor_control", "vehicles.multirotor"),
            "trajectories.lissajous_traj",
        )
    )
    peer, curve = control.SE3Control(params), curves.TwoDLissajous(1.5, 1.5, 1.6, 2.4, height=2.0)
    state = {"x": curve.update(0.0)["x"], "v": np.zeros(3), "q": np.array([0.0, 0.0, 0.0, 1.0])}
    state |= {"w": np.zeros(3), "wind": np.zeros(3), "rotor_speeds": hover_speeds(params)}
    vehicle, log = vehicles.Multirotor(params, state, "cmd_motor_speeds", aero=True), []
    for time in np.arange(0.0, 12.0, 1.0 / RATE):
        flat, phase = curve.update(time), 2.9 * time
        heights = (np.sin(phase), 2.9 * np.cos(phase), -(2.9**2) * np.sin(phase))
        for name, height in zip(("x", "x_dot", "x_ddot"), heights, strict=True):
            flat[name] = np.asarray(flat[name], float) + [0.0, 0.0, 0.5 * height]
        log.append((time, state["q"], state["rotor_speeds"], state["v"]))
        state = vehicle.step(state, peer.update(time, state, flat), 1.0 / RATE)
    times, quats, speeds, velocities = (np.array(each) for each in zip(*log, strict=True))
    thrusts = params["k_eta"] * np.sum(speeds**2, axis=1) / params["mass"]
    return pj.fit_drag(times, quats[:, [3, 0, 1, 2]], thrusts, velocities=velocities)[0]


def hover_speeds(params: dict[str, Any]) -> np.ndarray:
    """Return the speeds (4,) [rad/s] of the rotors of a robot at hover."""
    return np.full(4, np.sqrt(0.25 * params["mass"] * GRAVITY / params["k_eta"]))


def track(own: Any, state: dict[str, np.ndarray], at: SimpleNamespace) -> np.ndarray:
    """Return thrusts (4,) [N] of RotorPy's rotors that track a setpoint.

    The gains of the `SE3Control` in `own` correct the thrust, attitude and body rate of the
    setpoint `at`.
    """
    planned = Rotation.from_quat(at.quat_xyzw).as_matrix()
    back = own.kp_pos * (at.pos - state["x"]) + own.kd_pos * (at.vel - state["v"])
    force = at.thrust * planned[:, 2] + back
    axis = force / np.linalg.norm(force)
    x, y, z = np.cross(planned[:, 2], axis)
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # The wanted attitude is the plan's, after the shortest rotation of its thrust to the force.
    wanted = planned + (skew + skew @ skew / (1.0 + planned[:, 2] @ axis)) @ planned
    R, rate = Rotation.from_quat(state["q"]).as_matrix(), state["w"]
    apart = 0.5 * (wanted.T @ R - R.T @ wanted)
    error = np.array([apart[2, 1], apart[0, 2], apart[1, 0]])
    turning = at.turning - own.kp_att * error - own.kd_att * (rate - R.T @ wanted @ at.rate)
    torque = own.inertia @ turning + np.cross(rate, own.inertia @ rate)
    return own.TM_to_f @ np.append(own.mass * force @ R[:, 2], torque)


def fly(plan: Any, params: dict[str, Any], controller: str, wind: float | None) -> dict[str, float]:
    """Fly one plan in RotorPy by a controller of the table; wind None: no aerodynamics.

    Returns the distance from the plan at the contact, its greatest value in the recovery [m], and
    the share of control steps in which a rotor saturates.
    """
    multirotor = importlib.import_module("rotorpy.vehicles.multirotor").Multirotor
    peer = importlib.import_module("rotorpy.controllers.quadrotor_control").SE3Control(params)
    points, lag = plan.sample(RATE), params["tau_m"]
    quats = points.quat_wxyz[:, [1, 2, 3, 0]]
    # A lag of the rotors is compensated by thrusts and angular accelerations from ahead in time.
    thrusts = points.thrust + lag * np.gradient(points.thrust, 1.0 / RATE)
    ahead = np.minimum(np.arange(len(quats)) + round(lag * RATE), len(quats) - 1)
    turning = np.gradient(points.body_rate, 1.0 / RATE, axis=0)[ahead]
    state = {"x": points.pos[0], "v": points.vel[0], "q": quats[0], "w": np.zeros(3)}
    state["wind"] = np.array([wind or 0.0, 0.0, 0.0])
    state["rotor_speeds"] = hover_speeds(params)
    vehicle = multirotor(params, state, "cmd_motor_thrusts", aero=wind is not None)
    most = params["k_eta"] * params["rotor_speed_max"] ** 2
    later = np.arange(len(quats)) + (round(AHEAD * RATE) if controller == "SE3, ahead" else 0)
    accs = points.acc[np.minimum(later, len(quats) - 1)]
    apart, saturated = np.zeros(len(quats)), np.zeros(len(quats), bool)
    for k, (pos, vel, acc) in enumerate(zip(points.pos, points.vel, accs, strict=True)):
        apart[k] = np.linalg.norm(state["x"] - pos)
        if controller != "feed-forward":
            flat = {"x": pos, "x_dot": vel, "x_ddot": acc, "yaw": 0.0, "yaw_dot": 0.0}
            forces = peer.update(points.time[k], state, flat)["cmd_motor_thrusts"]
        else:
            at = SimpleNamespace(pos=pos, vel=vel, quat_xyzw=quats[k], thrust=thrusts[k])
            at.rate, at.turning = points.body_rate[k], turning[k]
            forces = track(peer, state, at)
        saturated[k] = (forces < 0.0).any() or (forces > most).any()
        state = vehicle.step(state, {"cmd_motor_thrusts": forces}, 1.0 / RATE)
    contact = np.searchsorted(points.time, float(np.sum(plan.trajectory.durations)))
    recovery = apart[contact:].max(initial=0.0)
    return {"contact": apart[contact], "recovery": recovery, "saturated": saturated.mean()}


def main() -> None:
    parser = argument_parser("flown_by_rotorpy", __doc__, num=10, seed=0)
    options = parser.parse_args()
    if importlib.util.find_spec("rotorpy") is None:
        parser.exit(0, "RotorPy is not installed (pip install 'planner-jax[peers]'): no flights.\n")
    tasks = {
        "hit": (pj.hit, Tool("racket", 0.06, 0.11)),
        "catch": (pj.catch, Tool("net", 0.1, 0.1)),
    }
    with begin(parser, options) as bench:
        bench.say(
            "| robot, task, air, controller | flights | contact, mean cm | contact, max cm "
            "| recovery, max cm | recoveries within 20 cm | flights that saturate |",
            "|---|---|---|---|---|---|---|",
        )
        drags = {name: identify_drag(params) for name, (params, _) in robots().items()}
        for name, drag in drags.items():
            bench.row(robot=name, across=drag.across, along=drag.along)
        for name, task, wind in itertools.product(robots(), tasks, (None, 0.0, 3.0)):
            (params, speed), (module, tool) = robots()[name], tasks[task]
            robot, blown = model_of(name, params, speed, tool), None
            if wind is not None:
                robot, blown = dataclasses.replace(robot, drag=drags[name]), (wind, 0.0, 0.0)
            cases = module.draw(options.num, seed=options.seed, robot=robot, wind=blown)
            plans = pj.plan(module.planner(recovery="brake"), cases)
            good = np.asarray(module.judge(cases, plans).success)
            bench.count(good)
            for controller in ("feed-forward", "SE3", "SE3, ahead")[: 3 if wind is None else 1]:
                some = [pj.take(plans, k) for k in np.flatnonzero(good)]
                flights = [fly(each, params, controller, wind) for each in some]
                contact, recovery, saturated = (
                    np.array([each[key] for each in flights])
                    for key in ("contact", "recovery", "saturated")
                )
                of = {"contact": contact, "recovery": recovery, "saturated": saturated}
                bench.row(robot=name, task=task, wind=wind, controller=controller, **of)
                air = "off" if wind is None else f"wind {wind:g} m/s"
                bench.say(
                    f"| {name}, {task}, {air}, {controller} | {len(some)} "
                    f"| {100 * contact.mean():.2f} | {100 * contact.max():.2f} "
                    f"| {100 * recovery.max():.1f} | {(recovery <= NEAR).sum()} "
                    f"| {(saturated > 0).sum()} |"
                )


if __name__ == "__main__":
    main()
