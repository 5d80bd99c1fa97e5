"""Learned decisions: Brax environments, Flax networks and their training."""
