"""Plans of quadrotor, car and arm from random numbers, and readers of exported files."""

import io
import warnings

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

import planner_jax as pj
from planner_jax.robot.arm import ArmPlan
from planner_jax.robot.car import CarPlan
from planner_jax.robot.quadrotor import QuadrotorPlan

FLOAT = np.float32
SOLVED = {
    "cost": FLOAT(2.5),
    "violation": FLOAT(-0.25),
    "iterations": np.int32(7),
    "status": np.int32(pj.Status.CONVERGED),
}


def pieces(num, powers, axes, seed=0, duration=0.2):
    """Return random pieces whose positions and velocities are continuous, up to rounding."""
    draw = np.random.default_rng(seed)
    coeffs = 6.0 * draw.normal(size=(num, powers, axes)) / 2.0 ** np.arange(powers)[:, None]
    durations = np.full(num, duration) + 0.01 * np.arange(num)
    for k in range(1, num):
        for axis in range(axes):
            piece = np.polynomial.Polynomial(coeffs[k - 1, :, axis])
            coeffs[k, :2, axis] = piece(durations[k - 1]), piece.deriv()(durations[k - 1])
    return pj.PiecewisePolynomial(coeffs=coeffs.astype(FLOAT), durations=durations.astype(FLOAT))


def quadrotor(num=2, powers=8, seed=0):
    return QuadrotorPlan(
        **SOLVED, trajectory=pieces(num, powers, 3, seed), gravity=np.asarray(9.81, FLOAT)
    )


def car():
    knots = np.arange(5, dtype=FLOAT)
    return CarPlan(
        **SOLVED,
        start=np.array([1.0, -2.0, 0.5], FLOAT),
        time=np.asarray(0.4, FLOAT),
        speed=2.0 + 0.25 * knots,
        curvature=FLOAT(0.1) * knots - FLOAT(0.2),
        origin=np.zeros(2, FLOAT),
    )


def arm():
    return ArmPlan(**SOLVED, motion=pieces(2, 4, 6, seed=1))


PLANS = {"quadrotor": quadrotor(), "car": car(), "arm": arm()}


def export_plan(plan, **options):
    """Export a plan without a recovery trajectory, which would need the limits of a case."""
    with warnings.catch_warnings():  # of an arm that does not end at standstill
        warnings.simplefilter("ignore", UserWarning)
        return pj.export(plan, recovery=None, **options)


def table(path):
    """Return the column names of a CSV file, and its numbers as a float64 array (rows, columns)."""
    lines = path.read_text().splitlines()
    header, *rows = (line for line in lines if not line.startswith("#"))
    return header.split(","), np.array([row.split(",") for row in rows], float)


def bag(path):
    """Return an MCAP file's profile, and (schema, channel, record, message) of each message."""
    reader = make_reader(io.BytesIO(path.read_bytes()), decoder_factories=[DecoderFactory()])
    return reader.get_header().profile, list(reader.iter_decoded_messages())


def matrices(quat_wxyz):
    """Return the rotations (K, 3, 3), body to world, of unit quaternions (K, 4)."""
    w, x, y, z = np.asarray(quat_wxyz, float).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)
