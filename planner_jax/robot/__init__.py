"""Models of quadrotors, cars and arms: kinematics, limits, readers of files, and plan classes."""
