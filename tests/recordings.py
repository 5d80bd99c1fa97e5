"""A recording of one flight that was never flown, for the tests of pictures and viewer."""

import numpy as np

from planner_jax.sims.recording import Recording


def recording(looks=6, met=0.04, target=(np.nan,) * 3):
    """A quadrotor that rises at 1 m/s while a ball falls from the side; looks 10 ms apart.

    The ball is met in the second half, and the quadrotor's record ends a look early.
    """
    time = 0.01 * np.arange(looks)
    pos = np.stack([0.0 * time, 0.0 * time, 1.0 + time], axis=1)
    pos[-1] = np.nan
    ball = np.stack([0.5 - 10.0 * time, 0.0 * time, 2.0 - time], axis=1)
    ball[time > met] = np.nan
    return Recording(
        index=np.array([3]),
        success=np.array([True]),
        time=time[None],
        robot=np.concatenate([pos, np.tile([1.0, 0.0, 0.0, 0.0], (looks, 1))], axis=1)[None],
        wanted=pos[None] + 0.01,
        balls=ball[None, :, None],
        met=np.array([[met]]),
        contact=np.array([[[0.1, 0.0, 1.96]]]),
        target=np.array([target]),
        expected=np.zeros((1, looks, 0, 3)),
    )
