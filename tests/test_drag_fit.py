"""Drag of the rotors from logs: noise, outliers, gaps, positions, and another simulator's log."""

import dataclasses
import importlib
import importlib.util

import numpy as np
import pytest

import planner_jax as pj
from planner_jax.core.errors import ArgumentError, ArgumentTypeError

GRAVITY, WIND = 9.81, np.array([1.0, -0.5, 0.2])
NAMES = ("times", "attitudes", "thrusts", "velocities", "positions")


def fly(seed=0, across=0.3, along=0.5, duration=20.0, rate=100.0):
    """Return a log of a flight along sums of sines, without noise."""
    random, t = np.random.default_rng(seed), np.arange(0.0, duration, 1.0 / rate)[:, None]
    pos, vel, acc = np.zeros((3, len(t), 3))
    for _ in range(4):
        turn, start = random.uniform(1.2, 5.0, 3), random.uniform(0.0, 6.3, 3)
        size = np.array([1.8, 1.8, 1.1]) / turn
        pos += size * np.sin(turn * t + start)
        vel += size * turn * np.cos(turn * t + start)
        acc -= size * turn**2 * np.sin(turn * t + start)
    pull = acc + across * (vel - WIND) + [0.0, 0.0, GRAVITY]
    length = np.linalg.norm(pull, axis=1)
    axis = pull / length[:, None]
    thrust = length + (along - across) * np.sum(axis * (vel - WIND), axis=1)
    return dict(zip(NAMES, (t[:, 0], axis, thrust, vel, pos), strict=True))


def fit(log, without="positions", **changed):
    return pj.fit_drag(**{k: x for k, x in (log | changed).items() if k != without}, wind=WIND)


@pytest.mark.parametrize("without", ["positions", "velocities"])
def test_a_log_without_noise_has_the_drag_of_the_flight_also_from_quaternions(without):
    log = fly()
    found = dataclasses.astuple(fit(log, without)[0])
    np.testing.assert_allclose(found, (0.3, 0.5), rtol=1e-3)
    x, y, z = log["attitudes"].T
    quats = np.stack([1.0 + z, -y, x, 0.0 * z], axis=1)  # not normalised
    np.testing.assert_allclose(
        dataclasses.astuple(fit(log, without, attitudes=quats)[0]), found, rtol=1e-9
    )


def spoil(log, seed):
    """Return a log with noise, outliers, a wrong scale of the thrust, and a fifth of it missing."""
    random, num = np.random.default_rng(seed), len(log["times"])
    noise = {"attitudes": 0.01, "velocities": 0.03, "positions": 0.002, "thrusts": 0.2}
    log = {k: x + noise.get(k, 0.0) * random.normal(size=x.shape) for k, x in log.items()}
    log["velocities"][random.random(num) < 0.03] += 2.0
    log["thrusts"] *= 1.05
    keep = np.sort(random.choice(num, 4 * num // 5, replace=False))
    return {name: array[keep] for name, array in log.items()}


@pytest.mark.parametrize("without", ["positions", "velocities"])
def test_standard_deviations_hold_with_noise_outliers_and_missing_samples(without):
    off = []
    for seed in range(12):
        drag, std = fit(spoil(fly(seed), seed), without)
        found, errors = map(dataclasses.astuple, (drag, std))
        assert max(errors) < 0.06
        off.append((np.array(found) - (0.3, 0.5)) / errors)
    assert np.mean(np.abs(off) < 2.5) > 0.85


def test_a_log_that_does_not_determine_the_drag_or_is_malformed_is_an_error_of_one_line():
    log = fly(duration=6.0)
    still = {"velocities": 0.0 * log["velocities"] + WIND}
    broken = log["thrusts"].copy()
    broken[7] = np.nan
    for changed, rule in (
        (still, "velocities must be of a flight that moves across and along the thrust"),
        ({"times": log["times"][::-1]}, "times must be increasing"),
        ({"times": 0.1 * log["times"]}, "times must be of 10 windows of 0.5 s"),
        ({"thrusts": broken}, "thrusts must be finite"),
        ({"thrusts": log["thrusts"][1:]}, r"thrusts must have the shape \(\) or \(600,\)"),
        ({"attitudes": log["attitudes"][:, :2]}, "attitudes must have the shape"),
    ):
        with pytest.raises(ArgumentError, match=f"^{rule}") as raised:
            fit(log, **changed)
        assert "\n" not in str(raised.value)
    with pytest.raises(ArgumentTypeError, match="^velocities must be numbers, got None"):
        fit(log, velocities=None)
    with pytest.raises(ArgumentError, match="^velocities must be left out beside positions"):
        fit(log, without="nothing")


@pytest.mark.skipif(importlib.util.find_spec("rotorpy") is None, reason="RotorPy is not installed")
def test_the_drag_of_a_log_of_rotorpy_is_near_the_drag_of_its_rotors_at_hover():
    of = {k: importlib.import_module(f"rotorpy.{name}") for k, name in ROTORPY.items()}
    params = of["params"].quad_params
    control = of["control"].SE3Control(params)
    path = of["path"].TwoDLissajous(A=2.0, B=1.5, a=1.6, b=2.4, height=2.0)
    speed = np.sqrt(0.25 * params["mass"] * GRAVITY / params["k_eta"])
    state = {"x": path.update(0.0)["x"], "v": np.zeros(3), "q": np.array([0.0, 0.0, 0.0, 1.0])}
    state |= {"w": np.zeros(3), "wind": WIND, "rotor_speeds": np.full(4, speed)}
    vehicle = of["vehicle"].Multirotor(params, state, "cmd_motor_speeds", aero=True)
    rows = []
    for k in range(5000):
        rows.append([0.002 * k, state["q"], state["rotor_speeds"], state["v"]])
        command = control.update(0.002 * k, state, path.update(0.002 * k))
        state = vehicle.step(state, command, 0.002)
    times, quats, speeds, velocities = (np.array(each) for each in zip(*rows, strict=True))
    thrusts = params["k_eta"] * (speeds**2).sum(axis=1) / params["mass"]
    drag, _ = pj.fit_drag(times, quats[:, [3, 0, 1, 2]], thrusts, velocities=velocities, wind=WIND)
    at_hover = 4.0 * speed * params["k_d"] / params["mass"]
    assert drag.across == pytest.approx(at_hover, rel=0.25)


ROTORPY = {
    "params": "vehicles.hummingbird_params",
    "control": "controllers.quadrotor_control",
    "path": "trajectories.lissajous_traj",
    "vehicle": "vehicles.multirotor",
}
