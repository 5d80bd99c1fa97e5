"""The simulated robots, a folder each; `sims/robot.py` declares their protocols."""
