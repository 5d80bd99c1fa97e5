"""A slow, independent solver of hits, by direct transcription with IPOPT.

It tells infeasible cases from failures of a planner. `benchmarks.oracle_hit` runs it.
"""
