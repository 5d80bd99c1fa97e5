"""The least-squares problem of a block: flight of the ball, end poses, and terms of the cost."""
