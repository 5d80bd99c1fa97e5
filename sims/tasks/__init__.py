"""The parts that each task adds to the closed loop and to a run of flights."""
