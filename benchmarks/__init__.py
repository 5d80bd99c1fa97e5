"""Measurements of speed, success and cost."""
