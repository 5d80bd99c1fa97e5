"""Figures of a catch run."""
