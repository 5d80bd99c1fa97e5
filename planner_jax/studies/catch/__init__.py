"""Experiments with catches."""
