"""How far bodies in space are from each other: segments, rectangles, boxes, vertical lines."""
