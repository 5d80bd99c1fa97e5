"""A ball seen by cameras: noise, colour masks, fits of trajectories, calibration."""
