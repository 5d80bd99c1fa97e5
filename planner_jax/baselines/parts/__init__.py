"""Trajectories in closed form (motion primitives) that several published methods share."""
