"""Distances between segments, rectangles, boxes and vertical lines in space."""
