"""The simulated robots, a folder each; what is asked of one is said in `sims/robot.py`."""
