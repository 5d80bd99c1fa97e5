"""Models of quadrotors, cars and arms: kinematics, limits, robots from files, and plans."""
