"""Benchmarks of the planners: programs that measure speed, success and cost of plans.

Each module with a function `main` is a program, run as `python -m benchmarks.NAME`.
"""
