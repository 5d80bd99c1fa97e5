"""Factors on a robot's limits; imports no JAX."""

SCALES = (1e-3, 1e3)  # beyond these, limits are no longer those of a machine


def scale_problem(value: float) -> str | None:
    """What is wrong with a factor, a sentence without its end, or None."""
    least, most = SCALES
    if least <= value <= most:
        return None
    return f"limit_scale must be from {least:g} to {most:g}, got {value:g}"
