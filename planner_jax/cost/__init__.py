"""Penalties, limits, quadrature along a trajectory, and contact."""
