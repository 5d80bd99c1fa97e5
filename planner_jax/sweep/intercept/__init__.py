"""Sweeps of interceptions: plan and judge many cases of a car that meets moving targets."""
