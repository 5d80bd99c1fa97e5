"""Predictions of targets in the plane from noisy observations."""
