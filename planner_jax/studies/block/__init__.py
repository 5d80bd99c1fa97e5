"""Experiments with arms that block balls: cameras, re-planning, and delays by slow planning."""
