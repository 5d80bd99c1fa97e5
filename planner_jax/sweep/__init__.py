"""Sweeps: thousands of scenarios planned and refereed in chunks, into one run folder."""
