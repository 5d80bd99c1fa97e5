"""Batched, differentiable planning for robots that meet flying objects."""
