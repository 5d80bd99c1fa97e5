"""A C++ program that plans catches of one ball: the problem of the baseline `PaperCatch`.

`benchmarks.catch_reference` compares the planners with it. It has its own L-BFGS and BFGS.
"""
