"""Experiments with arms that block balls: camera observations, repeated and timed planning."""
