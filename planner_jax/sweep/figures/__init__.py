"""Parts that the figures of all tasks share; every figure is drawn from a run's folder alone."""
