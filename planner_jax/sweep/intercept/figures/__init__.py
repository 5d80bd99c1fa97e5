"""Figures of an intercept run."""
