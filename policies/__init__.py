"""Learned policies over the planner: Brax environments, Flax networks and their training."""
