"""Predictions of where a target in the plane will be, from noisy observations of its position."""
