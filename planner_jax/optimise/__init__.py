"""The batched optimiser, its status codes, scaling and gradients through an optimum."""
