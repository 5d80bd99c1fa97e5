"""Seeing a ball in flight: cameras, their noise, colour masks, fits of flights, calibration."""
