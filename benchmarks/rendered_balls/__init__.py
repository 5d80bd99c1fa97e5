"""Balls found in rendered images: a camera beside the arm, its calibration, and a colour mask.

`benchmarks.block_perception` compares the positions from images with the noise model of a camera,
`sims.perception.noise`, by which simulated flights observe their balls.
"""
