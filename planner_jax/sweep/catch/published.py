"""Rates that paper 000 publishes (its Tables I and III), by suite.

Those of `throws` are of 50 real throws, planned; the others of 1,000 simulated ones each. The
paper gives no ranges of its scenarios: a suite of the same name is of the same kind, no more.
"""

from typing import NamedTuple


class PublishedRates(NamedTuple):
    """Planning success [%], optimal time ratio, and success of the paper's MPP [%]."""

    success: float | None = None
    time_ratio: float | None = None
    mpp_success: float | None = None


# In the order of `planner_jax.task.catch.suites.SUITES`, whose import would load JAX.
PUBLISHED = {
    "throws": PublishedRates(96.0, 0.092, 14.0),
    "hard": PublishedRates(),
    "parabola1": PublishedRates(99.3, 0.052),
    "parabola2": PublishedRates(98.2, 0.119),
    "harmonic2": PublishedRates(84.7, 0.234),
    "triangle3": PublishedRates(99.7, 0.126),
    "hexagon6": PublishedRates(76.3, 0.458),
}
