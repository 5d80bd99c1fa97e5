"""Models of quadrotors, cars and arms: flatness, kinematics and limits."""
