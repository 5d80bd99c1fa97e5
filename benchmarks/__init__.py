"""Measurements of speed, success and cost.

Each module with a `main` is a benchmark of the planners, run as `python -m benchmarks.NAME`.
"""
