"""Sweeps: seeded cases, planned and refereed in chunks, into one run folder."""
