"""Verdicts of referees, compared."""

import numpy as np


def assert_same(a, b, lanes=slice(None)):
    """Two verdicts say the same, numbers to rounding."""
    for name, left in vars(a).items():
        right = getattr(b, name)
        if left.dtype.kind == "f":
            np.testing.assert_allclose(left[lanes], right[lanes], rtol=1e-12, atol=1e-12)
        else:
            np.testing.assert_array_equal(left[lanes], right[lanes], err_msg=name)
