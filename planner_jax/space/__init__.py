"""Differentiable distances in space between segments, rectangles, boxes and vertical lines."""
