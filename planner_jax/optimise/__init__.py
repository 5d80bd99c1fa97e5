"""Batched L-BFGS, Newton and least-squares solvers, scaling, and gradients of an optimum."""
