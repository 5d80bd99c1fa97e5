"""A ball seen by cameras: noise of the observations, and fits of trajectories."""
