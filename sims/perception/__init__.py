"""Observations of thrown balls by a camera, and arms that plan blocks from them."""
