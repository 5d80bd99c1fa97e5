"""The problems of the planners `ExactHit` and `ExactCatch`, written with CasADi for IPOPT.

`benchmarks.ipopt` uses them to compare the planners with IPOPT.
"""
