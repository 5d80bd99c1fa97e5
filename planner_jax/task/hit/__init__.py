"""A quadrotor hits a ball to a target with a racket (paper 002)."""
