"""The simulated robots, one folder each; `sims/robot.py` declares the protocol that they follow."""
