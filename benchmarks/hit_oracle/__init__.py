"""A slow, independent solver of hits: a nonlinear program for IPOPT by direct transcription.

It shows whether a case that a planner does not solve is infeasible. `benchmarks.oracle_hit` runs
it.
"""
