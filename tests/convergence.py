"""Measurement of the order at which a numerical method converges."""

import numpy as np


def observed_order(steps, errors):
    """Return the exponent p for errors proportional to step^p, by a fit of log(error)."""
    return np.polyfit(np.log(steps), np.log(errors), 1)[0]
