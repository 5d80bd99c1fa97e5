"""Recovery trajectories, which lead from the end of a plan to standstill."""
