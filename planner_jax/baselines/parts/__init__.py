"""Motion primitives that several published methods share."""
