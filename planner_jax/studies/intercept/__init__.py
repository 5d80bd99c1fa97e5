"""Experiments with interceptions."""
