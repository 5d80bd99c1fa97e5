"""Trajectories to standstill that follow the end of a plan."""
