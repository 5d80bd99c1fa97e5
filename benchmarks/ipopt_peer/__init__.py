"""The problems `HitProblem` and `CatchProblem`, written with CasADi for IPOPT.

`benchmarks.ipopt` uses them to compare the planners with IPOPT.
"""
