"""Figures of a hit run."""
