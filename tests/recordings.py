"""An invented recording of one flight, for the tests of pictures and the flight viewer."""

import numpy as np

from planner_jax.sims.recording import Recording


def recording(num=6, met=0.04, target=(np.nan,) * 3):
    time = 0.01 * np.arange(num)
    pos = np.stack([0.0 * time, 0.0 * time, 1.0 + time], axis=1)
    pos[-1] = np.nan
    ball = np.stack([0.5 - 10.0 * time, 0.0 * time, 2.0 - time], axis=1)
    ball[time > met] = np.nan
    return Recording(
        index=np.array([3]),
        success=np.array([True]),
        time=time[None],
        robot=np.concatenate([pos, np.tile([1.0, 0.0, 0.0, 0.0], (num, 1))], axis=1)[None],
        wanted=pos[None] + 0.01,
        balls=ball[None, :, None],
        met=np.array([[met]]),
        contact=np.array([[[0.1, 0.0, 1.96]]]),
        target=np.array([target]),
        expected=np.zeros((1, num, 0, 3)),
    )
