"""The sweep of hits: a quadrotor returns served balls with its racket."""
