"""The order at which a numerical method converges, as it is observed."""

import numpy as np


def observed_order(steps, errors):
    """Slope of log error over log step: p for a method whose error is proportional to step^p."""
    return np.polyfit(np.log(steps), np.log(errors), 1)[0]
