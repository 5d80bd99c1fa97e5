"""Limits of trajectories, penalties for exceeding them, and their integrals over time."""
