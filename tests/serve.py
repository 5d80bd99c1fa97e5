"""States of served balls, drag constants and helpers for the tests of `planner_jax.ball`."""

import jax
import numpy as np
import pytest

from planner_jax.ball.flight import BallState

GRAVITY, DRAG = 9.8, 0.0616  # [m/s^2], [1/m]
LINEAR_DRAG = np.array([0.4, 0.3, 0.2])  # [1/s]
SERVE_POS, SERVE_VEL = (4.0, 0.5, 2.0), (-6.5, 0.7, 5.5)

float64 = pytest.mark.usefixtures("float64")


def serve(pos=SERVE_POS, vel=SERVE_VEL, dtype=np.float64):
    return BallState(pos=np.array(pos, dtype), vel=np.array(vel, dtype))


def assert_close(a, b, **tolerance):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, **tolerance), a, b)


def pick(tree, k):
    return jax.tree.map(lambda x: x[k], tree)
