"""Experiments with blocks."""
