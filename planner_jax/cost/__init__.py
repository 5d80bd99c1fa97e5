"""Penalty shapes, limits and contact: short pure functions."""
